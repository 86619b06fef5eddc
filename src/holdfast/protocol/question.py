"""The question that a robot asks, and the parts of its answer that have arrived.

The question is a state: what to do from there until the robot has sensed again? The answer has up
to two parts, the task actions on the way and the sensing action at its end. Each part may come from
another service, or from several. The robot follows the first; a later one can only agree, or show
that a service is wrong (:mod:`holdfast.protocol.verification`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from holdfast.arrays import FloatArray
from holdfast.config.settings import PlanningSettings
from holdfast.errors import MessageError
from holdfast.planning import PlanningState, encode_checkpoint, needs_sensing
from holdfast.protocol.events import OwnAnswer
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    Observed,
    SensingAnswer,
    TaskAnswer,
    decode_floats,
)

__all__ = ["AnswerPart", "Provenance", "Question", "same_actions"]


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


class AnswerPart:
    """One part of an answer as one service gave it.

    Attributes
    ----------
    task_actions : list of array or None
        Task actions; None for a sensing part.
    sensing : SensingAnswer or None
        None for a task part.
    outside_limits : bool
        Whether the problem's ``execute`` would change the task actions.
    judged : bool
        Whether it was compared with the own planner's answer.
    """

    def __init__(
        self, service: str, task_actions: list[FloatArray] | None, sensing: SensingAnswer | None
    ) -> None:
        self.service = service
        self.task_actions = task_actions
        self.sensing = sensing
        self.outside_limits = False
        self.judged = False

    @property
    def kind(self) -> str:
        """``task`` or ``sensing``."""
        return "task" if self.sensing is None else "sensing"

    def agrees_with(self, other: AnswerPart) -> bool:
        """Return whether two parts of the same kind are equal."""
        if self.sensing is not None and other.sensing is not None:
            return (self.sensing.sensing_action, self.sensing.digest) == (
                other.sensing.sensing_action,
                other.sensing.digest,
            )
        return (
            self.task_actions is not None
            and other.task_actions is not None
            and same_actions(self.task_actions, other.task_actions)
        )


class Question:
    """A state in which to decide, and the answer as far as it has arrived.

    The question itself never changes. Its answer is written by
    :class:`~holdfast.protocol.verification.Verification` where services answer, else by
    :class:`~holdfast.protocol.decision_source.InProcessSource`. The robot only reads it; the source
    notes in ``needed_at`` that the robot waits.

    Parameters
    ----------
    digest : bytes
        Of the state.
    observations : tuple of Observed
        The latest observations of this trial.
    num_observations : int
        Of this trial, including those not kept.

    Attributes
    ----------
    task_count : int
        Task actions in the answer.
    sensing_step : int or None
        Step of the answer's sensing action; None if it is too far away.
    needed_at : float or None
        Since when the robot waits for the answer; None if it does not.
    task_actions : sequence of array or None
        Task actions to follow; None until they arrive.
    sensing : SensingAnswer or None
        Sensing action to follow; None until it arrives.
    parts : list of AnswerPart
        All distinct parts that services gave.
    check_decided : bool
        Whether a check by the own planner was ordered, or left out.
    disputed : bool
        Whether the robot must wait for the own planner.
    own : OwnAnswer or None
        The own planner's answer.
    own_is_certain : bool or None
        Whether the own planner, asked twice, agreed with itself; None if asked once.
    """

    def __init__(
        self,
        settings: PlanningSettings,
        state: PlanningState,
        digest: bytes,
        observations: tuple[Observed, ...],
        num_observations: int,
    ) -> None:
        self.state = state
        self.digest = digest[:DIGEST_SIZE]
        self.observations = observations
        self.num_observations = num_observations
        self.needed_at: float | None = None
        self.task_actions: Sequence[FloatArray] | None = None
        self.sensing: SensingAnswer | None = None
        self.task_provenance: Provenance | None = None
        self.sensing_provenance: Provenance | None = None
        self.parts: list[AnswerPart] = []
        self.check_decided = False
        self.disputed = False
        self.own: OwnAnswer | None = None
        self.own_is_certain: bool | None = None
        self._checkpoint: bytes | None = None
        if needs_sensing(settings, state):
            self.task_count = 0
            self.sensing_step: int | None = state.step
        else:
            interval = settings.sensing_interval + 1
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

    def wait(self, now: float) -> None:
        """Note that the robot waits for the rest of the answer, if it does not already."""
        if self.needed_at is None:
            self.needed_at = now

    def stop_waiting(self) -> None:
        """Note that the robot no longer waits."""
        self.needed_at = None

    def checkpoint(self) -> bytes:
        """Return the encoded state (computed once)."""
        if self._checkpoint is None:
            self._checkpoint = encode_checkpoint(self.state)
        return self._checkpoint

    @property
    def is_open(self) -> bool:
        """Whether services are to be asked: the answer is incomplete and not disputed."""
        return not self.disputed and not self.complete

    def read_tasks(self, reply: TaskAnswer, action_size: int, service: str) -> AnswerPart:
        """Return the task actions of a reply.

        Raises
        ------
        MessageError
            If the reply cannot answer this question.
        """
        if reply.count != self.task_count:
            raise MessageError(
                "malformed", f"{reply.count} task actions where {self.task_count} were asked"
            )
        numbers = decode_floats(reply.actions, reply.count * action_size)
        return AnswerPart(service, list(numbers.reshape(reply.count, action_size)), None)

    def read_sensing(
        self, reply: SensingAnswer, num_sensing_actions: int, service: str
    ) -> AnswerPart:
        """Return the sensing action of a reply.

        Raises
        ------
        MessageError
            If the reply cannot answer this question.
        """
        if reply.step != self.sensing_step:
            raise MessageError(
                "malformed",
                f"a sensing action for step {reply.step} where {self.sensing_step} was asked",
            )
        if self.task_count == 0 and reply.digest != self.digest:
            raise MessageError("malformed", "a sensing action for another state than was asked")
        if reply.sensing_action >= num_sensing_actions:
            raise MessageError("malformed", f"there is no sensing action {reply.sensing_action}")
        return AnswerPart(service, None, reply)
