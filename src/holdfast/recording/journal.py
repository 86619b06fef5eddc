"""The journal of a run: each finished trial, and each step of the one that is not finished.

It is one SQLite file. A finished trial is one transaction, so after a crash or a power cut it is in
the journal whole or not at all. The steps of an unfinished trial are appended before the robot acts
on them, so that a new process can go on where the old one died; they go when their trial is
finished. Where nobody else knows what the robot has observed, because its world is no simulated
one, they stay, in a table that is made for the first of them: beliefs can be computed again. Tables
and summary are made from the journal and can be made again at any time.

SQLite writes ahead (WAL): a commit is one append to ``journal.sqlite-wal``, which takes some
microseconds and outlives the death of the process. To outlive the death of the machine it has to be
on the disk as well; that is done for what begins or finishes a trial, and on demand for every step.
The writer has the file for itself, so the index of that log is kept in its memory.

A log that is removed or cut, or left behind when the journal is copied, would take the last steps
with it, and SQLite would not notice. So whatever begins a trial is moved on into the main file at
once, which then says that there is a log; and how many records were kept is written beside it, into
``journal.sqlite-count``. A journal with fewer records than that is known to lack some. That costs
a few microseconds a step; a mode without a log, as safe in a power cut, would wait for the disk.
The two files beside the journal go when it is closed.
"""

from __future__ import annotations

import contextlib
import fcntl
import functools
import hashlib
import os
import shutil
import sqlite3
import struct
import tempfile
import weakref
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Literal, NamedTuple, Self, TypeAlias

import msgspec

from holdfast.errors import InvalidValueError
from holdfast.files import OutputError
from holdfast.outcome import Decisions, TrialResult
from holdfast.session.records import Record, RecordError, decode_record, encode_record

__all__ = [
    "SCHEMA_VERSION",
    "Journal",
    "LostJournalError",
    "Survives",
    "Tally",
    "UnfinishedTrial",
    "require_writable",
]

Survives: TypeAlias = Literal["process_crash", "power_cut"]
"""What a journalled step outlives; see :class:`holdfast.settings.RecoverySettings`."""

SCHEMA_VERSION = 3
"""Raised whenever the tables or what is in them change their form."""

_SCHEMA = (
    "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, checksum BLOB NOT NULL) "
    "WITHOUT ROWID",
    "CREATE TABLE trials (trial INTEGER PRIMARY KEY, result BLOB NOT NULL, "
    "result_checksum BLOB NOT NULL, decisions BLOB NOT NULL, decisions_checksum BLOB NOT NULL)",
    "CREATE TABLE steps (sequence INTEGER PRIMARY KEY, trial INTEGER NOT NULL, "
    "record BLOB NOT NULL, checksum BLOB NOT NULL)",
)

_KEPT_STEPS = (
    "CREATE TABLE IF NOT EXISTS kept_steps "
    "(trial INTEGER PRIMARY KEY, records BLOB NOT NULL, checksum BLOB NOT NULL)"
)
"""Not in every journal, so that those without it are still journals of this version."""

_SESSION_SIZE = 16
_MAX_EPOCH = 2**32 - 1
_CHECKSUM_SIZE = 8
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")

_BUSY_TIMEOUT_S = 1.0
_PAGE_BYTES = 1024
"""A step writes whole pages; larger ones take longer to write and to sum up."""

_MAX_LOG_PAGES = 16384
"""The log is moved into the main file beyond 16 MiB at the latest: read back after a crash in some
10 ms, and reached only in trials of thousands of steps."""

# SQLite's locks are on these bytes of the file, which it never writes; the range is the shared one.
_SHARED_LOCK_START = 0x40000002
_SHARED_LOCK_SIZE = 510

_START_ANEW = "start anew in another directory (--out)"

_RESULT_DECODER = msgspec.msgpack.Decoder(TrialResult)
_DECISIONS_DECODER = msgspec.msgpack.Decoder(Decisions)
_KEPT_DECODER = msgspec.msgpack.Decoder(list[bytes])
_NUMBERS = struct.Struct("<qq")

# Copied for each row: to make one takes longer than to sum up a step.
_OF_META, _OF_STEPS, _OF_TRIALS = (
    hashlib.blake2b(digest_size=_CHECKSUM_SIZE, person=person)
    for person in (b"holdfast-meta", b"holdfast-step", b"holdfast-trial")
)

