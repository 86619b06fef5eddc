"""The threads around a service's machine: what comes in, what is computed, what is sent.

Two things cost a robot time beside the decision itself: to wake a thread on another core, which
takes longer than many a decision; and threads that hold the interpreter against each other, as all
of them do that run brief jobs. So as few threads as possible take part. While the service is idle,
a call is answered on the thread of the transport on which it came in, if that is known to take a
moment only and to run none but this project's code. All other calls and jobs wait in one queue,
from which one worker, the *leader*, takes them. It lets the machine handle the call, and if a brief
job comes of that, runs it and sends the answer, all by itself. Before a long job, which computes
without the interpreter, it lets another worker lead. There is one worker more than jobs may run at
a time, so that a call is heard, and if need be turned away, while all others compute.

To send can block, if whoever is to receive it does not read, for as long as a link can be silent,
and a job that was thought brief can take for ever. A leader that is held up is deposed; the
transport's thread cannot be, so it does nothing for a while once it was held up. Replies go into
*lanes*: one for each session, one for all messages that are none, and one for the calls that are
turned away unread. Of a lane one thread sends at a time, mostly one of the *senders*, of which one
more is started whenever the last free one begins. Only one thread at a time may answer by itself,
which saves a lone robot the hand-over.

The thread that calls :meth:`ServiceShell.wait` keeps the time: it has the signs of progress sent,
while the workers compute, deposes the leader, and sleeps without a break when no robot is about.
"""

from __future__ import annotations

import contextlib
import enum
import itertools
import os
import select
import threading
import traceback
from collections import deque
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Any, Literal, TypeAlias

import msgspec

from holdfast.errors import HoldfastError, UnknownProblemError
from holdfast.problems import registry
from holdfast.problems.problem import Problem
from holdfast.runtime.logs import EventSink, NullEventLog
from holdfast.runtime.transport.contract import IncomingCall, ServiceTransport
from holdfast.session.messages import Busy, MessageError, Opening, Request, decode_request, encode
from holdfast.session.service import Service
from holdfast.session.service_effects import Answer, Computed, Effect, End, Noted, Run
from holdfast.session.service_jobs import Job, Outcome
from holdfast.session.service_limits import ServiceStatistics

__all__ = ["KnownProblems", "ServiceBrokenError", "ServiceShell"]

DecisionHook: TypeAlias = Callable[[Literal["task", "sensing"], float, float], None]

_MAX_INCOMING = 4096
"""Calls that nobody has looked at yet."""

_MAX_INCOMING_BYTES = 128 << 20
"""Of these calls: two of the largest requests. One is let in, however large it is."""

_UNREAD_BUSY = [encode(Busy(0, retry_after_ms)) for retry_after_ms in range(100, 126)]
"""Used in turn, so that robots that were turned away together do not come back together."""

_MAX_SENDERS = 32
"""Threads that send, at most: so many robots' links can be blocked, and the others notice nothing.
"""

_HERE_BYTES = 32_000
"""Larger calls are not even decoded on the transport's thread."""

_BRIEF_S = 0.002
"""Jobs that may take longer run beside others."""

_HELD_UP_S = 0.02
"""What takes so long though it is brief is held up, by a robot that does not read or otherwise."""

_NOT_HERE_FOR_S = 10.0
"""For so long after the transport's thread was held up, it only hands over."""

_HEARD_AT_A_TIME = 16
"""Calls that are let in before it is a job's turn."""

_SENT_AT_A_TIME = 16
"""Calls of a lane that are sent to before it is another one's turn."""

_NOBODY = b""
"""The lane of messages that name no session."""

_UNREAD = b"unread"
"""The lane of those that are turned away unread: robots' calls may be among them."""

_TICK_S = 0.05
_STAYS_AWAKE_S = 1.0
"""After a call the timekeeper goes on ticking for this long: to wake it costs the next call."""

_LOGGED_AT_MOST_EVERY_S = 1.0
_RARELY_LOGGED = frozenset({"busy", "refused", "session_opened", "restored", "evicted"})
_WAKE = b"\0"


