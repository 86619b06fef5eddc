"""Active sensing as one typed service: three requests, and a state that goes with each.

The first implementation had a service ``cloud_active_sensing`` in the cloud and another one,
``cloud_active_sensing_recovery``, on the robot. Each kept the belief to itself, so a robot that
went from one to the other lost it. Here a request brings the state and the answer takes it back:
the services keep nothing, and it does not matter which of them answers.

This module is the service without any wire: requests and answers as Python objects. How they look
as messages, ``interfaces/srv/ActiveSensing.srv`` says, field by field.
"""

from __future__ import annotations

import enum
import hashlib
from typing import NamedTuple

import msgspec
import numpy as np
import numpy.typing as npt

from holdfast import planning
from holdfast.belief import Belief
from holdfast.configuration import Configuration
from holdfast.errors import CheckpointError, HoldfastError, ProblemError
from holdfast.planning import Planner, PlanningState
from holdfast.runtime.robot_process import opening_of
from holdfast.user_code import account_of_user_error

__all__ = [
    "ActiveSensing",
    "Answer",
    "ErrorCode",
    "Kind",
    "Request",
    "checked_state",
    "configuration_digest",
    "no_state",
]

FloatArray = npt.NDArray[np.float64]

_MAX_MESSAGE = 2000
_NO_ENTROPIES = np.empty(0)


class Kind(enum.IntEnum):
    """What is asked."""

    INITIALIZE = 0
    """The belief that a trial begins with."""
    CHOOSE_SENSING_ACTION = 1
    """What to sense."""
    CHOOSE_TASK_ACTIONS = 2
    """What to do once this was observed."""


class ErrorCode(enum.IntEnum):
    """Why there is no answer."""

    OK = 0
    BAD_REQUEST = 1
    """Nobody can answer this request."""
    OTHER_CONFIGURATION = 2
    """This service plans with another configuration or other code."""
    PROBLEM_FAILED = 3
    """The problem's own code has raised an error."""
    BUSY = 4
    """Too much to do: somebody else may have time, and so may this service, later."""


class Request(NamedTuple):
    """A request; what its kind does not need is left as it is.

    Attributes
    ----------
    kind : int
        One of :class:`Kind`.
    configuration : str
        Digest of the configuration that is meant; empty means the service's own.
    seed, trial : int
        Of the trial that is to begin.
    state : PlanningState or None
        None only for INITIALIZE.
    sensing_action : int
        What was sensed.
    observation : array of shape (observation_size,)
        What it showed.
    """

    kind: int
    configuration: str = ""
    seed: int = 0
    trial: int = 0
    state: PlanningState | None = None
    sensing_action: int = 0
    observation: FloatArray = _NO_ENTROPIES


class Answer(NamedTuple):
    """An answer; what its request did not ask for is empty.

    Attributes
    ----------
    error : ErrorCode
    message : str
        Why there is no answer, in words.
    configuration : str
        Digest of the service's configuration.
    state : PlanningState or None
        For the next request; None if there is no answer.
    sensing_action : int
    entropies : array of shape (J,)
        Expected entropy after each sensing action, in nats; empty if the selector has none.
    task_actions : array of shape (n, action_size)
        What to do until the next sensing step, in order.
    """

    error: ErrorCode
    message: str
    configuration: str
    state: PlanningState | None = None
    sensing_action: int = 0
    entropies: FloatArray = _NO_ENTROPIES
    task_actions: FloatArray = np.empty((0, 0))


def no_state() -> PlanningState:
    """Return a state of no particles, for messages that must have one and mean none."""
    return PlanningState(0, 0, 0, 0, False, Belief(np.empty((0, 0)), np.empty(0)))


def configuration_digest(configuration: Configuration) -> str:
    """Return 16 digits that stand for all that decides but seed, trial and state.

    That is the problem and its code, the settings of the planning, and holdfast's own version.
    """
    opening = msgspec.structs.replace(opening_of(configuration), seed=0)
    return hashlib.blake2b(
        msgspec.msgpack.encode(opening, order="sorted"), digest_size=8
    ).hexdigest()


