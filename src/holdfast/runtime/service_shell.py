"""The threads around a service's machine: what comes in, what is computed, what is sent.

Two things cost a robot time beside the decision itself: to wake a thread on another core, which
takes longer than many a decision; and threads that take the interpreter from each other, as all of
them do that run brief jobs. So as few threads as possible take part. Calls and jobs wait in one
queue, from which one worker, the *leader*, takes them. It lets the machine handle the call, and if
a brief job comes of that, runs it and sends the answer, all by itself. Before a long job, which
computes without the interpreter, it lets another worker lead. There is one worker more than jobs
may run at a time, so that a call is heard, and if need be turned away, while all others compute.

Any of that can be held up: a reply blocks if whoever is to receive it does not read, and a job that
was thought brief can take for ever. A leader that is held up is deposed (after 20 to 70 ms), and
another one leads. The transport's threads, on which all calls come in, do nothing but hand over.
Replies go through :mod:`~holdfast.runtime.senders`, in one lane for each session, one for all
messages that are none, and one for the calls that are turned away unread. Only one thread at a time
may send by itself, which saves a lone robot the hand-over.

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
from collections.abc import Callable, Collection
from queue import Empty, SimpleQueue
from time import monotonic
from typing import Literal, TypeAlias

import msgspec

from holdfast.errors import HoldfastError
from holdfast.runtime.logs import CountedEvent, EventRates, EventSink, NullEventLog
from holdfast.runtime.senders import NOBODY, Senders
from holdfast.runtime.transport.contract import IncomingCall, ServiceTransport
from holdfast.session.messages import Busy, MessageError, Request, decode_request, encode
from holdfast.session.service import Service
from holdfast.session.service_effects import Answer, Computed, Effect, End, Noted, Run
from holdfast.session.service_jobs import Job
from holdfast.session.service_limits import ServiceStatistics

__all__ = ["ServiceBrokenError", "ServiceShell"]

DecisionHook: TypeAlias = Callable[[Literal["task", "sensing"], float, float], None]

_MAX_INCOMING = 4096
"""Calls that nobody has looked at yet."""

_MAX_INCOMING_BYTES = 128 << 20
"""Of these calls: two of the largest requests. One is let in, however large it is."""

_UNREAD_BUSY = [encode(Busy(0, retry_after_ms)) for retry_after_ms in range(100, 126)]
"""Used in turn, so that robots that were turned away together do not come back together."""

_BRIEF_S = 0.002
"""Jobs that may take longer run beside others."""

_HELD_UP_S = 0.02
"""A leader that is at work for so long is held up: by a robot that does not read, or otherwise."""

_HEARD_AT_A_TIME = 16
"""Calls that are let in before it is a job's turn."""

_UNREAD = b"unread"
"""The lane of those that are turned away unread: robots' calls may be among them."""

_TICK_S = 0.05
_STAYS_AWAKE_S = 1.0
"""After a call the timekeeper goes on ticking for this long: to wake it costs the next call."""

_RARELY_LOGGED = frozenset(
    {"busy", "refused", "session_opened", "session_taken_over", "restored", "evicted"}
)
_WAKE = b"\0"


class ServiceBrokenError(HoldfastError):
    """A thread of the service failed: a defect. A new process is better than this one."""


class _Rest(enum.Enum):
    """Instead of a call or job: nothing new."""

    REST = enum.auto()


_REST = _Rest.REST


