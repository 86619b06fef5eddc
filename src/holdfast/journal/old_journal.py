"""Journals of earlier versions, which were SQLite databases: what is in them, as entries of today.

A database is copied, with its log, and the copy is read: SQLite writes where it reads a log. Each
row has a checksum over its content and its key. A file beside it counts the records of an
unfinished trial, for a log that is lost takes the last of them with it and nobody notices.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import shutil
import sqlite3
import struct
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

from holdfast.errors import OutputError
from holdfast.journal.journal_file import Entry, Finished, Notes, Steps, damaged, packed
from holdfast.printable import brief

_SCHEMA_VERSION = "3"
_NUMBERS = struct.Struct("<qq")


def files_of(path: Path) -> list[Path]:
    """Return the files of a database: itself, its logs, and the count."""
    names = (path.name + suffix for suffix in ("", "-wal", "-journal", "-count"))
    return [each for name in names if (each := path.with_name(name)).is_file()]


def old_entries(path: Path) -> Iterator[Entry]:
    """Yield what is in a journal of an earlier version; it is not changed.

    Raises OutputError if it is damaged, of a still earlier version, or in use.
    """
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(path.open("rb"))
            try:
                # Held to the end, so that nobody begins to write: SQLite's range of shared locks.
                fcntl.lockf(file, fcntl.LOCK_SH | fcntl.LOCK_NB, 510, 0x40000002)
            except (BlockingIOError, PermissionError):
                raise OutputError(f"{path}: another process is using this run") from None
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="holdfast-")))
            for source in files_of(path):
                shutil.copyfile(source, folder / source.name)
        except OSError as error:
            raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
        try:
            connection = sqlite3.connect(folder / path.name, isolation_level=None)
            stack.enter_context(contextlib.closing(connection))
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2**29)
            yield from _Rows(path, connection).entries()
        except (sqlite3.Error, ValueError, TypeError, struct.error, msgspec.DecodeError) as error:
            raise damaged(path, str(error)) from error


class _Rows:
    def __init__(self, path: Path, connection: sqlite3.Connection) -> None:
        self._path = path
        self._ask = connection.execute

    def entries(self) -> Iterator[Entry]:
        # In somebody else's file a name may stand for a view, a trigger may write, and a column may
        # be computed, without end. Nothing is asked of it before this.
        for name, sql in self._ask("SELECT name, sql FROM sqlite_schema"):
            if not str(sql).startswith(f"CREATE TABLE {name} (") or " AS " in sql:
                raise damaged(self._path, f"{brief(name)} in it is no table of a journal")
        (found,) = self._ask("PRAGMA quick_check(1)").fetchone()
        if found != "ok":
            raise damaged(self._path, str(found).strip().splitlines()[-1])
        notes = {}
        for key, value, checksum in self._ask("SELECT * FROM meta"):
            data = f"{key}={value}".encode()
            self._require("meta", len(key), len(value), data, checksum, f"note {key!r}")
            notes[key] = value
        version = notes.pop("schema_version", None)
        if version != _SCHEMA_VERSION:
            raise OutputError(
                f"{self._path}: schema version {version}; this holdfast reads version "
                f"{_SCHEMA_VERSION}; use the holdfast that made it"
            )
        records = list(self._steps())
        if notes.pop("steps_counted", "0") == "1" and records and not self._has_all(records):
            # Whoever goes on must ask the world how far it is, as after a power cut.
            notes |= {"steps_boot": "", "steps_on_disk": "0"}
        yield Notes(notes, anew=True)
        kept = self._kept()
        for trial, result, result_sum, decisions, decisions_sum in self._ask(
            "SELECT * FROM trials ORDER BY trial"
        ):
            self._require("trial", trial, 0, result, result_sum, f"result of trial {trial}")
            self._require("trial", trial, 1, decisions, decisions_sum, f"decisions of {trial}")
            if (steps := kept.get(trial)) is not None:
                yield Steps(trial, packed(steps))
            raw = msgspec.Raw(result), msgspec.Raw(decisions)
            yield Finished(trial, *raw, keeps_steps=steps is not None)
        if records:
            yield Steps(records[0][0], packed([record for _, record in records]))

    def _steps(self) -> Iterator[tuple[int, msgspec.Raw]]:
        rows = self._ask("SELECT * FROM steps ORDER BY sequence")
        for expected, (sequence, trial, data, checksum) in enumerate(rows):
            where = f"record {expected} of the unfinished trial {trial}"
            if sequence != expected:
                raise damaged(self._path, f"{where} is missing")
            self._require("step", sequence, trial, data, checksum, where)
            yield trial, msgspec.Raw(data)

    def _kept(self) -> dict[int, list[msgspec.Raw]]:
        found = self._ask("SELECT 1 FROM sqlite_schema WHERE name = 'kept_steps'").fetchone()
        kept = {}
        for trial, data, checksum in self._ask("SELECT * FROM kept_steps") if found else ():
            self._require("trial", trial, 2, data, checksum, f"steps of trial {trial}")
            kept[trial] = list(map(msgspec.Raw, msgspec.msgpack.decode(data, type=list[bytes])))
        return kept

    def _has_all(self, records: list[tuple[int, msgspec.Raw]]) -> bool:
        try:
            data = self._path.with_name(f"{self._path.name}-count").read_bytes()
            trial, number = _NUMBERS.unpack(data)
        except (OSError, struct.error):
            return False
        return bool(trial == records[0][0] and number <= len(records))

    def _require(
        self, table: str, first: int, second: int, data: Any, checksum: Any, what: str
    ) -> None:
        """Raise OutputError unless a row has its checksum; SQLite has a type for each value."""
        row, person = _NUMBERS.pack(first, second) + data, f"holdfast-{table}".encode()
        if hashlib.blake2b(row, digest_size=8, person=person).digest() != checksum:
            raise damaged(self._path, f"the {what} has a wrong checksum")
