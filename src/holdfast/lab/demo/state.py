"""The state of the demo as data: what a timeline is drawn from."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol, TypeAlias

from holdfast.protocol.status import Status

__all__ = ["Activity", "Change", "DemoState", "Line", "Mark", "Observer", "Row"]

Row: TypeAlias = Literal["cloud", "local", "robot"]
Activity: TypeAlias = Literal[
    "off", "starting", "ready", "deciding", "by_cloud", "by_local", "held"
]
"""Of a service: off, starting, ready, deciding. Of the robot: off, starting, which service decides
for it, held, or ready at the end."""


class Change(NamedTuple):
    """From this moment on a row has another activity."""

    at_s: float
    activity: Activity


class Mark(NamedTuple):
    """The demo has started or killed a process."""

    at_s: float
    row: Row
    kind: Literal["start", "kill"]


class Line(NamedTuple):
    """One thing that happened, in words."""

    at_s: float
    who: str
    text: str


@dataclass
class DemoState:
    """All that has happened so far; times count from the beginning of the demo.

    Attributes
    ----------
    began_at : float
        In seconds since the epoch.
    expected_s : float
        How long the demo will take, as far as can be known.
    changes : dict of str to list of Change
        Of each row, in order of time.
    """

    title: str = ""
    began_at: float = field(default_factory=time.time)
    expected_s: float = 1.0
    changes: dict[Row, list[Change]] = field(
        default_factory=lambda: {"cloud": [], "local": [], "robot": []}
    )
    marks: list[Mark] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    status: Status = Status.STANDARD
    progress: str = ""

    @property
    def now_s(self) -> float:
        """Seconds since the beginning."""
        return time.time() - self.began_at


class Observer(Protocol):
    """Shows a demo while it runs."""

    def say(self, line: Line) -> None:
        """Show the next line; the state has it already."""
        ...
