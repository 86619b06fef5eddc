"""The question that a robot asks, its answer as far as it has arrived, and what answers it.

The question is a state: what to do from there until the robot has sensed again? The answer has up
to two parts, the task actions on the way and the sensing action at its end. Each part may come from
another service, or from several. The robot follows the first; a later one can only agree, or show
that a service is wrong (:mod:`holdfast.protocol.verification`).

What answers is a :class:`DecisionSource`: services, or the robot's own planner.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

from holdfast.errors import HoldfastError, MessageError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import CatchUpInput, decode_floats
from holdfast.planning.planner import Planner, PlanningState, encode_checkpoint
from holdfast.protocol.effects import Effects
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    PROTOCOL_VERSION,
    Request,
    SensingAnswer,
    SessionConfiguration,
    TaskAnswer,
)
from holdfast.protocol.robot_events import (
    ComputeOwnAnswer,
    OwnAnswer,
    RecoveryExited,
    RobotEffect,
    TransportEvent,
)
from holdfast.protocol.status import StatusTracker

OWN_PLANNER = "in_process"
"""Name of the planner in the robot's own process, where services have names."""


class Provenance(NamedTuple):
    """The service that gave an answer, and how long it took."""

    service: str
    round_trip_s: float
    computed_s: float


def same_actions(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> bool:
    """Return whether task actions are equal bit for bit (0.0 is not -0.0)."""
    return len(first) == len(second) and all(
        one.tobytes() == other.tobytes() for one, other in zip(first, second, strict=True)
    )


class Question:
    """A state in which to decide, and the answer as far as it has arrived.

    The question itself never changes, and only its own methods write its answer.
    """

    def __init__(
        self,
        planner: Planner,
        state: PlanningState,
        digest: bytes,
        inputs: tuple[CatchUpInput, ...],
        num_inputs: int,
        # Whether the robot takes the task actions itself, and asks for the sensing action alone.
        takes_tasks: bool = False,
    ) -> None:
        self.state = state
        self.digest = digest[:DIGEST_SIZE]
        # inputs, num_inputs: the latest of this trial, and how many there were.
        self.inputs = inputs
        self.num_inputs = num_inputs
        # Inputs that a service lacks if it has answered the question before; more if the robot has
        # moved by itself since then, and its moves give observations.
        self.new_inputs = 1
        self.num_ordered = 0  # task actions of the answer that are performed or ordered
        # task_actions, sensing: what the robot follows; None until it arrives. Of the actions that
        # it takes itself, those so far.
        self.takes_tasks = takes_tasks
        self.task_actions: list[FloatArray] | None = [] if takes_tasks else None
        self.sensing: SensingAnswer | None = None
        self.task_provenance = Provenance(OWN_PLANNER, 0.0, 0.0) if takes_tasks else None
        self.sensing_provenance: Provenance | None = None
        self._checkpoint: bytes | None = None
        # Step of the answer's sensing action; None if it is too far away.
        self.sensing_step: int | None
        if planner.needs_sensing(state):
            self.task_count = 0  # task actions in the answer
            self.sensing_step = state.step
            if takes_tasks and planner.moves_give_observations:
                self.new_inputs += planner.settings.sensing_interval + 1
        elif planner.moves_give_observations:
            self.task_count = 1
            self.sensing_step = None
        else:
            interval = planner.settings.sensing_interval + 1
            following = (state.step // interval + 1) * interval
            self.task_count = min(following - state.step, MAX_TASK_ACTIONS)
            within = following - state.step <= MAX_TASK_ACTIONS
            self.sensing_step = following if within else None

    @property
    def complete(self) -> bool:
        """Whether the whole answer has arrived."""
        return (self.task_actions is not None or self.task_count == 0) and (
            self.sensing is not None or self.sensing_step is None
        )

    @property
    def is_first(self) -> bool:
        """Whether its trial has only begun, so that a service needs nothing to reach its state."""
        return self.num_inputs == 0

    def followed(self) -> list[tuple[str, str]]:
        """Return the kind and the service of each part of the answer that the robot follows."""
        parts = ("task", self.task_provenance), ("sensing", self.sensing_provenance)
        return [(kind, given.service) for kind, given in parts if given is not None]

    def follow_tasks(self, actions: Sequence[FloatArray], provenance: Provenance) -> None:
        """Have the robot perform these task actions."""
        self.task_actions, self.task_provenance = list(actions), provenance

    def follow_sensing(self, answer: SensingAnswer, provenance: Provenance) -> None:
        """Have the robot perform this sensing action."""
        self.sensing, self.sensing_provenance = answer, provenance

    def follow_own(self, own: OwnAnswer, round_trip_s: float) -> None:
        """Have the robot do what its own planner has answered, one part or both."""
        provenance = Provenance(OWN_PLANNER, round_trip_s, own.computed_s)
        if own.actions:
            self.follow_tasks(own.actions, provenance)
        if self.sensing_step is not None and own.sensing_action is not None:
            digest = own.ahead_digest[:DIGEST_SIZE]
            answer = SensingAnswer(0, self.sensing_step, own.sensing_action, digest, 0)
            self.follow_sensing(answer, provenance)

    def order(self, offset: int) -> FloatArray:
        """Return a task action of the answer, which the robot is to order now."""
        assert self.task_actions is not None
        self.num_ordered = offset + 1
        return self.task_actions[offset]

    def checkpoint(self) -> bytes:
        """Return the encoded state (computed once)."""
        if self._checkpoint is None:
            self._checkpoint = encode_checkpoint(self.state)
        return self._checkpoint

    def request(
        self,
        session: bytes,
        epoch: int,
        number: int,
        num_inputs: int | None,  # the latest ones that it carries; None: the whole state
        session_configuration: SessionConfiguration | None,
    ) -> Request:
        """Return the question as a service is asked it."""
        state = self.state
        return Request(
            PROTOCOL_VERSION,
            session,
            epoch,
            number,
            state.trial,
            state.step,
            state.sensed,
            self.digest,
            self.inputs[-num_inputs:] if num_inputs else (),
            session_configuration,
            self.checkpoint() if num_inputs is None else None,
        )

    def read_tasks(self, reply: TaskAnswer, action_size: int) -> list[FloatArray]:
        """Return the task actions of a reply.

        Raises MessageError if the reply cannot answer this question.
        """
        if reply.count != self.task_count:
            raise MessageError(
                "malformed", f"{reply.count} task actions where {self.task_count} were asked"
            )
        numbers = decode_floats(reply.actions, reply.count * action_size)
        return list(numbers.reshape(reply.count, action_size))

    def check_sensing(self, reply: SensingAnswer, num_choices: int) -> None:
        """Check the sensing action of a reply.

        Raises MessageError if the reply cannot answer this question.
        """
        if reply.step != self.sensing_step:
            raise MessageError(
                "malformed",
                f"a sensing action for step {reply.step} where {self.sensing_step} was asked",
            )
        if self.task_count == 0 and reply.digest != self.digest:
            raise MessageError("malformed", "a sensing action for another state than was asked")
        if reply.sensing_action >= num_choices:
            raise MessageError("malformed", f"there is no sensing action {reply.sensing_action}")


class DecisionSource:
    """What answers a robot's questions.

    :class:`~holdfast.protocol.dispatcher.Dispatcher` asks services; :class:`InProcessSource` asks
    only the robot's own planner. What only services need does nothing here: there is no service to
    be lost, timed or verified.
    """

    def __init__(self) -> None:
        # To be carried out in order; the robot appends its own.
        self.effects: Effects[RobotEffect] = Effects()
        self.question: Question | None = None  # the current question, answered or not
        # Since when the robot waits for its answer; None if it does not.
        self.needed_at: float | None = None
        self.tracker = StatusTracker()  # which service decides
        # Since when the robot holds still because no service is usable.
        self.holding_since: float | None = None
        self.takes_tasks = False  # whether the robot takes task actions itself
        self.stopped_by: HoldfastError | None = None  # why the robot holds still for good

    @property
    def num_unverified(self) -> int:
        """Questions that the own planner still has to recompute."""
        return 0

    def start(self, now: float) -> None:
        """Begin the run."""

    def ask(self, question: Question, now: float) -> None:
        """Replace the question, for whose answer the robot waits unless it acts by itself."""
        self.question = question
        self.needed_at = None if question.takes_tasks and question.task_count > 0 else now

    def await_answer(self, now: float) -> None:
        """Have the robot wait for the rest of the answer."""
        if self.needed_at is None:
            self.needed_at = now
            self.wake(now)

    def end_wait(self, now: float) -> float:
        """Have the robot wait no more; return for how long it has."""
        waited_s, self.needed_at = self.waited_s(now), None
        return waited_s

    def waited_s(self, now: float) -> float:
        """Return how long the robot has waited for the answer."""
        return 0.0 if self.needed_at is None else now - self.needed_at

    def drop(self) -> None:
        """Drop the question: the trial has ended, or its answer is of no use."""
        self.question = self.needed_at = None

    def recompute(self) -> None:
        """Have the own planner answer the question too."""

    def handle(self, event: TransportEvent | OwnAnswer | RecoveryExited, now: float) -> None:
        """Handle an event of the transport, of a planner or of the local service's process."""
        raise NotImplementedError

    def wake(self, now: float) -> None:
        """Do what is due now."""

    def next_wakeup(self) -> float | None:
        """Return when :meth:`wake` is due if nothing happens before; None if never."""
        return None

    def event_loop_stalled(self, seconds: float) -> None:
        """Note that for so long the robot's process could not receive."""

    def stop(self, error: HoldfastError) -> None:
        """Hold still for good; the robot orders it when all is written."""
        self.stopped_by = self.stopped_by or error


class InProcessSource(DecisionSource):
    """Decisions without services.

    The own planner computes the parts of an answer, and the shell passes them back to
    :meth:`handle`.
    """

    def __init__(self) -> None:
        super().__init__()
        self._number = 0
        self._asked_at = 0.0

    def ask(self, question: Question, now: float) -> None:
        """Ask a new question; the one before is forgotten."""
        super().ask(question, now)
        self._number += 1
        self._asked_at = now
        self._compute("sensing" if question.task_count == 0 else "task", question.state)

    def _compute(self, part: Literal["task", "sensing"], state: PlanningState) -> None:
        self.effects.append(ComputeOwnAnswer(self._number, state, part=part))

    def handle(self, event: TransportEvent | OwnAnswer | RecoveryExited, now: float) -> None:
        """Take a part of the answer; results of earlier questions are ignored."""
        question = self.question
        if not isinstance(event, OwnAnswer) or event.number != self._number or question is None:
            return
        if event.failure is not None:
            self.stop(event.failure)
            return
        question.follow_own(event, now - self._asked_at)
        if event.sensing_action is None and question.sensing_step is not None:
            assert event.ahead is not None
            self._compute("sensing", event.ahead)
