"""Reading the journal of a run: its notes, its finished trials, and the trial that is not finished.

:class:`JournalReader` is all that looks at recorded runs: comparison, export, tables, resumption.
Every row is checked before it is decoded, so what it returns is what was written.
"""

from __future__ import annotations

import contextlib
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Self

import msgspec

from holdfast.errors import OutputError, RecordError
from holdfast.planning.outcome import Decisions, TrialResult
from holdfast.protocol.records import Record, decode_record
from holdfast.recording.journal_file import (
    START_ANEW,
    JournalFile,
    StepCount,
    boot_id,
    find_journal,
    is_named,
    meta_checksum,
    of_steps,
    of_trials,
)

__all__ = ["SCHEMA_VERSION", "SESSION_SIZE", "TABLES", "JournalReader", "UnfinishedTrial"]

SCHEMA_VERSION = 3
"""Raised whenever the tables or their content change form."""

TABLES = {
    "meta": "CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL, checksum BLOB NOT NULL) "
    "WITHOUT ROWID",
    "trials": "CREATE TABLE trials (trial INTEGER PRIMARY KEY, result BLOB NOT NULL, "
    "result_checksum BLOB NOT NULL, decisions BLOB NOT NULL, decisions_checksum BLOB NOT NULL)",
    "steps": "CREATE TABLE steps (sequence INTEGER PRIMARY KEY, trial INTEGER NOT NULL, "
    "record BLOB NOT NULL, checksum BLOB NOT NULL)",
    "kept_steps": "CREATE TABLE kept_steps "
    "(trial INTEGER PRIMARY KEY, records BLOB NOT NULL, checksum BLOB NOT NULL)",
}
"""The statements that make the tables. Not every journal has the last."""

SESSION_SIZE = 16
"""Bytes that identify a run."""

_RESULT_DECODER = msgspec.msgpack.Decoder(TrialResult)
_DECISIONS_DECODER = msgspec.msgpack.Decoder(Decisions)
_KEPT_DECODER = msgspec.msgpack.Decoder(list[bytes])


class UnfinishedTrial(NamedTuple):
    """A trial with journalled steps and no end.

    Attributes
    ----------
    records : list of Record
        In the order in which they were appended.
    same_boot : bool
        Whether the machine has not been rebooted since the last of them was written; False if that
        is not known.
    on_disk : bool
        Whether each of them was on the disk before it was acted on (``survives="power_cut"``).
    all_counted : bool
        Whether there are as many as were counted when they were written; False if that is not
        known. If so, no log was removed or cut.
    """

    trial: int
    records: list[Record]
    same_boot: bool
    on_disk: bool
    all_counted: bool

    @property
    def is_complete(self) -> bool:
        """Whether no record can have been lost."""
        return self.all_counted and (self.same_boot or self.on_disk)


