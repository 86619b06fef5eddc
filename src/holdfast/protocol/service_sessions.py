"""What a service remembers of each robot. It only saves work, and may be forgotten at any time.

A session holds two of the robot's states, the last requested one and the one at the next sensing
step, and the last few answers. A robot that was forgotten is asked for its state. Only the
robot's epoch outlives the session, so a process that was replaced stays replaced.

A session belongs to an *owner*: the name in the robot's verified certificate, None for all robots
without one. Sessions are found by owner and session id together, so the same id from another owner
is another session, and nothing is revealed. If room is short, the largest owners lose sessions.

A session also lists its pending tasks: parts of answers that wait or run. A part is identified by
the digest of its state, so equal questions share one task.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from holdfast.config.registry import BUILT_IN
from holdfast.planning.planner import PlanningState
from holdfast.planning.settings import PlanningSettings
from holdfast.protocol.computing_time import ExpectedTime
from holdfast.protocol.decision_cost import Cost, Price, ProblemCost
from holdfast.protocol.messages import Request, SessionConfiguration, pack_configuration
from holdfast.protocol.service_limits import ServiceLimits

_LEAST_EPOCHS = 4096
"""Epochs of forgotten sessions are remembered at least for so many."""

_MAX_THREADS = 64
"""Bound on the threads of one decision, whatever the robot's settings say."""

_TYPICAL_STEPS = 32
"""Bound on the steps of a task whose time earlier tasks predict."""

Owner: TypeAlias = str | None
"""Name in the robot's verified certificate; None without one."""

SessionKey: TypeAlias = tuple[Owner, bytes]
"""Owner and session id."""

SHORT_S = 0.002
"""Jobs that take no longer than that are *short*: handing them to a thread takes as long where
others want the interpreter, too."""

_ESTIMATING_S = 1e-4
"""Time of a job that does no more than that."""

NEW, FIRST, BRIEF, MEDIUM, LONG = range(5)
"""Lanes."""

REQUESTED, PREFETCHED = 0, 1
"""A session's slots: the robot waits for the first kind of task; the second is ahead of it."""


class CachedAnswer(NamedTuple):
    """A part of an answer, kept under the digest of its state."""

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