class ActiveSensing:
    """Answers requests by one configuration; one thread at a time.

    Parameters
    ----------
    configuration : Configuration
    """

    def __init__(self, configuration: Configuration) -> None:
        self._problem_name = configuration.problem_name
        self._planner = Planner(configuration.problem, configuration.planning)
        self._max_actions = configuration.planning.sensing_interval + 1
        self.configuration = configuration_digest(configuration)

    @property
    def action_size(self) -> int:
        """Coordinates of a task action."""
        return self._planner.problem.action_size

    @property
    def state_size(self) -> int:
        """Coordinates of a state."""
        return self._planner.problem.state_size

    def refusal(self, error: ErrorCode, message: str) -> Answer:
        """Return the answer that there is none."""
        return Answer(error, message[:_MAX_MESSAGE], self.configuration)

    def answer(self, request: Request) -> Answer:
        """Answer a request, or say in the answer why there is none."""
        if request.configuration not in ("", self.configuration):
            return self.refusal(
                ErrorCode.OTHER_CONFIGURATION,
                f"configuration {request.configuration!r:.60} was asked for; this service has "
                f"{self.configuration} ({self._problem_name})",
            )
        try:
            return self._answer(request)
        except HoldfastError as error:
            # Only its author can mend a problem that breaks its contract.
            code = ErrorCode.PROBLEM_FAILED if isinstance(error, ProblemError) else None
            return self.refusal(code or ErrorCode.BAD_REQUEST, str(error))
        except Exception as error:
            account = account_of_user_error(error, self._problem_name)
            if account is None:
                raise
            return self.refusal(ErrorCode.PROBLEM_FAILED, account)

    def _answer(self, request: Request) -> Answer:
        planner = self._planner
        if request.kind == Kind.INITIALIZE:
            state = planner.initial_state(request.seed, request.trial)
            return Answer(ErrorCode.OK, "", self.configuration, state)
        if request.kind not in (Kind.CHOOSE_SENSING_ACTION, Kind.CHOOSE_TASK_ACTIONS):
            return self.refusal(
                ErrorCode.BAD_REQUEST,
                f"kind {request.kind}: there are {', '.join(f'{k.value} {k.name}' for k in Kind)}",
            )
        if request.state is None:
            return self.refusal(ErrorCode.BAD_REQUEST, "state: there are no particles in it")
        state = request.state
        planning.check_state(planner.problem, planner.settings, state)
        needs_sensing = planner.needs_sensing(state)
        if request.kind == Kind.CHOOSE_SENSING_ACTION:
            if not needs_sensing:
                return self.refusal(
                    ErrorCode.BAD_REQUEST,
                    f"step {state.step} needs no sensing action; ask for CHOOSE_TASK_ACTIONS",
                )
            chosen, info = planning.choose_sensing_action(planner.problem, planner.settings, state)
            entropies = _NO_ENTROPIES if info.entropies is None else info.entropies
            return Answer(ErrorCode.OK, "", self.configuration, state, chosen, entropies)
        if needs_sensing:
            state, _ = planner.observe(state, request.sensing_action, request.observation)
        elif request.observation.size:
            return self.refusal(
                ErrorCode.BAD_REQUEST,
                f"observation of {request.observation.size} values: step {state.step} needs none",
            )
        actions, ahead = planner.plan_until_sensing(state, self._max_actions)
        return Answer(
            ErrorCode.OK,
            "",
            self.configuration,
            ahead,
            task_actions=np.reshape(actions, (len(actions), self.action_size)),
        )


def checked_state(
    seed: int,
    trial: int,
    step: int,
    stage: int,
    sensed: bool,
    state_size: int,
    states: FloatArray,
    weights: FloatArray,
) -> PlanningState | None:
    """Return the state that a message has, or None if it has no particles.

    Parameters
    ----------
    seed, trial, step, stage : int
    sensed : bool
    state_size : int
        Coordinates of a state.
    states : array of shape (num_particles * state_size,)
        Particle after particle.
    weights : array of shape (num_particles,)

    Raises
    ------
    CheckpointError
        If this is no state: numbers that are missing or not finite, weights that are negative or
        do not sum to 1, a negative seed.
    """
    if not weights.size and not states.size:
        return None
    if states.size != weights.size * state_size:
        raise CheckpointError(
            f"state.belief.states has {states.size} numbers: {weights.size} weights and "
            f"state_size {state_size} need {weights.size * state_size}"
        )
    belief = Belief(states.reshape(weights.size, state_size), weights)
    # What a checkpoint is checked for is what a state from outside must be checked for.
    return planning.decode_checkpoint(
        planning.encode_checkpoint(PlanningState(seed, trial, step, stage, sensed, belief))
    )
