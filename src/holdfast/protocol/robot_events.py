"""The robot's end: events in, effects out.

Events tell what happened on the wire and in the environment. A call is one request with any number
of replies, and always ends; a service whose call ends before the question is answered is suspected.
An order to the environment ends in one event, which may be a failure.

Effects are orders to the shell. It carries out each before it begins the next, and
:class:`WriteRecords` is done only when the records are as safe as the settings ask. So nothing is
sent or performed that a restarted robot would not know of.
"""

from __future__ import annotations

from typing import Literal, NamedTuple, TypeAlias

from holdfast.errors import HoldfastError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import Late, Moved, Record, Sensed
from holdfast.planning.outcome import Ending, TrialResult
from holdfast.planning.planner import PlanningState
from holdfast.protocol.effects import LogEvent


class ServiceAppeared(NamedTuple):
    """A service can be asked; another ``incarnation`` is another process, with another memory."""

    service: str
    incarnation: str


class ServiceVanished(NamedTuple):
    """A service closed, its process died, or its link broke."""

    service: str
    incarnation: str
    reason: str = ""


class ReplyReceived(NamedTuple):
    """A reply to a call."""

    call: int
    payload: bytes


class CallEnded(NamedTuple):
    """No more replies come to a call."""

    call: int


TransportEvent: TypeAlias = ServiceAppeared | ServiceVanished | ReplyReceived | CallEnded


class NoReading(NamedTuple):
    """A sensing action was performed, and no observation will come of it."""

    step: int


class Acted(NamedTuple):
    """A task action was performed; all numbers are finite."""

    moved: Moved
    ending: Ending | None = None
    late: tuple[Late, ...] = ()  # observations of earlier steps that have come meanwhile
    # Earlier steps of which it is known now that no observation will come.
    no_reading: tuple[int, ...] = ()

    @property
    def step(self) -> int:
        """Its step."""
        return self.moved.step


class EnvironmentReady(NamedTuple):
    """The environment of a trial was made."""

    ending: Ending | None  # how its task has ended; None if it goes on
    # Task actions performed in this trial, counted by the environment; None if it does not count.
    steps_performed: int | None
    # What the last of these has shown; of a resumed trial, if the environment can still tell.
    last: Moved | None = None
    # Of a resumed trial: observations that have come meanwhile.
    late: tuple[Late, ...] = ()


class EnvironmentFailed(NamedTuple):
    """The environment raised, returned something invalid, or timed out; it cannot be used again."""

    step: int
    what: str  # the method, or the environment's name if it could not be made
    text: str
    action_in_doubt: bool  # whether the step's task action was begun without an :class:`Acted`
    # The step's task action, if it was performed and what came after failed.
    performed: Acted | None = None
    # Whether the environment counts its steps, so that it can be asked later.
    counts_steps: bool = True


EnvironmentEvent: TypeAlias = EnvironmentReady | Sensed | NoReading | Acted | EnvironmentFailed


class OwnAnswer(NamedTuple):
    """The result of a :class:`ComputeOwnAnswer`."""

    number: int
    actions: tuple[FloatArray, ...] = ()  # task actions up to the next sensing step
    sensing_action: int | None = None  # of that step; None if it is too far away, or not asked
    ahead_digest: bytes = b""  # of the state in which the sensing action was chosen
    computed_s: float = 0.0
    failure: HoldfastError | None = None  # why there is no answer
    # To which the task actions lead, or in which the sensing action was chosen.
    ahead: PlanningState | None = None


class RecoveryExited(NamedTuple):
    """The process of the :class:`Launch` with this number ended, or could not be started."""

    launch: int
    reason: str


class WriteRecords(NamedTuple):
    """Append records of a trial to the journal, all or none."""

    trial: int
    records: tuple[Record, ...]


class Send(NamedTuple):
    """Send a request; ``call`` names it in later events."""

    service: str
    call: int
    payload: bytes


class Abandon(NamedTuple):
    """Drop a call; its events are no longer wanted."""

    call: int


class Sense(NamedTuple):
    """Perform a sensing action and deliver the observation."""

    step: int
    sensing_action: int


class Act(NamedTuple):
    """Perform a task action; deliver its reward and whether the task is done."""

    step: int
    action: FloatArray


class ComputeOwnAnswer(NamedTuple):
    """Have the robot's own planner answer a question, or a part of it.

    Without services, part by part; else all of it, to verify what services have answered.
    """

    number: int  # of the question; a part with an older number is of no use
    state: PlanningState
    # Whether it was answered before. It then goes before others, and is computed with a new
    # instance of the problem.
    again: bool = False
    part: Literal["task", "sensing"] | None = None


class VerificationNoted(NamedTuple):
    """A part of a service's answer was compared with the own planner's; for the tables only."""

    trial: int
    step: int
    service: str
    kind: str  # question, task or sensing
    # Of a question: asked, or left_out because too many wait. Of a part: same, different,
    # not_deterministic (the own planner disagrees with itself) or failed (it raised).
    verdict: str


class Launch(NamedTuple):
    """Start the local service, and end its previous process if there is one."""

    number: int


class Timing(NamedTuple):
    """Who made a decision, and how long it took; for the tables only."""

    trial: int
    step: int
    kind: str  # task or sensing
    service: str  # whose answer is used
    status: str
    waited_ms: float  # how long the robot stood still for it
    round_trip_ms: float  # from the request to the answer
    computed_ms: float  # the service's part of that


class EndTrial(NamedTuple):
    """The trial has ended: keep its result instead of its records."""

    result: TrialResult


class Paused(NamedTuple):
    """The robot stands still; the process may exit."""


class Halt(NamedTuple):
    """The robot holds still for good; the run can be resumed once the cause is removed."""

    error: HoldfastError


RobotEffect: TypeAlias = (
    WriteRecords
    | Send
    | Abandon
    | Sense
    | Act
    | ComputeOwnAnswer
    | Launch
    | LogEvent
    | Timing
    | VerificationNoted
    | EndTrial
    | Paused
    | Halt
)
