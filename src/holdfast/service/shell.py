"""What surrounds a service's machine: one event loop, and threads for what takes long.

To hand something over to another thread takes longer than many a decision. So all that is short
happens on the loop: a request is decoded there, the machine is told of it, and if a brief job comes
of that, the loop computes it in a later turn. By then all that has arrived meanwhile is read, so
that the machine knows what waits when it chooses who is next, and all that was answered is sent.
Long jobs, which compute without the interpreter, and large requests go to threads, and their
results come back to the loop.

A brief job cannot be interrupted, so a job counts as brief only if those before it of the same
robot were, and if it is as usual (:class:`~holdfast.session.service_effects.Run`).

Nothing here needs a socket.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import traceback
from collections import Counter, deque
from collections.abc import Callable
from typing import Literal, TypeAlias

import msgspec

from holdfast.errors import HoldfastError
from holdfast.runtime.logs import CountedEvent, EventRates, EventSink, NullEventLog
from holdfast.service.pool import ThreadPool
from holdfast.session.messages import Busy, MessageError, Request, decode_request, encode
from holdfast.session.service import Service
from holdfast.session.service_effects import Answer, Effect, End, Noted, Run
from holdfast.session.service_jobs import Job, Outcome
from holdfast.session.service_limits import ServiceStatistics
from holdfast.transport.contract import IncomingCall, ServiceTransport

__all__ = ["DecisionHook", "ServiceBrokenError", "ServiceShell"]

DecisionHook: TypeAlias = Callable[[Literal["task", "sensing"], float, float], None]

_BRIEF_S = 0.001
"""Jobs that may take longer run on threads: the loop hears nobody meanwhile."""

_LARGE_BYTES = 64 << 10
"""Requests that are larger are decoded on a thread."""

_MAX_UNDECODED = 4096
"""Large requests that wait to be decoded."""

_MAX_UNDECODED_BYTES = 128 << 20
"""Of these requests: two of the largest. One is let in, however large it is; and where others have
taken the room, one of each robot's as long as all do not take twice as much."""

_UNREAD_BUSY = [encode(Busy(0, retry_after_ms)) for retry_after_ms in range(100, 126)]
"""Used in turn, so that robots that were turned away together do not come back together."""


class ServiceBrokenError(HoldfastError):
    """The service's own code failed: a defect. A new process is better than half a service."""


