"""``holdfast serve --processes N``: several processes behind one address, and their supervisor.

One interpreter computes on one core. So N processes serve, each an ordinary ``holdfast serve``.
They share nothing but the address: a robot that reaches another process than before sends its
state, as after any lost link. The system chooses the process of a connection.

The supervisor binds the addresses, and each process listens there by itself. Processes are spawned,
not forked, and end when the supervisor does. It serves no robot itself, so little in it can fail.

Supervisor and process talk over a pair of SEQPACKET sockets. A process reports its counters every
second and on request; each report is a heartbeat, too.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from time import monotonic
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.errors import ServiceProcessError
from holdfast.runtime.events import EventSink
from holdfast.runtime.process_ends import how_it_ended, restart_delay_s
from holdfast.runtime.service_manager import ServiceManager
from holdfast.service.metrics import ServiceReport, summed

if TYPE_CHECKING:
    from holdfast.service.listening import SharedEndpoints

__all__ = ["Supervised", "Supervisor"]

_REPORT_EVERY_S = 1.0
_FRESH_WITHIN_S = 1.0
"""A request for metrics waits this long for the processes' newest reports."""

_SILENT_S = 10.0
_START_S = 60.0
"""A process that is silent for so long, after its first report or since its start, is stuck."""

_STEADY_S = 10.0
"""A process that ends earlier than this has failed at its start; its restart is delayed."""

_END_S = 0.5
_FIRST_DELAY_S, _LAST_DELAY_S = 0.2, 30.0

_MAX_MESSAGE_BYTES = 65_536
_MAX_TEXT = 4000


class _StatusReport(msgspec.Struct, tag="told"):
    """A process's status; ``answers`` is the number of the request for it, 0 without one."""

    ready: bool
    report: ServiceReport
    answers: int = 0


class _StartFailure(msgspec.Struct, tag="failed"):
    """Why a process cannot serve."""

    text: str


class Supervised:
    """A process's end of the pair: reports to the supervisor over an inherited descriptor."""

    def __init__(self, descriptor: int) -> None:
        self._socket = socket.socket(fileno=descriptor)
        self._socket.setblocking(False)
        self._socket.set_inheritable(False)
        self._ready = False
        self._timer: asyncio.TimerHandle | None = None

    @property
    def has_served(self) -> bool:
        """Whether this process has said that it serves."""
        return self._timer is not None

    def start(self, report: Callable[[], ServiceReport], lost: Callable[[], None]) -> None:
        """Report that this process serves, and its counters regularly, in the running loop.

        ``lost`` is called when the supervisor is gone.
        """
        self._loop = asyncio.get_running_loop()
        self._report, self._lost = report, lost
        self._ready = True
        self._loop.add_reader(self._socket, self._on_request)
        self._report_regularly()

    def not_ready(self) -> None:
        """Report that this process takes no more robots."""
        self._ready = False
        self._report_status(0)

    def failed(self, text: str) -> None:
        """Report why this process cannot serve."""
        self._send(_StartFailure(text[:_MAX_TEXT]))

    def close(self) -> None:
        """Report nothing more. The supervisor sees the socket close when the process ends."""
        if self._timer is not None:
            self._timer.cancel()
            self._loop.remove_reader(self._socket)
        self._socket.detach()

    def _report_regularly(self) -> None:
        self._report_status(0)
        self._timer = self._loop.call_later(_REPORT_EVERY_S, self._report_regularly)

    def _on_request(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionResetError):
            request = self._socket.recv(16)
            if request:
                self._report_status(int.from_bytes(request, "big"))
                return
        self._loop.remove_reader(self._socket)
        self._lost()

    def _report_status(self, answers: int) -> None:
        self._send(_StatusReport(self._ready, self._report(), answers))

    def _send(self, message: _StatusReport | _StartFailure) -> None:
        # A dropped report is no loss: the next one has all counters.
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            self._socket.send(msgspec.msgpack.encode(message))


class _Child:
    """A process, as the supervisor sees it."""

    def __init__(self, process: subprocess.Popen[bytes], control: socket.socket) -> None:
        self.process = process
        self.control = control
        self.started_at = self.heard_at = monotonic()
        self.report: ServiceReport | None = None
        self.ready = False
        self.reload = False
        self.answered = 0
        self.failure: str | None = None

    def trouble(self, now: float) -> str | None:
        """Return what is wrong with it, if anything."""
        silent_s = now - self.heard_at
        if silent_s <= (_START_S if self.report is None else _SILENT_S):
            return None
        return f"process {self.process.pid} has said nothing for {silent_s:.0f} s"


