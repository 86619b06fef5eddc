"""What a service remembers of each robot: it only saves work, and may be forgotten at any time.

Of a robot's state the service keeps two copies, the one that was last asked about and the one at
the next sensing step; of its answers, the last few. Whoever was forgotten is asked for the state
and goes on. One thing outlives the memory: which of a robot's processes was the last, so that one
that was replaced stays replaced.

A session belongs to its *owner*: the name in the certificate with which the robot has proved who it
is, None for all those that have proved nothing. All that is remembered stands under the owner and
the session together, so the same sixteen bytes from another owner are another session: there is
nothing to refuse, and nothing that a refusal could tell. Where room is needed it is taken from
whoever holds the most.

A session also lists the robot's *works*: the parts of answers that wait or run, each with the calls
that wait for it. A part is known by the digest of the state that it is for, so the same question is
the same work, however often it comes.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Callable, Iterator
from functools import lru_cache
from typing import NamedTuple, TypeAlias

import msgspec

from holdfast.planning import PlanningState
from holdfast.problems.registry import BUILT_IN
from holdfast.session.messages import Opening, Request, pack_opening
from holdfast.session.service_limits import ServiceLimits
from holdfast.session.usual_time import UsualTime
from holdfast.settings import PlanningSettings

__all__ = [
    "PREFETCHED",
    "REQUESTED",
    "ExpectedTimes",
    "Owner",
    "Part",
    "Session",
    "SessionKey",
    "Sessions",
    "WaitingCall",
    "Work",
]

_LEAST_EPOCHS = 4096
"""Epochs of forgotten robots that are remembered, however few sessions there may be."""

_SETTINGS_KEPT = 128
"""Settings that are shared by all robots that have the same."""

Owner: TypeAlias = str | None
"""Whose a session is: the name in a robot's certificate, None where nobody has proved anything."""

SessionKey: TypeAlias = tuple[Owner, bytes]
"""Names a session: whose it is, and the bytes that its requests carry."""

REQUESTED, PREFETCHED = 0, 1
"""The slots of a session: a robot stands still for the first, the second is ahead of it."""


class Part(NamedTuple):
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


class ExpectedTimes:
    """How long parts of answers may take, by what they took before.

    Parameters
    ----------
    inertia : float
        A sample moves a mean by its distance divided by this.
    task_s, sensing_s : float
        What is expected before anything was computed.

    Attributes
    ----------
    usual_task, usual_sensing : UsualTime
    """

    __slots__ = ("_inertia", "sensing_s", "task_s", "usual_sensing", "usual_task")

    def __init__(self, inertia: float, task_s: float, sensing_s: float) -> None:
        self._inertia = inertia
        self.usual_task = UsualTime()
        self.usual_sensing = UsualTime()
        self.task_s = task_s
        self.sensing_s = sensing_s

    def learn(self, computed_s: float, *, task: bool) -> None:
        """Let a job's time count in what the next ones are expected to take."""
        if task:
            self.usual_task.learn(computed_s)
            self.task_s = self._moved(self.task_s, computed_s)
        else:
            self.usual_sensing.learn(computed_s)
            self.sensing_s = self._moved(self.sensing_s, computed_s)

    def _moved(self, mean_s: float, sample_s: float) -> float:
        """Return a running mean.

        One sample out of all proportion (a stopped process) moves it little: else robots would be
        turned away for what happened once.
        """
        return mean_s + (min(sample_s, 4.0 * mean_s + 0.01) - mean_s) / self._inertia


class WaitingCall:
    """A call that waits for a part of its answer."""

    __slots__ = ("call", "number", "signed_at", "work")

    def __init__(self, call: int, number: int, work: Work, signed_at: float) -> None:
        self.call = call
        self.number = number
        self.work = work
        self.signed_at = signed_at


