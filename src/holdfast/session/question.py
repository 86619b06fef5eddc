"""The one question that a robot asks, and as much of its answer as has come.

The question is a state: what is to be done from there on until the robot has sensed again? The
answer has up to two parts, the task actions on the way and the sensing action at its end, and each
may come from another service, or from several. The first that comes counts; a later one can only
say the same, or show that somebody errs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.planning import PlanningState, encode_checkpoint, needs_sensing
from holdfast.session.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    MessageError,
    Observed,
    SensingAnswer,
    TaskAnswer,
    numbers_from,
)
from holdfast.settings import PlanningSettings

__all__ = ["Provenance", "Question"]

FloatArray = npt.NDArray[np.float64]


class Provenance(NamedTuple):
    """Where an answer came from and how long it took."""

    service: str
    round_trip_s: float
    computed_s: float


class Question:
    """What to do from a state on, and as much of the answer as has come.

    Parameters
    ----------
    settings : PlanningSettings
    state : PlanningState
    digest : bytes
        Of the state.
    observations : tuple of Observed
        What was sensed last in this trial.
    num_observations : int
        All that was sensed in this trial.

    Attributes
    ----------
    task_count : int
        Task actions that belong to the answer.
    sensing_step : int or None
        The sensing step that does; None if it is too far away.
    tasks : list of array or None
    sensing : SensingAnswer or None
    task_source, sensing_source : Provenance or None
    """

    __slots__ = (
        "_checkpoint",
        "digest",
        "needed_at",
        "num_observations",
        "observations",
        "sensing",
        "sensing_source",
        "sensing_step",
        "state",
        "task_count",
        "task_source",
        "tasks",
        "times_asked",
        "told_waiting",
    )

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
        self.told_waiting = False
        self.times_asked = 0
        self.tasks: list[FloatArray] | None = None
        self.sensing: SensingAnswer | None = None
        self.task_source: Provenance | None = None
        self.sensing_source: Provenance | None = None
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
        """Whether nothing of the answer is missing."""
        return (self.tasks is not None or self.task_count == 0) and (
            self.sensing is not None or self.sensing_step is None
        )

    def checkpoint(self) -> bytes:
        """Return the state, encoded (once)."""
        if self._checkpoint is None:
            self._checkpoint = encode_checkpoint(self.state)
        return self._checkpoint

    def take_tasks(self, reply: TaskAnswer, action_size: int, source: Provenance) -> bool:
        """Keep the task actions if none have come; tell whether they are the ones that are kept.

        Parameters
        ----------
        reply : TaskAnswer
        action_size : int
            Of the problem.
        source : Provenance

        Raises
        ------
        MessageError
            If this cannot be an answer to the question.
        """
        if reply.count != self.task_count:
            raise MessageError(
                "malformed", f"{reply.count} task actions where {self.task_count} were asked"
            )
        numbers = numbers_from(reply.actions, reply.count * action_size)
        actions = list(numbers.reshape(reply.count, action_size))
        if self.tasks is None:
            self.tasks = actions
            self.task_source = source
            return True
        return all(map(np.array_equal, self.tasks, actions))

    def take_sensing(
        self, reply: SensingAnswer, num_sensing_actions: int, source: Provenance
    ) -> bool:
        """Keep the sensing action if none has come; tell whether it is the one that is kept.

        Parameters
        ----------
        reply : SensingAnswer
        num_sensing_actions : int
            Of the problem.
        source : Provenance

        Raises
        ------
        MessageError
            If this cannot be an answer to the question.
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
        if self.sensing is None:
            self.sensing = reply
            self.sensing_source = source
            return True
        return self.sensing.sensing_action == reply.sensing_action
