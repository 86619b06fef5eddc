"""The service's end: many robots ask, and each of them holds the truth about itself.

What a service remembers of a robot only saves work: the state of the last request, the state at the
next sensing step, and the last answers. It may forget any of it at any time; then it says so and is
handed the state. And because an answer is a function of the state that the request's digest names,
the same request is computed once, however often and under however many numbers it comes.

A request is worked on in two parts. The *task* part brings the session's state to the request's
and chooses the task actions up to the next sensing step; it is short, and the robot stands still
for it. The *sensing* part, chosen in the state that those actions lead to, is long, and is usually
needed only once the robot has performed them. So the task part is answered before the sensing part
is begun, and the first parts of other robots go before it, within limits.

The machine computes nothing itself and knows no clock, thread or socket. Each method takes what
happened and the time, and returns effects, to be carried out in order. The caller runs each
:class:`Job` that it is handed wherever it likes (at most ``workers`` at a time are handed out) and
brings its :class:`Outcome` back with :meth:`Service.finished`.
"""

from __future__ import annotations

import enum
import hashlib
import math
from collections import OrderedDict
from collections.abc import Callable
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from holdfast.errors import (
    CheckpointError,
    ConfigurationError,
    HoldfastError,
    InvalidValueError,
    UnknownProblemError,
)
from holdfast.planning import (
    PlanningState,
    advance,
    check_state,
    choose_sensing_action,
    choose_task_action,
    decode_checkpoint,
    digest,
    initial_state,
    needs_sensing,
    observe,
)
from holdfast.problems.problem import Problem
from holdfast.session.messages import (
    DIGEST_SIZE,
    MAX_OBSERVATIONS,
    MAX_TASK_ACTIONS,
    Busy,
    MessageError,
    NeedState,
    Opening,
    Progress,
    Refused,
    Request,
    SensingAnswer,
    TaskAnswer,
    decode_request,
    encode,
    numbers_from,
    numbers_to,
)
from holdfast.settings import PlanningSettings

__all__ = [
    "Answer",
    "Computed",
    "Effect",
    "End",
    "Job",
    "Noted",
    "Outcome",
    "Run",
    "Service",
    "ServiceLimits",
    "ServiceStatistics",
]

_MAX_WORD = 2**32 - 1
_MAX_TEXT = 4000
_MAX_ACTION_SIZE = 4096
_REQUESTED, _PREFETCHED = 0, 1
_PROGRESS_TOGETHER = 0.8
"""Calls this far into the interval are told with those that are due: fewer wake-ups."""

_NO_ROOM_RETRY_MS = 100.0
"""A robot for which there is no room is to come back no sooner than after this."""

_RETRY_SPREAD = 0.25
"""By up to this share robots are to come back later than they could, each by its own."""


class ServiceLimits(msgspec.Struct, frozen=True, kw_only=True):
    """What a service takes on. Beyond it robots are turned away, or forgotten and handed over anew.

    Attributes
    ----------
    max_sessions : int
        Robots remembered; the one unused the longest is forgotten first.
    max_state_bytes : int
        Of all states remembered.
    max_idle_s : float
        A robot that was not heard for this long is forgotten.
    max_waiting : int
        Requests that wait for a worker.
    max_waiting_bytes : int
        Of these requests.
    max_wait_ms : float
        A request that would wait longer than this, by estimate, is turned away. (Not as long as
        fewer requests wait than there are workers: a service is never too small for one robot.)
    max_calls_per_request : int
        Calls that wait for the same answer; the oldest is ended.
    progress_interval_ms : float
        A robot is told this often that its request is in work.
    prefetch_patience_ms : float
        A sensing part that no robot stands still for lets others go first for this long.
    max_particles : int
        Of one robot.
    max_work : int
        Of one decision: particles times observation samples times sensing actions times horizon.
    max_steps : int
        Steps that a state is rolled forward for one request.
    max_threads : int
        Of one decision, whatever a robot's settings say; one, while several are computed.
    max_problems : int
        Problems kept for the next robot that has the same.
    answers_per_session : int
        Parts of answers remembered.
    """

    max_sessions: int = 1000
    max_state_bytes: int = 256 << 20
    max_idle_s: float = 600.0
    max_waiting: int = 1000
    max_waiting_bytes: int = 64 << 20
    max_wait_ms: float = 100.0
    max_calls_per_request: int = 8
    progress_interval_ms: float = 50.0
    prefetch_patience_ms: float = 20.0
    max_particles: int = 1_000_000
    max_work: int = 10**9
    max_steps: int = 16 * MAX_OBSERVATIONS
    max_threads: int = 64
    max_problems: int = 32
    answers_per_session: int = 8


class ServiceStatistics(msgspec.Struct):
    """What a service has done since it began, and what it holds now.

    Attributes
    ----------
    task_parts, sensing_parts : int
        Parts of answers computed.
    cache_hits : int
        Requests answered, wholly or up to what is in work, from what was computed before.
    attached : int
        Requests that joined one already in work.
    superseded : int
        Requests dropped for a newer one of the same robot.
    restores : int
        States taken from a checkpoint.
    state_requests : int
        Requests answered with the wish for the state.
    busy : int
        Requests turned away for lack of capacity.
    refusals : dict of str to int
        By code.
    sessions_opened, sessions_taken_over, sessions_evicted : int
    sessions, state_bytes, waiting, running, calls : int
        Held now.
    """

    task_parts: int = 0
    sensing_parts: int = 0
    cache_hits: int = 0
    attached: int = 0
    superseded: int = 0
    restores: int = 0
    state_requests: int = 0
    busy: int = 0
    refusals: dict[str, int] = msgspec.field(default_factory=dict)
    sessions_opened: int = 0
    sessions_taken_over: int = 0
    sessions_evicted: int = 0
    sessions: int = 0
    state_bytes: int = 0
    waiting: int = 0
    running: int = 0
    calls: int = 0


