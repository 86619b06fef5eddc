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

Here is what a request and an outcome mean. What is remembered of a robot stands in
:mod:`~holdfast.session.service_sessions`, who is next in :mod:`~holdfast.session.service_lines`,
what robots are told in :mod:`~holdfast.session.service_calls`, and what is computed in
:mod:`~holdfast.session.service_jobs`.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable

import msgspec

from holdfast.errors import InvalidValueError
from holdfast.planning import Planner, PlanningState, needs_sensing
from holdfast.problems.problem import Problem
from holdfast.session.messages import (
    MessageError,
    Opening,
    Request,
    decode_request,
    pack_opening,
)
from holdfast.session.service_calls import MAX_WORD, Calls
from holdfast.session.service_effects import Computed, Effect, End, Noted, Run
from holdfast.session.service_jobs import Job, Outcome, ProblemPool
from holdfast.session.service_limits import ServiceLimits, ServiceStatistics
from holdfast.session.service_lines import Lines
from holdfast.session.service_sessions import (
    REQUESTED,
    ExpectedTimes,
    Owner,
    Part,
    Session,
    SessionKey,
    Sessions,
    Work,
)
from holdfast.settings import PlanningSettings

__all__ = ["Service"]

_NO_ROOM_RETRY_MS = 100.0
"""A robot for which there is no room is to come back no sooner than after this."""

_USUAL_STEPS = 32
"""Of a work whose time can be told from those of the works before."""

_INERTIA_OF_ONE = 4.0
_INERTIA_OF_ALL = 8.0
"""What is expected of all robots moves more slowly than what is expected of one."""


class _Fate(enum.Enum):
    """What became of a request for which no work is to be waited for."""

    UNKNOWN = enum.auto()
    ANSWERED = enum.auto()
    TURNED_AWAY = enum.auto()


