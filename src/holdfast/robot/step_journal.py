"""What a robot needs of a journal; :class:`holdfast.recording.journal.Journal` provides it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from holdfast.protocol.records import Record

__all__ = ["StepJournal", "TrialInProgress"]


class TrialInProgress(Protocol):
    """A trial in the journal that has not ended."""

    @property
    def trial(self) -> int:
        """Number of the trial."""
        ...

    @property
    def records(self) -> Sequence[Record]:
        """Its records, in order."""
        ...

    @property
    def is_complete(self) -> bool:
        """Whether no record can be missing."""
        ...


class StepJournal(Protocol):
    """Keeps the records of the unfinished trial."""

    def session(self) -> bytes:
        """Return the run's identifier, 16 bytes."""
        ...

    def raise_epoch(self) -> int:
        """Return a number above all earlier ones, once it is on the disk."""
        ...

    def append(self, trial: int, records: Sequence[Record]) -> None:
        """Write records; they are safe when this returns."""
        ...

    def unfinished(self) -> TrialInProgress | None:
        """Return the trial that has not ended, if there is one."""
        ...