# Closing any descriptor of a file drops this process's locks on it, SQLite's too; so a journal that
# is open here must be opened a second time by SQLite alone, which knows that.
_open_here: weakref.WeakValueDictionary[tuple[int, int], Journal] = weakref.WeakValueDictionary()


class LostJournalError(OutputError):
    """The journal was removed or replaced while it was open: nothing can go on with it."""


class Tally(NamedTuple):
    """How many trials are finished, and how many of them succeeded and failed."""

    finished: int
    successes: int
    failures: int


class UnfinishedTrial(NamedTuple):
    """A trial of which steps are journalled, but no end.

    Attributes
    ----------
    trial : int
    records : list of Record
        In the order in which they were appended.
    same_boot : bool
        Whether the machine has not been started anew since the last of them was written; False if
        that is not known.
    on_disk : bool
        Whether each of them was on the disk before it was acted on (``survives="power_cut"``).
    all_counted : bool
        Whether they are as many as were counted when they were written; False if that is not known,
        too. If so, no log was removed or cut.
    """

    trial: int
    records: list[Record]
    same_boot: bool
    on_disk: bool
    all_counted: bool

    @property
    def is_complete(self) -> bool:
        """Whether no record can have been lost: what happened after the last one is not known."""
        return self.all_counted and (self.same_boot or self.on_disk)


