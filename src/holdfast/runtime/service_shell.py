"""The threads around a service's machine: what comes in, what is computed, what is sent.

Few threads do everything, because each hand-over from one to another costs a robot time. They take
calls and jobs from one queue. The one that takes a call lets the machine handle it, and if a job
comes of that, runs it and sends the answer, all by itself. There is one thread more than jobs may
run at a time, so that a call is heard, and if need be turned away, while all others compute.

The thread that calls :meth:`ServiceShell.wait` keeps the time: it sends the signs of progress,
while the workers compute, and it sleeps without a break when no robot is about.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import select
import threading
import traceback
from collections import deque
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from queue import SimpleQueue
from time import monotonic
from typing import Any, Literal, TypeAlias

import msgspec

from holdfast.errors import HoldfastError, UnknownProblemError
from holdfast.problems import registry
from holdfast.problems.problem import Problem
from holdfast.runtime.logs import EventSink, NullEventLog
from holdfast.runtime.transport.contract import IncomingCall, ServiceTransport
from holdfast.session.messages import Busy, Opening, encode
from holdfast.session.service import (
    Answer,
    Computed,
    Effect,
    End,
    Job,
    Noted,
    Run,
    Service,
    ServiceStatistics,
)

__all__ = ["KnownProblems", "ServiceBrokenError", "ServiceShell"]

DecisionHook: TypeAlias = Callable[[Literal["task", "sensing"], float, float], None]

_MAX_INCOMING = 4096
"""Calls that nobody has looked at yet."""

_UNREAD_BUSY = encode(Busy(0, 100))
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


class _OpenCall:
    """A call, and what is still to be sent to it.

    Replies are put here in the order in which the machine gives them, and sent in that order,
    whichever threads do it.
    """

    __slots__ = ("_incoming", "_lock", "outbox")

    def __init__(self, incoming: IncomingCall) -> None:
        self._incoming = incoming
        self._lock = threading.Lock()
        self.outbox: deque[bytes | None] = deque()

    def send(self) -> None:
        with self._lock:
            while self.outbox:
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
    max_incoming : int
        Calls beyond this that nobody has looked at yet are turned away unread.

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
    ) -> None:
        self._service = service
        self._transport = transport
        self._events = events or NullEventLog()
        self._on_decision = on_decision
        self._max_incoming = max_incoming
        self._lock = threading.Lock()
        self._queue: SimpleQueue[IncomingCall | Job | None] = SimpleQueue()
        self._calls: dict[int, _OpenCall] = {}
        self._numbers = itertools.count(1)
        self._unread = 0
        self._logged: dict[str, tuple[float, int]] = {}
        self._heard_at = -_STAYS_AWAKE_S
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
        if not any(thread.is_alive() for thread in self._threads):
            with self._lock:
                descriptors = self._woken_by, self.wakeup_descriptor
                self._woken_by = self.wakeup_descriptor = -1
            for descriptor in descriptors:
                if descriptor >= 0:
                    os.close(descriptor)

    def deliver(self, incoming: IncomingCall) -> None:
        """Take a call from the transport; never blocks."""
        if self._queue.qsize() >= self._max_incoming:
            self._unread += 1
            incoming.reply(_UNREAD_BUSY)
            incoming.end()
        else:
            self._queue.put(incoming)

    # -- workers ---------------------------------------------------------------------------------

    def _work(self) -> None:
        try:
            while (item := self._queue.get()) is not None:
                job = item if isinstance(item, Job) else self._receive(item)
                while job is not None:
                    outcome = job.run()
                    job = self._finish(job, outcome)
        except Exception:  # noqa: BLE001 - half a service is worse than none
            self._failure = traceback.format_exc()
            self._wake()

    def _receive(self, incoming: IncomingCall) -> Job | None:
        payload = incoming.payload
        call = _OpenCall(incoming)
        with self._lock:
            number = next(self._numbers)
            self._calls[number] = call
            now = monotonic()
            self._heard_at = now
            carried = self._sorted(self._service.receive(number, payload, now))
            due = self._service.next_wakeup()
            late = due is not None and due < self._wakes_at
            if late:
                self._wakes_at = now
        if late:
            self._wake()
        return self._carry_out(*carried)

    def _finish(self, job: Job, outcome: Any) -> Job | None:
        with self._lock:
            carried = self._sorted(self._service.finished(job, outcome, monotonic()))
        return self._carry_out(*carried)

    def _sorted(
        self, effects: list[Effect]
    ) -> tuple[list[_OpenCall], list[Job], list[Noted | Computed]]:
        """Put replies where they are sent from; the lock is held."""
        calls: list[_OpenCall] = []
        jobs: list[Job] = []
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
                jobs.append(effect.job)
            else:
                notes.append(effect)
        return calls, jobs, notes

    def _carry_out(
        self, calls: list[_OpenCall], jobs: list[Job], notes: list[Noted | Computed]
    ) -> Job | None:
        """Send, hand jobs to other workers, and return the one for this worker."""
        for job in jobs[1:]:
            self._queue.put(job)
        for call in calls:
            call.send()
        for note in notes:
            if isinstance(note, Noted):
                self._log(note)
            elif self._on_decision is not None:
                self._on_decision(note.kind, note.computed_s, note.waited_s)
        return jobs[0] if jobs else None

    # -- time ------------------------------------------------------------------------------------

    def _tick(self) -> float | None:
        """Let the machine take note of the time; return how long it can then be left alone."""
        with self._lock:
            now = monotonic()
            carried = self._sorted(self._service.tick(now))
            due = self._service.next_wakeup()
            if now - self._heard_at < _STAYS_AWAKE_S:
                due = now + _TICK_S if due is None else min(due, now + _TICK_S)
            self._wakes_at = float("inf") if due is None else due
        self._carry_out(*carried)
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
            logged_at, omitted = self._logged.get(note.event, (-_LOGGED_AT_MOST_EVERY_S, 0))
            if now - logged_at < _LOGGED_AT_MOST_EVERY_S:
                self._logged[note.event] = (logged_at, omitted + 1)
                return
            self._logged[note.event] = (now, 0)
        more = {"omitted": omitted} if omitted else {}
        self._events.event(note.event, **note.fields, **more)