class Answer(NamedTuple):
    """Send a reply to a call."""

    call: int
    payload: bytes


class End(NamedTuple):
    """End a call: no reply to it follows."""

    call: int


class Run(NamedTuple):
    """Run a job, anywhere, and bring its outcome to :meth:`Service.finished`.

    Attributes
    ----------
    job : Job
    expected_s : float
        How long it may take, by what such jobs took before; infinite if the problem is still to be
        built.
    """

    job: Job
    expected_s: float


class Computed(NamedTuple):
    """Take note of the time that a part of an answer took; it changes nothing.

    Attributes
    ----------
    kind : {"task", "sensing"}
    computed_s : float
    waited_s : float
        Before it was begun.
    """

    kind: Literal["task", "sensing"]
    computed_s: float
    waited_s: float


class Noted(NamedTuple):
    """Tell people: one line of the log.

    Attributes
    ----------
    event : str
        ``session_opened``, ``session_taken_over``, ``restored``, ``refused``, ``busy`` or
        ``evicted``.
    fields : dict
        Plain data.
    """

    event: str
    fields: dict[str, object]


Effect: TypeAlias = Answer | End | Run | Computed | Noted


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
    problem: Problem | None = None
    state: PlanningState | None = None
    restored: bool = False
    num_actions: int = 0
    actions: bytes = b""
    ahead: PlanningState | None = None
    ahead_digest: bytes = b""
    sensing_action: int = -1


class _Fate(enum.Enum):
    """What became of a request for which no work is to be waited for."""

    UNKNOWN = enum.auto()
    ANSWERED = enum.auto()
    TURNED_AWAY = enum.auto()


class _LacksStateError(Exception):
    """The events of a request do not connect to the state at hand, or lead to another one."""

    def __init__(self, *, differs: bool = False) -> None:
        super().__init__()
        self.differs = differs