class Supervisor:
    """Starts a service's processes, watches them, restarts those that die, and ends them.

    Belongs to the event loop that runs when it is made. Each process is given the ``arguments`` of
    ``holdfast serve``; ``listening`` is closed when the processes are to end.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        processes: int,
        listening: SharedEndpoints,
        events: EventSink,
    ) -> None:
        # -P: modules in the current directory are not imported.
        self._command = [sys.executable, "-P", "-m", "holdfast", "serve", *arguments]
        self._listening = listening
        self._events = events
        self._children: list[_Child | None] = [None] * processes
        self._early_ends = [0] * processes
        self._delayed: dict[int, asyncio.TimerHandle] = {}
        self._past = ServiceReport()
        self._requests = 0
        self._stopping = False
        self._loop = asyncio.get_running_loop()
        self._change: asyncio.Future[None] = self._loop.create_future()
        self._failure: str | None = None
        self._has_served = False
        self._restarts = 0

    async def run(
        self,
        ending: Iterable[signal.Signals],
        drain_s: float,
        ready: Callable[[], None],
        manager: ServiceManager,
    ) -> signal.Signals:
        """Run the processes until a signal ends them; return that signal.

        They have ``drain_s`` to end in order; a second signal ends them at once. SIGHUP has them
        read their credentials again unless it is one of the ``ending`` signals. ``ready`` is called
        once, when all of them serve.

        Raises
        ------
        ServiceProcessError
            If one of them cannot serve; the message says why.
        """
        loop = self._loop
        stopping: asyncio.Future[signal.Signals] = loop.create_future()

        def stop(number: signal.Signals) -> None:
            if stopping.done():
                self._kill()
            else:
                stopping.set_result(number)

        def reload() -> None:
            manager.reloading()
            for child in self._living():
                if child.ready:
                    child.process.send_signal(signal.SIGHUP)
                else:
                    child.reload = True  # it may have read the old credentials already
            if starting.done():
                manager.ready()

        loop.add_signal_handler(signal.SIGHUP, reload)
        for each in ending:
            loop.add_signal_handler(each, stop, each)
        starting = loop.create_task(self._start_all())
        try:
            awaited: set[asyncio.Future[Any]] = {starting, stopping}
            await asyncio.wait(awaited, return_when=asyncio.FIRST_COMPLETED)
            if starting.done():
                starting.result()
                ready()
                manager.watch(loop, self._status, lambda: self.why_not_alive() is None)
                manager.ready()
            number = await stopping
            self._events.event("stopping", reason=number.name)
            manager.stopping(drain_s)
            self._signal_all(number)
            await self._until(lambda: not self._living(), drain_s)
            return number
        finally:
            starting.cancel()
            self._kill()

    async def _start_all(self) -> None:
        """Start all processes; return when all of them serve, raise if one has ended before."""
        for index in range(len(self._children)):
            self._start(index)
        await self._until(
            lambda: (
                self._stopping
                or self._failure is not None
                or all(child is not None and child.ready for child in self._children)
            )
        )
        if self._failure is not None:
            raise ServiceProcessError(self._failure)
        self._has_served = True

    def _kill(self) -> None:
        """End all processes now; may be repeated."""
        self._signal_all(signal.SIGKILL)
        for index, dead in enumerate(self._children):
            if dead is not None:
                self._reap(index, dead)
        self._changed()

    def _signal_all(self, number: int) -> None:
        self._stopping = True
        for timer in self._delayed.values():
            timer.cancel()
        # An open local socket would go on accepting connections.
        self._listening.close()
        for child in self._living():
            child.process.send_signal(number)

    def process_ids(self) -> list[int]:
        """Return the ids of this process and of the service's processes."""
        return [os.getpid(), *(child.process.pid for child in self._living())]

    def why_not_ready(self) -> str | None:
        """Return why no process takes robots; None if one does."""
        if self._stopping:
            return "draining"
        serving = [child.report for child in self._living() if child.ready and child.report]
        gone = [report.credentials_gone for report in serving]
        return None if None in gone else next(iter(gone), "starting")

    def why_not_alive(self) -> str | None:
        """Return which process is stuck; None if none is."""
        now = monotonic()
        return next(filter(None, (child.trouble(now) for child in self._living())), None)

    def _status(self) -> str:
        """Return the status in a few words, from the processes' last reports."""
        living = self._living()
        sessions = sum(each.report.statistics.sessions for each in living if each.report)
        serving = (
            f"serving, {sessions} session{'' if sessions == 1 else 's'} at "
            f"{sum(each.ready for each in living)} of {len(self._children)} processes"
        )
        return self.why_not_alive() or self.why_not_ready() or serving

    async def report(self) -> ServiceReport:
        """Return the sum of all processes' counters, those that have ended included."""
        self._requests = number = self._requests + 1
        for child in self._living():
            with contextlib.suppress(OSError):
                child.control.send(number.to_bytes(8, "big"))
        await self._until(
            lambda: all(child.answered >= number for child in self._living() if child.ready),
            _FRESH_WITHIN_S,
        )
        reports = (child.report for child in self._living())
        total = summed([self._past, *(report for report in reports if report is not None)])
        total.restarts = self._restarts
        return total

    def _living(self) -> list[_Child]:
        return [child for child in self._children if child is not None]

    def _start(self, index: int) -> None:
        self._delayed.pop(index, None)
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        ours.setblocking(False)
        with theirs:
            try:
                descriptors = self._listening.descriptors
                process = subprocess.Popen(
                    [
                        *self._command,
                        f"--supervised={os.getpid()},{theirs.fileno()}",
                        f"--sockets={','.join(map(str, descriptors))}",
                    ],
                    stdin=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno(), *descriptors],
                    # A terminal's Ctrl-C is the supervisor's to answer.
                    start_new_session=True,
                )
            except OSError as error:
                ours.close()
                self._restart(index, f"cannot be started: {error.strerror}", lived_s=0.0)
                return
        child = self._children[index] = _Child(process, ours)
        self._loop.add_reader(ours, self._on_message, index, child)

    def _on_message(self, index: int, child: _Child) -> None:
        try:
            data = child.control.recv(_MAX_MESSAGE_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._ended(index, child)
            return
        message = msgspec.msgpack.decode(data, type=_StatusReport | _StartFailure)
        child.heard_at = monotonic()
        if isinstance(message, _StartFailure):
            child.failure = message.text
            return
        if message.ready and not child.ready and self._has_served:
            started_ms = round((child.heard_at - child.started_at) * 1000)
            self._events.event("process_started", pid=child.process.pid, launch_ms=started_ms)
        child.report, child.ready = message.report, message.ready
        if child.ready and child.reload:
            child.reload = False
            child.process.send_signal(signal.SIGHUP)
        child.answered = max(child.answered, message.answers)
        self._changed()

    def _ended(self, index: int, child: _Child) -> None:
        """Handle the end of a process, which closes its end of the pair."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            # The system closes a process's files a moment before its exit status is known.
            child.process.wait(_END_S)
        child.process.kill()
        reason = how_it_ended(self._reap(index, child))
        if not self._stopping:
            self._restart(index, child.failure or reason, monotonic() - child.started_at, child)
        self._changed()

    def _reap(self, index: int, child: _Child) -> int:
        """Keep the counters of a process that has ended or been killed; return its exit status."""
        self._loop.remove_reader(child.control)
        child.control.close()
        self._children[index] = None
        if child.report is not None:
            self._past = summed([self._past, child.report.without_gauges()])
        return child.process.wait()

    def _restart(
        self, index: int, reason: str, lived_s: float, child: _Child | None = None
    ) -> None:
        """Restart a process: at once, or with a delay if it keeps failing at its start."""
        if not self._has_served:
            self._failure = reason
            return
        early = self._early_ends[index] = 0 if lived_s >= _STEADY_S else self._early_ends[index] + 1
        delay_s = restart_delay_s(early, _FIRST_DELAY_S, _LAST_DELAY_S)
        fields = {} if child is None else {"pid": child.process.pid}
        self._events.event("process_ended", reason=reason, **fields, again_in_s=delay_s)
        self._restarts += 1
        self._delayed[index] = self._loop.call_later(delay_s, self._start, index)

    def _changed(self) -> None:
        change, self._change = self._change, self._loop.create_future()
        change.set_result(None)

    async def _until(self, reached: Callable[[], bool], timeout_s: float | None = None) -> None:
        """Wait until something holds, or for this long."""
        until = None if timeout_s is None else monotonic() + timeout_s
        while not reached():
            left_s = None if until is None else until - monotonic()
            if left_s is not None and left_s <= 0.0:
                return
            await asyncio.wait({self._change}, timeout=left_s)
