"""The journal of a run: each finished trial, and each step of the one that is not finished.

It is one file to which frames are appended (:mod:`holdfast.journal.journal_file`). The steps of a
trial are in it before the robot acts on them, so that a new process can go on where the old one
died; its result follows them. Tables and summary are made from the journal and can be made again at
any time.

What was written survives the death of the process. To survive the death of the machine it has to be
on the disk as well; that is done for what begins or finishes a trial, and on demand for every step.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Self

import msgspec

from holdfast.errors import InvalidValueError, OutputError
from holdfast.journal.journal_file import (
    Entry,
    Finished,
    JournalFile,
    Notes,
    Position,
    Steps,
    Survives,
    boot_id,
    damaged,
    encode,
    packed,
    steps_payload,
)
from holdfast.journal.journal_reader import SESSION_SIZE, JournalReader
from holdfast.planning.inputs import Record
from holdfast.planning.outcome import TrialResult
from holdfast.runtime.files import synchronize

_MAX_EPOCH = 2**32 - 1


class Journal(JournalReader):
    """The journal of one run, open to be written. No other process can write to it.

    Use :meth:`create` or :meth:`open`, and close it or use it in a ``with`` statement.

    Attributes
    ----------
    survives : {"process_crash", "power_cut"}
        What each appended step survives.
    """

    def __init__(self, path: Path, file: JournalFile) -> None:
        super().__init__(path, file)
        self.survives: Survives = "process_crash"
        self._on_disk = 0
        self._appending: int | None = None
        self._broken: OutputError | None = None

    # -- opening -------------------------------------------------------------------------------

    @classmethod
    def create(
        cls, path: Path, meta: dict[str, str], *, survives: Survives = "process_crash"
    ) -> Self:
        """Create a journal with notes about the run, to which its session is added.

        Raises OutputError if there is a file already or it cannot be written.
        """
        return cls.create_from(path, [_first_notes(meta)], survives)

    @classmethod
    def create_from(
        cls, path: Path, entries: Iterable[Entry], survives: Survives = "process_crash"
    ) -> Self:
        """Create a journal of its entries; see :meth:`create`."""
        # It is made under another name and then linked to its own, which fails if that is taken:
        # nobody ever sees half a journal, and only one of two runs gets it.
        unfinished = path.with_name(f".{path.name}.{os.getpid()}")
        with contextlib.suppress(OSError):
            unfinished.unlink()
        journal = cls(path, JournalFile(path, os.O_RDWR | os.O_CREAT | os.O_EXCL, unfinished))
        journal.survives = survives
        try:
            journal._on_disk = journal._file.fill(entries)
            journal._read_all()
            os.link(unfinished, path)
            synchronize(path.parent)  # its new name survives a power cut
        except BaseException as error:
            journal.close()
            if isinstance(error, FileExistsError):
                raise OutputError(f"{path}: there is a journal already") from error
            if isinstance(error, OSError):
                raise OutputError(f"{path}: cannot be made: {error.strerror}") from error
            raise
        finally:
            with contextlib.suppress(OSError):
                unfinished.unlink()
        return journal

    @classmethod
    def convert(cls, old: Path, path: Path) -> None:
        """Make a journal of one of an earlier version, unless that was done before.

        The old one is renamed (``journal.sqlite.old``), so that no earlier version goes on with it.
        Raises OutputError if the old one is damaged or in use, or this cannot be written.
        """
        from holdfast.journal.old_journal import files_of, old_entries  # few runs need it

        if not path.exists():
            cls.create_from(path, old_entries(old)).close()
        try:
            for file in reversed(files_of(old)):
                suffix = file.name.removeprefix(old.name)
                file.rename(file.with_name(f"{old.name}.old{suffix}"))
        except OSError as error:
            raise OutputError(f"{old}: cannot be renamed: {error.strerror}") from error

    @classmethod
    def open(cls, path: Path, *, survives: Survives = "process_crash") -> Self:
        """Open an existing journal to go on with it.

        Raises OutputError if there is none, it is no journal, damaged, another version's, or in use
        by another process.
        """
        journal = cls._opened(path, os.O_RDWR)
        journal.survives = survives
        try:
            _, journal._on_disk = journal._file.promised()
            # The rest was never whole, or a power cut has taken a part before it.
            if os.fstat(journal._file.descriptor).st_size > journal._end.offset:
                os.ftruncate(journal._file.descriptor, journal._end.offset)
        except BaseException as error:
            journal.close()
            if isinstance(error, OSError):
                raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
            raise
        return journal

    # -- writing -------------------------------------------------------------------------------

    def _write(self, *entries: Entry) -> None:
        """Append entries, all or none; when this returns, they are on the disk."""
        end = self._append(list(map(encode, entries)), synchronize=True)
        for _ in self.read_on():
            pass
        self._end = end

    def _append(self, payloads: Sequence[bytes], *, synchronize: bool) -> Position:
        if self._broken is not None:
            raise self._broken
        file = self._file
        try:
            end = file.append(self._end, payloads)
            if synchronize:
                os.fdatasync(file.descriptor)
                self._on_disk = end.offset
            file.mark(end.offset, self._on_disk)
        except OSError as error:
            # What of the file is on the disk is not known any more, so this process is done.
            self._broken = OutputError(f"{self.path}: cannot be written: {error.strerror}")
            with contextlib.suppress(OSError):
                os.ftruncate(file.descriptor, self._end.offset)
            raise self._broken from error
        file.require_in_place()
        return end

    def set_meta(self, **rows: str) -> None:
        """Write notes about the run, all or none."""
        self._write(Notes(rows))

    def restart(self, meta: dict[str, str]) -> None:
        """Replace the notes about a run; raise OutputError if a trial is finished or begun."""
        if not self.is_empty():
            raise OutputError(f"{self.path}: holds trials that are finished or begun")
        self._write(_first_notes(meta))

    def raise_epoch(self) -> int:
        """Count one more process of the run, and return their number, from 1.

        The new count is on the disk when this returns: no two processes get the same, even if the
        power is cut between them.
        """
        text = self._notes.get("epoch", "0")
        if not text.isdecimal() or not 0 <= int(text) < _MAX_EPOCH:
            raise damaged(self.path, f"its epoch is {text!r}, not from 0 to {_MAX_EPOCH - 1}")
        epoch = int(text) + 1
        self.set_meta(epoch=str(epoch))
        return epoch

    def append(self, trial: int, records: Sequence[Record]) -> None:
        """Write records of an unfinished trial; act on none of them if this raises.

        When this returns they survive the death of the process; with ``survives="power_cut"`` they
        are on the disk. The first records of a trial, and the first after each opening, always are:
        so it is always known that a trial was begun.

        Raises OutputError if they cannot be written, and then all of them are in the journal, or
        none; LostJournalError if the file was removed; InvalidValueError if the trial is finished
        already, or another one is unfinished.
        """
        if not records:
            return
        on_disk = self.survives == "power_cut"
        if self._appending == trial:
            self._end = self._append([steps_payload(trial, records)], synchronize=on_disk)
        else:
            self._require_may_begin(trial)
            boot = {"steps_boot": boot_id() or "", "steps_on_disk": str(int(on_disk))}
            self._write(Notes(boot), Steps(trial, packed(records)))
            self._appending = trial

    def _require_may_begin(self, trial: int) -> None:
        begun = self.unfinished_trial()
        if trial in self._results:
            raise InvalidValueError(f"trial {trial} is finished: no step can follow in {self.path}")
        if begun not in (None, trial):
            raise InvalidValueError(
                f"trial {begun} is not finished in {self.path}: trial {trial} cannot begin"
            )

    def add(self, result: TrialResult, *, keep_steps: bool = False) -> None:
        """Write a finished trial, with its decisions; when this returns, it is on the disk.

        ``keep_steps`` keeps its steps for :meth:`kept_steps`. Raises OutputError if the trial is in
        the journal already, or the disk is full.
        """
        trial, decisions = result.trial, result.decisions
        if decisions is None:
            raise OutputError(f"trial {trial}: the result comes without its decisions")
        if trial in self._results:
            raise OutputError(f"{self.path}: trial {trial} is in the journal already")
        outcome = msgspec.structs.replace(result, decisions=None)
        self._write(Finished(trial, packed(outcome), packed(decisions), keep_steps))
        if self._appending == trial:
            self._appending = None


def _first_notes(meta: dict[str, str]) -> Notes:
    return Notes({"session": os.urandom(SESSION_SIZE).hex(), **meta}, anew=True)
