"""The SQLite file of a journal: how it is opened and locked, and how damage to it is found.

SQLite writes ahead (WAL): a commit is one append to ``journal.sqlite-wal``, which takes some
microseconds and survives the death of the process. A log that is removed, cut, or left behind when
the journal is copied would take the last steps with it, and SQLite would not notice. So
``journal.sqlite-count`` holds the number of records that were written: a journal with fewer has
lost some. Both files are removed when the journal is closed.

Each row has a checksum over its content and its key, so that a damaged or misplaced row is found.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import os
import shutil
import sqlite3
import struct
import tempfile
import weakref
from pathlib import Path
from typing import Literal, TypeAlias

from holdfast.errors import OutputError

__all__ = [
    "JOURNAL_NAME",
    "START_ANEW",
    "FileIdentity",
    "JournalFile",
    "RowChecksum",
    "StepCount",
    "Survives",
    "boot_id",
    "find_journal",
    "is_named",
    "meta_checksum",
    "of_steps",
    "of_trials",
    "open_here",
    "synchronize_directory",
]

JOURNAL_NAME = "journal.sqlite"

Survives: TypeAlias = Literal["process_crash", "power_cut"]
"""What a journalled step survives; see :class:`holdfast.planning.settings.RecoverySettings`."""

FileIdentity: TypeAlias = tuple[int, int]
"""Device and inode."""

START_ANEW = "start anew in another directory (--out)"

_SQLITE_MAGIC = b"SQLite format 3\0"
_CHECKSUM_SIZE = 8
_NUMBERS = struct.Struct("<qq")
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_BUSY_TIMEOUT_S = 1.0
_MAX_ROW_BYTES = 2**29
"""Bound on a row, for a file of somebody else's; a trial of a million steps has a tenth of it."""

_PAGE_BYTES = 1024
"""A step writes whole pages; larger ones take longer to write and to checksum."""

# SQLite locks these bytes of the file, which it never writes; the range is that of shared locks.
_SHARED_LOCK_START = 0x40000002
_SHARED_LOCK_SIZE = 510

open_here: weakref.WeakValueDictionary[FileIdentity, object] = weakref.WeakValueDictionary()
"""Journals that this process has open for writing.

Closing any descriptor of a file drops this process's locks on it, SQLite's too. So such a file is
never opened a second time.
"""


def find_journal(run: Path, purpose: str) -> Path:
    """Return the journal of a run, by its directory or the journal itself.

    ``purpose`` is a verb, for messages: what the run is needed for.

    Raises
    ------
    OutputError
        If there is none.
    """
    if run.is_dir():
        if not (run / JOURNAL_NAME).is_file():
            raise OutputError(f"{run}: holds no {JOURNAL_NAME}, so no run to {purpose}")
        return run / JOURNAL_NAME
    if not run.exists():
        raise OutputError(f"{run}: there is no such directory or journal, so no run to {purpose}")
    if not run.is_file():
        raise OutputError(f"{run}: is a pipe or device, not a journal")
    try:
        with run.open("rb") as file:
            start = file.read(len(_SQLITE_MAGIC))
    except OSError as error:
        raise OutputError(f"{run}: cannot be read: {error.strerror}") from error
    if start not in (_SQLITE_MAGIC, b""):
        raise OutputError(
            f"{run}: is not a journal; name the directory of a run, or its {JOURNAL_NAME}"
        )
    return run