class Job:
    """A part of an answer to be computed: a pure function of what it was made with.

    Parameters
    ----------
    kind : {"task", "sensing"}
    problem : Problem or None
        None if it is still to be built.
    make_problem, describe_error : callable
    opening : Opening
    planning : PlanningSettings
    seed : int
    limits : ServiceLimits
    request : Request or None
        Names the state; None if ``state`` is that state already.
    state : PlanningState or None
        From where the request's state is reached; None if from the trial's beginning.
    """

    __slots__ = (
        "_describe_error",
        "_limits",
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
        opening: Opening,
        planning: PlanningSettings,
        seed: int,
        limits: ServiceLimits,
        request: Request | None,
        state: PlanningState | None,
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

    @property
    def problem_name(self) -> str:
        """What the problem is called in the opening."""
        return self._opening.problem

    def run(self) -> Outcome:
        """Compute; whatever goes wrong in the problem's functions is part of the outcome.

        Whatever they raise, ``KeyboardInterrupt`` included: on a worker's thread it can only come
        from them.
        """
        # Kept as it becomes known, for it is worth keeping if the rest fails.
        problem = self._problem
        try:
            if problem is None:
                problem = self._make_problem(self._opening)
            _check_work(problem, self._planning, self._limits)
            return self._computed(problem)
        except _LacksStateError as lack:
            differs = lack.differs or self._state is not None
            return Outcome(lacks_state=True, differs=differs, problem=problem)
        except MemoryError:
            return Outcome(failure=("busy", ""), problem=problem)
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
        state = self._reached(problem, request)
        restored = request.checkpoint is not None
        if needs_sensing(planning, state):
            index, _ = choose_sensing_action(problem, planning, state)
            return Outcome(problem=problem, state=state, restored=restored, sensing_action=index)
        actions: list[bytes] = []
        ahead = state
        while len(actions) < MAX_TASK_ACTIONS and not needs_sensing(planning, ahead):
            action, _ = choose_task_action(problem, planning, ahead)
            ahead = advance(problem, planning, ahead, action)
            actions.append(numbers_to(action))
        return Outcome(
            problem=problem,
            state=state,
            restored=restored,
            num_actions=len(actions),
            actions=b"".join(actions),
            ahead=ahead,
            ahead_digest=digest(ahead)[:DIGEST_SIZE],
        )

    def _reached(self, problem: Problem, request: Request) -> PlanningState:
        """Return the state that the request names."""
        planning = self._planning
        if request.checkpoint is not None:
            return self._restored(problem, request, request.checkpoint)
        state = self._state
        if state is None:
            state = initial_state(problem, planning, self._seed, request.trial)
        most = state.step + self._limits.max_steps
        for observed in request.observations:
            if (observed.step, True) <= (state.step, state.sensed):
                continue  # part of the state already
            state = self._rolled(problem, state, observed.step, most)
            if not needs_sensing(planning, state):
                raise _LacksStateError
            observation = numbers_from(observed.observation, len(observed.observation) // 8)
            state, _ = observe(problem, planning, state, observed.sensing_action, observation)
        state = self._rolled(problem, state, request.step, most)
        if state.sensed != request.sensed or digest(state)[:DIGEST_SIZE] != request.digest:
            raise _LacksStateError(differs=True)
        return state

    def _rolled(
        self, problem: Problem, state: PlanningState, step: int, most: int
    ) -> PlanningState:
        """Return the state at a later step, by task actions alone."""
        if not state.step <= step <= most:
            raise _LacksStateError
        planning = self._planning
        while state.step < step:
            if needs_sensing(planning, state):
                raise _LacksStateError
            action, _ = choose_task_action(problem, planning, state)
            state = advance(problem, planning, state, action)
        return state

    def _restored(self, problem: Problem, request: Request, checkpoint: bytes) -> PlanningState:
        state = decode_checkpoint(checkpoint)
        check_state(problem, self._planning, state)
        for name, came, asked in (
            ("seed", state.seed, self._seed),
            ("trial", state.trial, request.trial),
            ("step", state.step, request.step),
            ("sensed", state.sensed, request.sensed),
        ):
            if came != asked:
                raise CheckpointError(f"checkpoint with {name} {came}: the request says {asked}")
        if digest(state)[:DIGEST_SIZE] != request.digest:
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
            f"a decision of {work} units of work (particle_filter.num_particles {count} x "
            f"active_sensing.num_observation_samples {sensing.num_observation_samples} x "
            f"{actions} sensing actions x active_sensing.horizon {sensing.horizon}): this "
            f"service takes at most {limits.max_work} (max_work)"
        )
    if problem.action_size > _MAX_ACTION_SIZE:
        raise InvalidValueError(
            f"action_size of {problem.name} is {problem.action_size}: a service takes at most "
            f"{_MAX_ACTION_SIZE}"
        )


def _account(error: BaseException, describe: Callable[[BaseException], str]) -> str:
    """Put an error of a problem into words, even one that fails at that itself."""
    try:
        return describe(error)
    except BaseException:  # noqa: BLE001 - whoever wrote the problem may have written the error
        return f"{type(error).__name__}, which cannot be put into words"


def _described(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


def _code_of(error: HoldfastError) -> str:
    if isinstance(error, UnknownProblemError):
        return "unknown_problem"
    if isinstance(error, InvalidValueError | CheckpointError | ConfigurationError):
        return "invalid"
    # ProblemError, and whatever a problem raises of ours for reasons of its own.
    return "failed"


class _Part(NamedTuple):
    """A part of an answer as it is remembered, under the digest of the state that it is for."""

    trial: int
    step: int
    sensed: bool
    computed_us: int
    # Of a task part; ``following`` is the digest of the state whose sensing part comes after it.
    num_actions: int = 0
    actions: bytes = b""
    following: bytes | None = None
    # Of a sensing part.
    sensing_action: int = -1


class _Call:
    """A call that waits for a part of its answer."""

    __slots__ = ("call", "number", "signed_at", "work")

    def __init__(self, call: int, number: int, work: _Work, signed_at: float) -> None:
        self.call = call
        self.number = number
        self.work = work
        self.signed_at = signed_at


class _Work:
    """A part of an answer that is to be computed, and the calls that wait for it."""

    __slots__ = (
        "calls",
        "cost_s",
        "digest",
        "request",
        "running",
        "sensing",
        "session",
        "since",
        "size",
        "slot",
        "started_at",
        "state",
    )

    def __init__(
        self,
        session: _Session,
        digest: bytes,
        *,
        sensing: bool,
        request: Request | None,
        state: PlanningState | None,
        size: int,
        since: float,
    ) -> None:
        self.session = session
        self.digest = digest
        self.sensing = sensing
        self.request = request
        self.state = state
        self.size = size
        self.since = since
        self.slot = _PREFETCHED if request is None else _REQUESTED
        self.calls: dict[int, _Call] = {}
        self.cost_s = session.expected_s(task=not sensing)
        self.running = False
        self.started_at = since


class _Session:
    """What is remembered of one robot."""

    __slots__ = (
        "acknowledged",
        "ahead",
        "ahead_digest",
        "answers",
        "built",
        "closed",
        "epoch",
        "held",
        "key",
        "num_bytes",
        "number",
        "opening",
        "opening_key",
        "planning",
        "planning_single",
        "problem_key",
        "running",
        "seed",
        "sensing_s",
        "task_s",
        "used_at",
        "works",
    )

    def __init__(
        self, request: Request, opening: Opening, max_threads: int, means: tuple[float, float]
    ) -> None:
        self.key = request.session
        self.epoch = request.epoch
        self.number = -1
        self.opening = opening
        self.opening_key = _key_of(opening)
        self.problem_key = _key_of((opening.problem, opening.model, opening.state_space_planner))
        self.built = False
        # The number of threads changes no result, so the service may choose it.
        sensing = opening.planning.active_sensing
        most = min(sensing.num_cores, max_threads)
        self.planning, self.planning_single = (
            msgspec.structs.replace(
                opening.planning,
                active_sensing=msgspec.structs.replace(sensing, num_cores=num_cores),
            )
            for num_cores in (most, 1)
        )
        self.seed = opening.seed
        self.acknowledged: PlanningState | None = None
        self.ahead: PlanningState | None = None
        self.ahead_digest = b""
        self.answers: OrderedDict[bytes, _Part] = OrderedDict()
        self.works: dict[bytes, _Work] = {}
        # One work of each slot runs at a time; the one after it is held back, so that a robot has
        # no more than its turn.
        self.running: list[_Work | None] = [None, None]
        self.held: list[_Work | None] = [None, None]
        self.task_s, self.sensing_s = means
        self.num_bytes = 0
        self.used_at = 0.0
        self.closed = False

    def expected_s(self, *, task: bool) -> float:
        """Return how long a work may take, with the sensing part that follows a task part."""
        return self.task_s + self.sensing_s if task else self.sensing_s


def _key_of(data: object) -> bytes:
    return hashlib.blake2b(msgspec.msgpack.encode(data), digest_size=16).digest()


def _moved(mean_s: float, sample_s: float, divisor: float) -> float:
    """Return a running mean; one sample out of all proportion (a stopped process) moves it little.

    Else robots would be turned away for what happened once.
    """
    return mean_s + (min(sample_s, 4.0 * mean_s + 0.01) - mean_s) / divisor


def _size_of(state: PlanningState | None) -> int:
    return 0 if state is None else state.belief.states.nbytes + state.belief.weights.nbytes


def _connects(state: PlanningState | None, request: Request) -> bool:
    """Tell whether a state of the request's trial comes no later than the request's."""
    return (
        state is not None
        and state.trial == request.trial
        and (state.step, state.sensed) <= (request.step, request.sensed)
    )


class Service:
    """Answers the requests of many robots.

    Parameters
    ----------
    make_problem : callable
        Builds the problem that an opening names, or raises what is the robot's fault as an error of
        :mod:`holdfast.errors`. It is called by jobs, so several calls may run at a time.
    workers : int
        Jobs that may run at a time.
    limits : ServiceLimits, optional
    describe_error : callable, optional
        Puts an error that a problem raised into words.
    """

    def __init__(
        self,
        make_problem: Callable[[Opening], Problem],
        workers: int,
        limits: ServiceLimits | None = None,
        describe_error: Callable[[BaseException], str] | None = None,
    ) -> None:
        if workers < 1:
            raise InvalidValueError(f"workers {workers}: a service needs at least 1")
        self._make_problem = make_problem
        self._describe_error = describe_error or _described
        self._workers = workers
        self._limits = limits or ServiceLimits()
        self._progress_s = 1e-3 * self._limits.progress_interval_ms
        self._patience_s = 1e-3 * self._limits.prefetch_patience_ms
        self._effects: list[Effect] = []
        # Unused the longest first.
        self._sessions: OrderedDict[bytes, _Session] = OrderedDict()
        # Of sessions that were forgotten: a robot that was replaced stays replaced.
        self._epochs: OrderedDict[bytes, int] = OrderedDict()
        # Those that no job is using; the robots' that were heard last at the end.
        self._problems: OrderedDict[bytes, list[Problem]] = OrderedDict()
        # No sign for the longest first.
        self._calls: OrderedDict[int, _Call] = OrderedDict()
        # Robots stand still for the urgent works; the later ones are ahead of their robots. Each
        # session has one work in each line at most, so the lines are turns of the sessions.
        self._urgent: OrderedDict[_Work, None] = OrderedDict()
        self._later: OrderedDict[_Work, None] = OrderedDict()
        self._num_waiting = 0
        self._waiting_bytes = 0
        self._backlog_s = 0.0
        self._running: dict[Job, _Work] = {}
        self._state_bytes = 0
        self._task_s = 1e-3
        self._sensing_s = 1e-3
        self._statistics = ServiceStatistics()

    @property
    def statistics(self) -> ServiceStatistics:
        """Counters, and what is held at this moment."""
        statistics = self._statistics
        statistics.sessions = len(self._sessions)
        statistics.state_bytes = self._state_bytes
        statistics.waiting = self._num_waiting
        statistics.running = len(self._running)
        statistics.calls = len(self._calls)
        return statistics

    # -- what happens ----------------------------------------------------------------------------

    def receive(self, call: int, payload: bytes, now: float) -> list[Effect]:
        """Take a request.

        Parameters
        ----------
        call : int
            Names the call in the effects; never used before.
        payload : bytes
        now : float
            Seconds of any clock that does not go back.
        """
        request: Request | MessageError
        try:
            request = decode_request(payload)
        except MessageError as error:
            request = error
        return self.receive_request(call, request, len(payload), now)

    def receive_request(
        self, call: int, request: Request | MessageError, size: int, now: float
    ) -> list[Effect]:
        """Take a request that was decoded already: whoever locks the machine decodes before.

        Parameters
        ----------
        call : int
            Names the call in the effects; never used before.
        request : Request or MessageError
            What :func:`~holdfast.session.messages.decode_request` returned or raised.
        size : int
            Bytes of the message.
        now : float
            Seconds of any clock that does not go back.
        """
        if isinstance(request, MessageError):
            self._refuse(call, 0, request.code, str(request))
            return self._take()
        self._received(call, request, size, now)
        self._dispatch(now)
        return self._take()

    def finished(self, job: Job, outcome: Outcome, now: float) -> list[Effect]:
        """Take the outcome of a job that was handed out."""
        work = self._running.pop(job)
        work.running = False
        session = work.session
        session.running[work.slot] = None
        if session.works.get(work.digest) is work:
            del session.works[work.digest]
        self._give_back(session.problem_key, outcome.problem)
        if not session.closed:
            session.used_at = now
            self._sessions.move_to_end(session.key)
            # The first job of a problem also imports and builds it: no measure of the next ones.
            typical = session.built
            session.built = session.built or outcome.problem is not None
            if outcome.failure is not None or outcome.lacks_state:
                self._failed(work, outcome, now)
            else:
                if typical:
                    self._learn(session, now - work.started_at, task=not work.sensing)
                self._succeeded(work, outcome, now)
            for held in session.held:
                if held is not None and session.running[held.slot] is None:
                    session.held[held.slot] = None
                    self._line_of(held)[held] = None
        self._dispatch(now)
        return self._take()

    def tick(self, now: float) -> list[Effect]:
        """Take note of the time."""
        calls = self._calls
        if calls and next(iter(calls.values())).signed_at + self._progress_s <= now:
            since = now - _PROGRESS_TOGETHER * self._progress_s
            due = []
            for record in calls.values():
                if record.signed_at > since:
                    break
                due.append(record)
            for record in due:
                self._reply(record, encode(Progress(record.number, not record.work.running)), now)
        while self._sessions:
            session = next(iter(self._sessions.values()))
            if session.works or session.used_at + self._limits.max_idle_s > now:
                break
            self._forget(session, "idle")
        return self._take()

    def next_wakeup(self) -> float | None:
        """Return when :meth:`tick` must be called if nothing happens before."""
        due = None
        if self._calls:
            due = next(iter(self._calls.values())).signed_at + self._progress_s
        if self._sessions:
            session = next(iter(self._sessions.values()))
            if not session.works:
                idle = session.used_at + self._limits.max_idle_s
                due = idle if due is None else min(due, idle)
        return due

    def _take(self) -> list[Effect]:
        effects = self._effects
        self._effects = []
        return effects

    # -- requests --------------------------------------------------------------------------------

    def _received(self, call: int, request: Request, size: int, now: float) -> None:
        session = self._sessions.get(request.session)
        epoch = session.epoch if session is not None else self._epochs.get(request.session, 0)
        if request.epoch < epoch:
            text = f"epoch {request.epoch}: a robot of epoch {epoch} has taken this session over"
            self._refuse(call, request.number, "stale_epoch", text)
            return
        opening = request.opening
        if session is not None:
            if request.epoch > epoch:
                self._take_over(session, request.epoch, now)
            if opening is not None and _key_of(opening) != session.opening_key:
                if request.epoch == epoch:
                    text = "this session was opened with another problem, settings or seed"
                    self._refuse(call, request.number, "invalid", text)
                    return
                self._forget(session, "opened anew")
                session = None
        if session is None:
            if opening is None:
                self._need_state(call, request.number, differs=False)
                return
            session = self._opened(call, request, opening, now)
            if session is None:
                return
        else:
            session.used_at = now
            self._sessions.move_to_end(session.key)
        newest = request.number >= session.number
        if newest:
            session.number = request.number
        work = self._answer_known(session, call, request, now, newest=newest)
        if not newest:
            if work is _Fate.UNKNOWN:
                # A later request of this robot was here before: nobody waits for this one.
                self._statistics.superseded += 1
                self._effects.append(End(call))
            return
        if work is _Fate.UNKNOWN:
            work = self._begin(session, call, request, size, now)
        if isinstance(work, _Work):
            self._supersede(session, work)
        elif work is _Fate.ANSWERED:
            self._supersede(session, None)

    def _opened(self, call: int, request: Request, opening: Opening, now: float) -> _Session | None:
        """Return a new session, or turn the robot away."""
        limits = self._limits
        count = opening.planning.particle_filter.num_particles
        if count > limits.max_particles:
            text = (
                f"particle_filter.num_particles {count}: this service takes at most "
                f"{limits.max_particles} (max_particles)"
            )
            self._refuse(call, request.number, "invalid", text)
            return None
        room = len(self._sessions) < limits.max_sessions or self._unused() is not None
        if not room:
            # It is free once another robot has left, not once the next decision is computed.
            self._turn_away(call, request.number, request.session, now, _NO_ROOM_RETRY_MS)
            return None
        if self._is_overloaded(now):
            self._turn_away(call, request.number, request.session, now)
            return None
        session = _Session(request, opening, limits.max_threads, (self._task_s, self._sensing_s))
        session.used_at = now
        unused = self._unused()
        if unused is not None and len(self._sessions) >= limits.max_sessions:
            self._forget(unused, "room needed")
        self._sessions[session.key] = session
        self._epochs.pop(session.key, None)
        self._statistics.sessions_opened += 1
        self._note(
            "session_opened", session, problem=opening.problem, particles=count, epoch=request.epoch
        )
        return session

    def _take_over(self, session: _Session, epoch: int, now: float) -> None:
        """Go on with a robot's next process; whatever the one before waited for is moot."""
        self._note("session_taken_over", session, epoch=epoch, previous_epoch=session.epoch)
        self._statistics.sessions_taken_over += 1
        session.epoch = epoch
        session.number = -1
        session.used_at = now
        self._supersede(session, None)

    def _answer_known(
        self, session: _Session, call: int, request: Request, now: float, *, newest: bool
    ) -> _Work | _Fate:
        """Answer as far as the answer is there or in work; return what the rest comes from."""
        work = session.works.get(request.digest)
        if work is not None:
            if work.request is None and not work.running:
                self._hasten(work)
            self._statistics.attached += 1
            self._attach(work, call, request.number, now)
            return work
        part = session.answers.get(request.digest)
        if part is None:
            return _Fate.UNKNOWN
        if (part.trial, part.step, part.sensed) != (request.trial, request.step, request.sensed):
            text = (
                f"trial {request.trial}, step {request.step}, sensed {request.sensed}: the state "
                f"of this digest has {part.trial}, {part.step}, {part.sensed}"
            )
            self._refuse(call, request.number, "invalid", text)
            return _Fate.TURNED_AWAY
        following = part.following
        rest = None if following is None else session.works.get(following)
        if following is not None and rest is None and following not in session.answers:
            if not newest or session.ahead is None or session.ahead_digest != following:
                del session.answers[request.digest]
                return _Fate.UNKNOWN
            rest = self._prefetch(session, now)
        self._statistics.cache_hits += 1
        if part.num_actions:
            self._effects.append(Answer(call, _task_answer(request.number, part)))
        if rest is not None:
            self._attach(rest, call, request.number, now)
            return rest
        sensing = part if following is None else session.answers[following]
        if sensing.sensing_action >= 0:
            digest = request.digest if following is None else following
            payload = _sensing_answer(request.number, digest, sensing)
            self._effects.append(Answer(call, payload))
        self._effects.append(End(call))
        return _Fate.ANSWERED

    def _begin(
        self, session: _Session, call: int, request: Request, size: int, now: float
    ) -> _Work | _Fate:
        """Queue a request for what is not known yet, or turn it away."""
        interval = session.planning.sensing_interval + 1
        sensing = not request.sensed and request.step % interval == 0
        waiting = next(
            (
                work
                for work in session.works.values()
                if work.slot == _REQUESTED and not work.running
            ),
            None,
        )
        if waiting is None and self._is_overloaded(now):
            self._turn_away(call, request.number, request.session, now)
            return _Fate.TURNED_AWAY
        if waiting is not None:
            # It keeps the turn of the request that it replaces, and adds nothing to the backlog.
            self._end_calls(waiting)
            self._statistics.superseded += 1
            del session.works[waiting.digest]
            self._count_waiting(waiting, -1)
            waiting.digest, waiting.request = request.digest, request
            waiting.sensing, waiting.size = sensing, size
            waiting.cost_s = session.expected_s(task=not sensing)
            work = waiting
        else:
            work = _Work(
                session,
                request.digest,
                sensing=sensing,
                request=request,
                state=None,
                size=size,
                since=now,
            )
            self._line_up(work)
        session.works[work.digest] = work
        self._count_waiting(work, 1)
        self._attach(work, call, request.number, now)
        return work

    def _supersede(self, session: _Session, keep: _Work | None) -> None:
        """End whatever a robot waited for before it asked for ``keep``."""
        for work in list(session.works.values()):
            if work is not keep:
                self._end_calls(work)
                if not work.running:
                    self._statistics.superseded += 1
                    self._withdraw(work)

    def _is_overloaded(self, now: float) -> bool:
        limits = self._limits
        if self._num_waiting < self._workers:
            return False
        return (
            self._num_waiting >= limits.max_waiting
            or self._waiting_bytes >= limits.max_waiting_bytes
            or 1e3 * self._wait_s(now) > limits.max_wait_ms
        )

    def _wait_s(self, now: float) -> float:
        """Estimate how long a request that came now would wait for its answer to be begun."""
        ahead_s = self._backlog_s
        for work in self._running.values():
            ahead_s += max(0.0, work.cost_s - (now - work.started_at))
        return ahead_s / self._workers

    # -- lines -----------------------------------------------------------------------------------

    def _line_of(self, work: _Work) -> OrderedDict[_Work, None]:
        return self._urgent if work.slot == _REQUESTED else self._later

    def _line_up(self, work: _Work) -> None:
        if work.session.running[work.slot] is not None:
            work.session.held[work.slot] = work
        else:
            self._line_of(work)[work] = None

    def _count_waiting(self, work: _Work, sign: int) -> None:
        self._num_waiting += sign
        self._waiting_bytes += sign * work.size
        # Sums of floating-point numbers drift; an empty line is exactly empty.
        self._backlog_s = self._backlog_s + sign * work.cost_s if self._num_waiting else 0.0

    def _withdraw(self, work: _Work) -> None:
        """Take a work that was not begun out of its line."""
        session = work.session
        del session.works[work.digest]
        if session.held[work.slot] is work:
            session.held[work.slot] = None
        else:
            self._urgent.pop(work, None)
            self._later.pop(work, None)
        self._count_waiting(work, -1)

    def _hasten(self, work: _Work) -> None:
        """Let a prefetched work go with the urgent ones: its robot stands still now."""
        if work in self._later:
            del self._later[work]
            self._urgent[work] = None

    def _prefetch(self, session: _Session, now: float) -> _Work:
        """Queue the sensing part of the state ahead."""
        work = _Work(
            session,
            session.ahead_digest,
            sensing=True,
            request=None,
            state=session.ahead,
            size=0,
            since=now,
        )
        session.works[work.digest] = work
        self._count_waiting(work, 1)
        self._line_up(work)
        return work

    def _next(self) -> _Work | None:
        urgent = next(iter(self._urgent), None)
        later = next(iter(self._later), None)
        if urgent is None or later is None:
            return urgent or later
        return urgent if urgent.since <= later.since + self._patience_s else later

    def _dispatch(self, now: float) -> None:
        """Hand out jobs as long as workers are free."""
        while len(self._running) < self._workers:
            work = self._next()
            if work is None:
                return
            self._urgent.pop(work, None)
            self._later.pop(work, None)
            self._count_waiting(work, -1)
            self._start(work, now)

    def _start(self, work: _Work, now: float) -> None:
        session, request = work.session, work.request
        state = work.state
        if request is not None and request.checkpoint is None:
            held = (session.ahead, session.acknowledged)
            state = next((known for known in held if _connects(known, request)), None)
            if state is None and any(
                known is not None and known.trial == request.trial for known in held
            ):
                # The robot is behind what is remembered, or was elsewhere meanwhile.
                del session.works[work.digest]
                for record in self._released(work):
                    self._need_state(record.call, record.number, differs=True)
                return
        alone = not self._running and self._num_waiting == 0
        problem = self._lend(session.problem_key)
        job = Job(
            "sensing" if work.sensing else "task",
            problem,
            self._make_problem,
            self._describe_error,
            session.opening,
            session.planning if alone else session.planning_single,
            session.seed,
            self._limits,
            request,
            state,
        )
        work.running = True
        work.started_at = now
        session.running[work.slot] = work
        self._running[job] = work
        expected_s = session.sensing_s if work.sensing else session.task_s
        self._effects.append(Run(job, math.inf if problem is None else expected_s))

    # -- outcomes --------------------------------------------------------------------------------

    def _lend(self, key: bytes) -> Problem | None:
        """Take a problem that nobody uses; None if one is to be built."""
        idle = self._problems.get(key)
        return idle.pop() if idle else None

    def _give_back(self, key: bytes, problem: Problem | None) -> None:
        """Keep a problem for the next job. No two jobs at a time have the same instance."""
        if problem is None:
            return
        self._problems.setdefault(key, []).append(problem)
        self._problems.move_to_end(key)
        while len(self._problems) > self._limits.max_problems:
            self._problems.popitem(last=False)

    def _failed(self, work: _Work, outcome: Outcome, now: float) -> None:
        session = work.session
        for record in self._released(work):
            if outcome.failure is None:
                self._need_state(record.call, record.number, differs=outcome.differs)
            else:
                code, text = outcome.failure
                if code == "busy":
                    number, key = record.number, session.key
                    self._turn_away(record.call, number, key, now, _NO_ROOM_RETRY_MS)
                else:
                    self._refuse(record.call, record.number, code, text)
        if not session.built:
            # Nothing can ever come of it.
            self._forget(session, "refused")

    def _learn(self, session: _Session, computed_s: float, *, task: bool) -> None:
        """Let a job's time count in what the next ones are expected to take."""
        if task:
            self._task_s = _moved(self._task_s, computed_s, 8.0)
            session.task_s = _moved(session.task_s, computed_s, 4.0)
        else:
            self._sensing_s = _moved(self._sensing_s, computed_s, 8.0)
            session.sensing_s = _moved(session.sensing_s, computed_s, 4.0)

    def _succeeded(self, work: _Work, outcome: Outcome, now: float) -> None:
        session, statistics = work.session, self._statistics
        computed_s = now - work.started_at
        computed_us = min(_MAX_WORD, max(0, round(1e6 * computed_s)))
        if outcome.state is not None:
            session.acknowledged = outcome.state
            session.ahead, session.ahead_digest = outcome.ahead, outcome.ahead_digest
        if outcome.restored:
            statistics.restores += 1
            assert outcome.state is not None
            self._note("restored", session, trial=outcome.state.trial, step=outcome.state.step)
        state = work.state if outcome.state is None else outcome.state
        assert state is not None
        where = (state.trial, state.step, state.sensed, computed_us)
        if work.sensing:
            statistics.sensing_parts += 1
            self._effects.append(Computed("sensing", computed_s, work.started_at - work.since))
            part = _Part(*where, sensing_action=outcome.sensing_action)
            self._remember(session, work.digest, part)
            self._answer_sensing(self._released(work), work.digest, part)
        else:
            statistics.task_parts += 1
            self._effects.append(Computed("task", computed_s, work.started_at - work.since))
            ahead = outcome.ahead
            assert ahead is not None
            following = outcome.ahead_digest if needs_sensing(session.planning, ahead) else None
            part = _Part(*where, outcome.num_actions, outcome.actions, following)
            self._remember(session, work.digest, part)
            self._answer_task(work, part, now)
        self._weigh(session)

    def _answer_task(self, work: _Work, part: _Part, now: float) -> None:
        """Answer with the task part, and let the calls wait for the sensing part that follows."""
        session, following = work.session, part.following
        calls = list(work.calls.values())
        for record in calls:
            self._reply(record, _task_answer(record.number, part), now)
        if following is None or following in session.answers:
            released = self._released(work)
            if following is None:
                self._effects += [End(record.call) for record in released]
            else:
                self._answer_sensing(released, following, session.answers[following])
        elif calls:
            # If nobody waits, the robot is elsewhere by now.
            rest = session.works.get(following) or self._prefetch(session, now)
            work.calls.clear()
            for record in calls:
                record.work = rest
                rest.calls[record.call] = record

    def _answer_sensing(self, calls: list[_Call], digest: bytes, part: _Part) -> None:
        for record in calls:
            payload = _sensing_answer(record.number, digest, part)
            self._effects += (Answer(record.call, payload), End(record.call))

    def _remember(self, session: _Session, digest: bytes, part: _Part) -> None:
        answers = session.answers
        answers[digest] = part
        answers.move_to_end(digest)
        while len(answers) > self._limits.answers_per_session:
            answers.popitem(last=False)

    # -- calls -----------------------------------------------------------------------------------

    def _attach(self, work: _Work, call: int, number: int, now: float) -> None:
        record = _Call(call, number, work, now)
        self._calls[call] = record
        work.calls[call] = record
        if len(work.calls) > self._limits.max_calls_per_request:
            oldest = next(iter(work.calls))
            del work.calls[oldest], self._calls[oldest]
            self._effects.append(End(oldest))

    def _released(self, work: _Work) -> list[_Call]:
        """Return the calls of a work, to be ended by whoever takes them."""
        released = list(work.calls.values())
        work.calls.clear()
        for record in released:
            del self._calls[record.call]
        return released

    def _end_calls(self, work: _Work) -> None:
        self._effects += [End(record.call) for record in self._released(work)]

    def _reply(self, record: _Call, payload: bytes, now: float) -> None:
        """Reply to a call that goes on."""
        self._effects.append(Answer(record.call, payload))
        record.signed_at = now
        self._calls.move_to_end(record.call)

    def _need_state(self, call: int, number: int, *, differs: bool) -> None:
        self._statistics.state_requests += 1
        self._effects += (Answer(call, encode(NeedState(number, differs))), End(call))

    def _turn_away(
        self, call: int, number: int, key: bytes, now: float, least_ms: float = 1.0
    ) -> None:
        self._statistics.busy += 1
        # Robots that were turned away together shall not come back together.
        share = int.from_bytes(hashlib.blake2b(key, digest_size=2).digest(), "big") / 2**16
        spread = 1.0 + _RETRY_SPREAD * share
        retry_after_ms = math.ceil(max(least_ms, 1e3 * self._wait_s(now)) * spread)
        retry_after_ms = min(_MAX_WORD, retry_after_ms)
        self._effects += (
            Answer(call, encode(Busy(number, retry_after_ms))),
            End(call),
            Noted("busy", {"waiting": self._num_waiting, "retry_after_ms": retry_after_ms}),
        )

    def _refuse(self, call: int, number: int, code: str, text: str) -> None:
        refusals = self._statistics.refusals
        refusals[code] = refusals.get(code, 0) + 1
        # Texts of other people's errors may hold anything.
        text = text.encode("utf-8", "replace").decode()
        if len(text) > _MAX_TEXT:
            text = f"{text[: _MAX_TEXT - 3]}..."
        self._effects += (
            Answer(call, encode(Refused(number, code, text))),
            End(call),
            Noted("refused", {"code": code, "reason": text}),
        )

    # -- sessions --------------------------------------------------------------------------------

    def _weigh(self, session: _Session) -> None:
        """Count what a session's memory takes, and forget others, or part of it, if too much."""
        answers = sum(len(part.actions) for part in session.answers.values())
        num_bytes = _size_of(session.acknowledged) + _size_of(session.ahead) + answers
        self._state_bytes += num_bytes - session.num_bytes
        session.num_bytes = num_bytes
        while self._state_bytes > self._limits.max_state_bytes:
            unused = self._unused()
            if unused is None or unused is session:
                break
            self._forget(unused, "room needed")
        if self._state_bytes > self._limits.max_state_bytes:
            # The others are all in use: this one is handed the state each time.
            session.acknowledged = session.ahead = None
            session.answers.clear()
            self._state_bytes -= num_bytes
            session.num_bytes = 0

    def _unused(self) -> _Session | None:
        """Return the session without work that was unused the longest."""
        return next((each for each in self._sessions.values() if not each.works), None)

    def _forget(self, session: _Session, reason: str) -> None:
        self._supersede(session, None)
        session.closed = True
        del self._sessions[session.key]
        self._state_bytes -= session.num_bytes
        self._epochs[session.key] = session.epoch
        self._epochs.move_to_end(session.key)
        while len(self._epochs) > 4 * self._limits.max_sessions:
            self._epochs.popitem(last=False)
        self._statistics.sessions_evicted += 1
        self._note("evicted", session, reason=reason)

    def _note(self, event: str, session: _Session, **fields: object) -> None:
        self._effects.append(Noted(event, {"session": session.key[:4].hex(), **fields}))


def _task_answer(number: int, part: _Part) -> bytes:
    return encode(TaskAnswer(number, part.num_actions, part.actions, part.computed_us))


def _sensing_answer(number: int, digest: bytes, part: _Part) -> bytes:
    return encode(SensingAnswer(number, part.step, part.sensing_action, digest, part.computed_us))
