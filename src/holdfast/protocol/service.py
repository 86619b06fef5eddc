"""The service's end: it answers many robots, each of which holds its own true state.

What a service remembers of a robot only saves work: the last requested state, the state at the next
sensing step and the last answers. It may forget any of it at any time; it then replies that it
needs the state. An answer is a function of the state that the request's digest names, so the same
request is computed once, however often it comes.

A request is answered in two parts. The *task* part reaches the requested state and chooses the task
actions up to the next sensing step; it is short, and the robot waits for it. The *sensing* part is
chosen in the state that those actions lead to; it is long, and needed only after they are
performed. So the task part is sent before the sensing part is begun, and other robots' task parts
go first, within limits.

The machine computes nothing itself and has no clock, thread or socket. Methods take an event and
the time and return effects, to be carried out in order; then the caller asks for jobs. It runs each
:class:`Job` (at most ``max_running`` at a time, and some short ones) anywhere, and returns its
:class:`JobResult` with :meth:`Service.finished`.

This module decides what requests and results mean. Memory is in
:mod:`~holdfast.protocol.service_sessions`, the order of work in
:mod:`~holdfast.protocol.request_queue`, replies in :mod:`~holdfast.protocol.service_replies` and
computation in :mod:`~holdfast.protocol.service_jobs`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from holdfast.errors import InvalidValueError, MessageError
from holdfast.planning.planner import needs_sensing
from holdfast.problems.problem import Problem
from holdfast.protocol.computing_time import ExpectedTime
from holdfast.protocol.decision_cost import ANY_MACHINE, Cost, Pricing
from holdfast.protocol.effects import Effects
from holdfast.protocol.messages import MAX_WORD, Request, SessionConfiguration, pack_configuration
from holdfast.protocol.service_jobs import (
    Computed,
    EndCall,
    Job,
    JobResult,
    ProblemPool,
    ServiceEffect,
)
from holdfast.protocol.service_lanes import Lanes
from holdfast.protocol.service_limits import ServiceLimits, ServiceStatistics
from holdfast.protocol.service_replies import WaitingCalls
from holdfast.protocol.service_sessions import (
    BRIEF,
    LONG,
    MEDIUM,
    REQUESTED,
    CachedAnswer,
    Owner,
    PendingTask,
    Session,
    SessionKey,
    SessionTable,
)

_INERTIA_OF_ONE = 4.0
"""Inertia of the mean times of one session, whose decisions are alike."""

_NO_ROOM_RETRY_MS = 100.0
"""Shortest retry time for a robot that finds no free session."""

_NO_ROOM = "room needed"
"""The reason to forget a session that counts as an eviction."""


class Service:
    """Answers the requests of many robots."""

    def __init__(
        self,
        # Builds the problem of a session configuration; raises the robot's mistakes as errors of
        # :mod:`holdfast.errors`. Jobs call it, several at a time.
        make_problem: Callable[[SessionConfiguration], Problem],
        workers: int,  # brief jobs that may run at a time
        limits: ServiceLimits | None = None,
        # Turns an error of a problem's code into a message.
        describe_error: Callable[[BaseException], str] | None = None,
        pricing: Pricing = ANY_MACHINE,  # how fast this machine is
    ) -> None:
        if workers < 1:
            raise InvalidValueError(f"workers {workers}: a service needs at least 1")
        self._make_problem = make_problem
        self._describe_error = describe_error or (lambda error: f"{type(error).__name__}: {error}")
        self._workers = workers
        self._limits = limits or ServiceLimits()
        self._pricing = pricing
        self._statistics = ServiceStatistics()
        self._queue = Lanes(workers, self._limits)
        self.forget_everything()

    def forget_everything(self) -> None:
        """Begin anew, as a process would: the remedy after an exception of a method.

        The caller ends the calls. Jobs that run are cancelled, and their results are ignored.
        """
        self._queue.cancel_all()
        self._queue = Lanes(self._workers, self._limits)
        self._effects: Effects[ServiceEffect] = Effects()
        self._sessions = SessionTable(self._limits)
        self._problems = ProblemPool(self._limits.max_problems)
        self._calls = WaitingCalls(self._limits, self._statistics, self._effects)
        # Of results whose replies are on their way first.
        self._settling: list[Session] = []
        # Of all robots' task and sensing parts; each session has its own, which begin here.
        self._times = ExpectedTime(1e-3), ExpectedTime(1e-3)

    @property
    def max_running(self) -> int:
        """Jobs that may run at a time, besides short ones; :class:`Lanes` says why so many."""
        return self._queue.max_running

    @property
    def statistics(self) -> ServiceStatistics:
        """Counters, and what is held now."""
        statistics = self._statistics
        statistics.sessions = len(self._sessions)
        statistics.state_bytes = self._sessions.state_bytes
        statistics.waiting = self._queue.num_waiting
        statistics.running = self._queue.num_running
        statistics.calls = len(self._calls)
        return statistics

    # -- what happens ----------------------------------------------------------------------------

    def receive(
        self,
        call: int,  # unique; used in effects
        # What :func:`~holdfast.protocol.messages.decode_request` returned or raised.
        request: Request | MessageError,
        size: int,
        now: float,
        # Name in the robot's verified certificate. It reaches only sessions of this owner.
        owner: Owner = None,
    ) -> list[ServiceEffect]:
        """Handle a request, which callers decode outside their lock."""
        if isinstance(request, MessageError):
            self._calls.send_refused(call, 0, request.code, str(request))
            return self._effects.take()
        self._handle(call, request, (owner, request.session), size, now)
        return self._effects.take()

    def started(self, job: Job, now: float) -> None:
        """Note that a job that was handed out starts only now."""
        if (lane := self._queue.with_job(job)) is not None:
            lane.started(job, now)

    def finished(
        self, job: Job, outcome: JobResult, now: float, processor_s: float | None = None
    ) -> list[ServiceEffect]:
        """Handle the result of a job that was handed out, and the processor time that it took."""
        lane = self._queue.with_job(job)
        if lane is None:
            return []  # handed out before everything was forgotten
        task, started_at = lane.end(job)
        session = task.session
        is_pending = session.pending.get(task.digest) is task
        session.remove_task(task)
        price = outcome.price
        if job.expected_s == math.inf:
            self._problems.release(session.problem_key, outcome.problem)
        cost = None if price is None else price.problem
        self._problems.note_cost(session.owner, session.problem_key, cost)
        if not session.closed:
            self._sessions.use(session, now)
            # The first job of a problem also imports and builds it: no measure of the next ones.
            typical = session.built
            session.built = session.built or outcome.problem is not None
            # One whose problem cannot be built is refused: it opens none, and evicts none.
            self._statistics.sessions_opened += session.built and not typical
            session.price = price or session.price
            if outcome.cancelled or outcome.postponed is not None:
                if is_pending:
                    self._postpone(task, job, outcome.postponed, now)
            elif outcome.failure is not None or outcome.lacks_state:
                self._failed(task, outcome)
            else:
                computed_s = now - started_at
                session.overran = session.overran and computed_s > self._queue.limits_s[MEDIUM]
                if outcome.restored:
                    # A particle in an obstacle, say, takes a thousand times as long to move.
                    session.times[0].expect_long()  # of task parts
                if typical and task.lane <= BRIEF:
                    # What new robots are expected to take.
                    self._times[task.sensing].learn(computed_s)
                if typical or outcome.restored:
                    task.expected_time.learn(computed_s, processor_s)
                    common = self._sessions.alike(session).times[task.sensing]
                    common.learn(computed_s, processor_s)
                self._succeeded(task, outcome, started_at, now)
            self._settling.append(session)
        return self._effects.take()

    def gone(self, call: int) -> list[ServiceEffect]:
        """Handle the end of a call by itself: its link has ended, and nobody awaits replies."""
        task = self._calls.drop(call)
        if task is not None:
            self._statistics.superseded += self._queue.drop(task)
        return self._effects.take()

    def next_jobs(self, now: float) -> list[ServiceEffect]:
        """Hand out jobs while workers are free; called whenever effects were carried out."""
        for session in self._settling:
            if not session.closed:
                self._limit_memory(session)
            self._queue.release_held(session)
        self._settling.clear()
        while (task := self._queue.take(now)) is not None:
            self._start_job(task, now)
        return self._effects.take()

    def tick(self, now: float) -> list[ServiceEffect]:
        """Handle the passing of time."""
        self._calls.send_progress(now)
        while (session := self._sessions.idle(now)) is not None:
            self._forget(session, "idle")
        return self._effects.take()

    def next_wakeup(self) -> float | None:
        """Return when :meth:`tick` is due if nothing happens before; None if never."""
        due = (self._calls.progress_at(), self._sessions.idle_at())
        return min((at for at in due if at is not None), default=None)

    # -- requests --------------------------------------------------------------------------------

    def _handle(self, call: int, request: Request, key: SessionKey, size: int, now: float) -> None:
        session = self._sessions.get(key)
        epoch = self._sessions.epoch_of(key)
        if request.epoch < epoch:
            text = f"epoch {request.epoch}: a robot of epoch {epoch} has taken this session over"
            self._calls.send_refused(call, request.number, "stale_epoch", text)
            return
        configuration = request.session_configuration
        if session is not None:
            if request.epoch > epoch:
                self._take_over(session, request.epoch, now)
            if (
                configuration is not None
                and pack_configuration(configuration) != session.configuration
            ):
                if request.epoch == epoch:
                    text = "this session was opened with another problem, settings or seed"
                    self._calls.send_refused(call, request.number, "invalid", text)
                    return
                self._forget(session, "opened anew")
                session = None
        if session is None:
            if configuration is None:
                self._calls.send_need_state(call, request.number, differs=False)
                return
            session = self._open_session(call, request, key, configuration, now)
            if session is None:
                return
        else:
            self._sessions.use(session, now)
        newest = request.number >= session.number
        known, task = self._answer_from_cache(session, call, request, now, newest=newest)
        if not newest:
            if not known:
                # A later request of this robot came before: this one is superseded.
                self._statistics.superseded += 1
                self._effects.append(EndCall(call))
            return
        session.number = request.number
        if not known:
            task = self._enqueue(session, call, request, size, now)
            if task is None:
                return
        self._supersede(session, task)

    def _open_session(
        self,
        call: int,
        request: Request,
        key: SessionKey,
        configuration: SessionConfiguration,
        now: float,
    ) -> Session | None:
        """Open a session; None if the robot was turned away."""
        limits = self._limits
        count = configuration.planning.particle_filter.num_particles
        if count > limits.max_particles:
            text = (
                f"particle_filter.num_particles {count}: this service takes at most "
                f"{limits.max_particles} (max_particles)"
            )
            self._calls.send_refused(call, request.number, "invalid", text)
            return None
        task_s, sensing_s = (time.mean_s for time in self._times)
        times = ExpectedTime(task_s, _INERTIA_OF_ONE), ExpectedTime(sensing_s, _INERTIA_OF_ONE)
        session = Session(key, request, configuration, times)
        session.known = self._problems.cost_of(session.owner, session.problem_key)
        self._sessions.alike(session).share_with(session)
        lane = session.lane_of(request)
        if self._queue[lane].is_overloaded(now, key[0]):
            self._sessions.note_epoch(key, request.epoch)
            self._reject_busy(call, request.number, key, lane, now)
            return None
        session.used_at = now
        while not self._sessions.has_room_for(session):
            unused = self._sessions.evictable_for(session)
            if unused is None:
                # It is free once another robot has left, not once the next decision is computed.
                self._sessions.note_epoch(key, request.epoch)
                least_ms = _NO_ROOM_RETRY_MS
                self._reject_busy(call, request.number, key, lane, now, least_ms=least_ms)
                return None
            self._forget(unused, _NO_ROOM)
        self._sessions.add(session)
        named = {"problem": configuration.problem, "particles": count, "epoch": request.epoch}
        self._note("session_opened", session, **named)
        return session

    def _take_over(self, session: Session, epoch: int, now: float) -> None:
        """Continue a session with the robot's next process; nothing waits for the previous one."""
        self._note("session_taken_over", session, epoch=epoch, previous_epoch=session.epoch)
        self._statistics.sessions_taken_over += 1
        # The next process numbers its requests anew, and does not know of an observation with which
        # the previous one had asked, but which it had not written down when it died.
        session.epoch, session.number = epoch, -1
        session.acknowledged = None
        self._sessions.use(session, now)
        self._supersede(session, None)

    def _answer_from_cache(
        self, session: Session, call: int, request: Request, now: float, *, newest: bool
    ) -> tuple[bool, PendingTask | None]:
        """Answer as far as the cache goes.

        Returns whether it has the answer, or will have it; and the task for which the call waits.
        """
        task = session.pending.get(request.digest)
        if task is not None:
            if task.request is None and not task.running:
                self._queue[task.lane].promote(task)
            self._statistics.attached += 1
            self._calls.attach(task, call, request.number, now)
            return True, task
        answer = session.answers.get(request.digest)
        if answer is None:
            return False, None
        asked = (request.trial, request.step, request.sensed)
        if (answer.trial, answer.step, answer.sensed) != asked:
            text = (
                f"trial {request.trial}, step {request.step}, sensed {request.sensed}: the state "
                f"of this digest has {answer.trial}, {answer.step}, {answer.sensed}"
            )
            self._calls.send_refused(call, request.number, "invalid", text)
            return True, None
        following = answer.following
        rest = None if following is None else session.pending.get(following)
        if following is not None and rest is None and following not in session.answers:
            if not newest or session.ahead is None or session.ahead_digest != following:
                del session.answers[request.digest]
                return False, None
            rest = self._prefetch(session, now)
        self._statistics.cache_hits += 1
        if answer.num_actions:
            self._calls.send_task(call, request.number, answer)
        if rest is not None:
            self._calls.attach(rest, call, request.number, now)
            return True, rest
        sensing = answer if following is None else session.answers[following]
        if sensing.sensing_action >= 0:
            digest = request.digest if following is None else following
            self._calls.send_sensing(call, request.number, digest, sensing)
        else:
            self._effects.append(EndCall(call))
        return True, None

    def _enqueue(
        self, session: Session, call: int, request: Request, size: int, now: float
    ) -> PendingTask | None:
        """Queue a task for a request; None if it was turned away."""
        if request.session_configuration is not None:
            # The session has it; one copy for each request that waits would count nowhere.
            request = msgspec.structs.replace(request, session_configuration=None)
        interval = session.planning.sensing_interval + 1
        sensing = not request.sensed and request.step % interval == 0
        lane = session.lane_of(request)
        waiting = next(
            (
                task
                for task in session.pending.values()
                if task.slot == REQUESTED and not task.running and task.lane == lane
            ),
            None,
        )
        if waiting is None and self._queue[lane].is_overloaded(now, session.owner):
            self._reject_busy(call, request.number, session.key, lane, now)
            return None
        if waiting is not None:
            # It keeps the turn of the request that it replaces, and adds nothing to the backlog.
            self._calls.end(waiting)
            self._statistics.superseded += 1
            session.remove_task(waiting)
            self._queue[lane].replace(waiting, request, sensing=sensing, size=size)
            session.pending[request.digest] = task = waiting
        else:
            task = PendingTask(
                session, request.digest, sensing=sensing, since=now, request=request, size=size
            )
            self._queue.enqueue(task)
        self._calls.attach(task, call, request.number, now)
        return task

    def _supersede(self, session: Session, keep: PendingTask | None) -> None:
        """Drop everything the robot waits for, except ``keep``."""
        for task in list(session.pending.values()):
            if task is not keep:
                self._calls.end(task)
                self._statistics.superseded += self._queue.drop(task)

    # -- work ------------------------------------------------------------------------------------

    def _prefetch(self, session: Session, now: float) -> PendingTask:
        """Queue the sensing part of the state ahead."""
        digest, state = session.ahead_digest, session.ahead
        task = PendingTask(session, digest, sensing=True, since=now, state=state)
        self._queue.enqueue(task)
        return task

    def _start_job(self, task: PendingTask, now: float) -> None:
        session, request = task.session, task.request
        state = task.starts_at()
        if (
            state is None
            and request is not None
            and request.checkpoint is None
            and session.states_of(request.trial)
        ):
            # The robot is behind what is remembered, or was elsewhere meanwhile.
            session.remove_task(task)
            for record in self._calls.detach(task):
                self._calls.send_need_state(record.call, record.number, differs=True)
            return
        alone = self._queue.is_alone(task)
        estimated_s = self._queue.limits_s[task.lane]
        expected_s = task.predicted_s(state)
        is_short = expected_s < math.inf
        problems = self._problems
        problem = (problems.shared if is_short else problems.acquire)(session.problem_key)
        if problem is None:
            expected_s = math.inf
        job = Job(
            task.kind,
            problem,
            self._make_problem,
            self._describe_error,
            session.configuration,
            session.planning if alone else session.single_core,
            session.seed,
            self._limits,
            request,
            state,
            self._pricing,
            session.price,
            session.known,
            None if task.lane == LONG else Cost(estimated_s, self._limits.max_medium_bytes),
            self._queue.most_s(task.lane, expected_s),
            # A long one would have to build it again.
            building_counts=task.lane != LONG,
            company=session.company,
            expected_s=expected_s,
            is_brief=task.lane <= BRIEF,
        )
        self._queue[task.lane].handed_out(task, job, now)
        self._effects.append(job)

    # -- outcomes --------------------------------------------------------------------------------

    def _postpone(self, task: PendingTask, job: Job, cost: Cost | None, now: float) -> None:
        """Queue a task again that takes more than its lane allows."""
        awaited = self._calls.is_awaited(task)
        try:
            has_room = self._queue.postpone(task, job, cost, now, awaited=awaited)
        except MessageError as error:
            for record in self._calls.detach(task):
                self._calls.send_refused(record.call, record.number, error.code, str(error))
            return
        if not has_room:
            for record in self._calls.detach(task):
                key = task.session.key
                self._reject_busy(record.call, record.number, key, task.lane, now)

    def _failed(self, task: PendingTask, outcome: JobResult) -> None:
        session, request = task.session, task.request
        if outcome.diverged and request is not None:
            self._statistics.states_diverged += 1
            self._note("state_diverged", session, trial=request.trial, step=request.step)
        if outcome.failure is not None:
            # Together with others it would fail for all: the next one is on a thread.
            task.expected_time.expect_long()
        for record in self._calls.detach(task):
            if outcome.failure is None:
                self._calls.send_need_state(
                    record.call, record.number, differs=outcome.differs, diverged=outcome.diverged
                )
            else:
                self._calls.send_refused(record.call, record.number, *outcome.failure)
        if not session.built:
            # There is nothing to keep: whoever asks again sends all of it.
            self._forget(session, "refused")

    def _succeeded(
        self, task: PendingTask, outcome: JobResult, started_at: float, now: float
    ) -> None:
        session, statistics = task.session, self._statistics
        self._sessions.mark_served(session)
        most = self._limits.answers_per_session
        computed_s = now - started_at
        computed_us = min(MAX_WORD, max(0, round(1e6 * computed_s)))
        if outcome.state is not None:
            session.acknowledged = outcome.state
            session.ahead, session.ahead_digest = outcome.ahead, outcome.ahead_digest
        if outcome.restored:
            statistics.restores += 1
            assert outcome.state is not None
            self._note("restored", session, trial=outcome.state.trial, step=outcome.state.step)
        state = task.state if outcome.state is None else outcome.state
        assert state is not None
        where = (state.trial, state.step, state.sensed, computed_us)
        self._effects.append(Computed(task.kind, computed_s, started_at - task.since))
        if task.sensing:
            statistics.sensing_parts += 1
            answer = CachedAnswer(*where, sensing_action=outcome.sensing_action)
            session.remember(task.digest, answer, most)
            self._send_sensing(task, task.digest, answer)
        else:
            statistics.task_parts += 1
            ahead, following = outcome.ahead, None
            if ahead is not None and needs_sensing(session.planning, ahead):
                following = outcome.ahead_digest
            answer = CachedAnswer(*where, outcome.num_actions, outcome.actions, following)
            session.remember(task.digest, answer, most)
            self._send_task(task, answer, now)

    def _send_task(self, task: PendingTask, answer: CachedAnswer, now: float) -> None:
        """Send the task part, and let the calls wait for the sensing part that follows."""
        session, following = task.session, answer.following
        self._calls.send_task_to_all(task, answer, now)
        if following is None:
            self._calls.end(task)
        elif following in session.answers:
            self._send_sensing(task, following, session.answers[following])
        elif self._calls.is_awaited(task):
            # Without a waiting call the robot has moved on.
            rest = session.pending.get(following) or self._prefetch(session, now)
            self._calls.move(task, rest)

    def _send_sensing(self, task: PendingTask, digest: bytes, answer: CachedAnswer) -> None:
        for record in self._calls.detach(task):
            self._calls.send_sensing(record.call, record.number, digest, answer)

    def _reject_busy(
        self, call: int, number: int, key: SessionKey, lane: int, now: float, least_ms: float = 1.0
    ) -> None:
        owner, session = key
        wait_ms = max(least_ms, 1e3 * self._queue[lane].wait_s(now, owner))
        self._calls.send_busy(call, number, session, wait_ms, self._queue.num_waiting)

    # -- sessions --------------------------------------------------------------------------------

    def _limit_memory(self, session: Session) -> None:
        """Count a session's memory; if all take too much, forget others, or its states."""
        sessions = self._sessions
        sessions.update_size(session)
        while sessions.over_budget:
            unused = sessions.largest_evictable()
            if unused is None or unused is session:
                break
            self._forget(unused, _NO_ROOM)
        if sessions.over_budget:
            # The others are all in use: this robot sends its state each time.
            sessions.drop_states(session)

    def _forget(self, session: Session, reason: str) -> None:
        self._supersede(session, None)
        self._sessions.forget(session)
        self._statistics.sessions_evicted += reason == _NO_ROOM
        self._note("evicted", session, reason=reason)

    def _note(self, event: str, session: Session, **fields: object) -> None:
        owner, key = session.key
        named = {} if owner is None else {"robot": owner}
        self._effects.report(event, **named, session=key[:4].hex(), **fields)