class Journal:
    """The journal of one run, open. Unless it is only read, no other process can open it.

    Use :meth:`create`, :meth:`open` or :meth:`read`, and close it or use it in a ``with``
    statement. It belongs to the thread that opened it.

    Parameters
    ----------
    path : Path
        The file.
    connection : sqlite3.Connection
        The open database.
    survives : {"process_crash", "power_cut"}
        What each appended step outlives.
    """

    def __init__(
        self, path: Path, connection: sqlite3.Connection, survives: Survives = "process_crash"
    ) -> None:
        self.path = path
        self.survives = survives
        self._connection = connection
        self._encode = msgspec.msgpack.Encoder().encode
        self._steps: _Steps | None = None
        self._count: _Count | None = None
        self._in_place: list[tuple[str, tuple[int, int]]] = []
        self._version_read: tuple[int, ...] | None = None
        self._close = contextlib.ExitStack()
        self._close.callback(connection.close)

    # -----------------------------------------------------------------------------------------
    # Opening and closing
    # -----------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls, path: Path, meta: dict[str, str], *, survives: Survives = "process_crash"
    ) -> Self:
        """Make a new journal.

        Parameters
        ----------
        path : Path
            Where; there must be no file yet.
        meta : dict of str
            What to note about the run. The schema's version and a session are added.
        survives : {"process_crash", "power_cut"}
            What each appended step outlives.

        Raises
        ------
        OutputError
            If there is a file already or it cannot be written.
        """
        # Made under a name of its own and then linked to the right one, which fails if that is
        # taken: nobody ever sees a journal that is half made, and of two runs one has it.
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        unfinished.unlink(missing_ok=True)
        if not path.exists():
            for log in _logs_of(path):
                # SQLite would take it for the new journal's, and put its pages in.
                raise OutputError(
                    f"{log}: is the log of a journal that is gone; restore that, or {_START_ANEW}"
                )
        try:
            journal = cls(unfinished, _connect(unfinished, create=True))
            try:
                with journal._transaction():
                    for statement in _SCHEMA:
                        journal._connection.execute(statement)
                    journal._note(_first_rows(meta))
            finally:
                journal._connection.close()
            try:
                os.link(unfinished, path)
                _synchronize_directory(path.parent)
            except FileExistsError as error:
                raise OutputError(f"{path}: there is a journal already") from error
            except OSError as error:
                raise OutputError(f"{path}: cannot be made: {error.strerror}") from error
        finally:
            unfinished.unlink(missing_ok=True)
            unfinished.with_name(f"{unfinished.name}-journal").unlink(missing_ok=True)
        return cls.open(path, survives=survives, check=False)

    @classmethod
    def open(cls, path: Path, *, survives: Survives = "process_crash", check: bool = True) -> Self:
        """Open a journal that is there, to go on with it.

        Parameters
        ----------
        path : Path
        survives : {"process_crash", "power_cut"}
            What each appended step outlives.
        check : bool
            Whether to read all of it first, to find out whether it is whole.

        Raises
        ------
        OutputError
            If there is none, it is no journal, damaged, another version's, or in use by another
            process.
        """
        _require_file(path)
        journal = cls(path, _connect(path, create=False), survives)
        try:
            journal._require_version()
            if check:
                journal.check()
            journal._write_ahead()
            journal._note_places()
        except BaseException:
            journal.close()
            raise
        journal._close.callback(journal._leave_one_file)
        identity = journal._in_place[0][1]
        _open_here[identity] = journal
        journal._close.callback(_open_here.pop, identity, None)
        return journal

    @classmethod
    def read(cls, path: Path) -> Self:
        """Open a journal that nobody is using, to read it; neither it nor its directory change.

        What a killed process left behind in the log is read as well. That needs a copy, which is
        removed by :meth:`close`.

        Raises
        ------
        OutputError
            If there is none, it is no journal, damaged, another version's, or in use.
        """
        _require_file(path)
        close = contextlib.ExitStack()
        try:
            before = _version_of_file(path)
            connection = _connect_to_read(path, close)
            journal = cls(path, connection)
            journal._version_read = before
            close.push(journal._close.pop_all())
            journal._close = close
            journal._require_version()
            # A table whose first page is cut off would be taken for an empty one.
            journal.check()
        except BaseException:
            close.close()
            raise
        return journal

    def _require_version(self) -> None:
        with self._errors():
            row = self._connection.execute(
                "SELECT value FROM meta WHERE key = 'schema_version'"
            ).fetchone()
        version = None if row is None else row[0]
        if version != str(SCHEMA_VERSION):
            raise OutputError(
                f"{self.path}: schema version {version}; this holdfast reads version "
                f"{SCHEMA_VERSION}; go on with the holdfast that made it, or {_START_ANEW}"
            )

    def _write_ahead(self) -> None:
        with self._errors():
            (mode,) = self._connection.execute("PRAGMA journal_mode = WAL").fetchone()
            if mode != "wal":
                raise OutputError(f"{self.path}: SQLite cannot write ahead here (mode {mode})")
            self._connection.execute(f"PRAGMA wal_autocheckpoint = {_MAX_LOG_PAGES}")
            self._set_synchronous(self.survives)
            # The log is made by the first use of the database in that mode.
            self._connection.execute("SELECT 1 FROM meta LIMIT 1").fetchone()

    def _leave_one_file(self) -> None:
        """Move the log into the main file: a plain file can be read by anything."""
        # It does no harm if this fails: the next one to open the journal does it.
        with contextlib.suppress(sqlite3.Error, OSError, OutputError):
            needless = False
            # Only who has written the count may say that it is needed no more: if records were
            # lost before, whoever comes next must find that out as well.
            if self._count is not None:
                with contextlib.suppress(OutputError):
                    with self._transaction():
                        self._note({"steps_counted": "0"})
                    needless = True
            self._connection.execute("PRAGMA journal_mode = DELETE")
            if needless or self.unfinished_trial() is None:
                _count_path(self.path).unlink(missing_ok=True)

    def _move_log(self) -> None:
        """Move what is in the log into the main file, and let both outlive a power cut."""
        with self._errors():
            self._connection.execute("PRAGMA wal_checkpoint(PASSIVE)")

    def _note_places(self) -> None:
        # Absolute, for the user's code may change the current directory.
        path = self.path.absolute()
        try:
            self._in_place = [(str(place), _identity(place)) for place in (path, _log_path(path))]
        except OSError as error:
            raise OutputError(f"{error.filename}: cannot be read: {error.strerror}") from error

    def _require_in_place(self) -> None:
        """Find out whether what is written is still to be found under its name.

        A file can be removed while it is open. Then SQLite goes on to write to it, and all is gone
        as soon as it is closed. While it is open, no other file can get its number.
        """
        for number, (place, identity) in enumerate(self._in_place):
            try:
                status = os.stat(place)  # noqa: PTH116 (after every step, so it is to be fast)
                if (status.st_dev, status.st_ino) == identity:
                    continue
            except (FileNotFoundError, NotADirectoryError):
                pass
            except OSError as error:
                raise OutputError(f"{place}: is out of reach now: {error.strerror}") from None
            if number == 0:
                raise LostJournalError(
                    f"{place}: the journal is gone: it was removed, renamed or replaced while this "
                    "run was writing to it; nothing is performed that is not written down"
                )
            raise OutputError(
                f"{place}: the journal's log is gone: it was removed or replaced while this run "
                "was writing to it; nothing is performed that is not written down"
            )

    def check(self) -> None:
        """Find out whether the file is whole.

        Raises
        ------
        OutputError
            If it is damaged.
        """
        with self._errors():
            (found,) = self._connection.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            # SQLite's account begins with a line of stars that names the table.
            raise self._damaged(str(found).strip().splitlines()[-1])

    def require_unchanged(self) -> None:
        """Make sure, after all was read from a journal of :meth:`read`, that it was one journal.

        Raises
        ------
        OutputError
            If somebody has begun to write to the file since it was opened.
        """
        if self._version_read is None:
            return
        with contextlib.suppress(OSError):
            if self._version_read == _version_of_file(self.path):
                return
        raise OutputError(f"{self.path}: a run has written to it while it was read; try again")

    def close(self) -> None:
        """Close the file and leave it to others. May be repeated."""
        self._close.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    # -----------------------------------------------------------------------------------------
    # Errors and transactions
    # -----------------------------------------------------------------------------------------

    def _damaged(self, how: str) -> OutputError:
        return _damaged(self.path, how)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise self._account_of(error) from error
        except (msgspec.DecodeError, UnicodeDecodeError) as error:
            raise self._damaged(str(error)) from error

    def _account_of(self, error: sqlite3.Error) -> OutputError:
        """Return what is said of an error of SQLite's; LostJournalError if a file is gone."""
        if isinstance(error, sqlite3.DatabaseError):
            # The plain error is one in our SQL: then the tables are not those that we have made.
            # One without a name is of Python's module, which could not decode a text.
            name = getattr(error, "sqlite_errorname", None)
            undecoded = name is None and isinstance(error, sqlite3.OperationalError)
            if (
                undecoded
                or name == "SQLITE_ERROR"
                or _is_named(error, "SQLITE_CORRUPT", "SQLITE_NOTADB")
            ):
                return self._damaged(str(error))
            # SQLite says of some of the files that are gone that it cannot write to them.
            try:
                self._require_in_place()
            except OutputError as lost:
                return lost
        return OutputError(f"{self.path}: {error}")

    def _set_synchronous(self, survives: Survives) -> None:
        self._connection.execute(
            f"PRAGMA synchronous = {'FULL' if survives == 'power_cut' else 'NORMAL'}"
        )

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """Do all of what is inside or nothing; a power cut does not undo it.

        Raises
        ------
        LostJournalError
            If it was done to a file that nobody can find any more.
        """
        connection = self._connection
        raised = self.survives != "power_cut"
        with self._errors():
            if raised:
                self._set_synchronous("power_cut")
            try:
                connection.execute("BEGIN IMMEDIATE")
                yield
                connection.execute("COMMIT")
            except BaseException:
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
                raise
            finally:
                if raised:
                    self._set_synchronous(self.survives)
        self._require_in_place()

    # -----------------------------------------------------------------------------------------
    # The run
    # -----------------------------------------------------------------------------------------

    def meta(self) -> dict[str, str]:
        """Return what was noted about the run."""
        meta = {}
        with self._errors():
            for key, value, checksum in self._connection.execute(
                "SELECT key, value, checksum FROM meta"
            ):
                # SQLite's types belong to each value, so a damaged row may hold any.
                whole = isinstance(key, str) and isinstance(value, str)
                if not whole or _meta_checksum(key, value) != checksum:
                    raise self._damaged(f"its note {key!r} has a wrong checksum")
                meta[key] = value
        return meta

    def set_meta(self, key: str, value: str) -> None:
        """Note something about the run."""
        with self._transaction():
            self._note({key: value})

    def _note(self, rows: dict[str, str]) -> None:
        self._connection.executemany(
            "INSERT OR REPLACE INTO meta VALUES (?, ?, ?)",
            [(key, value, _meta_checksum(key, value)) for key, value in rows.items()],
        )

    def restart(self, meta: dict[str, str]) -> None:
        """Forget what was noted about a run that has done nothing yet, and note ``meta`` instead.

        Raises
        ------
        OutputError
            If a trial is finished or begun.
        """
        if not self.is_empty():
            raise OutputError(f"{self.path}: holds trials that are finished or begun")
        with self._transaction():
            self._connection.execute("DELETE FROM meta")
            self._note(_first_rows(meta))

    def session(self) -> bytes:
        """Return the 16 random bytes that were drawn for this run when it was made."""
        text = self.meta().get("session", "")
        try:
            session = bytes.fromhex(text)
        except ValueError:
            session = b""
        if len(session) != _SESSION_SIZE:
            raise self._damaged(f"its session is {text!r}, not {_SESSION_SIZE} bytes")
        return session

    def raise_epoch(self) -> int:
        """Count one more process of the run, and return how many these are now, from 1.

        When this returns, the new count is on the disk: no two processes get the same, even if the
        power is cut between them, or the log removed.
        """
        text = self.meta().get("epoch", "0")
        if not text.isdecimal() or not 0 <= int(text) < _MAX_EPOCH:
            raise self._damaged(f"its epoch is {text!r}, not from 0 to {_MAX_EPOCH - 1}")
        epoch = int(text) + 1
        self.set_meta("epoch", str(epoch))
        self._move_log()
        return epoch

    # -----------------------------------------------------------------------------------------
    # Steps of the unfinished trial
    # -----------------------------------------------------------------------------------------

    def append(self, trial: int, records: Sequence[Record]) -> None:
        """Keep records of a trial that is not finished; act on none of them if this raises.

        When this returns they outlive the death of the process; with ``survives="power_cut"`` they
        are on the disk. The first records of a trial, and the first after each opening, always
        are, and in the main file: so a trial that was begun is known to be, whatever happens.

        Parameters
        ----------
        trial : int
        records : sequence of Record

        Raises
        ------
        OutputError
            If they cannot be written. All of them are kept then, or none.
        LostJournalError
            If the file was removed.
        InvalidValueError
            If the trial is finished already, or another one is unfinished.
        """
        if not records:
            return
        steps = self._steps
        first = steps is None or steps.trial != trial
        if steps is None or first:
            steps = self._begin(trial)
        sequence = steps.next_sequence
        values: list[int | bytes] = []
        for record in records:
            data = encode_record(record)
            values += (sequence, trial, data, _step_checksum(sequence, trial, data))
            sequence += 1
        # Until it is known that they are kept, nothing is known of what is in the file.
        self._steps = None
        count = self._count_from(trial, steps.next_sequence) if first else self._count
        assert count is not None
        # One statement is a transaction by itself, in a fraction of the time.
        insert = _insert_steps(len(records))
        if first:
            with self._transaction():
                self._note(
                    {
                        "steps_boot": _boot_id() or "",
                        "steps_on_disk": str(int(self.survives == "power_cut")),
                        "steps_counted": "1",
                    }
                )
                self._connection.execute(insert, values)
            self._move_log()
        else:
            try:
                self._connection.execute(insert, values)
            except sqlite3.Error as error:
                raise self._account_of(error) from error
            self._require_in_place()
        # Afterwards: a count that is too small does no harm.
        count.write(trial, sequence)
        self._steps = _Steps(trial, sequence)

    def _count_from(self, trial: int, number: int) -> _Count:
        """Begin to count: what is in the journal now was found to be enough to go on from."""
        if self._count is None:
            self._count = _Count(
                _count_path(self.path.absolute()), synchronous=self.survives == "power_cut"
            )
            self._close.callback(self._count.close)
        self._count.begin(trial, number)
        return self._count

    def _begin(self, trial: int) -> _Steps:
        with self._errors():
            last, unfinished = self._connection.execute(
                "SELECT MAX(sequence), trial FROM steps"
            ).fetchone()
            finished = self._connection.execute(
                "SELECT 1 FROM trials WHERE trial = ?", (trial,)
            ).fetchone()
        if finished is not None:
            raise InvalidValueError(f"trial {trial} is finished: no step can follow in {self.path}")
        if last is not None and unfinished != trial:
            raise InvalidValueError(
                f"trial {unfinished} is not finished in {self.path}: trial {trial} cannot begin"
            )
        return _Steps(trial, 0 if last is None else last + 1)

    def unfinished_trial(self) -> int | None:
        """Return the number of the trial that is begun and not finished, None if there is none."""
        with self._errors():
            row = self._connection.execute(
                "SELECT trial FROM steps ORDER BY sequence LIMIT 1"
            ).fetchone()
        if row is None:
            return None
        trial = row[0]
        if not isinstance(trial, int):
            raise self._damaged(f"its unfinished trial is {trial!r}, no number")
        return trial

    def unfinished(self) -> UnfinishedTrial | None:
        """Return the records of the trial that is not finished, None if there is none.

        Raises
        ------
        OutputError
            If one of them is damaged or missing.
        """
        records = []
        trial: int | None = None
        with self._errors():
            rows = self._connection.execute(
                "SELECT sequence, trial, record, checksum FROM steps ORDER BY sequence"
            )
            for expected, (sequence, number, data, checksum) in enumerate(rows):
                trial = number if trial is None else trial
                where = f"record {expected} of the unfinished trial {trial}"
                if sequence != expected or number != trial:
                    raise self._damaged(f"{where} is missing")
                if not _is_intact(data, checksum, _step_checksum, sequence, number):
                    raise self._damaged(f"{where} has a wrong checksum")
                try:
                    records.append(decode_record(data))
                except RecordError as error:
                    raise self._damaged(f"{where}: {error}") from error
        if trial is None:
            return None
        meta = self.meta()
        boot = _boot_id()
        all_counted = True
        if meta.get("steps_counted") == "1":
            counted = _read_count(_count_path(self.path))
            all_counted = counted is not None and counted[0] == trial and counted[1] <= len(records)
        return UnfinishedTrial(
            trial=trial,
            records=records,
            same_boot=boot is not None and meta.get("steps_boot") == boot,
            on_disk=meta.get("steps_on_disk") == "1",
            all_counted=all_counted,
        )

    # -----------------------------------------------------------------------------------------
    # Finished trials
    # -----------------------------------------------------------------------------------------

    def add(self, result: TrialResult, *, keep_steps: bool = False) -> None:
        """Keep a finished trial, and drop its steps; when this returns, it is on the disk.

        Parameters
        ----------
        result : TrialResult
            The outcome, with its decisions.
        keep_steps : bool
            Whether its steps stay, for :meth:`kept_steps`.

        Raises
        ------
        OutputError
            If the trial is there already, or the disk is full.
        """
        if result.decisions is None:
            raise OutputError(f"trial {result.trial}: the result comes without its decisions")
        trial = result.trial
        outcome = self._encode(msgspec.structs.replace(result, decisions=None))
        decisions = self._encode(result.decisions)
        row = (
            trial,
            outcome,
            _trial_checksum(trial, 0, outcome),
            decisions,
            _trial_checksum(trial, 1, decisions),
        )
        self._steps = None
        kept: bytes | None = None
        if keep_steps:
            unfinished = self.unfinished()
            if unfinished is not None and unfinished.trial == trial:
                kept = self._encode([encode_record(record) for record in unfinished.records])
        with self._transaction():
            self._connection.execute("INSERT INTO trials VALUES (?, ?, ?, ?, ?)", row)
            if kept is not None:
                self._connection.execute(_KEPT_STEPS)
                self._connection.execute(
                    "INSERT INTO kept_steps VALUES (?, ?, ?)",
                    (trial, kept, _trial_checksum(trial, 2, kept)),
                )
            dropped = self._connection.execute("DELETE FROM steps WHERE trial = ?", (trial,))
        if dropped.rowcount:
            # Now, while the robot has nothing to do, and not in the middle of its next trial. The
            # trial is kept already, so trouble here is told by whatever is written next.
            with contextlib.suppress(OutputError):
                self._move_log()

    def kept_steps(self, trial: int) -> list[Record] | None:
        """Return the records of a finished trial whose steps were kept, None if they were not.

        Raises
        ------
        OutputError
            If they are damaged.
        """
        with self._errors():
            there = self._connection.execute(
                "SELECT 1 FROM sqlite_master WHERE type = 'table' AND name = 'kept_steps'"
            ).fetchone()
            row = (
                there
                and self._connection.execute(
                    "SELECT records, checksum FROM kept_steps WHERE trial = ?", (trial,)
                ).fetchone()
            )
            if not row:
                return None
            blob, checksum = row
            if not _is_intact(blob, checksum, _trial_checksum, trial, 2):
                raise self._damaged(f"the steps of trial {trial} have a wrong checksum")
            try:
                return [decode_record(data) for data in _KEPT_DECODER.decode(blob)]
            except RecordError as error:
                raise self._damaged(f"the steps of trial {trial}: {error}") from error

    def is_empty(self) -> bool:
        """Tell whether nothing has been done yet: no trial is finished, and none is begun."""
        with self._errors():
            return (
                self._connection.execute("SELECT 1 FROM trials LIMIT 1").fetchone() is None
                and self.unfinished_trial() is None
            )

    def finished(self) -> set[int]:
        """Return the numbers of the trials that are finished."""
        with self._errors():
            return {trial for (trial,) in self._connection.execute("SELECT trial FROM trials")}

    def tally(self) -> Tally:
        """Count the trials that are finished."""
        finished = successes = failures = 0
        for result in self.results():
            finished += 1
            successes += result.success
            failures += result.failed
        return Tally(finished, successes, failures)

    def results(self, *, with_decisions: bool = False) -> Iterator[TrialResult]:
        """Yield the results in the order of their trials.

        Parameters
        ----------
        with_decisions : bool
            Whether to read the decisions as well; else they are None.

        Raises
        ------
        OutputError
            If one is damaged.
        """
        with self._errors():
            for trial, blob, checksum in self._connection.execute(
                "SELECT trial, result, result_checksum FROM trials ORDER BY trial"
            ):
                if not _is_intact(blob, checksum, _trial_checksum, trial, 0):
                    raise self._damaged(f"the result of trial {trial} has a wrong checksum")
                result = _RESULT_DECODER.decode(blob)
                if with_decisions:
                    decisions = self.decisions(trial)
                    if decisions.digest() != result.digest:
                        raise self._damaged(f"trial {trial} has decisions with another digest")
                    result = msgspec.structs.replace(result, decisions=decisions)
                yield result

    def decisions(self, trial: int) -> Decisions:
        """Return the decisions of one trial.

        Raises
        ------
        OutputError
            If the journal does not have that trial, or it is damaged.
        """
        with self._errors():
            row = self._connection.execute(
                "SELECT decisions, decisions_checksum FROM trials WHERE trial = ?", (trial,)
            ).fetchone()
            if row is None:
                raise OutputError(f"{self.path}: trial {trial} is not in the journal")
            if not _is_intact(row[0], row[1], _trial_checksum, trial, 1):
                raise self._damaged(f"the decisions of trial {trial} have a wrong checksum")
            return _DECISIONS_DECODER.decode(row[0])


