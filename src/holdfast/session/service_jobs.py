"""The computations of a service: each a pure function of what it was made with.

A job rolls the robot's state forward, or takes it from a checkpoint, makes sure by the digest that
it is the state that the request names, and decides in it. It belongs to no session while it runs,
so it can run on any thread, and nothing that it comes to is kept before its outcome is handed in.

Problems are anybody's code. So whatever goes wrong in one is a refusal with an account of it, never
an error of the service, and the instances are lent to one job at a time (:class:`ProblemPool`).
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Literal, NamedTuple

from holdfast.errors import (
    CheckpointError,
    ConfigurationError,
    HoldfastError,
    InvalidValueError,
    OtherCodeError,
    UnknownProblemError,
)
from holdfast.planning import (
    Planner,
    PlanningState,
    check_state,
    choose_sensing_action,
    decode_checkpoint,
    needs_sensing,
)
from holdfast.problems.problem import Problem
from holdfast.session.messages import (
    DIGEST_SIZE,
    MAX_TASK_ACTIONS,
    MessageError,
    Opening,
    Request,
    numbers_from,
    numbers_to,
    unpack_opening,
)
from holdfast.session.service_limits import ServiceLimits
from holdfast.settings import PlanningSettings

__all__ = ["Job", "Outcome", "ProblemPool"]

_MAX_ACTION_SIZE = 4096


class Outcome(NamedTuple):
    """What a job came to.

    Attributes
    ----------
    failure : tuple of str or None
        Code and text of the refusal; None if it succeeded, or lacks the state.
    lacks_state : bool
        The requested state does not follow from what the service holds.
    differs : bool
        It held a state of this trial that leads elsewhere.
    diverged : bool
        It came to the step that the request names, and to another digest.
    problem : Problem or None
        As far as it was there or could be built.
    state : PlanningState or None
        The state that the request named, verified.
    restored : bool
        It came from a checkpoint.
    num_actions : int
        Task actions.
    actions : bytes
        These, as they are sent.
    ahead : PlanningState or None
        The state that they lead to.
    ahead_digest : bytes
        The part of its digest that is sent.
    sensing_action : int
        That was chosen; -1 if none was to be.
    """

    failure: tuple[str, str] | None = None
    lacks_state: bool = False
    differs: bool = False
    diverged: bool = False
    problem: Problem | None = None
    state: PlanningState | None = None
    restored: bool = False
    num_actions: int = 0
    actions: bytes = b""
    ahead: PlanningState | None = None
    ahead_digest: bytes = b""
    sensing_action: int = -1


class _LacksStateError(Exception):
    """The events of a request do not connect to the state at hand, or lead to another one."""

    def __init__(self, *, differs: bool = False, diverged: bool = False) -> None:
        super().__init__()
        self.differs = differs
        self.diverged = diverged


class Job:
    """A part of an answer to be computed: a pure function of what it was made with.

    Parameters
    ----------
    kind : {"task", "sensing"}
    problem : Problem or None
        None if it is still to be built.
    make_problem, describe_error : callable
    opening : bytes
        Packed (:func:`~holdfast.session.messages.pack_opening`).
    planning : PlanningSettings
    seed : int
    limits : ServiceLimits
    request : Request or None
        Names the state; None if ``state`` is that state already.
    state : PlanningState or None
        From where the request's state is reached; None if from the trial's beginning.
    make_planner : callable, optional
        Joins the problem and the settings to the functions that lead from state to state.
    """

    __slots__ = (
        "_describe_error",
        "_limits",
        "_make_planner",
        "_make_problem",
        "_opening",
        "_planning",
        "_problem",
        "_request",
        "_seed",
        "_state",
        "kind",
    )

    def __init__(
        self,
        kind: Literal["task", "sensing"],
        problem: Problem | None,
        make_problem: Callable[[Opening], Problem],
        describe_error: Callable[[BaseException], str],
        opening: bytes,
        planning: PlanningSettings,
        seed: int,
        limits: ServiceLimits,
        request: Request | None,
        state: PlanningState | None,
        make_planner: Callable[[Problem, PlanningSettings], Planner] = Planner,
    ) -> None:
        self.kind = kind
        self._problem = problem
        self._make_problem = make_problem
        self._describe_error = describe_error
        self._opening = opening
        self._planning = planning
        self._seed = seed
        self._limits = limits
        self._request = request
        self._state = state
        self._make_planner = make_planner

    @property
    def state(self) -> PlanningState | None:
        """From where it begins."""
        return self._state

    @property
    def identity(self) -> tuple[object, ...]:
        """What the outcome is a function of, besides that state, the problem and the settings."""
        request = self._request
        named = None
        if request is not None:
            named = (
                request.trial,
                request.step,
                request.sensed,
                request.digest,
                request.observations,
                request.checkpoint,
            )
        return self.kind, self._seed, named

    def run(self) -> Outcome:
        """Compute; whatever goes wrong in the problem's functions is part of the outcome.

        Whatever they raise, ``KeyboardInterrupt`` included: on a worker's thread it can only come
        from them.
        """
        # Kept as it becomes known, for it is worth keeping if the rest fails.
        problem = self._problem
        try:
            if problem is None:
                problem = self._make_problem(unpack_opening(self._opening))
            _check_work(problem, self._planning, self._limits)
            return self._computed(problem)
        except _LacksStateError as lack:
            differs = lack.differs or self._state is not None
            return Outcome(
                lacks_state=True, differs=differs, diverged=lack.diverged, problem=problem
            )
        except MemoryError as error:
            text = _account(error, self._describe_error)
            asked = _work_in_words(problem, self._planning)
            text = f"out of memory for a decision of {asked}: {text}"
            return Outcome(failure=("out_of_memory", text), problem=problem)
        except MessageError as error:
            return Outcome(failure=(error.code, str(error)), problem=problem)
        except HoldfastError as error:
            return Outcome(failure=(_code_of(error), _account(error, str)), problem=problem)
        except BaseException as error:  # noqa: BLE001 - the problem is anybody's code
            text = _account(error, self._describe_error)
            return Outcome(failure=("failed", text), problem=problem)

    def _computed(self, problem: Problem) -> Outcome:
        planning, request = self._planning, self._request
        if request is None:
            assert self._state is not None
            index, _ = choose_sensing_action(problem, planning, self._state)
            return Outcome(problem=problem, sensing_action=index)
        planner = self._make_planner(problem, planning)
        state = self._reached(planner, request)
        restored = request.checkpoint is not None
        if needs_sensing(planning, state):
            index, _ = choose_sensing_action(problem, planning, state)
            return Outcome(problem=problem, state=state, restored=restored, sensing_action=index)
        actions, ahead = planner.plan_until_sensing(state, MAX_TASK_ACTIONS)
        return Outcome(
            problem=problem,
            state=state,
            restored=restored,
            num_actions=len(actions),
            actions=numbers_to(actions),
            ahead=ahead,
            ahead_digest=planner.digest(ahead)[:DIGEST_SIZE],
        )

    def _reached(self, planner: Planner, request: Request) -> PlanningState:
        """Return the state that the request names."""
        if request.checkpoint is not None:
            return self._restored(planner, request, request.checkpoint)
        state = self._state
        if state is None:
            state = planner.initial_state(self._seed, request.trial)
        most = state.step + self._limits.max_steps
        for observed in request.observations:
            if (observed.step, True) <= (state.step, state.sensed):
                continue  # part of the state already
            state = self._rolled(planner, state, observed.step, most)
            if not planner.needs_sensing(state):
                raise _LacksStateError
            observation = numbers_from(observed.observation, len(observed.observation) // 8)
            state, _ = planner.observe(state, observed.sensing_action, observation)
        state = self._rolled(planner, state, request.step, most)
        if state.sensed != request.sensed:
            raise _LacksStateError(differs=True)
        if planner.digest(state)[:DIGEST_SIZE] != request.digest:
            raise _LacksStateError(differs=True, diverged=True)
        return state

    def _rolled(
        self, planner: Planner, state: PlanningState, step: int, most: int
    ) -> PlanningState:
        """Return the state at a later step, by task actions alone."""
        if not state.step <= step <= most:
            raise _LacksStateError
        while state.step < step:
            if planner.needs_sensing(state):
                raise _LacksStateError
            state = planner.advance(state, planner.choose_task_action(state))
        return state

    def _restored(
        self, planner: Planner, request: Request, checkpoint: bytes | memoryview
    ) -> PlanningState:
        state = decode_checkpoint(checkpoint)
        check_state(planner.problem, planner.settings, state)
        for name, came, asked in (
            ("seed", state.seed, self._seed),
            ("trial", state.trial, request.trial),
            ("step", state.step, request.step),
            ("sensed", state.sensed, request.sensed),
        ):
            if came != asked:
                raise CheckpointError(f"checkpoint with {name} {came}: the request says {asked}")
        if planner.digest(state)[:DIGEST_SIZE] != request.digest:
            raise CheckpointError("checkpoint of a state that has another digest than the request")
        return state


def _check_work(problem: Problem, planning: PlanningSettings, limits: ServiceLimits) -> None:
    """Check that a service can take decisions of this size on."""
    count = planning.particle_filter.num_particles
    sensing = planning.active_sensing
    actions = len(problem.sensing_actions)
    work = count * sensing.num_observation_samples * actions * sensing.horizon
    if work > limits.max_work:
        raise InvalidValueError(
            f"a decision of {work} units of work ({_work_in_words(problem, planning)}): this "
            f"service takes at most {limits.max_work} (max_work)"
        )
    if problem.action_size > _MAX_ACTION_SIZE:
        raise InvalidValueError(
            f"action_size of {problem.name} is {problem.action_size}: a service takes at most "
            f"{_MAX_ACTION_SIZE}"
        )


def _work_in_words(problem: Problem | None, planning: PlanningSettings) -> str:
    """Say what a decision's size follows from, by the keys of the configuration."""
    sensing = planning.active_sensing
    actions = "" if problem is None else f"{len(problem.sensing_actions)} sensing actions x "
    return (
        f"particle_filter.num_particles {planning.particle_filter.num_particles} x "
        f"active_sensing.num_observation_samples {sensing.num_observation_samples} x "
        f"{actions}active_sensing.horizon {sensing.horizon}"
    )


