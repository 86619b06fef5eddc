"""The I/O shell around a service's state machine: an event loop, and threads for long work.

Passing work to another thread takes longer than many decisions. So short work happens on the loop:
it decodes a request, passes it to the machine, and computes a resulting brief job in a later turn.
By then it has read all requests that arrived meanwhile, so the machine knows them when it chooses
the next job, and it has sent all replies. Long jobs, which compute without the interpreter, and
large requests go to threads; their results return to the loop.

A brief job cannot be interrupted, so a job counts as brief only if those before it of the same
robot were, and if it is as usual (:class:`~holdfast.protocol.service_jobs.Job`).

What a peer sends may lead to any exception, and none ends the process. Decoding and jobs touch
nothing that is shared, so an exception there refuses that request alone. One in the machine, also
while nothing but time passes, may leave it half-way through a change. Nobody can say which of its
tables still agree, and it holds nothing that cannot be lost, so it forgets everything, as a new
process would: the request that was being handled is refused, all others are told to come again, and
the links stand. Each is logged as ``defect`` with its traceback, and counted.

Nothing here needs a socket.
"""

from __future__ import annotations

import asyncio
import functools
import itertools
import math
import os
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Literal, TypeAlias

import msgspec

from holdfast.errors import DEFECT, MessageError, defect_fields
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.messages import Busy, Refused, Request, decode_request, encode
from holdfast.protocol.service import Service
from holdfast.protocol.service_batches import run_together
from holdfast.protocol.service_jobs import (
    EndCall,
    Job,
    JobResult,
    SendReply,
    ServiceEffect,
)
from holdfast.protocol.service_limits import ServiceStatistics
from holdfast.runtime.events import EventRates, EventSink
from holdfast.runtime.pool import ThreadPool
from holdfast.transport.contract import IncomingCall, ServiceTransport

DecisionHook: TypeAlias = Callable[[Literal["task", "sensing"], float, float], None]

_NICENESS = 5
"""Niceness of the threads for jobs that may take any time: a third of the others' processor time.

They also hold the interpreter for moments, which they must come to the end of.
"""

_LARGE_BYTES = 64 << 10
"""Requests that are larger are decoded on a thread."""

_MAX_UNDECODED = 4096
"""Large requests that wait to be decoded; further ones are rejected unread."""

_MAX_UNDECODED_BYTES = 128 << 20
"""Bytes of undecoded requests: two of the largest. One request is always admitted; when other
robots have used up the bound, each robot may have one more, up to twice the bound in total."""

_UNREAD_BUSY = [encode(Busy(0, retry_after_ms)) for retry_after_ms in range(100, 126)]
"""Used in rotation, so that robots that were rejected together do not retry together."""


