"""Active sensing as one stateless, typed service with three kinds of request.

Each request brings the planning state and each answer returns it, so any service can answer any
request. This module has the service without a wire: requests and answers as Python objects.
``srv/ActiveSensing.srv`` of ``holdfast_interfaces`` defines them as messages, field by field.
"""

from __future__ import annotations

import enum
import hashlib
from typing import Any, NamedTuple

import msgspec
import numpy as np

from holdfast.config.loader import Configuration
from holdfast.config.user_code import account_of_user_error
from holdfast.errors import HoldfastError, InvalidValueError, ProblemError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.planner import Planner, PlanningState
from holdfast.printable import brief
from holdfast.robot.environment import is_no_reading
from holdfast.robot.session_configuration import session_configuration_of

_MAX_MESSAGE = 2000
_NONE = np.empty(0)


class RequestKind(enum.IntEnum):
    """The kind of a request."""

    INITIALIZE = 0  # return the state that a trial begins with
    CHOOSE_SENSING_ACTION = 1  # choose what to sense
    CHOOSE_TASK_ACTIONS = 2  # choose the task actions after an observation


class ErrorCode(enum.IntEnum):
    """Why there is no answer."""

    OK = 0
    BAD_REQUEST = 1  # the request is invalid for every service
    OTHER_CONFIGURATION = 2  # this service plans with another configuration or other code
    PROBLEM_FAILED = 3  # the problem's own code has raised an error
    BUSY = 4  # too many requests: another service may answer now, or this one later


ANOTHER_MAY_ANSWER = (ErrorCode.OTHER_CONFIGURATION, ErrorCode.BUSY)
"""Refusals of one service; every other error is the request's or the problem's own."""


class DecisionRequest(NamedTuple):
    """A request; fields that its kind does not need keep their defaults."""

    kind: int
    configuration: str = ""  # digest of the required one; empty accepts the service's
    seed: int = 0
    trial: int = 0
    state: PlanningState | None = None
    sensing_action: int = 0  # that was performed
    observation: FloatArray = _NONE  # what it has shown; NaN in every component: no reading


class DecisionAnswer(NamedTuple):
    """An answer; fields that its request did not ask for are empty."""

    error: ErrorCode
    message: str  # why there is no answer
    configuration: str
    state: PlanningState | None = None  # for the next request
    sensing_action: int = 0
    entropies: FloatArray = _NONE  # expected after each sensing action, in nats
    task_actions: FloatArray = np.empty((0, 0))  # one a row, up to the next sensing step


def configuration_digest(configuration: Configuration) -> str:
    """Return 16 digits of a digest over the problem, its code, the settings and the version.

    Everything that decides is in it, except seed, trial and state.
    """
    session_configuration = msgspec.structs.replace(session_configuration_of(configuration), seed=0)
    return hashlib.blake2b(
        msgspec.msgpack.encode(session_configuration, order="sorted"), digest_size=8
    ).hexdigest()


class ActiveSensing:
    """Answers the requests of one configuration; for one thread at a time."""

    def __init__(self, configuration: Configuration) -> None:
        self._problem_name = configuration.problem_name
        self._planner = Planner(configuration.problem, configuration.planning)
        self._max_actions = configuration.planning.sensing_interval + 1
        self.configuration = configuration_digest(configuration)

    def refusal(self, error: ErrorCode, message: str) -> DecisionAnswer:
        """Return an answer with an error."""
        return DecisionAnswer(error, message[:_MAX_MESSAGE], self.configuration)

    def answer(self, request: DecisionRequest) -> DecisionAnswer:
        """Answer a request; errors are answers, too."""
        if request.configuration not in ("", self.configuration):
            return self.refusal(
                ErrorCode.OTHER_CONFIGURATION,
                f"configuration {brief(request.configuration)} was asked for; this service has "
                f"{self.configuration} ({self._problem_name})",
            )
        try:
            return self._answer(request)
        except HoldfastError as error:
            # Only the author can fix a problem that breaks its contract.
            of_problem = isinstance(error, ProblemError)
            code = ErrorCode.PROBLEM_FAILED if of_problem else ErrorCode.BAD_REQUEST
            return self.refusal(code, str(error))
        except Exception as error:
            account = account_of_user_error(error, self._problem_name)
            if account is None:
                raise
            return self.refusal(ErrorCode.PROBLEM_FAILED, account)

    def _answer(self, request: DecisionRequest) -> DecisionAnswer:
        planner = self._planner
        if request.kind == RequestKind.INITIALIZE:
            return self._ok(planner.init(request.seed, request.trial))
        if request.kind not in (RequestKind.CHOOSE_SENSING_ACTION, RequestKind.CHOOSE_TASK_ACTIONS):
            known = ", ".join(f"{kind.value} {kind.name}" for kind in RequestKind)
            raise InvalidValueError(f"kind {request.kind}: there are {known}")
        if (state := request.state) is None:
            raise InvalidValueError("state: there are no particles in it")
        planner.check(state)
        needs_sensing = planner.needs_sensing(state)
        if request.kind == RequestKind.CHOOSE_SENSING_ACTION:
            if not needs_sensing:
                raise InvalidValueError(
                    f"step {state.step} needs no sensing action; ask for CHOOSE_TASK_ACTIONS"
                )
            chosen, info = planner.choose_sensing_action(state)
            entropies = _NONE if info.entropies is None else info.entropies
            return self._ok(state, sensing_action=chosen, entropies=entropies)
        if needs_sensing:
            shown = request.observation
            chosen_not_to = request.sensing_action == planner.no_sensing and not shown.size
            observation = None if chosen_not_to or is_no_reading(shown) else shown
            state, _ = planner.observe(state, request.sensing_action, observation)
        elif request.observation.size:
            raise InvalidValueError(
                f"observation of {request.observation.size} values: step {state.step} needs none"
            )
        actions, ahead = planner.plan_until_sensing(state, self._max_actions)
        shape = len(actions), planner.problem.action_size
        return self._ok(ahead, task_actions=np.reshape(actions, shape))

    def _ok(self, state: PlanningState, **fields: Any) -> DecisionAnswer:
        return DecisionAnswer(ErrorCode.OK, "", self.configuration, state, **fields)
