"""A service's computations, each a pure function of its inputs, and the effects that start them.

A job rolls the robot's state forward or restores it from a checkpoint, verifies by the digest that
it is the requested state, and decides in it. It belongs to no session while it runs, so any thread
can run it, and nothing is kept before its result is handed in.

Problems are other people's code. Whatever goes wrong in one becomes a refusal with an explanation,
never an error of the service, and each instance is lent to one job at a time
(:class:`ProblemPool`).
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias

from holdfast.errors import (
    CheckpointError,
    ConfigurationError,
    HoldfastError,
    InterruptedComputationError,
    InvalidValueError,
    MessageError,
    OtherCodeError,
    UnknownProblemError,
)
from holdfast.planning.inputs import CatchUpInput, Moved, Sensed, encode_floats, fold
from holdfast.planning.interruption import Interruption, check, interruptible
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.protocol.decision_cost import (
    ANY_MACHINE,
    Cost,
    Price,
    Pricing,
    ProblemCost,
    describe_cost,
)
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    MAX_ACTION_SIZE,
    MAX_TASK_ACTIONS,
    Request,
    SessionConfiguration,
    unpack_configuration,
)
from holdfast.protocol.service_limits import ServiceLimits

_COSTS_PER_PROBLEM = 128
"""So many costs are kept for each problem of which instances are; they take little memory."""


class JobResult(NamedTuple):
    """The result of a job."""

    # Code and text of the refusal; None if it succeeded or lacks the state.
    failure: tuple[str, str] | None = None
    # The requested state does not follow from what the service holds. ``differs``: it held a state
    # of this trial that leads elsewhere. ``diverged``: the requested step was reached with another
    # digest.
    lacks_state: bool = False
    differs: bool = False
    diverged: bool = False
    problem: Problem | None = None  # to be reused, as far as it could be built
    # The requested state, verified; ``restored`` if it came from a checkpoint.
    state: PlanningState | None = None
    restored: bool = False
    num_actions: int = 0
    actions: bytes = b""
    # ahead, ahead_digest: the state to which the ``num_actions`` actions lead, and its digest as it
    # is sent; None where it depends on what a move will show.
    ahead: PlanningState | None = None
    ahead_digest: bytes = b""
    sensing_action: int = -1  # the chosen one; -1 if none was to be chosen
    price: Price | None = None  # what this session's decisions cost, as far as that is known
    # The estimated cost; nothing was computed, because it is more than this job may take.
    postponed: Cost | None = None
    cancelled: bool = False  # it was ended from outside, or has used up its time


class _LacksStateError(Exception):
    """The request's events do not connect to the held state, or lead to another one."""

    def __init__(self, *, differs: bool = False, diverged: bool = False) -> None:
        super().__init__()
        self.differs = differs
        self.diverged = diverged