class ServiceBrokenError(HoldfastError):
    """A thread of the service failed: a defect. A new process is better than this one."""


class KnownProblems:
    """Builds the problems that a service decides for.

    Those that are registered are known by name. A class in somebody's file is code that a robot
    must not be able to choose, so it is known only if whoever starts the service has named it.

    Parameters
    ----------
    names : sequence of str
        Problems to have ready; ``module:Class`` among them.
    directory : Path or None
        Where their modules are looked for first.

    Raises
    ------
    UnknownProblemError
        If one of the names does not lead to a problem.
    """

    def __init__(self, names: Sequence[str] = (), directory: Path | None = None) -> None:
        self._classes = {
            name: registry.problem_class(name, search_directory=directory) for name in names
        }
        # msgspec (0.22) finds out about a struct's fields when the first one is made, and crashes
        # if a second thread makes one meanwhile.
        self._lock = threading.Lock()

    def __call__(self, opening: Opening) -> Problem:
        """Build the problem that an opening names.

        Raises
        ------
        UnknownProblemError
            If this service does not know it.
        ConfigurationError
            If its settings do not fit.
        """
        with self._lock:
            return self._build(opening)

    def _build(self, opening: Opening) -> Problem:
        name = opening.problem
        found = self._classes.get(name) or self._registered(name)
        if name in registry.BUILT_IN:
            # Their own check is enough to know that all is well; what is not, the configuration
            # can explain, but takes long to import.
            with contextlib.suppress(HoldfastError, msgspec.ValidationError):
                built: Problem = found.from_settings(opening.model, opening.state_space_planner)
                return built
        from holdfast.configuration import build_problem

        return build_problem(name, found, opening.model, opening.state_space_planner)

    def _registered(self, name: str) -> type[Any]:
        if ":" not in name:
            with contextlib.suppress(UnknownProblemError):
                return registry.problem_class(name)
        known = ", ".join(sorted({*registry.names(), *self._classes}))
        hint = "; a class in a file must be named when the service is started (--problem)"
        raise UnknownProblemError(
            f"problem {name}: is not known to this service{hint if ':' in name else ''}; known are "
            f"{known}"
        )


class _Rest(enum.Enum):
    """Instead of a call or job: nothing new."""

    REST = enum.auto()


_REST = _Rest.REST


class _OpenCall:
    """A call, and what is still to be sent to it.

    Replies are put here in the order in which the machine gives them, and sent in that order,
    whichever threads do it.
    """

    __slots__ = ("_incoming", "_lock", "lane", "outbox")

    def __init__(self, incoming: IncomingCall, lane: bytes) -> None:
        self._incoming = incoming
        self._lock = threading.Lock()
        self.lane = lane
        self.outbox: deque[bytes | None] = deque()

    def send(self) -> None:
        with self._lock:
            while self.outbox:
                payload = self.outbox.popleft()
                if payload is None:
                    self._incoming.end()
                else:
                    self._incoming.reply(payload)


