"""What a robot's machine asks of the shell around it.

The order is part of the meaning: each effect is carried out before the next one is begun, and a
:class:`Journal` is carried out only when its records are as safe as the settings ask. So nothing is
sent or performed that a restarted robot would not know of.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from holdfast.errors import HoldfastError
from holdfast.outcome import TrialResult
from holdfast.planning import PlanningState
from holdfast.session.records import Record

__all__ = [
    "Abandon",
    "Act",
    "Decide",
    "Effect",
    "EndTrial",
    "Journal",
    "Launch",
    "Paused",
    "Plan",
    "Report",
    "Send",
    "Sense",
    "Stop",
    "Timing",
    "Verified",
]

FloatArray = npt.NDArray[np.float64]


class Journal(NamedTuple):
    """Write records of a trial down, all or none."""

    trial: int
    records: tuple[Record, ...]


class Send(NamedTuple):
    """Send a request; ``call`` names it in the events that follow."""

    service: str
    call: int
    payload: bytes


class Abandon(NamedTuple):
    """Give a call up; no event of it is wanted any more."""

    call: int


class Sense(NamedTuple):
    """Perform a sensing action, and deliver what it shows."""

    step: int
    sensing_action: int


class Act(NamedTuple):
    """Perform a task action, and deliver its reward and whether the task is done."""

    step: int
    action: FloatArray


class Decide(NamedTuple):
    """Let the robot's own planner answer a question, while the robot goes on.

    Attributes
    ----------
    number : int
        Names it in the :class:`~holdfast.session.events.Decided` that follows.
    state : PlanningState
        Of the question.
    urgent : bool
        Whether the robot waits for it: then it comes before those that are not. It may have been
        asked with this number before.
    again : bool
        Whether it was answered before; then with an instance of the problem that is made anew.
    """

    number: int
    state: PlanningState
    urgent: bool
    again: bool


class Plan(NamedTuple):
    """Let the planner of a robot without services compute a part of an answer.

    Attributes
    ----------
    number : int
        Of the question; in the :class:`~holdfast.session.events.Planned` that follows. What was
        asked under another number is of no use any more.
    state : PlanningState
    sensing : bool
        Whether it is the sensing action of this state; else the task actions from there on.
    """

    number: int
    state: PlanningState
    sensing: bool


class Verified(NamedTuple):
    """A part of an answer was compared with what the robot's own planner answers; for the record.

    Attributes
    ----------
    trial, step : int
        Of the question.
    service : str
        Whose answer it was.
    kind : {"question", "task", "sensing"}
    verdict : {"asked", "left_out", "same", "different", "not_deterministic", "failed"}
        Of a question: it is to be answered by the robot's own planner, or too many such wait. Of a
        part of an answer: the last two say that the planner does not agree with itself, or has
        failed.
    """

    trial: int
    step: int
    service: str
    kind: str
    verdict: str


class Launch(NamedTuple):
    """Start the local service; end the process that was started before, if it is still there.

    Attributes
    ----------
    number : int
        Of the launch; when its process ends, the machine is told this number.
    """

    number: int


class Report(NamedTuple):
    """Tell people: one line of the log.

    Attributes
    ----------
    name : str
        Of the event.
    fields : dict
        Plain data; durations end in ``_ms``.
    """

    name: str
    fields: dict[str, object]


class Timing(NamedTuple):
    """How long a decision took; for the record, it changes nothing.

    Attributes
    ----------
    trial, step : int
    kind : str
        ``sensing`` or ``task``.
    service : str
        Whose answer was used.
    status : str
    waited_ms : float
        How long the robot stood still for it: 0 if it was there before it was needed.
    round_trip_ms : float
        From the request until the answer.
    computed_ms : float
        The service's own part of that.
    """

    trial: int
    step: int
    kind: str
    service: str
    status: str
    waited_ms: float
    round_trip_ms: float
    computed_ms: float


class EndTrial(NamedTuple):
    """The trial is over: keep its result instead of its records."""

    result: TrialResult


class Paused(NamedTuple):
    """The robot stands still in order; the process may end."""


class Stop(NamedTuple):
    """The robot holds still and cannot go on; the run can be resumed once the reason is gone."""

    error: HoldfastError


Effect: TypeAlias = (
    Journal
    | Send
    | Abandon
    | Sense
    | Act
    | Decide
    | Plan
    | Launch
    | Report
    | Timing
    | Verified
    | EndTrial
    | Paused
    | Stop
)