def require_writable(path: Path) -> None:
    """Make sure that a journal's file can be written; SQLite's own errors do not say why not.

    Raises
    ------
    OutputError
        If it cannot be.
    """
    try:
        # One that is open here can be, and closing it a second time would drop its lock.
        if _identity(path) not in _open_here:
            os.close(os.open(path, os.O_WRONLY | os.O_CLOEXEC))
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error


@functools.cache
def _insert_steps(number: int) -> str:
    return f"INSERT INTO steps VALUES {', '.join(['(?, ?, ?, ?)'] * number)}"


class _Steps(NamedTuple):
    """The unfinished trial, and the number of its next record."""

    trial: int
    next_sequence: int


class _Count:
    """How many records of the unfinished trial were kept, in a file beside the journal.

    Parameters
    ----------
    path : Path
    synchronous : bool
        Whether it is on the disk when :meth:`begin` returns.

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
        """Count the records of another trial, or those that a process before has left."""
        self.write(trial, number)
        if self._synchronous:
            try:
                os.fsync(self._descriptor)
                _synchronize_directory(self._path.parent)
            except OSError as error:
                raise self._cannot_be_written(error) from error

    def write(self, trial: int, number: int) -> None:
        """Note how many there are; this outlives the process."""
        try:
            os.pwrite(self._descriptor, _NUMBERS.pack(trial, number), 0)
        except OSError as error:
            raise self._cannot_be_written(error) from error

    def close(self) -> None:
        """Close the file and leave it where it is."""
        os.close(self._descriptor)


def _read_count(path: Path) -> tuple[int, int] | None:
    """Return the trial, and how many of its records were kept; None if nobody knows."""
    try:
        trial, number = _NUMBERS.unpack(path.read_bytes())
    except (OSError, struct.error):
        return None
    return trial, number


def _first_rows(meta: dict[str, str]) -> dict[str, str]:
    return {
        "schema_version": str(SCHEMA_VERSION),
        "session": os.urandom(_SESSION_SIZE).hex(),
        **meta,
    }


def _checksum(empty: hashlib.blake2b, first: int, second: int, data: bytes) -> bytes:
    # The numbers too, so that a row cannot pass for another.
    checksum = empty.copy()
    checksum.update(_NUMBERS.pack(first, second) + data)
    return checksum.digest()


def _meta_checksum(key: str, value: str) -> bytes:
    data = f"{key}={value}".encode()
    return _checksum(_OF_META, len(key), len(value), data)


def _step_checksum(sequence: int, trial: int, data: bytes) -> bytes:
    return _checksum(_OF_STEPS, sequence, trial, data)


def _trial_checksum(trial: int, column: int, data: bytes) -> bytes:
    return _checksum(_OF_TRIALS, trial, column, data)


def _is_intact(
    data: object,
    checksum: object,
    make: Callable[[int, int, bytes], bytes],
    first: object,
    second: object,
) -> bool:
    # SQLite's types belong to each value, so a damaged row may hold any.
    return (
        isinstance(data, bytes)
        and isinstance(first, int)
        and isinstance(second, int)
        and make(first, second, data) == checksum
    )


def _boot_id() -> str | None:
    """Return what tells this run of the kernel from every other, None if there is no such thing."""
    try:
        return _BOOT_ID.read_text(encoding="ascii").strip() or None
    except (OSError, UnicodeDecodeError):
        return None


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino


def _version_of_file(path: Path) -> tuple[int, ...]:
    status = path.stat()
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _log_path(path: Path) -> Path:
    return path.with_name(f"{path.name}-wal")


def _count_path(path: Path) -> Path:
    return path.with_name(f"{path.name}-count")


def _logs_of(path: Path) -> list[Path]:
    """Return the files beside a database that hold a part of its content."""
    logs = (_log_path(path), path.with_name(f"{path.name}-journal"))
    return [log for log in logs if log.is_file() and log.stat().st_size]


def _require_file(path: Path) -> None:
    try:
        size = path.stat().st_size if path.is_file() else None
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    if size is None:
        raise OutputError(f"{path}: there is no journal of a run")
    if size == 0:
        # SQLite would take it for a new database, and remove the log beside it.
        raise OutputError(f"{path}: is empty, so no journal of a run; {_START_ANEW}")


def _synchronize_directory(path: Path) -> None:
    """Make a new name in a directory outlive a power cut."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _connect(path: Path, *, create: bool) -> sqlite3.Connection:
    """Open a database for this process alone."""
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
        # Two runs in one directory would spoil each other, so the lock is held until the end.
        if create:
            connection.execute(f"PRAGMA page_size = {_PAGE_BYTES}")
        connection.execute("PRAGMA locking_mode = EXCLUSIVE")
        connection.execute("BEGIN EXCLUSIVE")
        connection.execute("COMMIT")
    except sqlite3.Error as error:
        connection.close()
        if _is_named(error, "SQLITE_BUSY", "SQLITE_LOCKED"):
            raise _in_use(path) from error
        if _is_named(error, "SQLITE_READONLY", "SQLITE_CANTOPEN", "SQLITE_FULL"):
            raise OutputError(f"{path}: cannot be written: {error}") from error
        if _is_named(error, "SQLITE_CORRUPT"):
            raise _damaged(path, str(error)) from error
        raise OutputError(f"{path}: not a usable journal: {error}; {_START_ANEW}") from error
    return connection