class JournalFile:
    """A journal's file, and those beside it."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.log = path.with_name(f"{path.name}-wal")  # where SQLite writes ahead
        self.count = path.with_name(f"{path.name}-count")

    def require(self) -> None:
        """Raise OutputError unless there is a file with content.

        SQLite would take an empty file for a new database, and remove the log beside it.
        """
        try:
            size = self.path.stat().st_size if self.path.is_file() else None
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be read: {error.strerror}") from error
        if size is None:
            raise OutputError(f"{self.path}: there is no journal of a run")
        if size == 0:
            raise OutputError(f"{self.path}: is empty, so no journal of a run; {START_ANEW}")

    def require_writable(self) -> None:
        """Raise OutputError unless it can be written; SQLite's errors do not say why not."""
        try:
            if self.version()[:2] not in open_here:
                os.close(os.open(self.path, os.O_WRONLY | os.O_CLOEXEC))
        except OSError as error:
            raise OutputError(f"{self.path}: cannot be written: {error.strerror}") from error

    def version(self) -> tuple[int, int, int, int]:
        """Return device, inode, size and time of change.

        The first two are the file's identity: no other file has them while this one is open.
        """
        status = self.path.stat()
        return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns

    def logs(self) -> list[Path]:
        """Return the files beside a database that hold a part of its content."""
        logs = (self.log, self.path.with_name(f"{self.path.name}-journal"))
        return [log for log in logs if log.is_file() and log.stat().st_size]

    def damaged(self, how: str) -> OutputError:
        """Return the error of a damaged journal."""
        return OutputError(
            f"{self.path}: the journal is damaged ({how}), so the run cannot go on; restore the "
            f"file, or {START_ANEW}"
        )

    def _in_use(self) -> OutputError:
        return OutputError(f"{self.path}: another process is using this run")

    def connect(self, *, create: bool = False) -> sqlite3.Connection:
        """Open the database for this process alone; raise OutputError if that is not possible."""
        path = self.path
        try:
            connection = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={'rwc' if create else 'rw'}",
                uri=True,
                timeout=_BUSY_TIMEOUT_S,
                isolation_level=None,
            )
        except sqlite3.Error as error:
            raise OutputError(f"{path}: cannot be opened: {error}") from error
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_ROW_BYTES)
        try:
            if create:
                connection.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
            # Two runs in one directory would corrupt each other, so the lock is held until the end.
            # With it, the index of the log is in this process's memory.
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            connection.execute("BEGIN EXCLUSIVE")
            connection.execute("COMMIT")
        except sqlite3.Error as error:
            connection.close()
            if is_named(error, "SQLITE_BUSY", "SQLITE_LOCKED"):
                raise self._in_use() from error
            if is_named(error, "SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_FULL"):
                raise OutputError(f"{path}: cannot be written: {error}") from error
            if is_named(error, "SQLITE_CORRUPT"):
                raise self.damaged(str(error)) from error
            raise OutputError(f"{path}: not a usable journal: {error}; {START_ANEW}") from error
        return connection

    def connect_to_read(self, close: contextlib.ExitStack) -> sqlite3.Connection:
        """Open the database without a lock and without changing its directory.

        SQLite reads a log only where it may write beside it. So if there is a log, both are copied,
        and the copy is read; a file without a log is read in place.

        Raises
        ------
        OutputError
            If it is in use or cannot be read.
        """
        path, copy = self.path, None
        if self.version()[:2] in open_here:
            raise OutputError(f"{path}: this process is using this run")
        try:
            with path.open("rb") as file:
                try:
                    # Held only while it is copied: then nobody can begin to write.
                    fcntl.lockf(
                        file, fcntl.LOCK_SH | fcntl.LOCK_NB, _SHARED_LOCK_SIZE, _SHARED_LOCK_START
                    )
                except (BlockingIOError, PermissionError) as error:
                    raise self._in_use() from error
                if logs := self.logs():
                    folder = tempfile.TemporaryDirectory(
                        prefix="holdfast-journal-", ignore_cleanup_errors=True
                    )
                    copy = JournalFile(Path(close.enter_context(folder)) / path.name)
                    for source in (path, *logs):
                        shutil.copyfile(source, copy.path.with_name(source.name))
        except OSError as error:
            raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
        try:
            connection = (
                sqlite3.connect(
                    f"{path.absolute().as_uri()}?immutable=1", uri=True, isolation_level=None
                )
                if copy is None
                else copy.connect()
            )
        except sqlite3.Error as error:
            raise OutputError(f"{path}: cannot be opened: {error}") from error
        except OutputError as error:
            assert copy is not None
            raise OutputError(str(error).replace(str(copy.path), str(path))) from error
        connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_ROW_BYTES)
        connection.execute("PRAGMA query_only = ON")
        return connection


def synchronize_directory(path: Path) -> None:
    """Make a new name in a directory survive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def boot_id() -> str | None:
    """Return the identity of this boot of the machine, None if there is none."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip() or None
    except (OSError, UnicodeDecodeError):
        return None


def is_named(error: sqlite3.Error, *names: str) -> bool:
    """Return whether an error of SQLite has one of these names or a refinement of one."""
    # Those that Python's module raises by itself have no name.
    return str(getattr(error, "sqlite_errorname", "")).startswith(names)


class StepCount:
    """How many records of the unfinished trial were written, in a file beside the journal.

    If it is ``synchronous``, :meth:`begin` returns only when it is on the disk. All methods raise
    OutputError if it cannot be written.
    """

    def __init__(self, path: Path, *, synchronous: bool) -> None:
        self._path = path
        self._synchronous = synchronous
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise self._cannot_be_written(error) from error

    def _cannot_be_written(self, error: OSError) -> OutputError:
        return OutputError(f"{self._path}: cannot be written: {error.strerror}")

    def begin(self, trial: int, number: int) -> None:
        """Count the records of another trial, starting from those that are in the journal."""
        self.write(trial, number)
        if self._synchronous:
            try:
                os.fsync(self._descriptor)
                synchronize_directory(self._path.parent)
            except OSError as error:
                raise self._cannot_be_written(error) from error

    def write(self, trial: int, number: int) -> None:
        """Write how many there are; this survives the process."""
        try:
            os.pwrite(self._descriptor, _NUMBERS.pack(trial, number), 0)
        except OSError as error:
            raise self._cannot_be_written(error) from error

    def close(self) -> None:
        """Close the file and leave it where it is."""
        os.close(self._descriptor)

    @staticmethod
    def read(path: Path) -> tuple[int, int] | None:
        """Return the trial and the number of its records, None if that is missing or damaged."""
        try:
            trial, number = _NUMBERS.unpack(path.read_bytes())
        except (OSError, struct.error):
            return None
        return trial, number


class RowChecksum:
    """The checksums of the rows of a table, each over its content and its key."""

    def __init__(self, table: bytes) -> None:
        # Copied for each row: creating one takes longer than hashing a step.
        self._empty = hashlib.blake2b(digest_size=_CHECKSUM_SIZE, person=table)

    def __call__(self, first: int, second: int, data: bytes) -> bytes:
        """Return the checksum of a row whose key is two numbers."""
        checksum = self._empty.copy()
        checksum.update(_NUMBERS.pack(first, second) + data)
        return checksum.digest()

    def is_intact(self, data: object, checksum: object, first: object, second: object) -> bool:
        """Return whether a row has the right types and checksum; SQLite has a type a value."""
        return (
            isinstance(data, bytes)
            and isinstance(first, int)
            and isinstance(second, int)
            and self(first, second, data) == checksum
        )


of_steps = RowChecksum(b"holdfast-step")
"""By the record's number and its trial."""

of_trials = RowChecksum(b"holdfast-trial")
"""By the trial, and 0 for its result, 1 for its decisions, 2 for its kept steps."""

_of_meta = RowChecksum(b"holdfast-meta")


def meta_checksum(key: str, value: str) -> bytes:
    """Return the checksum of a note about the run."""
    return _of_meta(len(key), len(value), f"{key}={value}".encode())
