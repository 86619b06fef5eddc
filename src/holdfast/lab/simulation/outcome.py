"""What became of a simulated run, and its story."""

from __future__ import annotations

from typing import NamedTuple

from holdfast.lab.simulation.schedule import SimulatedFault

__all__ = ["RunOutcome", "StoryLine"]


class StoryLine(NamedTuple):
    """One line of a run's story."""

    time: float
    actor: str
    text: str


class RunOutcome(NamedTuple):
    """What became of a run.

    Attributes
    ----------
    violation : str or None
        What must never happen and did.
    held : str or None
        Why the robot holds still for good, although that is right.
    duration_s : float
        Of the run, in virtual time.
    recovery_s : float
        From the end of the last fault until the end of the run.
    faults : dict of str to int
        By kind, how many have happened.
    story : list of StoryLine
        What happened, if it was to be told.
    never_happened : tuple of SimulatedFault
        Those of the schedule's faults, if the story was to be told: the run had ended before, or
        what they would have struck was not there.
    """

    violation: str | None
    held: str | None
    duration_s: float
    recovery_s: float
    messages: int
    faults: dict[str, int]
    story: list[StoryLine]
    never_happened: tuple[SimulatedFault, ...]
