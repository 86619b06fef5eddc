"""The journal of a run: each finished trial, kept the moment it is finished.

It is one SQLite file, and each trial is one transaction: after a crash or a power cut, a trial is
in it whole or not at all. Tables and summary are made from it and can be made again at any time; a
resumed run reads from it which trials are missing.
"""

from __future__ import annotations

import contextlib
import os
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

import msgspec

from holdfast.outcome import Decisions, TrialResult
from holdfast.recording.files import OutputError

__all__ = ["SCHEMA_VERSION", "Journal", "Tally"]

SCHEMA_VERSION = 1
"""Raised whenever the tables or what is in them change their form."""

_SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE trials (trial INTEGER PRIMARY KEY, result BLOB NOT NULL, decisions BLOB NOT NULL);
"""

_RESULT_DECODER = msgspec.msgpack.Decoder(TrialResult)
_DECISIONS_DECODER = msgspec.msgpack.Decoder(Decisions)


class Tally(NamedTuple):
    """How many trials are finished, and how many of them successfully."""

    finished: int
    successes: int


class Journal:
    """The journal of one run, open. It is this process's alone until it is closed.

    Use :meth:`create` or :meth:`open`, and close it or use it in a ``with`` statement.

    Parameters
    ----------
    path : Path
        The file.
    connection : sqlite3.Connection
        The open database.
    """

    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self.path = path
        self._connection = connection
        self._encode = msgspec.msgpack.Encoder().encode

    @classmethod
    def create(cls, path: Path, meta: dict[str, str]) -> Self:
        """Make a new journal.

        Parameters
        ----------
        path : Path
            Where; there must be no file yet.
        meta : dict of str
            What to note about the run. The schema's version is added.

        Raises
        ------
        OutputError
            If there is a file already or it cannot be written.
        """
        # Made under a name of its own and then linked to the right one, which fails if that is
        # taken: nobody ever sees a journal that is half made, and of two runs one has it.
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        unfinished.unlink(missing_ok=True)
        try:
            journal = cls(unfinished, cls._connect(unfinished, create=True))
            try:
                with journal._errors():
                    rows = {"schema_version": str(SCHEMA_VERSION)} | meta
                    statements = [
                        "BEGIN IMMEDIATE",
                        *(part for part in _SCHEMA.split(";") if part.strip()),
                    ]
                    for statement in statements:
                        journal._connection.execute(statement)
                    journal._connection.executemany("INSERT INTO meta VALUES (?, ?)", rows.items())
                    journal._connection.execute("COMMIT")
            finally:
                journal.close()
            try:
                os.link(unfinished, path)
            except FileExistsError as error:
                raise OutputError(f"{path}: there is a journal already") from error
            except OSError as error:
                raise OutputError(f"{path}: cannot be made: {error.strerror}") from error
        finally:
            unfinished.unlink(missing_ok=True)
            unfinished.with_name(f"{unfinished.name}-journal").unlink(missing_ok=True)
        return cls.open(path)

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a journal that is there.

        Raises
        ------
        OutputError
            If there is none, it is no journal, another version's, or in use by another process.
        """
        if not path.is_file():
            raise OutputError(f"{path}: there is no journal of a run")
        journal = cls(path, cls._connect(path, create=False))
        try:
            version = journal.meta().get("schema_version")
        except OutputError:
            journal.close()
            raise
        if version != str(SCHEMA_VERSION):
            journal.close()
            raise OutputError(
                f"{path}: schema version {version}; this holdfast reads version {SCHEMA_VERSION}"
            )
        return journal

    @staticmethod
    def _connect(path: Path, *, create: bool) -> sqlite3.Connection:
        try:
            connection = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={'rwc' if create else 'rw'}",
                uri=True,
                timeout=1.0,
                isolation_level=None,
            )
        except sqlite3.Error as error:
            raise OutputError(f"{path}: cannot be opened: {error}") from error
        try:
            # Two runs in one directory would spoil each other, so the lock is held until the end.
            connection.execute("PRAGMA locking_mode = EXCLUSIVE")
            connection.execute("PRAGMA journal_mode = TRUNCATE")
            connection.execute("BEGIN IMMEDIATE")
            connection.execute("COMMIT")
        except sqlite3.Error as error:
            connection.close()
            if "locked" in str(error):
                raise OutputError(f"{path}: another process is using this run") from error
            raise OutputError(f"{path}: not a usable journal: {error}") from error
        return connection

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (sqlite3.Error, msgspec.DecodeError) as error:
            raise OutputError(f"{self.path}: {error}") from error

    def meta(self) -> dict[str, str]:
        """Return what was noted about the run."""
        with self._errors():
            return dict(self._connection.execute("SELECT key, value FROM meta"))

    def set_meta(self, key: str, value: str) -> None:
        """Note something about the run."""
        with self._errors():
            self._connection.execute("INSERT OR REPLACE INTO meta VALUES (?, ?)", (key, value))

    def restart(self, meta: dict[str, str]) -> None:
        """Forget what was noted about a run without a finished trial, and note ``meta`` instead.

        Raises
        ------
        OutputError
            If a trial is finished.
        """
        if not self.is_empty():
            raise OutputError(f"{self.path}: holds finished trials")
        rows = {"schema_version": str(SCHEMA_VERSION)} | meta
        with self._errors():
            self._connection.execute("BEGIN IMMEDIATE")
            self._connection.execute("DELETE FROM meta")
            self._connection.executemany("INSERT INTO meta VALUES (?, ?)", rows.items())
            self._connection.execute("COMMIT")

    def add(self, result: TrialResult) -> None:
        """Keep a finished trial; when this returns, it is on the disk.

        Parameters
        ----------
        result : TrialResult
            The outcome, with its decisions.

        Raises
        ------
        OutputError
            If the trial is there already, or the disk is full.
        """
        if result.decisions is None:
            raise OutputError(f"trial {result.trial}: the result comes without its decisions")
        row = (
            result.trial,
            self._encode(msgspec.structs.replace(result, decisions=None)),
            self._encode(result.decisions),
        )
        with self._errors():
            # Outside an explicit transaction, a statement is one of its own.
            self._connection.execute("INSERT INTO trials VALUES (?, ?, ?)", row)

    def is_empty(self) -> bool:
        """Tell whether no trial is kept."""
        with self._errors():
            return self._connection.execute("SELECT 1 FROM trials LIMIT 1").fetchone() is None

    def finished(self) -> set[int]:
        """Return the numbers of the trials that are kept."""
        with self._errors():
            return {trial for (trial,) in self._connection.execute("SELECT trial FROM trials")}

    def tally(self) -> Tally:
        """Count the trials that are kept."""
        finished = successes = 0
        for result in self.results():
            finished += 1
            successes += result.success
        return Tally(finished, successes)

    def results(self) -> Iterator[TrialResult]:
        """Yield the results in the order of their trials, without their decisions."""
        with self._errors():
            for (blob,) in self._connection.execute("SELECT result FROM trials ORDER BY trial"):
                yield _RESULT_DECODER.decode(blob)

    def decisions(self, trial: int) -> Decisions:
        """Return the decisions of one trial.

        Raises
        ------
        OutputError
            If the journal does not have that trial.
        """
        with self._errors():
            row = self._connection.execute(
                "SELECT decisions FROM trials WHERE trial = ?", (trial,)
            ).fetchone()
            if row is None:
                raise OutputError(f"{self.path}: trial {trial} is not in the journal")
            return _DECISIONS_DECODER.decode(row[0])

    def close(self) -> None:
        """Close the file and leave it to others."""
        # An empty rollback file would stay behind otherwise; it does no harm if this fails.
        with contextlib.suppress(sqlite3.Error):
            self._connection.execute("PRAGMA journal_mode = DELETE")
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