class Job:
    """A part of an answer to be computed anywhere; its result is handed to ``Service.finished``.

    Short jobs are run one after another, or together
    (:func:`~holdfast.protocol.service_batches.run_together`): they share their problem.
    """

    def __init__(
        self,
        kind: Literal["task", "sensing"],
        problem: Problem | None,  # None if it must be built
        make_problem: Callable[[SessionConfiguration], Problem],
        describe_error: Callable[[BaseException], str],
        configuration: bytes,  # packed (:func:`~holdfast.protocol.messages.pack_configuration`)
        planning: PlanningSettings,
        seed: int,
        limits: ServiceLimits,
        request: Request | None,  # names the state; None if ``state`` is that state
        state: PlanningState | None,  # where to start; None for the trial's beginning
        pricing: Pricing = ANY_MACHINE,
        price: Price | None = None,  # from an earlier job of this session
        # What the problem's functions take, from an earlier job of any session.
        known: ProblemCost | None = None,
        # What it may take; if it is estimated to take more, nothing is computed. None: what a
        # decision may take at all.
        most: Cost | None = None,
        most_s: float = math.inf,  # processor time after which it ends, whatever was estimated
        *,
        # Whether building the problem and measuring it are part of that time.
        building_counts: bool = False,
        # The same for jobs of the same problem and settings; None: like no other.
        company: bytes | None = None,
        # How long a short job takes; infinite for one that takes long or that nothing predicts: the
        # first job, a problem that is not built in, or an unusual request.
        expected_s: float = math.inf,
        # Whether its lane ends it after a moment. All others may take any time, so their threads
        # have less weight (:class:`~holdfast.protocol.service_lanes.Lanes`).
        is_brief: bool = False,
    ) -> None:
        self.kind = kind
        self.company = company
        self.expected_s = expected_s
        self.is_brief = is_brief
        self._pricing = pricing
        self.price = price
        self._known = known
        self._most = most
        self._building_counts = building_counts
        self.interruption = Interruption(most_s)  # ends it
        self.problem = problem
        self._make_problem = make_problem
        self._describe_error = describe_error
        self._configuration = configuration
        self.planning = planning
        self._seed = seed
        self._limits = limits
        self.request = request
        self.state = state

    @property
    def identity(self) -> tuple[object, ...]:
        """What the result depends on, besides that state, the problem and the settings."""
        request = self.request
        named = None
        if request is not None:
            named = (
                request.trial,
                request.step,
                request.sensed,
                request.digest,
                request.inputs,
                request.checkpoint,
            )
        return self.kind, self._seed, named

    def is_like(self, other: Job) -> bool:
        """Return whether another job asks the same of the same problem and settings."""
        return self.company is not None and (self.kind, self.company) == (other.kind, other.company)

    def cancel(self) -> None:
        """End it as soon as it can be; from any thread."""
        self.interruption.set()

    def run(self) -> JobResult:
        """Compute. Anything that the problem's functions raise becomes part of the result.

        That includes ``KeyboardInterrupt``: on a worker's thread it can only come from them.
        """
        # Kept as it becomes known, for it is worth keeping if the rest fails.
        problem = self.problem
        try:
            # All of it: a model may take long to build, and to measure.
            with interruptible(self.interruption):
                if self._building_counts:
                    self.interruption.start_clock()
                if problem is None:
                    problem = self._make_problem(unpack_configuration(self._configuration))
                if self.price is None:
                    self.price = self._pricing.price_of(problem, self.planning, self._known)
                if not self._building_counts:
                    self.interruption.start_clock()
                check()
                if (cost := self.too_dear(problem, self.price)) is not None:
                    return JobResult(problem=problem, price=self.price, postponed=cost)
                return self._computed(problem)._replace(price=self.price)
        except InterruptedComputationError:
            # The problem was left in the middle of something. What it costs may be known.
            return JobResult(cancelled=True, price=self.price)
        except _LacksStateError as lack:
            differs = lack.differs or self.state is not None
            return JobResult(
                lacks_state=True, differs=differs, diverged=lack.diverged, problem=problem
            )
        except MemoryError as error:
            text = _account(error, self._describe_error)
            asked = describe_cost(problem, self.planning)
            text = f"out of memory for a decision of {asked}: {text}"
            return JobResult(failure=("out_of_memory", text), problem=problem)
        except MessageError as error:
            return JobResult(failure=(error.code, str(error)), problem=problem)
        except HoldfastError as error:
            return JobResult(failure=(_code_of(error), _account(error, str)), problem=problem)
        except BaseException as error:  # noqa: BLE001 - the problem is anybody's code
            text = _account(error, self._describe_error)
            return JobResult(failure=("failed", text), problem=problem)

    def too_dear(self, problem: Problem, price: Price) -> Cost | None:
        """Return what this job takes if that is more than it may."""
        cost, most = self._checked_cost(problem, price), self._most
        if most is None or (cost.seconds <= most.seconds and cost.num_bytes <= most.num_bytes):
            return None
        return cost

    def _checked_cost(self, problem: Problem, price: Price) -> Cost:
        """Return what this job takes; if that, or any decision of the session, is too much, raise.

        The robot hears of it before it moves.
        """
        if problem.action_size > MAX_ACTION_SIZE:
            raise InvalidValueError(
                f"action_size of {problem.name} is {problem.action_size}: a service takes at most "
                f"{MAX_ACTION_SIZE}"
            )
        request, limits = self.request, self._limits
        reached, sensing = Cost(0.0, 0.0), price.sensing
        if request is not None:
            steps, state = 0, self.state
            size = sum(len(each.observation) for each in request.inputs)
            if request.checkpoint is not None:
                size += len(request.checkpoint)
            else:
                steps = min(
                    max(0, request.step - (0 if state is None else state.step)), limits.max_steps
                )
            if self.kind == "task":
                steps += min(self.planning.sensing_interval, MAX_TASK_ACTIONS) + 1
            reached = price.reaching.cost(
                steps=steps,
                inputs=len(request.inputs),
                begins=state is None and request.checkpoint is None,
                num_bytes=size,
            )
        seconds = max(reached.seconds, sensing.seconds)
        num_bytes = max(reached.num_bytes, sensing.num_bytes)
        too_much = None
        if seconds > limits.max_decision_s:
            most = f"{limits.max_decision_s:.3g} s (--max-decision-s)"
            too_much = f"{seconds:.3g} s on one core", most
        elif num_bytes > limits.max_decision_bytes:
            most = f"{limits.max_decision_bytes / 2**20:.3g} MB (--max-decision-mb)"
            too_much = f"{num_bytes / 2**20:.3g} MB of memory", most
        if too_much is not None:
            raise InvalidValueError(
                f"a decision of about {too_much[0]}: this service takes at most {too_much[1]}. "
                f"It has {describe_cost(problem, self.planning)}"
            )
        if self.kind == "task":
            return reached
        return Cost(reached.seconds + sensing.seconds, num_bytes)

    def _computed(self, problem: Problem) -> JobResult:
        planning, request = self.planning, self.request
        planner = Planner(problem, planning)
        if request is None:
            assert self.state is not None
            index, _ = planner.choose_sensing_action(self.state)
            return JobResult(problem=problem, sensing_action=index)
        state = self._reached(planner, request)
        restored = request.checkpoint is not None
        if planner.needs_sensing(state):
            index, _ = planner.choose_sensing_action(state)
            return JobResult(problem=problem, state=state, restored=restored, sensing_action=index)
        actions, ahead = planner.plan_until_sensing(state, MAX_TASK_ACTIONS)
        reached = JobResult(
            problem=problem,
            state=state,
            restored=restored,
            num_actions=len(actions),
            actions=encode_floats(actions),
        )
        if planner.moves_give_observations:
            # The state ahead depends on what the move will show.
            return reached
        return reached._replace(ahead=ahead, ahead_digest=planner.digest(ahead)[:DIGEST_SIZE])

    def _reached(self, planner: Planner, request: Request) -> PlanningState:
        """Return the requested state."""
        if request.checkpoint is not None:
            return self._restored(planner, request, request.checkpoint)
        state = self.state
        if state is None:
            state = planner.init(self._seed, request.trial)
        most = state.step + self._limits.max_steps
        for given in request.inputs:
            before = (given.step, isinstance(given, Moved))
            if before < (state.step, state.sensed):
                continue  # part of the state already
            check()
            state = self._rolled(planner, state, given.step, most)
            state = _with_input(planner, state, given)
        state = self._rolled(planner, state, request.step, most)
        if state.sensed != request.sensed:
            raise _LacksStateError(differs=True)
        if planner.digest(state)[:DIGEST_SIZE] != request.digest:
            raise _LacksStateError(differs=True, diverged=True)
        return state

    def _rolled(
        self, planner: Planner, state: PlanningState, step: int, most: int
    ) -> PlanningState:
        """Return the state at a later step, reached by task actions alone."""
        if not state.step <= step <= most:
            raise _LacksStateError
        while state.step < step:
            check()
            if planner.needs_sensing(state):
                raise _LacksStateError
            state = planner.advance(state, planner.choose_task_action(state)[0])
        return state

    def _restored(
        self, planner: Planner, request: Request, checkpoint: bytes | memoryview
    ) -> PlanningState:
        state = planner.decode(checkpoint)
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


