"""The outcome of a simulated run, and its story: one line for each thing that happened."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from holdfast_lab.simulation.schedule import MessageFault, SimulatedFault, line_of

_ACTION = re.compile(r"performs task action (\d+)")


class StoryLine(NamedTuple):
    """One line of a run's story."""

    time: float
    actor: str
    text: str


class RunOutcome(NamedTuple):
    """What became of a run."""

    violation: str | None  # what must never happen and did
    held: str | None  # why the robot holds still for good, although that is right
    duration_s: float  # of the run, in virtual time
    recovery_s: float  # from the end of the last fault until the end of the run
    messages: int
    faults: dict[str, int]  # by kind, how many have happened
    story: list[StoryLine]  # what happened, if it was to be told
    # Those of the schedule's faults, if the story was to be told: the run had ended before, or what
    # they would have struck was not there.
    never_happened: tuple[SimulatedFault, ...]


def story_lines(outcome: RunOutcome) -> list[str]:
    """Return the lines of a run that was line, with their times in seconds.

    Task actions that follow each other with nothing in between are one line. The last lines name
    the faults of the schedule that have not happened, those of messages together.
    """
    happened = [f"{line.time:9.4f}  {line.actor:8s} {line.text}" for line in _folded(outcome.story)]
    return [*happened, *(f"never happened: {what}" for what in _together(outcome.never_happened))]


def _together(faults: Iterable[SimulatedFault]) -> Iterator[str]:
    numbers: dict[tuple[str, str], list[int]] = {}
    for fault in faults:
        if isinstance(fault, MessageFault):
            numbers.setdefault((fault.service, fault.direction), []).append(fault.number)
        else:
            yield line_of(fault)
    for (service, direction), missing in numbers.items():
        shown = ",".join(map(str, sorted(missing)))
        yield f"message service={service} direction={direction} number={shown}"


def _folded(story: Iterable[StoryLine]) -> Iterator[StoryLine]:
    first: StoryLine | None = None
    begin = end = 0
    for line in story:
        action = _ACTION.fullmatch(line.text)
        number = int(action[1]) if action else -1
        if first is not None and number == end + 1:
            end = number
            continue
        if first is not None:
            yield _actions(first, begin, end)
            first = None
        if action:
            first, begin, end = line, number, number
        else:
            yield line
    if first is not None:
        yield _actions(first, begin, end)


def _actions(first: StoryLine, begin: int, end: int) -> StoryLine:
    if begin == end:
        return first
    return first._replace(text=f"performs task actions {begin} to {end}")