class _Senders:
    """Sends what calls have in their outboxes, so that one that blocks holds up its lane alone.

    Parameters
    ----------
    failed : callable
        Is called on a thread that fails, which is a defect.
    """

    def __init__(self, failed: Callable[[], None]) -> None:
        self._failed = failed
        self._lock = threading.Lock()
        # Those in which something waits or is being sent.
        self._lanes: dict[bytes, deque[_OpenCall]] = {}
        self._turns: SimpleQueue[bytes | None] = SimpleQueue()
        self._by_itself = threading.Lock()
        self._threads: list[threading.Thread] = []
        self._free = 0
        self._closed = False

    def start(self) -> None:
        """Begin to send."""
        with self._lock:
            self._add_thread()

    def post(self, calls: Collection[_OpenCall]) -> None:
        """Have the outboxes of these calls sent; never blocks."""
        for lane in self._entered(calls):
            self._turns.put(lane)

    def send(self, calls: Collection[_OpenCall]) -> None:
        """Send the outboxes of these calls, at once if no other thread is doing that.

        What cannot be sent at once is posted.
        """
        for lane in self._entered(calls):
            # What names no session is nobody's answer.
            if lane != _NOBODY and self._by_itself.acquire(blocking=False):
                try:
                    self._send(lane)
                finally:
                    self._by_itself.release()
            else:
                self._turns.put(lane)

    def close(self, until: float) -> None:
        """Let the threads go; those that are blocked are not waited for beyond this time."""
        with self._lock:
            self._closed = True
            threads = list(self._threads)
        for _ in threads:
            self._turns.put(None)
        for thread in threads:
            thread.join(max(0.0, until - monotonic()))

    def _entered(self, calls: Collection[_OpenCall]) -> list[bytes]:
        """Put calls into their lanes; return the lanes that nobody was taking care of."""
        idle = []
        with self._lock:
            for call in calls:
                lane = self._lanes.get(call.lane)
                if lane is None:
                    self._lanes[call.lane] = deque((call,))
                    idle.append(call.lane)
                else:
                    lane.append(call)
        return idle

    def _send(self, lane: bytes) -> None:
        """Send the first that wait in a lane, and leave the rest for another turn."""
        calls = self._lanes[lane]
        for _ in range(_SENT_AT_A_TIME):
            with self._lock:
                if not calls:
                    del self._lanes[lane]
                    return
                call = calls.popleft()
            call.send()
        self._turns.put(lane)

    def _add_thread(self) -> None:
        """Start another thread; the lock is held."""
        if self._closed or len(self._threads) >= _MAX_SENDERS:
            return
        thread = threading.Thread(
            target=self._run, name=f"holdfast-sender-{len(self._threads)}", daemon=True
        )
        self._free += 1
        self._threads.append(thread)
        thread.start()

    def _run(self) -> None:
        try:
            while (lane := self._turns.get()) is not None:
                with self._lock:
                    self._free -= 1
                    if not self._free:
                        # This one may be held up; somebody has to be there for the next lane.
                        self._add_thread()
                self._send(lane)
                with self._lock:
                    self._free += 1
        except BaseException:  # noqa: BLE001 - half a service is worse than none
            self._failed()