class ServiceShell:
    """Joins a service's machine to a transport; all methods are called on the loop's thread."""

    def __init__(
        self,
        service: Service,
        transport: ServiceTransport,  # not started yet
        events: EventSink,
        # Called with the kind, computing time and waiting time of each decision.
        on_decision: DecisionHook | None = None,
    ) -> None:
        self._service = service
        self._transport = transport
        self._brief = ThreadPool(service.max_running, "holdfast-worker")
        self._others = ThreadPool(service.max_running, "holdfast-other", niceness=_NICENESS)
        self._decoder = ThreadPool(1, "holdfast-decoder")
        self._events = events
        self._on_decision = on_decision
        self._calls: dict[int, IncomingCall] = {}
        self._numbers = itertools.count(1)
        # Large requests that are being decoded, of each robot; and their bytes.
        self._undecoded: Counter[str | None] = Counter()
        self._undecoded_bytes = 0
        self._unread = 0
        self._rates = EventRates()
        self._brief_jobs: deque[Job] = deque()
        self._has_replied = False  # since the last brief job, and has more to reply
        self._timer: asyncio.TimerHandle | None = None
        self._idle: asyncio.Future[None] | None = None
        self._closed = False
        # Whether new robots are rejected because the service is about to end.
        self.is_draining = False

    async def start(self) -> None:
        """Start the transport; raise TransportError if the transport cannot be started."""
        self._loop = asyncio.get_running_loop()
        self._stopped: asyncio.Future[str] = self._loop.create_future()
        await self._transport.start(self.deliver)

    async def wait(self) -> str:
        """Wait for :meth:`stop`, and return its reason."""
        return await asyncio.shield(self._stopped)

    def stop(self, reason: str) -> None:
        """Let :meth:`wait` return."""
        if not self._stopped.done():
            self._stopped.set_result(reason)

    async def drain(self, timeout_s: float) -> None:
        """Take no new links, and wait until all robots have their replies and have left.

        A robot is still answered until it has found another service.
        """
        self.is_draining = True
        awaited = {self._transport.dismiss()}
        if self._calls or self._undecoded:
            self._idle = self._loop.create_future()
            awaited.add(self._idle)
        await asyncio.wait(awaited, timeout=timeout_s)

    async def close(self, timeout_s: float = 1.0) -> None:
        """End all calls and links within this time, without waiting for a running job."""
        self._closed = True
        if self._timer is not None:
            self._timer.cancel()
        self._brief_jobs.clear()
        await self._transport.close(timeout_s)
        self._calls.clear()
        self._brief.close()
        self._others.close()
        self._decoder.close()

    @property
    def is_computing(self) -> bool:
        """Whether a thread is still computing."""
        pools = (self._brief, self._others, self._decoder)
        return any(pool.num_open for pool in pools)

    def note(self, event: str, /, **fields: object) -> None:
        """Log an event, with a limited rate for each kind."""
        if event == DEFECT:
            self._service.statistics.defects += 1
        for name, told in self._rates.admit(event, event, fields, self._loop.time()):
            self._events.event(name, **told)
        self._set_timer()

    def statistics(self) -> ServiceStatistics:
        """Return a copy of the machine's counters."""
        statistics = self._service.statistics
        copy = msgspec.structs.replace(statistics, refusals=dict(statistics.refusals))
        copy.busy += self._unread
        return copy

    # -- events ----------------------------------------------------------------------------------

    def deliver(self, call: IncomingCall) -> None:
        """Take a call from the transport."""
        if self._closed:
            call.end()
        else:
            self._guarded(self._received, call)

    def _guarded(self, handler: Callable[..., None], *arguments: object) -> None:
        """Call a handler unless the shell is closed; whatever it raises has the machine forget."""
        if self._closed:
            return
        try:
            handler(*arguments)
        except Exception as error:  # noqa: BLE001 - what a peer sends may raise anything
            self._forget_everything(error)

    def _forget_everything(self, error: Exception) -> None:
        """Go on as a new process would, after an exception of the machine."""
        self.note(DEFECT, **defect_fields(error))
        self._service.forget_everything()
        self._brief_jobs.clear()
        calls, self._calls = self._calls, {}
        for call in calls.values():
            self._reject_unread(call)
        self._note_if_idle()

    def _received(self, call: IncomingCall) -> None:
        payload = call.payload
        size = len(payload)
        if size <= _LARGE_BYTES:
            self._decoded(call, size, _decode(payload))
        elif self._undecoded.total() >= _MAX_UNDECODED or self._takes_too_much(call.robot, size):
            self._reject_unread(call)
        else:
            self._undecoded[call.robot] += 1
            self._undecoded_bytes += size
            done = functools.partial(self._guarded, self._large_one_decoded, call, size)
            self._decoder.submit(functools.partial(_decode, payload), done)

    def _takes_too_much(self, robot: str | None, size: int) -> bool:
        """Return whether a large request exceeds the bound on bytes."""
        wanted_bytes = self._undecoded_bytes + size
        if self._undecoded[robot]:
            return wanted_bytes > _MAX_UNDECODED_BYTES
        return bool(self._undecoded) and wanted_bytes > 2 * _MAX_UNDECODED_BYTES

    def _reject_unread(self, call: IncomingCall) -> None:
        self._unread += 1
        call.reply(_UNREAD_BUSY[self._unread % len(_UNREAD_BUSY)], last=True)
        self.note("busy", turned_away_unread=self._unread)

    def _large_one_decoded(
        self, call: IncomingCall, size: int, request: Request | MessageError
    ) -> None:
        self._undecoded[call.robot] -= 1
        if not self._undecoded[call.robot]:
            del self._undecoded[call.robot]
        self._undecoded_bytes -= size
        self._decoded(call, size, request)

    def _decoded(self, call: IncomingCall, size: int, request: Request | MessageError) -> None:
        number = next(self._numbers)
        self._calls[number] = call
        # Later: a reply may end the link while effects are carried out.
        call.on_gone = functools.partial(self._loop.call_soon, self._guarded, self._gone, number)
        now = self._loop.time()
        try:
            effects = self._service.receive(number, request, size, now, call.robot)
        except Exception as error:
            del self._calls[number]
            call.reply(encode(Refused(0, "failed", _in_words(error))), last=True)
            raise
        self._carry_out(effects, now)

    def _gone(self, number: int) -> None:
        """Handle the end of a link on which a call was open."""
        if self._calls.pop(number, None) is not None:
            self._carry_out(self._service.gone(number), self._loop.time())

    def _run_brief_jobs(self) -> None:
        if not self._brief_jobs:
            return  # forgotten meanwhile
        first = self._brief_jobs[0]
        jobs = [job for job in self._brief_jobs if job is first or job.is_like(first)]
        self._brief_jobs = deque(job for job in self._brief_jobs if job not in jobs)
        if self._brief_jobs:
            self._run_brief_jobs_soon()
        elif self._has_replied and len(self._calls) == 1:
            # The only robot, if on this machine, may wait for this very core to read its reply.
            os.sched_yield()
        self._has_replied = False
        began, used_s = self._loop.time(), time.thread_time()
        found = run_together(jobs)
        computed_s, processor_s = self._loop.time() - began, time.thread_time() - used_s
        for job in jobs:
            if (outcome := found.get(job)) is not None:
                self._finished(job, outcome, computed_s / len(found), processor_s / len(found))
            elif len(jobs) == 1:
                self._finished(job, *self._computed(job))
            else:
                job.company = None  # alone, in a turn of its own: each may take its full time
                self._run_briefly(job)

    def _run_briefly(self, job: Job) -> None:
        self._brief_jobs.append(job)
        if len(self._brief_jobs) == 1:
            self._run_brief_jobs_soon()

    def _run_brief_jobs_soon(self) -> None:
        """Schedule the next brief jobs after all input that has arrived by then.

        In one turn the loop runs ``call_soon`` callbacks of before, then reads sockets, then runs
        due timers.
        """
        self._loop.call_at(self._loop.time(), self._guarded, self._run_brief_jobs)

    def _computed(self, job: Job) -> tuple[JobResult, float, float]:
        """Run a job on any thread; return its outcome, its duration and its processor time."""
        began, used_s = self._loop.time(), time.thread_time()
        try:
            outcome = job.run()
        except BaseException as error:  # noqa: BLE001 - a job touches nothing that is shared
            self._loop.call_soon_threadsafe(
                functools.partial(self.note, DEFECT, **defect_fields(error))
            )
            outcome = JobResult(failure=("failed", _in_words(error)))
        return outcome, self._loop.time() - began, time.thread_time() - used_s

    def _finished(
        self, job: Job, outcome: JobResult, computed_s: float, processor_s: float
    ) -> None:
        now = self._loop.time()
        # Without the time to a thread and back: with it a brief job that once ran there would
        # never count as brief again.
        self._service.started(job, now - computed_s)
        self._carry_out(self._service.finished(job, outcome, now, processor_s), now)

    def _tick(self) -> None:
        """Advance the machine's clock, and log dropped events that are due."""
        self._timer = None
        now = self._loop.time()
        for name, told in self._rates.due(now):
            self._events.event(name, **told)
        self._carry_out(self._service.tick(now), now)

    # -- effects ---------------------------------------------------------------------------------

    def _carry_out(self, effects: list[ServiceEffect], now: float) -> None:
        self._perform(effects)
        self._perform(self._service.next_jobs(now))  # the replies are on their way
        if not self._brief_jobs or len(self._calls) > 1:
            self._set_timer()  # for a lone robot after its job, which stands in the next turn
        self._note_if_idle()

    def _perform(self, effects: list[ServiceEffect]) -> None:
        for effect, following in itertools.zip_longest(effects, effects[1:]):
            if isinstance(effect, SendReply):
                is_last = isinstance(following, EndCall) and following.call == effect.call
                self._calls[effect.call].reply(effect.payload, last=is_last)
                self._has_replied |= not is_last
            elif isinstance(effect, EndCall):
                self._calls.pop(effect.call).end()
            elif isinstance(effect, Job):
                self._run(effect)
            elif isinstance(effect, LogEvent):
                self.note(effect.name, **effect.fields)
            elif self._on_decision is not None:
                self._on_decision(effect.kind, effect.computed_s, effect.waited_s)

    def _note_if_idle(self) -> None:
        if self._idle is not None and not self._calls and not self._undecoded:
            self._idle.set_result(None)
            self._idle = None

    def _run(self, job: Job) -> None:
        if job.expected_s == math.inf:
            pool = self._brief if job.is_brief else self._others
            pool.submit(
                functools.partial(self._computed, job),
                lambda computed: self._guarded(self._finished, job, *computed),
            )
        else:
            self._run_briefly(job)

    def _set_timer(self) -> None:
        """Set the timer for the machine's or the log's next wake-up."""
        dues = (self._service.next_wakeup(), self._rates.next_due())
        due = min((each for each in dues if each is not None), default=None)
        if due is None:
            return
        if self._timer is not None:
            if self._timer.when() <= due:
                return  # it fires earlier, and is set again then
            self._timer.cancel()
        self._timer = self._loop.call_at(due, self._guarded, self._tick)


def _decode(payload: bytes) -> Request | MessageError:
    try:
        return decode_request(payload)
    except MessageError as error:
        # Kept in this frame, it would hold itself and the message until garbage collection.
        return error
    except Exception as error:  # noqa: BLE001 - what a peer sends may raise anything
        return MessageError("malformed", f"{len(payload)} bytes: {_in_words(error)}")


def _in_words(error: BaseException) -> str:
    return f"this service's own code has failed: {type(error).__name__}: {error}"
