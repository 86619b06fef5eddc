"""What has happened in the demo so far, as data: for whoever shows it and however it is shown."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol, TypeAlias

from holdfast.session.status import Status

__all__ = ["Audience", "Change", "Chronicle", "Line", "Mark", "Row", "State"]

Row: TypeAlias = Literal["cloud", "local", "robot"]
State: TypeAlias = Literal["off", "starting", "ready", "deciding", "by_cloud", "by_local", "held"]
"""Of a service: off, starting, ready, deciding. Of the robot: off, starting, by whom its decisions
are made, or held."""


class Change(NamedTuple):
    """From a moment on something is in a state."""

    at_s: float
    state: State


class Mark(NamedTuple):
    """The moment at which the demo started or killed a process."""

    at_s: float
    row: Row
    kind: Literal["start", "kill"]


class Line(NamedTuple):
    """What happened, in words."""

    at_s: float
    who: str
    text: str


@dataclass
class Chronicle:
    """All that has happened so far; times count from the beginning of the story.

    Attributes
    ----------
    title : str
    expected_s : float
        How long it will take, as far as can be known.
    changes : dict of str to list of Change
        Of the cloud, the local service and the robot, in order of time.
    marks : list of Mark
    lines : list of Line
    status : str
        Of the robot.
    progress : str
        How far the robot is.
    """

    title: str = ""
    expected_s: float = 1.0
    changes: dict[Row, list[Change]] = field(
        default_factory=lambda: {"cloud": [], "local": [], "robot": []}
    )
    marks: list[Mark] = field(default_factory=list)
    lines: list[Line] = field(default_factory=list)
    status: str = Status.STANDARD.value
    progress: str = ""


class Audience(Protocol):
    """Whoever the story is told to."""

    def say(self, line: Line) -> None:
        """Take the next line; the chronicle has it already."""
        ...

    def look(self, chronicle: Chronicle, now_s: float) -> None:
        """Look at everything; called about ten times a second and whenever something happens."""
        ...