def _is_named(error: sqlite3.Error, *names: str) -> bool:
    """Tell whether SQLite calls an error by one of these names, or a finer one below them."""
    # Those that Python's module raises by itself have no such name.
    return str(getattr(error, "sqlite_errorname", "")).startswith(names)


def _damaged(path: Path, how: str) -> OutputError:
    return OutputError(
        f"{path}: the journal is damaged ({how}), so the run cannot go on; restore the file, or "
        f"{_START_ANEW}"
    )


def _in_use(path: Path) -> OutputError:
    return OutputError(f"{path}: another process is using this run")


def _connect_to_read(path: Path, close: contextlib.ExitStack) -> sqlite3.Connection:
    """Open a database without a lock and without a trace.

    SQLite reads a log only where it may write beside it. So if there is one, both are copied, and
    the copy is read; a file without a log is read where it is.
    """
    if _identity(path) in _open_here:
        raise OutputError(f"{path}: this process is using this run")
    try:
        with path.open("rb") as file:
            try:
                # Nobody can begin to write while it is copied; held no longer than that.
                fcntl.lockf(
                    file, fcntl.LOCK_SH | fcntl.LOCK_NB, _SHARED_LOCK_SIZE, _SHARED_LOCK_START
                )
            except (BlockingIOError, PermissionError) as error:
                raise _in_use(path) from error
            logs = _logs_of(path)
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
            connection = _connect(folder / path.name, create=False)
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