class ServiceShell:
    """Joins a service's machine to a transport; all methods are called on the loop's thread.

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
    max_undecoded, max_undecoded_bytes : int
        Large requests that wait to be decoded, and their size; what is beyond is turned away
        unread.

    Attributes
    ----------
    is_draining : bool
        Whether no new robots are taken, because the service is about to end.
    """

    def __init__(
        self,
        service: Service,
        transport: ServiceTransport,
        workers: int,
        events: EventSink | None = None,
        on_decision: DecisionHook | None = None,
        *,
        max_undecoded: int = _MAX_UNDECODED,
        max_undecoded_bytes: int = _MAX_UNDECODED_BYTES,
    ) -> None:
        self._service = service
        self._transport = transport
        self._jobs = ThreadPool(workers, "holdfast-worker", self._broke)
        self._decoder = ThreadPool(1, "holdfast-decoder", self._broke)
        self._events = events or NullEventLog()
        self._on_decision = on_decision
        self._max_undecoded = max_undecoded
        self._max_undecoded_bytes = max_undecoded_bytes
        self._calls: dict[int, IncomingCall] = {}
        self._numbers = itertools.count(1)
        self._undecoded = 0
        self._undecoded_bytes = 0
        self._undecoded_of: Counter[str | None] = Counter()
        self._unread = 0
        self._rates = EventRates()
        self._brief_jobs: deque[Job] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._idle: asyncio.Future[None] | None = None
        self._closed = False
        self.is_draining = False

    async def start(self) -> None:
        """Be there for robots.

        Raises
        ------
        TransportError
            If the transport cannot be started.
        """
        self._loop = asyncio.get_running_loop()
        self._stopped: asyncio.Future[str] = self._loop.create_future()
        await self._transport.start(self.deliver)

    async def wait(self) -> str:
        """Wait until there is a reason to stop, and return the one that :meth:`stop` was told.

        Raises
        ------
        ServiceBrokenError
            If the service's own code has failed.
        """
        return await asyncio.shield(self._stopped)

    def stop(self, reason: str) -> None:
        """Let :meth:`wait` return."""
        if not self._stopped.done():
            self._stopped.set_result(reason)

    async def drain(self, timeout_s: float) -> None:
        """Take no more links, and wait until all robots have their answers and have left.

        Until it has found another service a robot goes on asking this one, and is answered.
        """
        self.is_draining = True
        awaited = {self._transport.dismiss()}
        if self._calls or self._undecoded:
            self._idle = self._loop.create_future()
            awaited.add(self._idle)
        await asyncio.wait(awaited, timeout=timeout_s)

    async def close(self, timeout_s: float = 1.0) -> None:
        """End all calls and links, within this time; a job that runs is not waited for."""
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        self._brief_jobs.clear()
        await self._transport.close(timeout_s)
        self._calls.clear()
        self._jobs.close()
        self._decoder.close()

    @property
    def is_computing(self) -> bool:
        """Whether a thread is at work, which nobody waits for."""
        return self._jobs.num_open + self._decoder.num_open > 0

    def note(self, event: str, /, **fields: object) -> None:
        """Log an event; of each kind only so often, with the number of those left out.

        What another machine can bring about, it can bring about a thousand times a second.
        """
        omitted = self._rates.admit(event, event, fields, self._loop.time())
        if omitted is not None:
            self._log(CountedEvent(event, fields, omitted))
        self._set_timer()

    def statistics(self) -> ServiceStatistics:
        """Return a copy of what the machine counts."""
        statistics = self._service.statistics
        copy = msgspec.structs.replace(statistics, refusals=dict(statistics.refusals))
        copy.busy += self._unread
        return copy

    # -- what happens ----------------------------------------------------------------------------

    def deliver(self, call: IncomingCall) -> None:
        """Take a call from the transport."""
        if self._closed:
            call.end()
        else:
            self._guarded(self._received, call)

    def _guarded(self, handler: Callable[..., None], *arguments: object) -> None:
        """Call a handler, as long as the service is there; what it raises is a defect of ours."""
        if self._closed:
            return
        try:
            handler(*arguments)
        except Exception as error:  # noqa: BLE001 - half a service is worse than none
            self._broke(error)

    def _broke(self, error: BaseException) -> None:
        """Let :meth:`wait` raise, and be there for no robot any more."""
        if self._closed:
            return
        self._closed = True
        trace = "".join(traceback.format_exception(error))
        if not self._stopped.done():
            self._stopped.set_exception(ServiceBrokenError(f"the service has failed\n{trace}"))
        self._closing = self._loop.create_task(self._transport.close(0.0))

    def _received(self, call: IncomingCall) -> None:
        payload = call.payload
        size = len(payload)
        if size <= _LARGE_BYTES:
            self._decoded(call, size, _decode(payload))
        elif self._undecoded >= self._max_undecoded or self._takes_too_much(call.robot, size):
            self._turn_away_unread(call)
        else:
            self._undecoded += 1
            self._undecoded_of[call.robot] += 1
            self._undecoded_bytes += size
            done = functools.partial(self._guarded, self._large_one_decoded, call, size)
            self._decoder.submit(functools.partial(_decode, payload), done)

    def _takes_too_much(self, robot: str | None, size: int) -> bool:
        """Tell whether a large request is one too many."""
        wanted_bytes = self._undecoded_bytes + size
        if self._undecoded_of[robot]:
            return wanted_bytes > self._max_undecoded_bytes
        return self._undecoded > 0 and wanted_bytes > 2 * self._max_undecoded_bytes

    def _turn_away_unread(self, call: IncomingCall) -> None:
        self._unread += 1
        call.reply(_UNREAD_BUSY[self._unread % len(_UNREAD_BUSY)])
        call.end()
        self.note("busy", turned_away_unread=self._unread)

    def _large_one_decoded(
        self, call: IncomingCall, size: int, request: Request | MessageError
    ) -> None:
        self._undecoded -= 1
        self._undecoded_of[call.robot] -= 1
        if not self._undecoded_of[call.robot]:
            del self._undecoded_of[call.robot]
        self._undecoded_bytes -= size
        self._decoded(call, size, request)

    def _decoded(self, call: IncomingCall, size: int, request: Request | MessageError) -> None:
        number = next(self._numbers)
        self._calls[number] = call
        now = self._loop.time()
        self._carry_out(self._service.receive_request(number, request, size, now, call.robot))

    def _run_brief_job(self) -> None:
        job = self._brief_jobs.popleft()
        if self._brief_jobs:
            self._run_brief_job_soon()
        self._finished(job, *self._computed(job))

    def _run_brief_job_soon(self) -> None:
        """Have the next brief job run once all that has arrived by then was handled.

        The loop hears what has arrived after what was to be called soon, and before what is due.
        """
        self._loop.call_at(self._loop.time(), self._guarded, self._run_brief_job)

    def _computed(self, job: Job) -> tuple[Outcome, float]:
        """Return what a job comes to, and how long it took; on any thread."""
        began = self._loop.time()
        outcome = job.run()
        return outcome, self._loop.time() - began

    def _finished(self, job: Job, outcome: Outcome, computed_s: float) -> None:
        now = self._loop.time()
        # Without the ways to a thread and back: else a brief job that was once sent there never
        # counts as brief again.
        self._service.begun(job, now - computed_s)
        self._carry_out(self._service.finished(job, outcome, now))

    def _tick(self) -> None:
        """Let the machine take note of the time, and log what was left out before."""
        self._timer = None
        now = self._loop.time()
        for event in self._rates.due(now):
            self._log(event)
        self._carry_out(self._service.tick(now))

    # -- what comes of it ------------------------------------------------------------------------

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Answer):
                self._calls[effect.call].reply(effect.payload)
            elif isinstance(effect, End):
                self._calls.pop(effect.call).end()
            elif isinstance(effect, Run):
                self._run(effect)
            elif isinstance(effect, Noted):
                self.note(effect.event, **effect.fields)
            elif self._on_decision is not None:
                self._on_decision(effect.kind, effect.computed_s, effect.waited_s)
        self._set_timer()
        if self._idle is not None and not self._calls and not self._undecoded:
            self._idle.set_result(None)
            self._idle = None

    def _run(self, run: Run) -> None:
        job = run.job
        if run.expected_s > _BRIEF_S:
            self._jobs.submit(
                functools.partial(self._computed, job),
                lambda computed: self._guarded(self._finished, job, *computed),
            )
            return
        self._brief_jobs.append(job)
        if len(self._brief_jobs) == 1:
            self._run_brief_job_soon()

    def _set_timer(self) -> None:
        """Be woken when the machine, or the log, is to be told of the time."""
        dues = (self._service.next_wakeup(), self._rates.next_due())
        due = min((each for each in dues if each is not None), default=None)
        if due is None:
            return
        if self._timer is not None:
            if self._timer.when() <= due:
                return  # earlier than need be: it is set anew then
            self._timer.cancel()
        self._timer = self._loop.call_at(due, self._guarded, self._tick)

    def _log(self, event: CountedEvent) -> None:
        self._events.event(event.name, **event.told())


def _decode(payload: bytes) -> Request | MessageError:
    try:
        return decode_request(payload)
    except MessageError as error:
        return error
