"""What a service remembers of each robot: it only saves work, and may be forgotten at any time.

Of a robot's state the service keeps two copies, the one that was last asked about and the one at
the next sensing step; of its answers, the last few. Whoever was forgotten is asked for the state
and goes on. One thing outlives the memory: which of a robot's processes was the last, so that one
that was replaced stays replaced.

A session also lists the robot's *works*: the parts of answers that wait or run, each with the calls
that wait for it. A part is known by the digest of the state that it is for, so the same question is
the same work, however often it comes.
"""

from __future__ import annotations

import hashlib
import math
from collections import OrderedDict
from functools import lru_cache
from typing import NamedTuple

import msgspec

from holdfast.planning import PlanningState
from holdfast.problems.registry import BUILT_IN
from holdfast.session.messages import Opening, Request, pack_opening
from holdfast.session.service_limits import ServiceLimits
from holdfast.settings import PlanningSettings

__all__ = [
    "PREFETCHED",
    "REQUESTED",
    "ExpectedTimes",
    "Part",
    "Session",
    "Sessions",
    "WaitingCall",
    "Work",
]

_LEAST_EPOCHS = 4096
"""Epochs of forgotten robots that are remembered, however few sessions there may be."""

_SETTINGS_KEPT = 128
"""Settings that are shared by all robots that have the same."""

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
    """

    __slots__ = ("_inertia", "_sensing_known", "_task_known", "sensing_s", "task_s")

    def __init__(self, inertia: float, task_s: float, sensing_s: float) -> None:
        self._inertia = inertia
        self._task_known = self._sensing_known = False
        self.task_s = task_s
        self.sensing_s = sensing_s

    def known_s(self, *, task: bool) -> float:
        """Return what a part is expected to take; infinite if none was ever computed."""
        if task:
            return self.task_s if self._task_known else math.inf
        return self.sensing_s if self._sensing_known else math.inf

    def learn(self, computed_s: float, *, task: bool) -> None:
        """Let a job's time count in what the next ones are expected to take."""
        if task:
            self._task_known = True
            self.task_s = self._moved(self.task_s, computed_s)
        else:
            self._sensing_known = True
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
        self.newcomer = not session.served
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
        self, request: Request, opening: Opening, max_threads: int, times: ExpectedTimes
    ) -> None:
        self.key = request.session
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
        self._sessions: OrderedDict[bytes, Session] = OrderedDict()
        # Of sessions that were forgotten: a robot that was replaced stays replaced.
        self._epochs: OrderedDict[bytes, int] = OrderedDict()
        self._num_newcomers = 0
        self.state_bytes = 0
        self.opening_bytes = 0

    def __len__(self) -> int:
        return len(self._sessions)

    def get(self, key: bytes) -> Session | None:
        """Return a robot's session; None if it is not remembered."""
        return self._sessions.get(key)

    def epoch_of(self, key: bytes) -> int:
        """Return the epoch of a robot's last process, remembered or not; 0 if none is known."""
        session = self._sessions.get(key)
        return session.epoch if session is not None else self._epochs.get(key, 0)

    def unused(self, *, for_newcomer: bool = False) -> Session | None:
        """Return the session without work that was unused the longest.

        For a newcomer, one of those that were never served, if these have half of the room already:
        so however many come, they do not drive all others out.
        """
        among_newcomers = for_newcomer and 2 * self._num_newcomers >= self._limits.max_sessions
        return next(
            (
                each
                for each in self._sessions.values()
                if not each.works and not (among_newcomers and each.served)
            ),
            None,
        )

    def serve(self, session: Session) -> None:
        """Take note that a robot has got an answer."""
        self._num_newcomers -= not session.served
        session.served = True

    def has_room_for(self, session: Session) -> bool:
        """Tell whether one more fits without forgetting another; the only one always does."""
        limits = self._limits
        return not self._sessions or (
            len(self._sessions) < limits.max_sessions
            and self.opening_bytes + len(session.opening) <= limits.max_opening_bytes
        )

    def add(self, session: Session) -> None:
        """Remember a robot from now on."""
        self._sessions[session.key] = session
        self._num_newcomers += 1
        self.opening_bytes += len(session.opening)
        self._epochs.pop(session.key, None)

    def use(self, session: Session, now: float) -> None:
        """Take note that a robot was heard, or worked for."""
        session.used_at = now
        self._sessions.move_to_end(session.key)

    def forget(self, session: Session) -> None:
        """Forget all but the epoch of a robot for which nothing waits."""
        session.closed = True
        del self._sessions[session.key]
        self._num_newcomers -= not session.served
        self.state_bytes -= session.num_bytes
        self.opening_bytes -= len(session.opening)
        self.note_epoch(session.key, session.epoch)

    def note_epoch(self, key: bytes, epoch: int) -> None:
        """Remember the epoch of a robot that has no session: its processes before are replaced."""
        self._epochs[key] = epoch
        self._epochs.move_to_end(key)
        while len(self._epochs) > max(4 * self._limits.max_sessions, _LEAST_EPOCHS):
            self._epochs.popitem(last=False)

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
        num_bytes = session.size()
        self.state_bytes += num_bytes - session.num_bytes
        session.num_bytes = num_bytes

    @property
    def too_heavy(self) -> bool:
        """Whether all of them together take more than they may."""
        return self.state_bytes > self._limits.max_state_bytes

    def empty(self, session: Session) -> None:
        """Forget the states and answers of a robot, which is handed the state each time."""
        session.acknowledged = session.ahead = None
        session.answers.clear()
        self.state_bytes -= session.num_bytes
        session.num_bytes = 0


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