class _Term:
    """One worker's time as the leader.

    Attributes
    ----------
    since : float or None
        When it began what it is doing; None while it waits for something to do.
    """

    __slots__ = ("since",)

    def __init__(self) -> None:
        self.since: float | None = None


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
            # No more than there is now: a robot that reads slowly would keep this thread for ever.
            for _ in range(len(self.outbox)):
                payload = self.outbox.popleft()
                if payload is None:
                    self._incoming.end()
                else:
                    self._incoming.reply(payload)


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
        self._senders = Senders("holdfast-sender", self._broke)
        self._queue: SimpleQueue[IncomingCall | Run | _Rest | None] = SimpleQueue()
        self._calls: dict[int, _OpenCall] = {}
        self._numbers = itertools.count(1)
        self._unread = 0
        self._unread_logged = 0
        self._rates = EventRates(burst=1)
        self._heard_at = -_STAYS_AWAKE_S
        # Who leads holds the baton; it is passed on, by whomever, when the term ends. What is ready
        # to run belongs to the leader of the moment; both are changed under this lock.
        self._leading = threading.Lock()
        self._baton = threading.Semaphore()
        self._term: _Term | None = None
        self._ready: deque[Run] = deque()
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
        """Take a call from the transport; never blocks."""
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
        else:
            now = monotonic()
            self._heard_at = now
            if self._wakes_at > now + _TICK_S:
                # Somebody may have to be deposed, or told that his request is in work.
                self._wakes_at = now
                self._wake()
            self._queue.put(incoming)

    # -- workers ---------------------------------------------------------------------------------

    def _work(self) -> None:
        try:
            while True:
                self._baton.acquire()
                term = _Term()
                with self._leading:
                    self._term = term
                if not self._lead(term):
                    return
        except BaseException:  # noqa: BLE001 - half a service is worse than none
            self._broke()

    def _lead(self, term: _Term) -> bool:
        """Take calls and jobs as long as a term lasts.

        Calls go first, up to a number, so that the machine knows what waits: then it chooses what
        is computed next, and turns away what is too much. Returns False if the service is being
        closed.
        """
        heard = 0
        while self._term is term:
            item = self._next(term, look=heard < _HEARD_AT_A_TIME)
            term.since = monotonic()
            if self._term is not term:
                # Deposed while it waited: this is for whoever leads now.
                self._queue.put(item)
            elif item is None:
                self._pass_on(term)
                return False
            elif isinstance(item, Run):
                self._make_ready([item], term)
            elif item is not _REST:
                heard += 1
                self._receive(item, term)
            elif (run := self._take_ready(term)) is not None:
                heard = 0
                if run.expected_s > _BRIEF_S:
                    self._pass_on(term)
                self._run(run.job, term)
        return True

    def _next(self, term: _Term, *, look: bool) -> IncomingCall | Run | _Rest | None:
        """Return what has come; if there is something to run, do not wait for more."""
        if not self._ready:
            term.since = None
            return self._queue.get()
        if look:
            with contextlib.suppress(Empty):
                return self._queue.get_nowait()
        return _REST

    def _take_ready(self, term: _Term) -> Run | None:
        with self._leading:
            return self._ready.popleft() if self._ready and self._term is term else None

    def _make_ready(self, runs: list[Run], term: _Term) -> None:
        """Have jobs run: by this thread, if its term lasts, else by the leader."""
        with self._leading:
            if self._term is term:
                self._ready += runs
                return
        for run in runs:
            self._queue.put(run)

    def _pass_on(self, term: _Term) -> None:
        """End a term, if it has not ended yet, and let another worker lead."""
        with self._leading:
            if self._term is not term:
                return
            self._term = None
        self._baton.release()

    def _depose(self, now: float) -> None:
        """Let another worker lead if the leader is held up."""
        term = self._term
        since = None if term is None else term.since
        if term is not None and since is not None and now - since > _HELD_UP_S:
            self._pass_on(term)

    def _broke(self) -> None:
        """Let :meth:`wait` raise what is being handled on this thread."""
        self._failure = traceback.format_exc()
        self._wake()

    def _receive(self, incoming: IncomingCall, term: _Term) -> None:
        size = incoming.size_bytes
        request: Request | MessageError
        try:
            # Large ones take their time; the other threads have the machine meanwhile.
            request = decode_request(incoming.payload)
        except MessageError as error:
            request = error.retold()
        finally:
            with self._incoming_lock:
                self._incoming -= 1
                self._incoming_bytes -= size
        lane = request.session if isinstance(request, Request) else NOBODY
        call = _OpenCall(incoming, lane)
        with self._lock:
            number = next(self._numbers)
            self._calls[number] = call
            effects = self._service.receive_request(number, request, size, monotonic())
            carried = self._sorted(effects)
        self._carry_out(*carried, term)

    def _run(self, job: Job, term: _Term) -> None:
        with self._lock:
            self._service.begun(job, monotonic())
        outcome = job.run()
        with self._lock:
            carried = self._sorted(self._service.finished(job, outcome, monotonic()))
        self._carry_out(*carried, term)

    def _sorted(
        self, effects: list[Effect], *, only_if_nothing_waits: bool = False
    ) -> tuple[list[_OpenCall], list[Run], list[Noted | Computed]]:
        """Put replies where they are sent from; the lock is held.

        A sign of progress need not be sent to a robot to whom something is being sent.
        """
        calls: list[_OpenCall] = []
        runs: list[Run] = []
        notes: list[Noted | Computed] = []
        for effect in effects:
            if isinstance(effect, Answer):
                call = self._calls[effect.call]
                if only_if_nothing_waits and call.outbox:
                    continue
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
        self,
        calls: list[_OpenCall],
        runs: list[Run],
        notes: list[Noted | Computed],
        term: _Term,
    ) -> None:
        # In this order: whoever leads when this thread is held up in sending finds the jobs.
        if runs:
            self._make_ready(runs, term)
        self._senders.send(calls)
        self._take_note(notes)

    def _take_note(self, notes: list[Noted | Computed]) -> None:
        for note in notes:
            if isinstance(note, Noted):
                self._log(note)
            elif self._on_decision is not None:
                self._on_decision(note.kind, note.computed_s, note.waited_s)

    # -- time ------------------------------------------------------------------------------------

    def _tick(self) -> float | None:
        """Let the machine take note of the time; return how long it can then be left alone."""
        self._depose(monotonic())
        with self._lock:
            now = monotonic()
            calls, _, notes = self._sorted(self._service.tick(now), only_if_nothing_waits=True)
            due = self._service.next_wakeup()
            if now - self._heard_at < _STAYS_AWAKE_S:
                due = now + _TICK_S if due is None else min(due, now + _TICK_S)
            omitted = self._rates.due(now)
            tell_at = self._rates.next_due()
            if tell_at is not None:
                due = tell_at if due is None else min(due, tell_at)
            self._wakes_at = float("inf") if due is None else due
        self._senders.post(calls)
        self._take_note(notes)
        self._log_omitted(omitted)
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
            omitted = self._rates.admit(note.event, note.event, note.fields, now)
            tell_at = self._rates.next_due()
            late = omitted is None and tell_at is not None and tell_at < self._wakes_at
            if late:
                self._wakes_at = now
        if late:
            self._wake()
        if omitted is not None:
            self._log_one(CountedEvent(note.event, note.fields, omitted))

    def _log_omitted(self, events: list[CountedEvent]) -> None:
        """Log events that were left out and whose time has come, and who was turned away unread."""
        for event in events:
            self._log_one(event)
        unread = self._unread
        if unread != self._unread_logged:
            self._unread_logged = unread
            self._log(Noted("busy", {"turned_away_unread": unread}))

    def _log_one(self, event: CountedEvent) -> None:
        self._events.event(event.name, **event.told())
