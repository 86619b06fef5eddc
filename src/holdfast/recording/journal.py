"""The journal of a run: each finished trial, and each step of the one that is not finished.

It is one SQLite file. A finished trial is one transaction, so after a crash or a power cut it is in
the journal whole or not at all. The steps of an unfinished trial are appended before the robot acts
on them, so that a new process can go on where the old one died; they are deleted when their trial
is finished. A simulated world can be computed again. What a robot has observed cannot, so there the
steps are kept, in a table that is created for the first of them. Tables and summary are made from
the journal and can be made again at any time.

A commit survives the death of the process. To survive the death of the machine it has to be on the
disk as well; that is done for what begins or finishes a trial, and on demand for every step.

A log that is lost would take the last steps with it. So what begins a trial is moved into the main
file at once, which then says that there is a log, and the records are counted beside it
(:mod:`holdfast.recording.journal_file`). That costs a few microseconds a step; a mode without a
log, as safe in a power cut, would wait for the disk.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Self

import msgspec

from holdfast.errors import InvalidValueError, LostJournalError, OutputError
from holdfast.planning.outcome import TrialResult
from holdfast.protocol.records import Record, encode_record
from holdfast.recording.journal_file import (
    START_ANEW,
    FileIdentity,
    JournalFile,
    StepCount,
    Survives,
    boot_id,
    meta_checksum,
    of_steps,
    of_trials,
    open_here,
    synchronize_directory,
)
from holdfast.recording.journal_reader import (
    SCHEMA_VERSION,
    SESSION_SIZE,
    TABLES,
    JournalReader,
)

__all__ = ["Journal"]

_MAX_EPOCH = 2**32 - 1

_MAX_LOG_PAGES = 16384
"""The log is moved into the main file beyond 16 MiB at the latest: read back after a crash in some
10 ms, and reached only in trials of thousands of steps."""


class Journal(JournalReader):
    """The journal of one run, open to be written. No other process can open it.

    Use :meth:`create` or :meth:`open`, and close it or use it in a ``with`` statement. It belongs
    to the thread that opened it.

    Attributes
    ----------
    survives : {"process_crash", "power_cut"}
        What each appended step survives.
    on_append : callable or None
        Gets the trial and the records of each :meth:`append`, once they are written.
    """

    def __init__(
        self, path: Path, connection: sqlite3.Connection, survives: Survives = "process_crash"
    ) -> None:
        super().__init__(path, connection)
        self.survives = survives
        self._encode = msgspec.msgpack.Encoder().encode
        self._steps: _Steps | None = None
        self.on_append: Callable[[int, Sequence[Record]], None] | None = None
        self._count: StepCount | None = None
        self._in_place: list[tuple[str, FileIdentity]] = []

    # -- opening and closing -------------------------------------------------------------------

    @classmethod
    def create(
        cls, path: Path, meta: dict[str, str], *, survives: Survives = "process_crash"
    ) -> Self:
        """Create a journal with notes about the run, to which its version and session are added.

        Raises
        ------
        OutputError
            If there is a file already or it cannot be written.
        """
        # It is made under another name and then linked to its own, which fails if that is taken:
        # nobody ever sees half a journal, and only one of two runs gets it.
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        unfinished.unlink(missing_ok=True)
        if not path.exists():
            for log in JournalFile(path).logs():
                # SQLite would take it for the new journal's log.
                raise OutputError(
                    f"{log}: is the log of a journal that is gone; restore that, or {START_ANEW}"
                )
        try:
            journal = cls(unfinished, JournalFile(unfinished).connect(create=True))
            try:
                with journal._transaction():
                    for table in ("meta", "trials", "steps"):
                        journal._connection.execute(TABLES[table])
                    journal._note(_first_rows(meta))
            finally:
                journal._connection.close()
            try:
                os.link(unfinished, path)
                synchronize_directory(path.parent)
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
        """Open an existing journal to go on with it.

        ``check`` reads all of it first, to find damage.

        Raises
        ------
        OutputError
            If there is none, it is no journal, damaged, another version's, or in use by another
            process.
        """
        file = JournalFile(path)
        file.require()
        journal = cls(path, file.connect(), survives)
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
        open_here[identity] = journal
        journal._close.callback(open_here.pop, identity, None)
        return journal

    def _write_ahead(self) -> None:
        with self._errors():
            (mode,) = self._connection.execute("PRAGMA journal_mode = WAL").fetchone()
            if mode != "wal":
                raise OutputError(f"{self.path}: SQLite cannot write ahead here (mode {mode})")
            self._connection.execute(f"PRAGMA wal_autocheckpoint = {_MAX_LOG_PAGES}")
            self._set_synchronous(self.survives)
            # SQLite creates the log at the first use of the database in that mode.
            self._connection.execute("SELECT 1 FROM meta LIMIT 1").fetchone()

    def _leave_one_file(self) -> None:
        """Move the log into the main file: a plain file can be read by anything."""
        # It does no harm if this fails: the next one to open the journal does it.
        with contextlib.suppress(sqlite3.Error, OSError, OutputError):
            count_is_needless = False
            # Only the process that has written the count may say that it is not needed any more:
            # if records were lost before, the next process must find that out as well.
            if self._count is not None:
                with contextlib.suppress(OutputError):
                    with self._transaction():
                        self._note({"steps_counted": "0"})
                    count_is_needless = True
            self._connection.execute("PRAGMA journal_mode = DELETE")
            if count_is_needless or self.unfinished_trial() is None:
                self._file.count.unlink(missing_ok=True)

    def _move_log(self) -> None:
        """Move the content of the log into the main file, and let both survive a power cut."""
        with self._errors():
            self._connection.execute("PRAGMA wal_checkpoint(PASSIVE)")

    # -- the files are still there -------------------------------------------------------------

    def _note_places(self) -> None:
        # Absolute, for the user's code may change the current directory.
        path = self.path.absolute()
        files = (JournalFile(path), JournalFile(self._file.log.absolute()))
        try:
            self._in_place = [(str(file.path), file.version()[:2]) for file in files]
        except OSError as error:
            raise OutputError(f"{error.filename}: cannot be read: {error.strerror}") from error

    def _require_in_place(self) -> None:
        """Check that what is written can still be found under its name.

        If an open file is removed, SQLite goes on to write to it, and all is lost as soon as it is
        closed. While it is open, no other file can get its inode.
        """
        for number, (place, identity) in enumerate(self._in_place):
            try:
                status = os.stat(place)  # noqa: PTH116 (runs after every step, so it must be fast)
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

    # -- transactions --------------------------------------------------------------------------

    def _set_synchronous(self, survives: Survives) -> None:
        self._connection.execute(
            f"PRAGMA synchronous = {'FULL' if survives == 'power_cut' else 'NORMAL'}"
        )

    @contextlib.contextmanager
    def _transaction(self) -> Iterator[None]:
        """Do all of what is inside or nothing; the result survives a power cut."""
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

    # -- the run -------------------------------------------------------------------------------

    def set_meta(self, **rows: str) -> None:
        """Write notes about the run, all or none."""
        with self._transaction():
            self._note(rows)

    def _note(self, rows: dict[str, str]) -> None:
        self._connection.executemany(
            "INSERT OR REPLACE INTO meta VALUES (?, ?, ?)",
            [(key, value, meta_checksum(key, value)) for key, value in rows.items()],
        )

    def restart(self, meta: dict[str, str]) -> None:
        """Replace the notes about a run; raise OutputError if a trial is finished or begun."""
        if not self.is_empty():
            raise OutputError(f"{self.path}: holds trials that are finished or begun")
        with self._transaction():
            self._connection.execute("DELETE FROM meta")
            self._note(_first_rows(meta))

    def raise_epoch(self) -> int:
        """Count one more process of the run, and return their number, from 1.

        The new count is on the disk when this returns: no two processes get the same, even if the
        power is cut between them, or the log removed.
        """
        text = self.meta().get("epoch", "0")
        if not text.isdecimal() or not 0 <= int(text) < _MAX_EPOCH:
            raise self._damaged(f"its epoch is {text!r}, not from 0 to {_MAX_EPOCH - 1}")
        epoch = int(text) + 1
        self.set_meta(epoch=str(epoch))
        self._move_log()
        return epoch

    # -- steps of the unfinished trial ---------------------------------------------------------

    def append(self, trial: int, records: Sequence[Record]) -> None:
        """Write records of an unfinished trial; act on none of them if this raises.

        When this returns they survive the death of the process; with ``survives="power_cut"`` they
        are on the disk. The first records of a trial, and the first after each opening, always are,
        and in the main file: so it is always known that a trial was begun.

        Raises
        ------
        OutputError
            If they cannot be written. Then all of them are in the journal, or none.
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
            values += (sequence, trial, data, of_steps(sequence, trial, data))
            sequence += 1
        # Until they are known to be written, the content of the file is not known.
        self._steps = None
        count = self._count_from(trial, steps.next_sequence) if first else self._count
        assert count is not None
        # One statement is a transaction by itself, in a fraction of the time.
        insert = f"INSERT INTO steps VALUES {', '.join(['(?, ?, ?, ?)'] * len(records))}"
        if first:
            with self._transaction():
                self._note(
                    {
                        "steps_boot": boot_id() or "",
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
                raise self._output_error(error) from error
            self._require_in_place()
        # Afterwards: a count that is too small does no harm.
        count.write(trial, sequence)
        self._steps = _Steps(trial, sequence)
        if self.on_append is not None:
            self.on_append(trial, records)

    def _count_from(self, trial: int, number: int) -> StepCount:
        """Begin to count, once what is in the journal was found to be enough to go on from."""
        if self._count is None:
            self._count = StepCount(
                self._file.count.absolute(), synchronous=self.survives == "power_cut"
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

    # -- finished trials -----------------------------------------------------------------------

    def add(self, result: TrialResult, *, keep_steps: bool = False) -> None:
        """Write a finished trial, with its decisions; when this returns, it is on the disk.

        Its steps are deleted; ``keep_steps`` keeps them for :meth:`kept_steps`.

        Raises
        ------
        OutputError
            If the trial is in the journal already, or the disk is full.
        """
        if result.decisions is None:
            raise OutputError(f"trial {result.trial}: the result comes without its decisions")
        trial = result.trial
        outcome = self._encode(msgspec.structs.replace(result, decisions=None))
        decisions = self._encode(result.decisions)
        checksums = of_trials(trial, 0, outcome), of_trials(trial, 1, decisions)
        self._steps = None
        unfinished = self.unfinished() if keep_steps else None
        with self._transaction():
            self._connection.execute(
                "INSERT INTO trials VALUES (?, ?, ?, ?, ?)",
                (trial, outcome, checksums[0], decisions, checksums[1]),
            )
            if unfinished is not None and unfinished.trial == trial:
                kept = self._encode([encode_record(record) for record in unfinished.records])
                if not self._has_kept_steps():
                    self._connection.execute(TABLES["kept_steps"])
                self._connection.execute(
                    "INSERT INTO kept_steps VALUES (?, ?, ?)",
                    (trial, kept, of_trials(trial, 2, kept)),
                )
            dropped = self._connection.execute("DELETE FROM steps WHERE trial = ?", (trial,))
        if dropped.rowcount:
            # Now, while the robot has nothing to do, and not during its next trial. The trial is
            # in the journal already, so the next write reports any trouble.
            with contextlib.suppress(OutputError):
                self._move_log()


class _Steps(NamedTuple):
    """The unfinished trial, and the number of its next record."""

    trial: int
    next_sequence: int


def _first_rows(meta: dict[str, str]) -> dict[str, str]:
    return {
        "schema_version": str(SCHEMA_VERSION),
        "session": os.urandom(SESSION_SIZE).hex(),
        **meta,
    }