def _account(error: BaseException, describe: Callable[[BaseException], str]) -> str:
    """Put an error of a problem into words, even one that fails at that itself."""
    try:
        return describe(error)
    except BaseException:  # noqa: BLE001 - whoever wrote the problem may have written the error
        return f"{type(error).__name__}, which cannot be put into words"


def _code_of(error: HoldfastError) -> str:
    if isinstance(error, UnknownProblemError):
        return "unknown_problem"
    if isinstance(error, OtherCodeError):
        return "other_code"
    if isinstance(error, InvalidValueError | CheckpointError | ConfigurationError):
        return "invalid"
    # ProblemError, and whatever a problem raises of ours for reasons of its own.
    return "failed"


class ProblemPool:
    """The problem instances that no job is using.

    No two jobs at a time have the same instance: a user's problem may keep buffers.

    Parameters
    ----------
    max_problems : int
        Problems kept; the one that was given back the longest ago goes first.
    """

    def __init__(self, max_problems: int) -> None:
        self._max_problems = max_problems
        self._idle: OrderedDict[bytes, list[Problem]] = OrderedDict()

    def lend(self, key: bytes) -> Problem | None:
        """Take a problem that nobody uses; None if one is to be built."""
        idle = self._idle.get(key)
        return idle.pop() if idle else None

    def give_back(self, key: bytes, problem: Problem | None) -> None:
        """Keep a problem for the next job."""
        if problem is None:
            return
        self._idle.setdefault(key, []).append(problem)
        self._idle.move_to_end(key)
        while len(self._idle) > self._max_problems:
            self._idle.popitem(last=False)
