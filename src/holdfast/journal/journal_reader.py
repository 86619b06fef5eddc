"""Reading the journal of a run: its notes, its finished trials, and the trial that is not finished.

:class:`JournalReader` is all that looks at recorded runs: comparison, export, tables, resumption.
Every frame is checked before it is decoded, so what it returns is what was written. A run may go on
meanwhile: what is read is the journal as it was when it was opened.
"""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Self

import msgspec

from holdfast.errors import OutputError
from holdfast.journal.journal_file import (
    SQLITE_MAGIC,
    START,
    Entry,
    Finished,
    JournalFile,
    Notes,
    Position,
    Steps,
    boot_id,
    damaged,
    decode_entry,
    find_journal,
)
from holdfast.planning.inputs import Record
from holdfast.planning.outcome import Decisions, TrialResult

SESSION_SIZE = 16
"""Bytes that identify a run."""


decode_records = msgspec.msgpack.Decoder(list[Record]).decode
decode_result = msgspec.msgpack.Decoder(TrialResult).decode
_decode_decisions = msgspec.msgpack.Decoder(Decisions).decode


class UnfinishedTrial(NamedTuple):
    """A trial with journalled steps and no end."""

    trial: int
    records: list[Record]  # in the order in which they were appended
    # Whether none can have been lost: the machine is known not to have been rebooted since, or each
    # was on the disk before it was acted on (``survives="power_cut"``).
    is_complete: bool


