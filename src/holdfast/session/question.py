"""The one question that a robot asks, and as much of its answer as has come.

The question is a state: what is to be done from there on until the robot has sensed again? The
answer has up to two parts, the task actions on the way and the sensing action at its end, and each
may come from another service, or from several. The first that comes counts; a later one can only
say the same, or show that somebody errs. Then the robot's own planner answers
(:mod:`holdfast.protocol.verification`), and nothing is done before it has.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.planning import PlanningState, encode_checkpoint, needs_sensing
from holdfast.session.events import Decided
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

__all__ = ["Given", "Provenance", "Question", "same_actions"]

FloatArray = npt.NDArray[np.float64]


class Provenance(NamedTuple):
    """Where an answer came from and how long it took."""

    service: str
    round_trip_s: float
    computed_s: float


_MAX_GIVEN = 64
"""Bound on the parts of answers that are kept to be compared; services that differ are few."""


def same_actions(first: Sequence[FloatArray], second: Sequence[FloatArray]) -> bool:
    """Tell whether task actions are the same, bit for bit, as in a digest: 0.0 is not -0.0."""
    return len(first) == len(second) and all(
        one.tobytes() == other.tobytes() for one, other in zip(first, second, strict=True)
    )


class Given:
    """A part of an answer, as a service gave it; equal parts of one service are kept once.

    Attributes
    ----------
    service : str
    tasks : list of array or None
    sensing : SensingAnswer or None
        One of the two.
    outside_limits : bool
        Whether the tasks are not what the problem's ``execute`` lets through.
    judged : bool
        Whether it was compared with the robot's own answer.
    """

    __slots__ = ("judged", "outside_limits", "sensing", "service", "tasks")

    def __init__(
        self, service: str, tasks: list[FloatArray] | None, sensing: SensingAnswer | None
    ) -> None:
        self.service = service
        self.tasks = tasks
        self.sensing = sensing
        self.outside_limits = False
        self.judged = False

    @property
    def kind(self) -> str:
        """Which part it is."""
        return "task" if self.sensing is None else "sensing"

    def says_the_same(self, other: Given) -> bool:
        """Tell whether two parts of the same kind agree."""
        if self.sensing is not None and other.sensing is not None:
            return (self.sensing.sensing_action, self.sensing.digest) == (
                other.sensing.sensing_action,
                other.sensing.digest,
            )
        return (
            self.tasks is not None
            and other.tasks is not None
            and same_actions(self.tasks, other.tasks)
        )


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
    tasks : sequence of array or None
    sensing : SensingAnswer or None
    task_source, sensing_source : Provenance or None
    given : list of Given
        What services answered, to be compared.
    checked : bool
        Whether the robot's own planner answers it as well.
    disputed : bool
        Whether nothing may be done before it has.
    own : Decided or None
        What it answered.
    own_is_certain : bool or None
        Whether it came to the same when it was asked twice; None if it was not.
    """

    __slots__ = (
        "_checkpoint",
        "checked",
        "digest",
        "disputed",
        "given",
        "needed_at",
        "num_observations",
        "observations",
        "own",
        "own_is_certain",
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
        self.tasks: Sequence[FloatArray] | None = None
        self.sensing: SensingAnswer | None = None
        self.task_source: Provenance | None = None
        self.sensing_source: Provenance | None = None
        self.given: list[Given] = []
        self.checked = False
        self.disputed = False
        self.own: Decided | None = None
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
        """Whether nothing of the answer is missing."""
        return (self.tasks is not None or self.task_count == 0) and (
            self.sensing is not None or self.sensing_step is None
        )

    def checkpoint(self) -> bytes:
        """Return the state, encoded (once)."""
        if self._checkpoint is None:
            self._checkpoint = encode_checkpoint(self.state)
        return self._checkpoint

    @property
    def is_open(self) -> bool:
        """Whether services are to be asked: something is missing, and it is not in dispute."""
        return not self.disputed and not self.complete

    def read_tasks(self, reply: TaskAnswer, action_size: int, service: str) -> Given:
        """Return the task actions of a reply.

        Parameters
        ----------
        reply : TaskAnswer
        action_size : int
            Of the problem.
        service : str

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
        return Given(service, list(numbers.reshape(reply.count, action_size)), None)

    def read_sensing(self, reply: SensingAnswer, num_sensing_actions: int, service: str) -> Given:
        """Return the sensing action of a reply.

        Parameters
        ----------
        reply : SensingAnswer
        num_sensing_actions : int
            Of the problem.
        service : str

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
        return Given(service, None, reply)

    def take(self, given: Given, source: Provenance) -> bool:
        """Keep a part of the answer if it is the first; tell whether it agrees with what was given.

        A part outside the limits is only kept to be compared.

        Parameters
        ----------
        given : Given
        source : Provenance
        """
        others = [each for each in self.given if each.kind == given.kind]
        known = any(each.service == given.service and each.says_the_same(given) for each in others)
        if not known and len(self.given) < _MAX_GIVEN:
            self.given.append(given)
        if given.outside_limits:
            return False
        if given.tasks is not None and self.tasks is None:
            self.tasks = given.tasks
            self.task_source = source
        elif given.sensing is not None and self.sensing is None:
            self.sensing = given.sensing
            self.sensing_source = source
        return all(given.says_the_same(each) for each in others)