class PendingTask:
    """A part of an answer to be computed; only the lanes, where it waits and runs, write it."""

    def __init__(
        self,
        session: Session,
        digest: bytes,  # of the part's state
        *,
        sensing: bool,
        since: float,  # when it was queued; of one that carries a newer request, the first of them
        # request, state: the request names the state; without one (the robot has not asked yet) it
        # is ``state``.
        request: Request | None = None,
        state: PlanningState | None = None,
        size: int = 0,  # bytes of the request
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
        # Where it waits and runs (:mod:`~holdfast.protocol.service_lanes`).
        self.lane = session.lane_of(request)
        self.num_bytes = 0.0  # estimated memory, unless it is brief
        self.cost_s = self._expected_s()
        self.running = False

    @property
    def kind(self) -> Literal["task", "sensing"]:
        """Which part of the answer it is."""
        return "sensing" if self.sensing else "task"

    @property
    def expected_time(self) -> ExpectedTime:
        """Learned from earlier ones of its session and kind."""
        return self.session.times[self.sensing]

    def _expected_s(self) -> float:
        """Return how long it may take, with the sensing part that follows a task part."""
        task_time, sensing_time = self.session.times
        mean_s = sensing_time.mean_s + (0.0 if self.sensing else task_time.mean_s)
        # One that may be too long for its lane is only estimated there.
        is_computed = self.lane > BRIEF or self.session.is_brief
        return mean_s if is_computed else _ESTIMATING_S

    def move_to(self, lane: int, cost: Cost) -> None:
        """Move to another lane, for an estimated cost; it waits in none meanwhile."""
        self.lane = lane
        self.num_bytes = cost.num_bytes
        self.cost_s = self._expected_s()

    def starts_at(self) -> PlanningState | None:
        """Return the nearest state that is held before its own; None if there is none."""
        request = self.request
        if request is None or request.checkpoint is not None:
            return self.state
        return self.session.state_before(request)

    def predicted_s(self, state: PlanningState | None) -> float:
        """Return how long it takes on a free core; infinite if that is unknown, or not short."""
        typical_s = self.expected_time.typical_s
        return typical_s if typical_s <= SHORT_S and self._is_typical(state) else math.inf

    def _is_typical(self, state: PlanningState | None) -> bool:
        """Return whether earlier times predict this task's, if it starts at ``state``.

        It must follow the previous observation, or start a trial, and span few steps, since a robot
        may choose their number. Its problem must be built in: other code may take any time.
        """
        request = self.request
        if not (self.session.built_in and self.session.is_brief) or self.lane == NEW:
            return False
        if request is None:
            return True
        if request.checkpoint is not None or len(request.inputs) > 1:
            return False
        num_steps = request.step - (0 if state is None else state.step)
        if not self.sensing:
            num_steps += self.session.planning.sensing_interval
        return num_steps <= _TYPICAL_STEPS

    def become(self, request: Request, *, sensing: bool, size: int) -> None:
        """Carry a newer request of the same robot instead of its own."""
        self.digest, self.request = request.digest, request
        self.sensing, self.size = sensing, size
        self.cost_s = self._expected_s()


class Alike:
    """What is common to sessions with the same problem and settings."""

    def __init__(self, session: Session) -> None:
        self.planning = session.planning
        self.single_core = session.single_core
        # How long their task and sensing parts take, whoever's they are.
        self.times = ExpectedTime(), ExpectedTime()

    def share_with(self, session: Session) -> None:
        """Give a new session what is known: the same objects need no further check."""
        session.planning, session.single_core = self.planning, self.single_core
        for time, common in zip(session.times, self.times, strict=True):
            time.typical_s = common.typical_s


class Session:
    """What is remembered of one robot.

    :class:`SessionTable` writes ``served``, ``closed`` and ``num_bytes``, and drops states and
    answers; :class:`~holdfast.protocol.service.Service` and
    :class:`~holdfast.protocol.service_lanes.Lanes` write all else.
    """

    def __init__(
        self,
        key: SessionKey,
        request: Request,
        configuration: SessionConfiguration,
        times: tuple[ExpectedTime, ExpectedTime],  # of its task and sensing parts
    ) -> None:
        self.key = key
        self.owner = key[0]
        self.epoch = request.epoch
        self.number = -1  # of the newest request in this epoch; -1 before the first
        # Packed, it is one object instead of thousands, all of which the collector would look at
        # again and again while nobody else has the interpreter.
        self.configuration = pack_configuration(configuration)
        # Identifies the problem among those kept for reuse. With its code's digests: a robot with
        # other code must be refused.
        self.problem_key = _digest_of(
            (
                configuration.problem,
                configuration.core_version,
                configuration.problem_digest,
                configuration.model,
                configuration.state_space_planner,
            )
        )
        # built, built_in: whether the problem was built before, and whether it is part of holdfast.
        self.built = False
        # What its problem's functions take, if they were measured for another session of its owner.
        self.known: ProblemCost | None = None
        # Whether no decision was estimated to be too long for the lane of brief ones.
        self.is_brief = True
        self.overran = False  # whether its last decision took much longer than was estimated
        self.price: Price | None = None  # what its decisions cost; None before the first
        self.built_in = configuration.problem in BUILT_IN
        # The number of threads changes no result, so the service may choose it.
        most = min(configuration.planning.active_sensing.num_cores, _MAX_THREADS)
        # With the threads that a decision has when it is computed alone.
        self.planning = with_cores(configuration.planning, most)
        self.single_core = with_cores(self.planning, 1)  # when others are computed, too
        # What the sessions have in common that decide alike.
        self.company = _digest_of((self.problem_key, configuration.planning))
        self.seed = configuration.seed
        self.served = False  # whether the robot got an answer
        # acknowledged, ahead: the state last asked about, and that at the next sensing step. The
        # first is None if it was asked about by an earlier process of the robot.
        self.acknowledged: PlanningState | None = None
        self.ahead: PlanningState | None = None
        self.ahead_digest = b""
        # answers, pending: cached parts of answers, oldest first, and tasks that wait or run, by
        # the digest of their state.
        self.answers: OrderedDict[bytes, CachedAnswer] = OrderedDict()
        self.pending: dict[bytes, PendingTask] = {}
        self.times = times
        self.num_bytes = 0  # counted size of states and answers
        self.used_at = 0.0  # time of the last request or result
        self.closed = False

    def lane_of(self, request: Request | None) -> int:
        """Return the lane in which a task begins.

        Of a session that was not served at most its problem is known, and nothing of a state that
        comes from outside.
        """
        if request is not None and request.checkpoint is not None:
            return NEW
        if not self.served:
            return NEW if self.known is None else FIRST
        return LONG if self.overran else BRIEF

    def remove_task(self, task: PendingTask) -> None:
        """Remove a task, unless another has taken its place."""
        if self.pending.get(task.digest) is task:
            del self.pending[task.digest]

    def remember(self, digest: bytes, answer: CachedAnswer, most: int) -> None:
        """Cache a part of an answer, and drop the oldest beyond ``most``."""
        answers = self.answers
        answers[digest] = answer
        answers.move_to_end(digest)
        while len(answers) > most:
            answers.popitem(last=False)

    def state_before(self, request: Request) -> PlanningState | None:
        """Return the nearest state before the request's; None if there is none."""
        asked = request.step, request.sensed
        states = self.states_of(request.trial)
        return next((each for each in states if (each.step, each.sensed) <= asked), None)

    def states_of(self, trial: int) -> list[PlanningState]:
        """Return the states from which a trial may go on, the later first."""
        held = () if self.acknowledged is None else (self.ahead, self.acknowledged)
        return [each for each in held if each is not None and each.trial == trial]

    def size(self) -> int:
        """Return the bytes of its states and answers."""
        answers = sum(len(answer.actions) for answer in self.answers.values())
        return _size_of(self.acknowledged) + _size_of(self.ahead) + answers


class ForgottenEpochs:
    """Epochs of forgotten sessions, remembered so that a replaced process stays replaced.

    Above the ``most`` that are kept, the oldest of the owner with the most is dropped.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._count = 0
        # Owners in the order in which they were noted last.
        self._of: OrderedDict[Owner, OrderedDict[bytes, int]] = OrderedDict()

    def __iter__(self) -> Iterator[SessionKey]:
        return ((owner, session) for owner, epochs in self._of.items() for session in epochs)

    def get(self, key: SessionKey) -> int:
        """Return a session's epoch; 0 if unknown."""
        owner, session = key
        epochs = self._of.get(owner)
        return 0 if epochs is None else epochs.get(session, 0)

    def note(self, key: SessionKey, epoch: int) -> None:
        """Keep an epoch."""
        owner, session = key
        self.forget(key)
        self._of.setdefault(owner, OrderedDict())[session] = epoch
        self._of.move_to_end(owner)
        self._count += 1
        if self._count > self._most:
            largest = max(self._of, key=lambda each: len(self._of[each]))
            self.forget((largest, next(iter(self._of[largest]))))

    def forget(self, key: SessionKey) -> None:
        """Drop the epoch of a session that is held again."""
        owner, session = key
        epochs = self._of.get(owner)
        if epochs is not None and epochs.pop(session, None) is not None:
            self._count -= 1
            if not epochs:
                del self._of[owner]


class SessionTable:
    """All sessions, least recently used first."""

    def __init__(self, limits: ServiceLimits) -> None:
        self._limits = limits
        self._sessions: OrderedDict[SessionKey, Session] = OrderedDict()
        # What each owner holds, and all together.
        self._num_of: Counter[Owner] = Counter()
        self._configuration_bytes_of: Counter[Owner] = Counter()
        self._state_bytes_of: Counter[Owner] = Counter()
        self.configuration_bytes = self.state_bytes = 0
        self._epochs = ForgottenEpochs(max(4 * limits.max_sessions, _LEAST_EPOCHS))
        self._num_unserved = 0
        # By problem and settings; the last used last.
        self._alike: OrderedDict[bytes, Alike] = OrderedDict()

    def __len__(self) -> int:
        return len(self._sessions)

    def get(self, key: SessionKey) -> Session | None:
        """Return a session; None if it is not held."""
        return self._sessions.get(key)

    def alike(self, session: Session) -> Alike:
        """Return what is common to the sessions with a session's problem and settings."""
        alike = self._alike.get(session.company)
        if alike is None:
            alike = self._alike[session.company] = Alike(session)
            if len(self._alike) > 4 * self._limits.max_problems:
                self._alike.popitem(last=False)
        self._alike.move_to_end(session.company)
        return alike

    def epoch_of(self, key: SessionKey) -> int:
        """Return a session's epoch, held or not; 0 if unknown."""
        session = self._sessions.get(key)
        return session.epoch if session is not None else self._epochs.get(key)

    def mark_served(self, session: Session) -> None:
        """Note that a robot got an answer."""
        self._num_unserved -= not session.served
        session.served = True

    def add(self, session: Session) -> None:
        """Add a session."""
        self._sessions[session.key] = session
        self._count(session, 1)
        self._epochs.forget(session.key)

    def use(self, session: Session, now: float) -> None:
        """Make a session the most recently used."""
        session.used_at = now
        self._sessions.move_to_end(session.key)

    def forget(self, session: Session) -> None:
        """Drop all of a session but its epoch. Nothing may wait for it."""
        session.closed = True
        del self._sessions[session.key]
        self._count_state(session, 0)
        self._count(session, -1)
        self.note_epoch(session.key, session.epoch)

    def _count(self, session: Session, sign: int) -> None:
        """Count a session without states, or count it no more."""
        owner, num_bytes = session.owner, sign * len(session.configuration)
        self._num_unserved += sign * (not session.served)
        self._num_of[owner] += sign
        self._configuration_bytes_of[owner] += num_bytes
        self.configuration_bytes += num_bytes
        if not self._num_of[owner]:
            for held in (self._num_of, self._configuration_bytes_of, self._state_bytes_of):
                del held[owner]

    def note_epoch(self, key: SessionKey, epoch: int) -> None:
        """Remember the epoch of a robot without a session."""
        self._epochs.note(key, epoch)

    # -- room for one more -----------------------------------------------------------------------

    def has_room_for(self, session: Session) -> bool:
        """Return whether a session fits without dropping another; the only one always fits."""
        configuration_bytes = self.configuration_bytes + len(session.configuration)
        return not self._sessions or not (
            self._is_full_for(session.owner)
            or self._is_full
            or configuration_bytes > self._limits.max_configuration_bytes
        )

    def evictable_for(self, session: Session) -> Session | None:
        """Return the session without tasks to be dropped for a new one; None if there is none.

        If the owner has its maximum, one of its own. Else the least recently used of the owners
        that hold the most; and of these one never served, if such sessions fill half of the room
        already.
        """
        if self._is_full_for(session.owner):
            owner = session.owner
            return self._first_unused(lambda each: each.owner == owner)
        only_unserved = 2 * self._num_unserved >= self._limits.max_sessions
        held = self._num_of if self._is_full else self._configuration_bytes_of
        return self._unused_of_most(held, only_unserved=only_unserved)

    def _is_full_for(self, owner: Owner) -> bool:
        most = self._limits.max_sessions_per_robot
        return owner is not None and most is not None and self._num_of[owner] >= most

    @property
    def _is_full(self) -> bool:
        return len(self._sessions) >= self._limits.max_sessions

    def _unused_of_most(self, held: Counter[Owner], *, only_unserved: bool) -> Session | None:
        """Return the least recently used session without tasks, of the owners that hold the most.

        These hold at least half of the largest holding: among near equals the same one is not
        dropped each time. If all of these have tasks, it is one of the others.
        """
        if len(self._num_of) > 1:
            least = max(held.values()) / 2
            found = self._first_unused(
                lambda each: held[each.owner] >= least and not (only_unserved and each.served)
            )
            if found is not None:
                return found
        return self._first_unused(lambda each: not (only_unserved and each.served))

    def _first_unused(self, fits: Callable[[Session], bool]) -> Session | None:
        return next(
            (each for each in self._sessions.values() if not each.pending and fits(each)), None
        )

    # -- what was not heard for long -------------------------------------------------------------

    def idle(self, now: float) -> Session | None:
        """Return the least recently used session if its time is over; else None."""
        due = self.idle_at()
        return None if due is None or due > now else next(iter(self._sessions.values()))

    def idle_at(self) -> float | None:
        """Return when the least recently used session is to be dropped; None if it has tasks."""
        session = next(iter(self._sessions.values()), None)
        if session is None or session.pending:
            return None
        return session.used_at + self._limits.max_idle_s

    # -- what takes too much ---------------------------------------------------------------------

    def update_size(self, session: Session) -> None:
        """Count what a session's states and answers take now."""
        self._count_state(session, session.size())

    @property
    def over_budget(self) -> bool:
        """Whether all states take more than they may."""
        return self.state_bytes > self._limits.max_state_bytes

    def largest_evictable(self) -> Session | None:
        """Return the session without tasks to be dropped for its memory; None if there is none."""
        return self._unused_of_most(self._state_bytes_of, only_unserved=False)

    def drop_states(self, session: Session) -> None:
        """Drop a session's states and answers; the robot will send its state each time."""
        session.acknowledged = session.ahead = None
        session.answers.clear()
        self._count_state(session, 0)

    def _count_state(self, session: Session, num_bytes: int) -> None:
        self._state_bytes_of[session.owner] += num_bytes - session.num_bytes
        self.state_bytes += num_bytes - session.num_bytes
        session.num_bytes = num_bytes


def _digest_of(data: object) -> bytes:
    """Return a short digest of plain data."""
    return hashlib.blake2b(msgspec.msgpack.encode(data), digest_size=16).digest()


def with_cores(planning: PlanningSettings, num_cores: int) -> PlanningSettings:
    """Return the settings with another number of threads."""
    sensing = msgspec.structs.replace(planning.active_sensing, num_cores=num_cores)
    return msgspec.structs.replace(planning, active_sensing=sensing)


def _size_of(state: PlanningState | None) -> int:
    return 0 if state is None else state.belief.states.nbytes + state.belief.weights.nbytes