def _with_input(planner: Planner, state: PlanningState, given: CatchUpInput) -> PlanningState:
    """Return the state after an input of its step."""
    if planner.needs_sensing(state) != isinstance(given, Sensed):
        raise _LacksStateError
    action = None if isinstance(given, Sensed) else planner.choose_task_action(state)[0]
    return fold(planner, state, given, action)[0]


def _account(error: BaseException, describe: Callable[[BaseException], str]) -> str:
    """Describe an error of a problem, even one whose description fails."""
    try:
        return describe(error)
    except BaseException:  # noqa: BLE001 - the error, too, may be the problem's code
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
    """Problem instances that no job is using, and what problems cost.

    Each instance is used by one job at a time, since it may keep buffers; all short jobs, of which
    one runs at a time, have one. Instances are kept of so many distinct problems, the least
    recently released going first; costs of many times as many.
    """

    def __init__(self, max_problems: int) -> None:
        self._max_problems = max_problems
        self._idle: OrderedDict[bytes, list[Problem]] = OrderedDict()
        self._shared: OrderedDict[bytes, Problem] = OrderedDict()
        self._costs: OrderedDict[tuple[str | None, bytes], ProblemCost] = OrderedDict()

    def cost_of(self, owner: str | None, key: bytes) -> ProblemCost | None:
        """Return what the functions of a problem take that this owner has brought before.

        None if that is not known any more. (Nobody's lane depends on what another has brought.)
        """
        return self._costs.get((owner, key))

    def shared(self, key: bytes) -> Problem | None:
        """Return the instance of all short jobs; None if one must be built, by another job."""
        problem = self._shared.pop(key, None) or self.acquire(key)
        if problem is not None:
            self._shared[key] = problem
            if len(self._shared) > self._max_problems:
                self._shared.popitem(last=False)
        return problem

    def acquire(self, key: bytes) -> Problem | None:
        """Take an unused instance; None if one must be built."""
        idle = self._idle.get(key)
        return idle.pop() if idle else None

    def note_cost(self, owner: str | None, key: bytes, cost: ProblemCost | None) -> None:
        """Remember what a problem of an owner costs."""
        if cost is not None:
            self._costs[owner, key] = cost
            self._costs.move_to_end((owner, key))
            if len(self._costs) > _COSTS_PER_PROBLEM * self._max_problems:
                self._costs.popitem(last=False)

    def release(self, key: bytes, problem: Problem | None) -> None:
        """Keep an instance for the next job."""
        if problem is None:
            return
        self._idle.setdefault(key, []).append(problem)
        self._idle.move_to_end(key)
        while len(self._idle) > self._max_problems:
            self._idle.popitem(last=False)


class SendReply(NamedTuple):
    """Send a reply to a call."""

    call: int
    payload: bytes


class EndCall(NamedTuple):
    """End a call; no reply follows."""

    call: int


class Computed(NamedTuple):
    """Time that a part of an answer took; for metrics only."""

    kind: Literal["task", "sensing"]
    computed_s: float
    waited_s: float  # before it was begun


ServiceEffect: TypeAlias = SendReply | EndCall | Job | Computed | LogEvent