class JournalReader:
    """The journal of a run, open to be read.

    Use :meth:`read`, and close it or use it in a ``with`` statement. It belongs to the thread that
    opened it. Every method raises OutputError if what it reads is damaged.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._file = JournalFile(path)
        self._connection = connection
        self._version_read: tuple[int, ...] | None = None
        self._close = contextlib.ExitStack()
        self._close.callback(connection.close)

    @classmethod
    def read(cls, path: Path) -> Self:
        """Open a journal that nobody is using; neither it nor its directory change.

        What a killed process left in the log is read as well. That needs a copy, which is removed
        by :meth:`close`.

        Raises
        ------
        OutputError
            If there is none, it is no journal, damaged, another version's, or in use.
        """
        file = JournalFile(path)
        file.require()
        close = contextlib.ExitStack()
        try:
            before = file.version()
            journal = cls(path, file.connect_to_read(close))
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

    @classmethod
    def read_run(cls, run: Path, purpose: str) -> Self:
        """Open the journal of a run to be read; see :func:`find_journal` and :meth:`read`."""
        return cls.read(find_journal(run, purpose))

    def close(self) -> None:
        """Close the file. May be repeated."""
        self._close.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def check(self) -> None:
        """Read all of the file to find damage to its structure."""
        with self._errors():
            (found,) = self._connection.execute("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            # SQLite's account begins with a line of stars that names the table.
            raise self._damaged(str(found).strip().splitlines()[-1])

    def require_unchanged(self) -> None:
        """Raise OutputError if somebody has written to the file since :meth:`read` opened it."""
        if self._version_read is None:
            return
        with contextlib.suppress(OSError):
            if self._version_read == self._file.version():
                return
        raise OutputError(f"{self.path}: a run has written to it while it was read; try again")

    def _require_version(self) -> None:
        with self._errors():
            # In somebody else's file a name may stand for a view, a trigger may write, and a
            # column may be computed, without end. Nothing is asked of it before this.
            for name, sql in self._connection.execute("SELECT name, sql FROM sqlite_schema"):
                if sql != TABLES.get(name, ""):
                    raise self._damaged(f"{name!r:.80} in it is no table of a journal")
            row = self._connection.execute(
                "SELECT value FROM meta WHERE key = 'schema_version'"
            ).fetchone()
        version = None if row is None else row[0]
        if version != str(SCHEMA_VERSION):
            raise OutputError(
                f"{self.path}: schema version {version}; this holdfast reads version "
                f"{SCHEMA_VERSION}; go on with the holdfast that made it, or {START_ANEW}"
            )

    def _require_in_place(self) -> None:
        """Raise OutputError if the file can no longer be found under its name."""

    def _damaged(self, how: str) -> OutputError:
        return self._file.damaged(how)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise self._output_error(error) from error
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise self._damaged(str(error)) from error

    def _output_error(self, error: sqlite3.Error) -> OutputError:
        """Return our error for one of SQLite's; LostJournalError if a file is gone."""
        if isinstance(error, sqlite3.DatabaseError):
            # SQLITE_ERROR is an error in our SQL: then the tables are not ours. An error without a
            # name is from Python's module, which could not decode a text.
            name = getattr(error, "sqlite_errorname", None)
            undecoded = name is None and isinstance(error, sqlite3.OperationalError)
            if (
                undecoded
                or name == "SQLITE_ERROR"
                or is_named(error, "SQLITE_CORRUPT", "SQLITE_NOTADB")
            ):
                return self._damaged(str(error))
            # For some of the files that are gone, SQLite says that it cannot write to them.
            try:
                self._require_in_place()
            except OutputError as lost:
                return lost
        return OutputError(f"{self.path}: {error}")

    # -- the run -------------------------------------------------------------------------------

    def meta(self) -> dict[str, str]:
        """Return the notes about the run."""
        meta = {}
        with self._errors():
            for key, value, checksum in self._connection.execute(
                "SELECT key, value, checksum FROM meta"
            ):
                is_text = isinstance(key, str) and isinstance(value, str)
                if not is_text or meta_checksum(key, value) != checksum:
                    raise self._damaged(f"its note {key!r} has a wrong checksum")
                meta[key] = value
        return meta

    def session(self) -> bytes:
        """Return the 16 random bytes that were drawn for this run when it was created."""
        text = self.meta().get("session", "")
        try:
            session = bytes.fromhex(text)
        except ValueError:
            session = b""
        if len(session) != SESSION_SIZE:
            raise self._damaged(f"its session is {text!r}, not {SESSION_SIZE} bytes")
        return session

    def is_empty(self) -> bool:
        """Return whether no trial is finished or begun."""
        with self._errors():
            return (
                self._connection.execute("SELECT 1 FROM trials LIMIT 1").fetchone() is None
                and self.unfinished_trial() is None
            )

    # -- the unfinished trial ------------------------------------------------------------------

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
        """Return the records of the trial that is not finished, None if there is none."""
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
                if not of_steps.is_intact(data, checksum, sequence, number):
                    raise self._damaged(f"{where} has a wrong checksum")
                try:
                    records.append(decode_record(data))
                except RecordError as error:
                    raise self._damaged(f"{where}: {error}") from error
        if trial is None:
            return None
        meta = self.meta()
        boot = boot_id()
        all_counted = True
        if meta.get("steps_counted") == "1":
            counted = StepCount.read(self._file.count)
            all_counted = counted is not None and counted[0] == trial and counted[1] <= len(records)
        return UnfinishedTrial(
            trial=trial,
            records=records,
            same_boot=boot is not None and meta.get("steps_boot") == boot,
            on_disk=meta.get("steps_on_disk") == "1",
            all_counted=all_counted,
        )

    # -- finished trials -----------------------------------------------------------------------

    def finished(self) -> set[int]:
        """Return the numbers of the finished trials."""
        with self._errors():
            return {trial for (trial,) in self._connection.execute("SELECT trial FROM trials")}

    def results(self, *, with_decisions: bool = False) -> Iterator[TrialResult]:
        """Yield the results in the order of their trials."""
        with self._errors():
            for trial, blob, checksum in self._connection.execute(
                "SELECT trial, result, result_checksum FROM trials ORDER BY trial"
            ):
                if not of_trials.is_intact(blob, checksum, trial, 0):
                    raise self._damaged(f"the result of trial {trial} has a wrong checksum")
                result = _RESULT_DECODER.decode(blob)
                if with_decisions:
                    decisions = self.decisions(trial)
                    if decisions.digest() != result.digest:
                        raise self._damaged(f"trial {trial} has decisions with another digest")
                    # Which of the two is wrong is not known, but arrays are as long as the first.
                    if result.steps > len(decisions.log):
                        raise self._damaged(f"trial {trial} has more steps than decisions")
                    result = msgspec.structs.replace(result, decisions=decisions)
                yield result

    def decisions(self, trial: int) -> Decisions:
        """Return the decisions of a finished trial; raise OutputError if there is no such trial."""
        with self._errors():
            row = self._connection.execute(
                "SELECT decisions, decisions_checksum FROM trials WHERE trial = ?", (trial,)
            ).fetchone()
            if row is None:
                raise OutputError(f"{self.path}: trial {trial} is not in the journal")
            if not of_trials.is_intact(row[0], row[1], trial, 1):
                raise self._damaged(f"the decisions of trial {trial} have a wrong checksum")
            return _DECISIONS_DECODER.decode(row[0])

    def _has_kept_steps(self) -> bool:
        found = self._connection.execute("SELECT 1 FROM sqlite_schema WHERE name = 'kept_steps'")
        return found.fetchone() is not None

    def kept_steps(self, trial: int) -> list[Record] | None:
        """Return the records of a finished trial whose steps were kept, None if they were not."""
        with self._errors():
            row = (
                self._has_kept_steps()
                and self._connection.execute(
                    "SELECT records, checksum FROM kept_steps WHERE trial = ?", (trial,)
                ).fetchone()
            )
            if not row:
                return None
            if not of_trials.is_intact(row[0], row[1], trial, 2):
                raise self._damaged(f"the steps of trial {trial} have a wrong checksum")
            try:
                return [decode_record(data) for data in _KEPT_DECODER.decode(row[0])]
            except RecordError as error:
                raise self._damaged(f"the steps of trial {trial}: {error}") from error