class ServiceShell:
    """Joins a service's machine to a transport.

    Parameters
    ----------
    service : Service
    transport : ServiceTransport
        Not started yet.
    workers : int
        As the machine was told.
    events : EventSink
        Is told what happens.
    on_decision : callable or None
        Is called with the kind, the time computed and the time waited of each part of an answer.
    max_incoming, max_incoming_bytes : int
        Calls that nobody has looked at yet, and their size; what is beyond is turned away unread.

    Attributes
    ----------
    wakeup_descriptor : int
        Numbers of signals that are written here let :meth:`wait` return.
    """

    def __init__(
        self,
        service: Service,
        transport: ServiceTransport,
        workers: int,
        events: EventSink | None = None,
        on_decision: DecisionHook | None = None,
        max_incoming: int = _MAX_INCOMING,
        max_incoming_bytes: int = _MAX_INCOMING_BYTES,
    ) -> None:
        self._service = service
        self._transport = transport
        self._events = events or NullEventLog()
        self._on_decision = on_decision
        self._max_incoming = max_incoming
        self._max_incoming_bytes = max_incoming_bytes
        self._lock = threading.Lock()
        self._incoming_lock = threading.Lock()
        self._incoming = 0
        self._incoming_bytes = 0
        self._senders = _Senders(self._broke)
        self._queue: SimpleQueue[IncomingCall | Run | _Rest | None] = SimpleQueue()
        # The leader's; one that was deposed may not know yet.
        self._ready: deque[Run] = deque()
        self._calls: dict[int, _OpenCall] = {}
        self._numbers = itertools.count(1)
        self._unread = 0
        self._unread_logged = 0
        self._logged: dict[str, tuple[float, int, Noted]] = {}
        self._heard_at = -_STAYS_AWAKE_S
        # The transport's thread is free for what comes from this time on.
        self._here = threading.Lock()
        self._here_from = 0.0
        # Who leads holds the baton; a term ends when it is passed on, by whomever.
        self._baton = threading.Semaphore()
        self._term = 0
        # The term of a leader that is at work, and since when.
        self._at_work: tuple[int, float] | None = None
        self._wakes_at = 0.0
        self._failure: str | None = None
        self._stopped = False
        self._woken_by, self.wakeup_descriptor = os.pipe()
        os.set_blocking(self._woken_by, False)
        os.set_blocking(self.wakeup_descriptor, False)
        self._threads = [
            threading.Thread(target=self._work, name=f"holdfast-worker-{index}", daemon=True)
            for index in range(workers + 1)
        ]

    def start(self) -> None:
        """Be there for robots.

        Raises
        ------
        TransportError
            If the transport cannot be started.
        """
        self._senders.start()
        for thread in self._threads:
            thread.start()
        self._transport.start(self.deliver)

    def statistics(self) -> ServiceStatistics:
        """Return a copy of what the machine counts, from any thread."""
        with self._lock:
            statistics = self._service.statistics
            copy = msgspec.structs.replace(statistics, refusals=dict(statistics.refusals))
        copy.busy += self._unread
        return copy

    def wait(self, inputs: Collection[int] = ()) -> int:
        """Keep the time until there is a reason to stop.

        Parameters
        ----------
        inputs : collection of int
            Descriptors at whose end the service is to stop; what is read from them is dropped.

        Returns
        -------
        int
            The signal whose number was written to ``wakeup_descriptor``
            (:func:`signal.set_wakeup_fd`); 0 if an input has ended or :meth:`stop` was called.

        Raises
        ------
        ServiceBrokenError
            If a thread has failed.
        """
        watched = [self._woken_by, *inputs]
        while True:
            timeout_s = self._tick()
            ready, _, _ = select.select(watched, (), (), timeout_s)
            for descriptor in ready:
                try:
                    data = os.read(descriptor, 4096)
                except BlockingIOError:
                    continue
                if descriptor != self._woken_by:
                    if not data:
                        return 0
                elif number := max(data):
                    return number
            if self._failure is not None:
                raise ServiceBrokenError(f"a worker of the service failed\n{self._failure}")
            if self._stopped:
                return 0

    def stop(self) -> None:
        """Let :meth:`wait` return, from any thread."""
        self._stopped = True
        self._wake()

    def close(self, timeout_s: float = 0.8) -> None:
        """End all calls and links, and let the threads go; within about this time."""
        self._transport.close(timeout_s)
        for _ in self._threads:
            self._queue.put(None)
        until = monotonic() + 0.1
        for thread in self._threads:
            if thread.is_alive():
                # One that computes is not waited for; it ends with the process.
                thread.join(max(0.0, until - monotonic()))
        self._senders.close(until)
        if not any(thread.is_alive() for thread in self._threads):
            with self._lock:
                descriptors = self._woken_by, self.wakeup_descriptor
                self._woken_by = self.wakeup_descriptor = -1
            for descriptor in descriptors:
                if descriptor >= 0:
                    os.close(descriptor)

    def deliver(self, incoming: IncomingCall) -> None:
        """Take a call from the transport; as good as never blocks."""
        size = incoming.size_bytes
        with self._incoming_lock:
            full = self._incoming >= self._max_incoming or (
                self._incoming > 0 and self._incoming_bytes + size > self._max_incoming_bytes
            )
            if full:
                self._unread += 1
                busy = _UNREAD_BUSY[self._unread % len(_UNREAD_BUSY)]
            else:
                self._incoming += 1
                self._incoming_bytes += size
        if full:
            if self._unread == self._unread_logged + 1:
                self._wake()  # to log it
            call = _OpenCall(incoming, _UNREAD)
            call.outbox += (busy, None)
            self._senders.post((call,))
        elif (
            size <= _HERE_BYTES
            and self._queue.empty()
            and self._at_work is None
            and self._here.acquire(blocking=False)
        ):
            try:
                self._answer_here(incoming)
            finally:
                self._here.release()
        else:
            self._queue.put(incoming)

    # -- the transport's thread ------------------------------------------------------------------

    def _answer_here(self, incoming: IncomingCall) -> None:
        """Answer a call on the transport's thread, or hand over to a worker what takes longer.

        That thread is taken for half of the time at most: what it has not read yet no limit can
        turn away.
        """
        began = monotonic()
        if began < self._here_from:
            self._queue.put(incoming)
            return
        try:
            runs = self._receive(incoming)
            while runs:
                run, *others = runs
                for other in others:
                    self._queue.put(other)
                if run.expected_s > _BRIEF_S or run.job.problem_name not in registry.BUILT_IN:
                    self._queue.put(run)
                    break
                runs = self._finish(run.job, run.job.run())
        except BaseException:  # noqa: BLE001 - half a service is worse than none
            self._broke()
        now = monotonic()
        took_s = now - began
        self._here_from = now + (_NOT_HERE_FOR_S if took_s > _HELD_UP_S else took_s)

    # -- workers ---------------------------------------------------------------------------------

    def _work(self) -> None:
        try:
            while True:
                self._baton.acquire()
                if not self._lead():
                    return
        except BaseException:  # noqa: BLE001 - half a service is worse than none
            self._broke()

    def _lead(self) -> bool:
        """Take calls and jobs as long as this thread's term lasts.

        Calls go first, up to a number, so that the machine knows what waits: then it chooses what
        is computed next, and turns away what is too much. Returns False if the service is being
        closed.
        """
        term = self._term
        heard = 0
        while self._term == term:
            if not self._ready:
                self._at_work = None
                item = self._queue.get()
            elif heard < _HEARD_AT_A_TIME:
                try:
                    item = self._queue.get_nowait()
                except Empty:
                    item = _REST
            else:
                item = _REST
            self._at_work = (term, monotonic())
            if item is None:
                self._pass_on(term)
                return False
            if isinstance(item, Run):
                self._make_ready(term, [item])
            elif item is not _REST:
                heard += 1
                self._make_ready(term, self._receive(item))
            else:
                heard = 0
                try:
                    run = self._ready.popleft()
                except IndexError:
                    continue  # whoever leads now was faster
                if run.expected_s > _BRIEF_S:
                    self._pass_on(term)
                self._make_ready(term, self._finish(run.job, run.job.run()))
        return True

    def _make_ready(self, term: int, runs: list[Run]) -> None:
        """Have jobs run: by this thread, if its term lasts, else by the leader."""
        mine = self._term == term
        for run in runs:
            if mine:
                self._ready.append(run)
            else:
                self._queue.put(run)
        if mine and self._term != term:
            self._queue.put(_REST)  # deposed just now: who leads may wait for something to come

    def _pass_on(self, term: int) -> None:
        """End a term, if it has not ended yet, and let another worker lead."""
        with self._incoming_lock:
            if self._term != term:
                return
            self._term += 1
            self._at_work = None
        self._baton.release()

    def _broke(self) -> None:
        """Let :meth:`wait` raise what is being handled on this thread."""
        self._failure = traceback.format_exc()
        self._wake()

    def _receive(self, incoming: IncomingCall) -> list[Run]:
        size = incoming.size_bytes
        request: Request | MessageError
        try:
            # Large ones take their time; the other workers have the machine meanwhile.
            request = decode_request(incoming.payload)
        except MessageError as error:
            request = error
        finally:
            with self._incoming_lock:
                self._incoming -= 1
                self._incoming_bytes -= size
        lane = request.session if isinstance(request, Request) else _NOBODY
        call = _OpenCall(incoming, lane)
        with self._lock:
            number = next(self._numbers)
            self._calls[number] = call
            now = monotonic()
            self._heard_at = now
            carried = self._sorted(self._service.receive_request(number, request, size, now))
            due = self._service.next_wakeup()
            late = due is not None and due < self._wakes_at
            if late:
                self._wakes_at = now
        if late:
            self._wake()
        return self._carry_out(*carried)

    def _finish(self, job: Job, outcome: Outcome) -> list[Run]:
        with self._lock:
            carried = self._sorted(self._service.finished(job, outcome, monotonic()))
        return self._carry_out(*carried)

    def _sorted(
        self, effects: list[Effect]
    ) -> tuple[list[_OpenCall], list[Run], list[Noted | Computed]]:
        """Put replies where they are sent from; the lock is held."""
        calls: list[_OpenCall] = []
        runs: list[Run] = []
        notes: list[Noted | Computed] = []
        for effect in effects:
            if isinstance(effect, Answer):
                call = self._calls[effect.call]
                call.outbox.append(effect.payload)
                calls.append(call)
            elif isinstance(effect, End):
                call = self._calls.pop(effect.call)
                call.outbox.append(None)
                calls.append(call)
            elif isinstance(effect, Run):
                runs.append(effect)
            else:
                notes.append(effect)
        return calls, runs, notes

    def _carry_out(
        self, calls: list[_OpenCall], runs: list[Run], notes: list[Noted | Computed]
    ) -> list[Run]:
        """Send, and return what is to be run."""
        self._senders.send(calls)
        self._take_note(notes)
        return runs

    def _take_note(self, notes: list[Noted | Computed]) -> None:
        for note in notes:
            if isinstance(note, Noted):
                self._log(note)
            elif self._on_decision is not None:
                self._on_decision(note.kind, note.computed_s, note.waited_s)

    # -- time ------------------------------------------------------------------------------------

    def _tick(self) -> float | None:
        """Let the machine take note of the time; return how long it can then be left alone."""
        at_work = self._at_work
        if at_work is not None and monotonic() - at_work[1] > _HELD_UP_S:
            self._pass_on(at_work[0])
        with self._lock:
            now = monotonic()
            calls, _, notes = self._sorted(self._service.tick(now))
            due = self._service.next_wakeup()
            if now - self._heard_at < _STAYS_AWAKE_S:
                due = now + _TICK_S if due is None else min(due, now + _TICK_S)
            for logged_at, omitted, _ in self._logged.values():
                tell_at = logged_at + _LOGGED_AT_MOST_EVERY_S
                if omitted and tell_at > now:
                    due = tell_at if due is None else min(due, tell_at)
            self._wakes_at = float("inf") if due is None else due
        self._senders.post(calls)
        self._take_note(notes)
        self._log_omitted(now)
        return None if due is None else max(0.0, due - monotonic())

    def _wake(self) -> None:
        # It may be full, then somebody has woken it already, or closed.
        with contextlib.suppress(OSError):
            os.write(self.wakeup_descriptor, _WAKE)

    def _log(self, note: Noted) -> None:
        """Log an event; the frequent ones only so often, with the number of those left out."""
        if note.event not in _RARELY_LOGGED:
            self._events.event(note.event, **note.fields)
            return
        now = monotonic()
        with self._lock:
            logged_at, omitted, _ = self._logged.get(
                note.event, (-_LOGGED_AT_MOST_EVERY_S, 0, note)
            )
            tell_at = logged_at + _LOGGED_AT_MOST_EVERY_S
            omit = now < tell_at
            self._logged[note.event] = (logged_at, omitted + 1, note) if omit else (now, 0, note)
            late = omit and tell_at < self._wakes_at
            if late:
                self._wakes_at = now
        if late:
            self._wake()
        if not omit:
            self._log_one(note, omitted)

    def _log_omitted(self, now: float) -> None:
        """Log the last of those that were left out, once its time has come, with their number."""
        told = []
        with self._lock:
            for event, (logged_at, omitted, note) in self._logged.items():
                if omitted and logged_at + _LOGGED_AT_MOST_EVERY_S <= now:
                    self._logged[event] = (now, 0, note)
                    told.append((note, omitted - 1))
        for note, omitted in told:
            self._log_one(note, omitted)
        unread = self._unread
        if unread != self._unread_logged:
            self._unread_logged = unread
            self._log(Noted("busy", {"turned_away_unread": unread}))

    def _log_one(self, note: Noted, omitted: int) -> None:
        more = {"omitted": omitted} if omitted else {}
        self._events.event(note.event, **note.fields, **more)
