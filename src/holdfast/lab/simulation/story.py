"""A run as a person reads it: one line for each thing that happened, and no more than is needed."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from holdfast.lab.simulation.outcome import RunOutcome, StoryLine
from holdfast.lab.simulation.schedule import MessageFault, SimulatedFault, line_of

__all__ = ["story_lines"]

_ACTION = re.compile(r"performs task action (\d+)")


def story_lines(outcome: RunOutcome) -> list[str]:
    """Return the lines of a run that was told, with their times in seconds.

    Task actions that follow each other with nothing in between are one line. The last lines name
    the faults of the schedule that have not happened, those of messages together.
    """
    happened = [f"{told.time:9.4f}  {told.actor:8s} {told.text}" for told in _folded(outcome.story)]
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
    for told in story:
        action = _ACTION.fullmatch(told.text)
        number = int(action[1]) if action else -1
        if first is not None and number == end + 1:
            end = number
            continue
        if first is not None:
            yield _actions(first, begin, end)
            first = None
        if action:
            first, begin, end = told, number, number
        else:
            yield told
    if first is not None:
        yield _actions(first, begin, end)


def _actions(first: StoryLine, begin: int, end: int) -> StoryLine:
    if begin == end:
        return first
    return first._replace(text=f"performs task actions {begin} to {end}")
