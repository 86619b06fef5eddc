"""The robot's journal, as a disk keeps it: what was written may not be on it yet.

The end of a process loses nothing that was appended. The end of the machine loses a tail of it,
unless each append was forced out (``journal_survives: power_cut``). Whoever opens the journal
afterwards is told whether a tail may be missing. This is what the real journal promises
(:mod:`holdfast.journal.journal`), without a file.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from holdfast.journal.journal_file import encode
from holdfast.journal.journal_reader import decode_records
from holdfast.planning.inputs import Record
from holdfast.planning.outcome import TrialResult


class Unfinished(NamedTuple):
    """What a journal holds of a trial that has not ended."""

    trial: int
    records: list[Record]
    is_complete: bool


class Disk:
    """The journal of one run; ``forces_out``: each append is on the disk when it returns."""

    def __init__(self, *, forces_out: bool) -> None:
        self._forces_out = forces_out
        self._trial = 0
        self._appended: list[bytes] = []
        self._num_unsynced = 0
        self._first_of_process = True
        self._tail_is_certain = True
        self.results: dict[int, TrialResult] = {}
        self.epoch = 0

    def opened(self) -> int:
        """Let a new process open it; return its epoch, which is on the disk."""
        self._first_of_process = True
        self.epoch += 1
        return self.epoch

    def append(self, trial: int, records: Sequence[Record]) -> None:
        """Keep records of a trial."""
        self._trial = trial
        self._appended.append(encode(records))
        if self._forces_out or self._first_of_process:
            # The first of a process also notes in which life of the machine it is written.
            self._num_unsynced = 0
            self._tail_is_certain = True
        else:
            self._num_unsynced += 1
        self._first_of_process = False

    def add(self, result: TrialResult) -> None:
        """Keep the result of a trial instead of its records; it is on the disk."""
        self.results[result.trial] = result
        self._appended.clear()
        self._num_unsynced = 0
        self._first_of_process = True

    def cut_power(self, lost_appends: int) -> None:
        """Lose so many of the last appends, of those that were not on the disk."""
        del self._appended[len(self._appended) - min(lost_appends, self._num_unsynced) :]
        self._num_unsynced = 0
        self._tail_is_certain = self._tail_is_certain and self._forces_out

    def unfinished(self) -> Unfinished | None:
        """Return what there is of a trial that has not ended."""
        if not self._appended:
            return None
        records = [record for data in self._appended for record in decode_records(data)]
        return Unfinished(self._trial, records, self._tail_is_certain)