def _takes_the_usual_time(work: Work, state: PlanningState | None) -> bool:
    """Tell whether a work is as most are, so that what those before took says what it will take.

    It then comes one observation after the one before, or from a trial's beginning, and is of few
    steps, for a robot may choose the number of steps anew with each request. It is of a problem of
    holdfast's own: other people's code may take any time at any call.
    """
    request = work.request
    if not work.session.built_in:
        return False
    if request is None:
        return True
    if request.checkpoint is not None or len(request.observations) > 1:
        return False
    num_steps = request.step - (0 if state is None else state.step)
    if not work.sensing:
        num_steps += work.session.planning.sensing_interval
    return num_steps <= _USUAL_STEPS


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
    make_planner : callable, optional
        Joins a problem and settings to the functions that lead from state to state. It is called by
        jobs, too.
    """

    def __init__(
        self,
        make_problem: Callable[[Opening], Problem],
        workers: int,
        limits: ServiceLimits | None = None,
        describe_error: Callable[[BaseException], str] | None = None,
        make_planner: Callable[[Problem, PlanningSettings], Planner] = Planner,
    ) -> None:
        if workers < 1:
            raise InvalidValueError(f"workers {workers}: a service needs at least 1")
        self._make_problem = make_problem
        self._make_planner = make_planner
        self._describe_error = describe_error or _described
        self._limits = limits or ServiceLimits()
        self._statistics = ServiceStatistics()
        # One list for all, because the order of the effects counts.
        self._effects: list[Effect] = []
        self._sessions = Sessions(self._limits)
        self._problems = ProblemPool(self._limits.max_problems)
        self._lines = Lines(workers, self._limits)
        self._calls = Calls(self._limits, self._statistics, self._effects)
        self._times = ExpectedTimes(_INERTIA_OF_ALL, task_s=1e-3, sensing_s=1e-3)

    @property
    def statistics(self) -> ServiceStatistics:
        """Counters, and what is held at this moment."""
        statistics = self._statistics
        statistics.sessions = len(self._sessions)
        statistics.state_bytes = self._sessions.state_bytes
        statistics.waiting = self._lines.num_waiting
        statistics.running = self._lines.num_running
        statistics.calls = len(self._calls)
        return statistics

    # -- what happens ----------------------------------------------------------------------------

    def receive(self, call: int, payload: bytes, now: float, owner: Owner = None) -> list[Effect]:
        """Take a request.

        Parameters
        ----------
        call : int
            Names the call in the effects; never used before.
        payload : bytes
        now : float
            Seconds of any clock that does not go back.
        owner : str or None, optional
            Name in the certificate with which the robot has proved who it is; None if it has not.
            It reaches the sessions of this name alone.
        """
        request: Request | MessageError
        try:
            request = decode_request(payload)
        except MessageError as error:
            request = error.retold()
        return self.receive_request(call, request, len(payload), now, owner)

    def receive_request(
        self,
        call: int,
        request: Request | MessageError,
        size: int,
        now: float,
        owner: Owner = None,
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
        owner : str or None, optional
            As for :meth:`receive`.
        """
        if isinstance(request, MessageError):
            self._calls.refuse(call, 0, request.code, str(request))
            return self._take()
        self._received(call, request, (owner, request.session), size, now)
        self._dispatch(now)
        return self._take()

    def begun(self, job: Job, now: float) -> None:
        """Take note that a job which was handed out is begun only now."""
        self._lines.begun(job, now)

    def finished(self, job: Job, outcome: Outcome, now: float) -> list[Effect]:
        """Take the outcome of a job that was handed out."""
        work = self._lines.end(job)
        session = work.session
        if session.works.get(work.digest) is work:
            del session.works[work.digest]
        self._problems.give_back(session.problem_key, outcome.problem)
        if not session.closed:
            self._sessions.use(session, now)
            # The first job of a problem also imports and builds it: no measure of the next ones.
            typical = session.built
            session.built = session.built or outcome.problem is not None
            if outcome.failure is not None or outcome.lacks_state:
                self._failed(work, outcome)
            else:
                if typical:
                    computed_s = now - work.started_at
                    self._times.learn(computed_s, task=not work.sensing)
                    session.times.learn(computed_s, task=not work.sensing)
                self._succeeded(work, outcome, now)
            self._lines.let_go_on(session)
        self._dispatch(now)
        return self._take()

    def tick(self, now: float) -> list[Effect]:
        """Take note of the time."""
        self._calls.tell_progress(now)
        while (session := self._sessions.idle(now)) is not None:
            self._forget(session, "idle")
        return self._take()

    def next_wakeup(self) -> float | None:
        """Return when :meth:`tick` must be called if nothing happens before."""
        due = (self._calls.progress_at(), self._sessions.idle_at())
        return min((at for at in due if at is not None), default=None)

    def _take(self) -> list[Effect]:
        effects = self._effects.copy()
        self._effects.clear()
        return effects

    # -- requests --------------------------------------------------------------------------------

    def _received(
        self, call: int, request: Request, key: SessionKey, size: int, now: float
    ) -> None:
        session = self._sessions.get(key)
        epoch = self._sessions.epoch_of(key)
        if request.epoch < epoch:
            text = f"epoch {request.epoch}: a robot of epoch {epoch} has taken this session over"
            self._calls.refuse(call, request.number, "stale_epoch", text)
            return
        opening = request.opening
        if session is not None:
            if request.epoch > epoch:
                self._take_over(session, request.epoch, now)
            if opening is not None and pack_opening(opening) != session.opening:
                if request.epoch == epoch:
                    text = "this session was opened with another problem, settings or seed"
                    self._calls.refuse(call, request.number, "invalid", text)
                    return
                self._forget(session, "opened anew")
                session = None
        if session is None:
            if opening is None:
                self._calls.need_state(call, request.number, differs=False)
                return
            session = self._opened(call, request, key, opening, now)
            if session is None:
                return
        else:
            self._sessions.use(session, now)
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
        if isinstance(work, Work):
            self._supersede(session, work)
        elif work is _Fate.ANSWERED:
            self._supersede(session, None)

    def _opened(
        self, call: int, request: Request, key: SessionKey, opening: Opening, now: float
    ) -> Session | None:
        """Return a new session, or turn the robot away."""
        limits = self._limits
        count = opening.planning.particle_filter.num_particles
        if count > limits.max_particles:
            text = (
                f"particle_filter.num_particles {count}: this service takes at most "
                f"{limits.max_particles} (max_particles)"
            )
            self._calls.refuse(call, request.number, "invalid", text)
            return None
        newcomer = self._sessions.is_newcomer(key[0])
        if self._lines.is_overloaded(now, key[0], newcomer=newcomer):
            self._sessions.note_epoch(key, request.epoch)
            self._turn_away(call, request.number, key, now, newcomer=newcomer)
            return None
        times = ExpectedTimes(_INERTIA_OF_ONE, self._times.task_s, self._times.sensing_s)
        session = Session(key, request, opening, limits.max_threads, times)
        session.used_at = now
        while not self._sessions.has_room_for(session):
            unused = self._sessions.unused_for(session)
            if unused is None:
                # It is free once another robot has left, not once the next decision is computed.
                self._sessions.note_epoch(key, request.epoch)
                self._turn_away(
                    call,
                    request.number,
                    key,
                    now,
                    newcomer=newcomer,
                    least_ms=_NO_ROOM_RETRY_MS,
                )
                return None
            self._forget(unused, "room needed")
        self._sessions.add(session)
        self._statistics.sessions_opened += 1
        self._note(
            "session_opened", session, problem=opening.problem, particles=count, epoch=request.epoch
        )
        return session

    def _take_over(self, session: Session, epoch: int, now: float) -> None:
        """Go on with a robot's next process; whatever the one before waited for is moot."""
        self._note("session_taken_over", session, epoch=epoch, previous_epoch=session.epoch)
        self._statistics.sessions_taken_over += 1
        session.epoch = epoch
        session.number = -1
        session.used_at = now
        self._supersede(session, None)

    def _answer_known(
        self, session: Session, call: int, request: Request, now: float, *, newest: bool
    ) -> Work | _Fate:
        """Answer as far as the answer is there or in work; return what the rest comes from."""
        work = session.works.get(request.digest)
        if work is not None:
            if work.request is None and not work.running:
                self._lines.hasten(work)
            self._statistics.attached += 1
            self._calls.attach(work, call, request.number, now)
            return work
        part = session.answers.get(request.digest)
        if part is None:
            return _Fate.UNKNOWN
        if (part.trial, part.step, part.sensed) != (request.trial, request.step, request.sensed):
            text = (
                f"trial {request.trial}, step {request.step}, sensed {request.sensed}: the state "
                f"of this digest has {part.trial}, {part.step}, {part.sensed}"
            )
            self._calls.refuse(call, request.number, "invalid", text)
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
            self._calls.tell_task(call, request.number, part)
        if rest is not None:
            self._calls.attach(rest, call, request.number, now)
            return rest
        sensing = part if following is None else session.answers[following]
        if sensing.sensing_action >= 0:
            digest = request.digest if following is None else following
            self._calls.tell_sensing(call, request.number, digest, sensing)
        else:
            self._effects.append(End(call))
        return _Fate.ANSWERED

    def _begin(
        self, session: Session, call: int, request: Request, size: int, now: float
    ) -> Work | _Fate:
        """Queue a request for what is not known yet, or turn it away."""
        if request.opening is not None:
            # The session has it; one copy for each request that waits would count nowhere.
            request = msgspec.structs.replace(request, opening=None)
        interval = session.planning.sensing_interval + 1
        sensing = not request.sensed and request.step % interval == 0
        waiting = next(
            (
                work
                for work in session.works.values()
                if work.slot == REQUESTED and not work.running
            ),
            None,
        )
        newcomer = session.newcomer
        if waiting is None and self._lines.is_overloaded(now, session.owner, newcomer=newcomer):
            self._turn_away(call, request.number, session.key, now, newcomer=newcomer)
            return _Fate.TURNED_AWAY
        if waiting is not None:
            # It keeps the turn of the request that it replaces, and adds nothing to the backlog.
            self._calls.end(waiting)
            self._statistics.superseded += 1
            del session.works[waiting.digest]
            self._lines.replace(waiting, request, sensing=sensing, size=size)
            work = waiting
        else:
            work = Work(
                session,
                request.digest,
                sensing=sensing,
                request=request,
                state=None,
                size=size,
                since=now,
            )
            self._lines.line_up(work)
        session.works[work.digest] = work
        self._calls.attach(work, call, request.number, now)
        return work

    def _supersede(self, session: Session, keep: Work | None) -> None:
        """End whatever a robot waited for before it asked for ``keep``."""
        for work in list(session.works.values()):
            if work is not keep:
                self._calls.end(work)
                if not work.running:
                    self._statistics.superseded += 1
                    del session.works[work.digest]
                    self._lines.withdraw(work)

    # -- work ------------------------------------------------------------------------------------

    def _prefetch(self, session: Session, now: float) -> Work:
        """Queue the sensing part of the state ahead."""
        work = Work(
            session,
            session.ahead_digest,
            sensing=True,
            request=None,
            state=session.ahead,
            size=0,
            since=now,
        )
        session.works[work.digest] = work
        self._lines.line_up(work)
        return work

    def _dispatch(self, now: float) -> None:
        """Hand out jobs as long as workers are free."""
        while (work := self._lines.take(now)) is not None:
            self._start(work, now)

    def _start(self, work: Work, now: float) -> None:
        session, request = work.session, work.request
        state = work.state
        if request is not None and request.checkpoint is None:
            state = session.state_before(request)
            if state is None and session.knows_trial(request.trial):
                # The robot is behind what is remembered, or was elsewhere meanwhile.
                del session.works[work.digest]
                for record in self._calls.released(work):
                    self._calls.need_state(record.call, record.number, differs=True)
                return
        alone = self._lines.num_running == 0 and self._lines.num_waiting == 0
        problem = self._problems.lend(session.problem_key)
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
            self._make_planner,
        )
        self._lines.begin(work, job, now)
        expected_s = math.inf
        if problem is not None and _takes_the_usual_time(work, state):
            times = session.times
            expected_s = (times.usual_sensing if work.sensing else times.usual_task).seconds
        self._effects.append(Run(job, expected_s))

    # -- outcomes --------------------------------------------------------------------------------

    def _failed(self, work: Work, outcome: Outcome) -> None:
        session, request = work.session, work.request
        if outcome.diverged and request is not None:
            self._statistics.states_diverged += 1
            self._note("state_diverged", session, trial=request.trial, step=request.step)
        for record in self._calls.released(work):
            if outcome.failure is None:
                self._calls.need_state(
                    record.call,
                    record.number,
                    differs=outcome.differs,
                    diverged=outcome.diverged,
                )
            else:
                self._calls.refuse(record.call, record.number, *outcome.failure)
        if not session.built:
            # Nothing can ever come of it.
            self._forget(session, "refused")

    def _succeeded(self, work: Work, outcome: Outcome, now: float) -> None:
        session, statistics = work.session, self._statistics
        self._sessions.serve(session)
        most = self._limits.answers_per_session
        computed_s = now - work.started_at
        computed_us = min(MAX_WORD, max(0, round(1e6 * computed_s)))
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
            part = Part(*where, sensing_action=outcome.sensing_action)
            session.remember(work.digest, part, most)
            self._answer_sensing(work, work.digest, part)
        else:
            statistics.task_parts += 1
            self._effects.append(Computed("task", computed_s, work.started_at - work.since))
            ahead = outcome.ahead
            assert ahead is not None
            following = outcome.ahead_digest if needs_sensing(session.planning, ahead) else None
            part = Part(*where, outcome.num_actions, outcome.actions, following)
            session.remember(work.digest, part, most)
            self._answer_task(work, part, now)
        self._weigh(session)

    def _answer_task(self, work: Work, part: Part, now: float) -> None:
        """Answer with the task part, and let the calls wait for the sensing part that follows."""
        session, following = work.session, part.following
        self._calls.answer_task(work, part, now)
        if following is None:
            self._calls.end(work)
        elif following in session.answers:
            self._answer_sensing(work, following, session.answers[following])
        elif work.calls:
            # If nobody waits, the robot is elsewhere by now.
            rest = session.works.get(following) or self._prefetch(session, now)
            self._calls.pass_on(work, rest)

    def _answer_sensing(self, work: Work, digest: bytes, part: Part) -> None:
        for record in self._calls.released(work):
            self._calls.tell_sensing(record.call, record.number, digest, part)

    def _turn_away(
        self,
        call: int,
        number: int,
        key: SessionKey,
        now: float,
        *,
        newcomer: bool,
        least_ms: float = 1.0,
    ) -> None:
        lines = self._lines
        owner, session = key
        wait_ms = max(least_ms, 1e3 * lines.wait_s(now, owner, newcomer=newcomer))
        self._calls.turn_away(call, number, session, wait_ms, lines.num_waiting)

    # -- sessions --------------------------------------------------------------------------------

    def _weigh(self, session: Session) -> None:
        """Count what a session's memory takes, and forget others, or part of it, if too much."""
        sessions = self._sessions
        sessions.weigh(session)
        while sessions.too_heavy:
            unused = sessions.unused_of_heaviest()
            if unused is None or unused is session:
                break
            self._forget(unused, "room needed")
        if sessions.too_heavy:
            # The others are all in use: this one is handed the state each time.
            sessions.empty(session)

    def _forget(self, session: Session, reason: str) -> None:
        self._supersede(session, None)
        self._sessions.forget(session)
        self._statistics.sessions_evicted += 1
        self._note("evicted", session, reason=reason)

    def _note(self, event: str, session: Session, **fields: object) -> None:
        owner, key = session.key
        named = {} if owner is None else {"robot": owner}
        self._effects.append(Noted(event, {**named, "session": key[:4].hex(), **fields}))


def _described(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"
