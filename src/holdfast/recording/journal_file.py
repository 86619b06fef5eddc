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
from collections.abc import Callable
from pathlib import Path
from typing import Literal, TypeAlias

from holdfast.errors import OutputError

__all__ = [
    "JOURNAL_NAME",
    "START_ANEW",
    "FileIdentity",
    "StepCount",
    "Survives",
    "boot_id",
    "connect",
    "connect_to_read",
    "count_path",
    "damaged",
    "find_journal",
    "identity_of",
    "is_intact",
    "is_named",
    "log_path",
    "logs_of",
    "meta_checksum",
    "open_here",
    "read_count",
    "require_file",
    "require_writable",
    "step_checksum",
    "synchronize_directory",
    "trial_checksum",
    "version_of_file",
]

JOURNAL_NAME = "journal.sqlite"

Survives: TypeAlias = Literal["process_crash", "power_cut"]
"""What a journalled step survives; see :class:`holdfast.config.settings.RecoverySettings`."""

FileIdentity: TypeAlias = tuple[int, int]
"""Device and inode."""

START_ANEW = "start anew in another directory (--out)"

_SQLITE_MAGIC = b"SQLite format 3\0"
_CHECKSUM_SIZE = 8
_NUMBERS = struct.Struct("<qq")
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")
_BUSY_TIMEOUT_S = 1.0
_PAGE_BYTES = 1024
"""A step writes whole pages; larger ones take longer to write and to checksum."""

# SQLite locks these bytes of the file, which it never writes; the range is that of shared locks.
_SHARED_LOCK_START = 0x40000002
_SHARED_LOCK_SIZE = 510

# Copied for each row: creating one takes longer than hashing a step.
_OF_META, _OF_STEPS, _OF_TRIALS = (
    hashlib.blake2b(digest_size=_CHECKSUM_SIZE, person=person)
    for person in (b"holdfast-meta", b"holdfast-step", b"holdfast-trial")
)

open_here: weakref.WeakValueDictionary[FileIdentity, object] = weakref.WeakValueDictionary()
"""Journals that this process has open for writing.

Closing any descriptor of a file drops this process's locks on it, SQLite's too. So such a file is
never opened a second time.
"""


# -- finding ---------------------------------------------------------------------------------------


def find_journal(run: Path, purpose: str) -> Path:
    """Return the journal of a run.

    Parameters
    ----------
    run : Path
        The run's directory, or the journal itself.
    purpose : str
        A verb, for messages: what the run is needed for.

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


def require_file(path: Path) -> None:
    """Raise OutputError unless there is a file with content.

    SQLite would take an empty file for a new database, and remove the log beside it.
    """
    try:
        size = path.stat().st_size if path.is_file() else None
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    if size is None:
        raise OutputError(f"{path}: there is no journal of a run")
    if size == 0:
        raise OutputError(f"{path}: is empty, so no journal of a run; {START_ANEW}")


def require_writable(path: Path) -> None:
    """Raise OutputError unless a journal can be written; SQLite's errors do not say why not."""
    try:
        if identity_of(path) not in open_here:
            os.close(os.open(path, os.O_WRONLY | os.O_CLOEXEC))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


def identity_of(path: Path) -> FileIdentity:
    """Return device and inode. No other file has them while this one is open."""
    status = path.stat()
    return status.st_dev, status.st_ino


def version_of_file(path: Path) -> tuple[int, ...]:
    """Return what changes when a file is replaced or written."""
    status = path.stat()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def log_path(path: Path) -> Path:
    """Return where SQLite writes ahead."""
    return path.with_name(f"{path.name}-wal")


def count_path(path: Path) -> Path:
    """Return where the number of records is."""
    return path.with_name(f"{path.name}-count")


def logs_of(path: Path) -> list[Path]:
    """Return the files beside a database that hold a part of its content."""
    logs = (log_path(path), path.with_name(f"{path.name}-journal"))
    return [log for log in logs if log.is_file() and log.stat().st_size]


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


# -- opening ---------------------------------------------------------------------------------------


def connect(path: Path, *, create: bool) -> sqlite3.Connection:
    """Open a database for this process alone; raise OutputError if that is not possible."""
    try:
        connection = sqlite3.connect(
            f"{path.absolute().as_uri()}?mode={'rwc' if create else 'rw'}",
            uri=True,
            timeout=_BUSY_TIMEOUT_S,
            isolation_level=None,
        )
    except sqlite3.Error as error:
        raise OutputError(f"{path}: cannot be opened: {error}") from error
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
            raise _in_use(path) from error
        if is_named(error, "SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_FULL"):
            raise OutputError(f"{path}: cannot be written: {error}") from error
        if is_named(error, "SQLITE_CORRUPT"):
            raise damaged(path, str(error)) from error
        raise OutputError(f"{path}: not a usable journal: {error}; {START_ANEW}") from error
    return connection