class JournalReader:
    """The journal of a run, open to be read.

    Use :meth:`read`, and close it or use it in a ``with`` statement. Every method raises
    OutputError if what it reads is damaged.
    """

    def __init__(self, path: Path, file: JournalFile) -> None:
        self.path = path
        self._file = file
        self._end = START
        self._notes: dict[str, str] = {}
        self._results: dict[int, Position] = {}
        self._kept: dict[int, Position] = {}
        self._begun: tuple[int, Position] | None = None

    @classmethod
    def read(cls, path: Path) -> Self:
        """Open a journal; neither it nor its directory change, and a run may be writing to it.

        Raises OutputError if there is none, it is no journal, damaged, or another version's.
        """
        return cls._opened(path, os.O_RDONLY)

    @classmethod
    def _opened(cls, path: Path, flags: int) -> Self:
        if not path.is_file():
            raise OutputError(f"{path}: there is no journal of a run")
        file = JournalFile(path, flags)
        try:
            with _errors(path):
                start = os.pread(file.descriptor, len(SQLITE_MAGIC), 0)
                if start == SQLITE_MAGIC and flags == os.O_RDONLY:
                    file.close()
                    file = _converted(path)
                file.require_journal()
                journal = cls(path, file)
                journal._read_all()
        except BaseException:
            file.close()
            raise
        return journal

    @classmethod
    def read_run(cls, run: Path, purpose: str) -> Self:
        """Open the journal of a run to be read; see :func:`find_journal` and :meth:`read`."""
        return cls.read(find_journal(run, purpose))

    def close(self) -> None:
        """Close the file. May be repeated."""
        self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    # -- from the file -------------------------------------------------------------------------

    def _read_all(self) -> None:
        promised, _ = self._file.promised()
        for _ in self.read_on():
            pass
        if self._end.offset < promised:
            raise damaged(self.path, f"{self._last()}, a frame is missing or not whole")

    def read_on(self) -> Iterator[Entry]:
        """Take in what was written since, and yield it."""
        with _errors(self.path):
            for payload, end in self._file.frames(self._end):
                entry = decode_entry(payload)
                self._take(entry, self._end)
                self._end = end
                yield entry

    def _take(self, entry: Entry, position: Position) -> None:
        if isinstance(entry, Notes):
            self._notes = {**({} if entry.anew else self._notes), **entry.notes}
            return
        trial, begun = entry.trial, self._begun
        is_begun = begun is not None and begun[0] == trial
        if trial in self._results or (isinstance(entry, Steps) and begun and not is_begun):
            raise damaged(self.path, f"{self._last()}, trial {trial} comes where it cannot")
        if isinstance(entry, Steps):
            self._begun = begun or (trial, position)
            return
        self._results[trial] = position
        if begun is not None and is_begun:
            self._begun = None
            if entry.keeps_steps:
                self._kept[trial] = begun[1]

    def _last(self) -> str:
        what = "its notes"
        if self._begun is not None:
            trial = self._begun[0]
            what = f"record {len(self._steps(*self._begun)) - 1} of the unfinished trial {trial}"
        elif self._results:
            what = f"the result of trial {next(reversed(self._results))}"
        return f"after {what}, at byte {self._end.offset}"

    def _result_of(self, trial: int) -> Finished:
        for payload, _ in self._file.frames(self._results[trial], 4096):
            if isinstance(entry := decode_entry(payload), Finished):
                return entry
        raise damaged(self.path, f"the result of trial {trial} has changed since it was read")

    def _steps(self, trial: int, position: Position) -> list[Record]:
        records: list[Record] = []
        for payload, end in self._file.frames(position):
            entry = decode_entry(payload)
            if isinstance(entry, Steps) and entry.trial == trial:
                records += decode_records(entry.records)
            if end.offset >= self._end.offset or (
                isinstance(entry, Finished) and entry.trial == trial
            ):
                break
        return records

    # -- the run -------------------------------------------------------------------------------

    def meta(self) -> dict[str, str]:
        """Return the notes about the run."""
        return dict(self._notes)

    def session(self) -> bytes:
        """Return the 16 random bytes that were drawn for this run when it was created."""
        text = self._notes.get("session", "")
        with contextlib.suppress(ValueError):
            if len(session := bytes.fromhex(text)) == SESSION_SIZE:
                return session
        raise damaged(self.path, f"its session is {text!r}, not {SESSION_SIZE} bytes")

    def is_empty(self) -> bool:
        """Return whether no trial is finished or begun."""
        return not self._results and self._begun is None

    # -- the unfinished trial ------------------------------------------------------------------

    def unfinished_trial(self) -> int | None:
        """Return the number of the trial that is begun and not finished, None if there is none."""
        return None if self._begun is None else self._begun[0]

    def unfinished(self) -> UnfinishedTrial | None:
        """Return the records of the trial that is not finished, None if there is none."""
        if self._begun is None:
            return None
        with _errors(self.path):
            records = self._steps(*self._begun)
        on_disk, boot = self._notes.get("steps_on_disk") == "1", boot_id()
        is_complete = on_disk or (boot is not None and self._notes.get("steps_boot") == boot)
        return UnfinishedTrial(self._begun[0], records, is_complete)

    # -- finished trials -----------------------------------------------------------------------

    def finished(self) -> set[int]:
        """Return the numbers of the finished trials."""
        return set(self._results)

    def results(self, *, with_decisions: bool = False) -> Iterator[TrialResult]:
        """Yield the results in the order of their trials."""
        with _errors(self.path):
            for trial in sorted(self._results):
                entry = self._result_of(trial)
                result = decode_result(entry.result)
                if result.trial != trial:
                    raise damaged(self.path, f"trial {trial} has the result of {result.trial}")
                if with_decisions:
                    decisions = _decode_decisions(entry.decisions)
                    if decisions.digest() != result.digest:
                        raise damaged(self.path, f"trial {trial} has decisions of another digest")
                    # Which of the two is wrong is not known, but arrays are as long as the first.
                    if result.steps > len(decisions.log):
                        raise damaged(self.path, f"trial {trial} has more steps than decisions")
                    result = msgspec.structs.replace(result, decisions=decisions)
                yield result

    def decisions(self, trial: int) -> Decisions:
        """Return the decisions of a finished trial; raise OutputError if there is no such trial."""
        if trial not in self._results:
            raise OutputError(f"{self.path}: trial {trial} is not in the journal")
        with _errors(self.path):
            return _decode_decisions(self._result_of(trial).decisions)

    def kept_steps(self, trial: int) -> list[Record] | None:
        """Return the records of a finished trial whose steps were kept, None if they were not."""
        if trial not in self._kept:
            return None
        with _errors(self.path):
            return self._steps(trial, self._kept[trial])


@contextlib.contextmanager
def _errors(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise damaged(path, str(error)) from error


def _converted(path: Path) -> JournalFile:
    """Return a journal of an earlier version in the form of today, as a file without a name."""
    from holdfast.journal.old_journal import old_entries  # few runs need it

    with tempfile.NamedTemporaryFile(prefix="holdfast-journal-") as named:
        file = JournalFile(path, os.O_RDWR, Path(named.name))
    try:
        file.fill(old_entries(path))
    except BaseException:
        file.close()
        raise
    return file