class Work:
    """A part of an answer that is to be computed, and the calls that wait for it.

    Parameters
    ----------
    session : Session
    digest : bytes
        Of the state that the part is for.
    sensing : bool
        Whether it is a sensing part.
    request : Request or None
        Names the state; None if the robot has not asked yet.
    state : PlanningState or None
        The state, where no request names it.
    size : int
        Bytes of the request.
    since : float
        When it came.
    """

    __slots__ = (
        "calls",
        "cost_s",
        "digest",
        "newcomer",
        "request",
        "running",
        "sensing",
        "session",
        "since",
        "size",
        "slot",
        "started_at",
        "state",
        "urgent",
    )

    def __init__(
        self,
        session: Session,
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
        self.slot = PREFETCHED if request is None else REQUESTED
        self.urgent = request is not None
        self.newcomer = session.newcomer
        self.calls: dict[int, WaitingCall] = {}
        self.cost_s = session.expected_s(task=not sensing)
        self.running = False
        self.started_at = since

    def become(self, request: Request, *, sensing: bool, size: int) -> None:
        """Be of a newer request of the same robot, in the place of the one before."""
        self.digest, self.request = request.digest, request
        self.sensing, self.size = sensing, size
        self.cost_s = self.session.expected_s(task=not sensing)


class Session:
    """What is remembered of one robot.

    Parameters
    ----------
    key : SessionKey
    request : Request
        The one that opens it.
    opening : Opening
    max_threads : int
        Of one decision.
    times : ExpectedTimes
        Of this robot's parts.
    """

    __slots__ = (
        "acknowledged",
        "ahead",
        "ahead_digest",
        "answers",
        "built",
        "built_in",
        "closed",
        "epoch",
        "held",
        "key",
        "newcomer",
        "num_bytes",
        "number",
        "opening",
        "planning",
        "planning_single",
        "problem_key",
        "running",
        "seed",
        "served",
        "times",
        "used_at",
        "works",
    )

    def __init__(
        self,
        key: SessionKey,
        request: Request,
        opening: Opening,
        max_threads: int,
        times: ExpectedTimes,
    ) -> None:
        self.key = key
        self.epoch = request.epoch
        self.number = -1
        # Packed, it is one object instead of thousands, all of which the collector would look at
        # again and again while nobody else has the interpreter.
        self.opening = pack_opening(opening)
        # Of a problem's code, too: whoever names other code has to be refused.
        named = (opening.problem, opening.core_version, opening.problem_digest)
        self.problem_key = _key_of((named, opening.model, opening.state_space_planner))
        self.built = False
        self.built_in = opening.problem in BUILT_IN
        # The number of threads changes no result, so the service may choose it.
        most = min(opening.planning.active_sensing.num_cores, max_threads)
        self.planning = _with_cores(opening.planning, most)
        self.planning_single = _with_cores(opening.planning, 1)
        self.seed = opening.seed
        self.served = False
        # Whether it goes with those of whom nobody knows who they are.
        self.newcomer = True
        self.acknowledged: PlanningState | None = None
        self.ahead: PlanningState | None = None
        self.ahead_digest = b""
        self.answers: OrderedDict[bytes, Part] = OrderedDict()
        self.works: dict[bytes, Work] = {}
        # One work of each slot runs at a time; the one after it is held back, so that a robot has
        # no more than its turn.
        self.running: list[Work | None] = [None, None]
        self.held: list[Work | None] = [None, None]
        self.times = times
        self.num_bytes = 0
        self.used_at = 0.0
        self.closed = False

    @property
    def owner(self) -> Owner:
        """Whose it is."""
        return self.key[0]

    def expected_s(self, *, task: bool) -> float:
        """Return how long a work may take, with the sensing part that follows a task part."""
        times = self.times
        return times.task_s + times.sensing_s if task else times.sensing_s

    def remember(self, digest: bytes, part: Part, most: int) -> None:
        """Keep a part of an answer, and forget the oldest beyond so many."""
        answers = self.answers
        answers[digest] = part
        answers.move_to_end(digest)
        while len(answers) > most:
            answers.popitem(last=False)

    def state_before(self, request: Request) -> PlanningState | None:
        """Return the nearest state from which the request's may be reached; None if none is."""
        held = (self.ahead, self.acknowledged)
        return next((known for known in held if _connects(known, request)), None)

    def knows_trial(self, trial: int) -> bool:
        """Tell whether a state of that trial is remembered."""
        return any(
            known is not None and known.trial == trial for known in (self.ahead, self.acknowledged)
        )

    def size(self) -> int:
        """Return how many bytes its states and answers take now."""
        answers = sum(len(part.actions) for part in self.answers.values())
        return _size_of(self.acknowledged) + _size_of(self.ahead) + answers


class _Holding:
    """What one owner's sessions take, all together."""

    __slots__ = ("newcomers", "opening_bytes", "sessions", "state_bytes")

    def __init__(self) -> None:
        self.sessions = 0
        self.newcomers = 0
        self.state_bytes = 0
        self.opening_bytes = 0


class Sessions:
    """The robots that are remembered, those unused the longest first.

    Parameters
    ----------
    limits : ServiceLimits

    Attributes
    ----------
    state_bytes : int
        Of all states and answers, as they were weighed last.
    opening_bytes : int
        Of all openings, packed.
    """

    def __init__(self, limits: ServiceLimits) -> None:
        self._limits = limits
        self._sessions: OrderedDict[SessionKey, Session] = OrderedDict()
        self._holdings: dict[Owner, _Holding] = {}
        self._epochs = _Epochs(max(4 * limits.max_sessions, _LEAST_EPOCHS))
        self._num_newcomers = 0
        self.state_bytes = 0
        self.opening_bytes = 0

    def __len__(self) -> int:
        return len(self._sessions)

    def get(self, key: SessionKey) -> Session | None:
        """Return a robot's session; None if it is not remembered."""
        return self._sessions.get(key)

    def epoch_of(self, key: SessionKey) -> int:
        """Return the epoch of a robot's last process, remembered or not; 0 if none is known."""
        session = self._sessions.get(key)
        return session.epoch if session is not None else self._epochs.get(key)

    def is_newcomer(self, owner: Owner) -> bool:
        """Tell whether a new session of this owner is one of somebody of whom nothing is known.

        To be somebody new costs nothing without a certificate. With one it does: so one session of
        each that was never served goes with those that were.
        """
        holding = self._holdings.get(owner)
        return owner is None or (holding is not None and holding.newcomers > 0)

    def serve(self, session: Session) -> None:
        """Take note that a robot has got an answer."""
        if not session.served:
            self._num_newcomers -= 1
            self._holdings[session.owner].newcomers -= 1
        session.served = True
        session.newcomer = False

    def add(self, session: Session) -> None:
        """Remember a robot from now on."""
        session.newcomer = self.is_newcomer(session.owner)
        self._sessions[session.key] = session
        holding = self._holdings.setdefault(session.owner, _Holding())
        holding.sessions += 1
        holding.newcomers += 1
        holding.opening_bytes += len(session.opening)
        self._num_newcomers += 1
        self.opening_bytes += len(session.opening)
        self._epochs.forget(session.key)

    def use(self, session: Session, now: float) -> None:
        """Take note that a robot was heard, or worked for."""
        session.used_at = now
        self._sessions.move_to_end(session.key)

    def forget(self, session: Session) -> None:
        """Forget all but the epoch of a robot for which nothing waits."""
        session.closed = True
        del self._sessions[session.key]
        holding = self._holdings[session.owner]
        holding.sessions -= 1
        holding.newcomers -= not session.served
        holding.opening_bytes -= len(session.opening)
        self._num_newcomers -= not session.served
        self.opening_bytes -= len(session.opening)
        self._count_state(session, 0)
        if not holding.sessions:
            del self._holdings[session.owner]
        self.note_epoch(session.key, session.epoch)

    def note_epoch(self, key: SessionKey, epoch: int) -> None:
        """Remember the epoch of a robot that has no session: its processes before are replaced."""
        self._epochs.note(key, epoch)

    # -- room for one more -----------------------------------------------------------------------

    def has_room_for(self, session: Session) -> bool:
        """Tell whether one more fits without forgetting another; the only one always does."""
        return not self._sessions or not (
            self._is_full_for(session.owner)
            or self._has_all_sessions
            or self._has_all_openings(session)
        )

    def unused_for(self, session: Session) -> Session | None:
        """Return the session without work that is to be forgotten for a new one, if there is any.

        If its owner has as many as one may have, one of its own. Else the one unused the longest of
        those who hold the most of what is short; and of these one that was never served, if such
        have half of the room already: so however many come, they do not drive all others out.
        """
        if self._is_full_for(session.owner):
            owner = session.owner
            return self._first_unused(lambda each: each.owner == owner)
        newcomers = 2 * self._num_newcomers >= self._limits.max_sessions
        if self._has_all_sessions:
            return self._unused_of_most(lambda holding: holding.sessions, newcomers=newcomers)
        return self._unused_of_most(lambda holding: holding.opening_bytes, newcomers=newcomers)

    def _is_full_for(self, owner: Owner) -> bool:
        most, holding = self._limits.max_sessions_per_robot, self._holdings.get(owner)
        if owner is None or most is None or holding is None:
            return False
        return holding.sessions >= most

    @property
    def _has_all_sessions(self) -> bool:
        return len(self._sessions) >= self._limits.max_sessions

    def _has_all_openings(self, session: Session) -> bool:
        return self.opening_bytes + len(session.opening) > self._limits.max_opening_bytes

    def _unused_of_most(
        self, amount: Callable[[_Holding], int], *, newcomers: bool
    ) -> Session | None:
        """Return the session without work that was unused the longest, of those who hold the most.

        That is at least half of what anybody holds: among equals a few bytes more are no reason to
        be forgotten each time. If all of these have work, it is one of the others.
        """
        holdings = self._holdings
        if len(holdings) > 1:
            least = max(map(amount, holdings.values())) / 2
            found = self._first_unused(
                lambda each: (
                    amount(holdings[each.owner]) >= least and not (newcomers and each.served)
                )
            )
            if found is not None:
                return found
        return self._first_unused(lambda each: not (newcomers and each.served))

    def _first_unused(self, fits: Callable[[Session], bool]) -> Session | None:
        return next(
            (each for each in self._sessions.values() if not each.works and fits(each)), None
        )

    # -- what was not heard for long -------------------------------------------------------------

    def idle(self, now: float) -> Session | None:
        """Return the session unused the longest if it is to be forgotten by now."""
        due = self.idle_at()
        return None if due is None or due > now else next(iter(self._sessions.values()))

    def idle_at(self) -> float | None:
        """Return when the session unused the longest is to be forgotten; None if it has work."""
        session = next(iter(self._sessions.values()), None)
        if session is None or session.works:
            return None
        return session.used_at + self._limits.max_idle_s

    # -- what takes too much ---------------------------------------------------------------------

    def weigh(self, session: Session) -> None:
        """Count what a session's memory takes now."""
        self._count_state(session, session.size())

    @property
    def too_heavy(self) -> bool:
        """Whether all of them together take more than they may."""
        return self.state_bytes > self._limits.max_state_bytes

    def unused_of_heaviest(self) -> Session | None:
        """Return the session without work to be forgotten because all states take too much."""
        return self._unused_of_most(lambda holding: holding.state_bytes, newcomers=False)

    def empty(self, session: Session) -> None:
        """Forget the states and answers of a robot, which is handed the state each time."""
        session.acknowledged = session.ahead = None
        session.answers.clear()
        self._count_state(session, 0)

    def _count_state(self, session: Session, num_bytes: int) -> None:
        self.state_bytes += num_bytes - session.num_bytes
        self._holdings[session.owner].state_bytes += num_bytes - session.num_bytes
        session.num_bytes = num_bytes


class _Epochs:
    """The epochs of sessions that were forgotten: a robot that was replaced stays replaced.

    Parameters
    ----------
    most : int
        So many are remembered. Beyond that the oldest goes, of the owner that has the most.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._count = 0
        # Owners in the order in which they were noted last.
        self._of: OrderedDict[Owner, OrderedDict[bytes, int]] = OrderedDict()

    def __iter__(self) -> Iterator[SessionKey]:
        return ((owner, session) for owner, epochs in self._of.items() for session in epochs)

    def get(self, key: SessionKey) -> int:
        """Return the epoch of a session; 0 if none is known."""
        owner, session = key
        epochs = self._of.get(owner)
        return 0 if epochs is None else epochs.get(session, 0)

    def note(self, key: SessionKey, epoch: int) -> None:
        """Remember an epoch."""
        owner, session = key
        self.forget(key)
        self._of.setdefault(owner, OrderedDict())[session] = epoch
        self._of.move_to_end(owner)
        self._count += 1
        if self._count > self._most:
            largest = max(self._of, key=lambda each: len(self._of[each]))
            self.forget((largest, next(iter(self._of[largest]))))

    def forget(self, key: SessionKey) -> None:
        """Forget the epoch of a session that is there again."""
        owner, session = key
        epochs = self._of.get(owner)
        if epochs is not None and epochs.pop(session, None) is not None:
            self._count -= 1
            if not epochs:
                del self._of[owner]


def _key_of(data: object) -> bytes:
    """Return a short name of plain data, equal for equal data."""
    return hashlib.blake2b(msgspec.msgpack.encode(data), digest_size=16).digest()


@lru_cache(maxsize=_SETTINGS_KEPT)
def _with_cores(planning: PlanningSettings, num_cores: int) -> PlanningSettings:
    """Return settings with another number of threads, one copy for all robots that have them."""
    sensing = msgspec.structs.replace(planning.active_sensing, num_cores=num_cores)
    return msgspec.structs.replace(planning, active_sensing=sensing)


def _size_of(state: PlanningState | None) -> int:
    return 0 if state is None else state.belief.states.nbytes + state.belief.weights.nbytes


def _connects(state: PlanningState | None, request: Request) -> bool:
    """Tell whether a state of the request's trial comes no later than the request's."""
    return (
        state is not None
        and state.trial == request.trial
        and (state.step, state.sensed) <= (request.step, request.sensed)
    )