def connect_to_read(path: Path, close: contextlib.ExitStack) -> sqlite3.Connection:
    """Open a database without a lock and without changing its directory.

    SQLite reads a log only where it may write beside it. So if there is a log, both are copied, and
    the copy is read; a file without a log is read in place.

    Raises
    ------
    OutputError
        If it is in use or cannot be read.
    """
    if identity_of(path) in open_here:
        raise OutputError(f"{path}: this process is using this run")
    try:
        with path.open("rb") as file:
            try:
                # Held only while it is copied: then nobody can begin to write.
                fcntl.lockf(
                    file, fcntl.LOCK_SH | fcntl.LOCK_NB, _SHARED_LOCK_SIZE, _SHARED_LOCK_START
                )
            except (BlockingIOError, PermissionError) as error:
                raise _in_use(path) from error
            logs = logs_of(path)
            if logs:
                folder = Path(
                    close.enter_context(
                        tempfile.TemporaryDirectory(
                            prefix="holdfast-journal-", ignore_cleanup_errors=True
                        )
                    )
                )
                for source in (path, *logs):
                    shutil.copyfile(source, folder / source.name)
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    if logs:
        try:
            connection = connect(folder / path.name, create=False)
        except OutputError as error:
            raise OutputError(str(error).replace(str(folder / path.name), str(path))) from error
    else:
        try:
            connection = sqlite3.connect(
                f"{path.absolute().as_uri()}?immutable=1", uri=True, isolation_level=None
            )
        except sqlite3.Error as error:
            raise OutputError(f"{path}: cannot be opened: {error}") from error
    connection.execute("PRAGMA query_only = ON")
    return connection


def is_named(error: sqlite3.Error, *names: str) -> bool:
    """Return whether an error of SQLite has one of these names or a refinement of one."""
    # Those that Python's module raises by itself have no name.
    return str(getattr(error, "sqlite_errorname", "")).startswith(names)


def damaged(path: Path, how: str) -> OutputError:
    """Return the error of a damaged journal."""
    return OutputError(
        f"{path}: the journal is damaged ({how}), so the run cannot go on; restore the file, or "
        f"{START_ANEW}"
    )


def _in_use(path: Path) -> OutputError:
    return OutputError(f"{path}: another process is using this run")


# -- the number of records -------------------------------------------------------------------------


class StepCount:
    """How many records of the unfinished trial were written, in a file beside the journal.

    Parameters
    ----------
    synchronous : bool
        Whether :meth:`begin` returns only when it is on the disk.

    Raises
    ------
    OutputError
        If it cannot be written; so do the methods.
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


def read_count(path: Path) -> tuple[int, int] | None:
    """Return the trial and the number of its records; None if the file is missing or damaged."""
    try:
        trial, number = _NUMBERS.unpack(path.read_bytes())
    except (OSError, struct.error):
        return None
    return trial, number


# -- checksums -------------------------------------------------------------------------------------


def meta_checksum(key: str, value: str) -> bytes:
    """Return the checksum of a note about the run."""
    return _checksum(_OF_META, len(key), len(value), f"{key}={value}".encode())


def step_checksum(sequence: int, trial: int, data: bytes) -> bytes:
    """Return the checksum of a record of the unfinished trial."""
    return _checksum(_OF_STEPS, sequence, trial, data)


def trial_checksum(trial: int, column: int, data: bytes) -> bytes:
    """Return the checksum of a finished trial's result (0), decisions (1) or kept steps (2)."""
    return _checksum(_OF_TRIALS, trial, column, data)


def _checksum(empty: hashlib.blake2b, first: int, second: int, data: bytes) -> bytes:
    checksum = empty.copy()
    checksum.update(_NUMBERS.pack(first, second) + data)
    return checksum.digest()


def is_intact(
    data: object,
    checksum: object,
    make: Callable[[int, int, bytes], bytes],
    first: object,
    second: object,
) -> bool:
    """Return whether a row has the right types and checksum; in SQLite each value has its type."""
    return (
        isinstance(data, bytes)
        and isinstance(first, int)
        and isinstance(second, int)
        and make(first, second, data) == checksum
    )
