"""``holdfast serve --processes N``: several processes behind one address, and their supervisor.

One interpreter computes on one core. So N processes serve, each an ordinary ``holdfast serve``.
They share nothing but the address: a robot that reaches another process than before sends its
state, as after any lost link. The system chooses the process of a connection.

The supervisor binds the addresses, and each process listens there by itself. Processes are spawned,
not forked, and end when the supervisor does. It serves no robot itself, so little in it can fail.

A process reports its counters every second over a SEQPACKET socket; each report is a heartbeat,
too. The socket closes when the process ends.
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

_REPORT_EVERY_S = 1.0

_SILENT_S = 10
_START_S = 60
"""A process that is silent for so long, after its first report or since its start, is stuck."""

_KILL_S = 5
"""It is killed if it lives for so long after its own watchdog should have ended it."""

_STEADY_S = 10.0
"""A process that ends earlier than this has failed at its start; its restart is delayed."""

_FIRST_DELAY_S, _LAST_DELAY_S = 0.2, 30.0
_CHECK_INTERVAL_S = 0.01

_MAX_MESSAGE_BYTES = 65_536


class Supervised:
    """A process's end: reports to the supervisor over an inherited descriptor."""

    def __init__(self, descriptor: int) -> None:
        os.set_blocking(descriptor, False)
        os.set_inheritable(descriptor, False)
        # Never closed: the supervisor takes that for the end of this process.
        self._descriptor = descriptor
        self.has_served = False

    def start(self, report: Callable[[], ServiceReport]) -> None:
        """Report that this process serves, now and regularly, in the running loop."""
        self.has_served = True
        self.tell(report())
        asyncio.get_running_loop().call_later(_REPORT_EVERY_S, self.start, report)

    def tell(self, message: ServiceReport | str) -> None:
        """Send a report, or why this process cannot serve."""
        # A dropped report is no loss: the next one has all counters.
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            os.write(self._descriptor, msgspec.msgpack.encode(message))


class _Child:
    """A process, as the supervisor sees it."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process
        self.started_at = monotonic()
        # Counted by the supervisor's timer: what stops this process, too, does not count.
        self.silent_s = 0
        self.report: ServiceReport | None = None
        # Why it cannot serve, or was killed.
        self.failure: str | None = None

    def trouble(self) -> str | None:
        """Return what is wrong with it, if anything."""
        if self.silent_s <= (_START_S if self.report is None else _SILENT_S):
            return None
        return f"process {self.process.pid} has said nothing for {self.silent_s} s"

    def note_second(self, watchdog_s: float) -> None:
        """Count a second without a report; kill one that its own watchdog has failed to end."""
        self.silent_s += 1
        if self.report is not None and self.silent_s > watchdog_s + _KILL_S:
            self.failure = (
                f"said nothing for {self.silent_s} s, so the supervisor killed it; the limit is "
                f"--watchdog-s, {watchdog_s:g} s, and {_KILL_S} s more"
            )
            self.process.kill()


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
        watchdog_s: float,
    ) -> None:
        # -P: modules in the current directory are not imported.
        self._command = [sys.executable, "-P", "-m", "holdfast", "serve", *arguments]
        self._processes = processes
        self._listening = listening
        self._events = events
        self._watchdog_s = watchdog_s
        self._living: list[_Child] = []
        self._past = ServiceReport()
        self._loop = asyncio.get_running_loop()
        self._serving: asyncio.Future[None] = self._loop.create_future()
        self._stopping: asyncio.Future[signal.Signals] = self._loop.create_future()

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

        Raises ServiceProcessError if one of them cannot serve; the message says why.
        """

        def stop(number: signal.Signals) -> None:
            if self._stopping.done():
                self._signal_all(signal.SIGKILL)
            else:
                self._stopping.set_result(number)

        def reload() -> None:
            manager.reloading()
            for child in self._living:
                if child.report:  # one that starts sees by itself which files have changed
                    child.process.send_signal(signal.SIGHUP)
            if self._serving.done():
                manager.ready()

        self._loop.add_signal_handler(signal.SIGHUP, reload)
        for each in ending:
            self._loop.add_signal_handler(each, stop, each)
        self._note_second()
        kept = [self._loop.create_task(self._keep_one()) for _ in range(self._processes)]
        try:
            await _first_of(self._serving, self._stopping, *kept)
            if self._serving.done():
                ready()
                manager.watch(
                    *(self._loop, self._events, self._status), lambda: self.why_not_alive() is None
                )
                manager.ready()
                await _first_of(self._stopping, *kept)
            number = self._stopping.result()
            self._events.event("stopping", reason=number.name)
            manager.stopping(drain_s)
            # An open local socket would go on accepting connections.
            self._listening.close()
            self._signal_all(number)
            await asyncio.wait(kept, timeout=drain_s)
            return number
        finally:
            self._stopping.cancel()
            self._signal_all(signal.SIGKILL)
            await asyncio.gather(*kept, return_exceptions=True)

    def _signal_all(self, number: int) -> None:
        for child in self._living:
            child.process.send_signal(number)

    def process_ids(self) -> list[int]:
        """Return the ids of this process and of the service's processes."""
        return [os.getpid(), *(child.process.pid for child in self._living)]

    def why_not_ready(self) -> str | None:
        """Return why no process takes robots; None if one does."""
        if self._stopping.done():
            return "draining"
        reasons = [report.why_not_ready for report in self._reports()] or ["starting"]
        return None if None in reasons else reasons[0]

    def why_not_alive(self) -> str | None:
        """Return which process is stuck; None if none is."""
        return next(filter(None, (child.trouble() for child in self._living)), None)

    def _note_second(self) -> None:
        for child in self._living:
            child.note_second(self._watchdog_s)
        self._loop.call_later(_REPORT_EVERY_S, self._note_second)

    def _status(self) -> str:
        """Return the status in a few words, from the processes' last reports."""
        reports = self._reports()
        sessions = sum(report.statistics.sessions for report in reports)
        serving = (
            f"serving, {sessions} session{'' if sessions == 1 else 's'} at "
            f"{len(reports)} of {self._processes} processes"
        )
        return self.why_not_alive() or self.why_not_ready() or serving

    def report(self) -> ServiceReport:
        """Return the sum of all processes' last reports, those that have ended included."""
        return summed([self._past, *self._reports()])

    def _reports(self) -> list[ServiceReport]:
        return [child.report for child in self._living if child.report is not None]

    async def _keep_one(self) -> None:
        """Run one of the processes, and start it again whenever it ends, until all are to end.

        At once, or with a delay if it keeps failing at its start. Raises a ServiceProcessError if
        it ends before all of them serve.
        """
        early_ends = 0
        while not self._stopping.done():
            started_at = monotonic()
            fields = {}
            control, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            with control:
                control.setblocking(False)
                try:
                    with theirs:
                        child = self._start(theirs.fileno())
                except OSError as error:
                    reason = f"cannot be started: {error.strerror}"
                else:
                    fields["pid"] = child.process.pid
                    reason = await self._until_it_ends(child, control)
            if self._stopping.done():
                return
            if not self._serving.done():
                raise ServiceProcessError(reason)
            early_ends = 0 if monotonic() - started_at >= _STEADY_S else early_ends + 1
            delay_s = restart_delay_s(early_ends, _FIRST_DELAY_S, _LAST_DELAY_S)
            self._events.event("process_ended", reason=reason, **fields, again_in_s=delay_s)
            self._past.restarts += 1
            await asyncio.wait([self._stopping], timeout=delay_s)

    def _start(self, reports: int) -> _Child:
        """Start a process that sends its reports to a descriptor."""
        descriptors = self._listening.descriptors
        process = subprocess.Popen(
            [
                *self._command,
                f"--supervised={os.getpid()},{reports}",
                f"--sockets={','.join(map(str, descriptors))}",
            ],
            stdin=subprocess.DEVNULL,
            pass_fds=[reports, *descriptors],
            # A terminal's Ctrl-C is the supervisor's to answer.
            start_new_session=True,
        )
        child = _Child(process)
        self._living.append(child)
        return child

    async def _until_it_ends(self, child: _Child, control: socket.socket) -> str:
        """Take a process's reports until it ends; return how it ended."""
        while data := await self._loop.sock_recv(control, _MAX_MESSAGE_BYTES):
            message = msgspec.msgpack.decode(data, type=ServiceReport | str)
            child.silent_s = 0
            if isinstance(message, str):
                child.failure = message
                continue
            if child.report is None and self._serving.done():
                started_ms = round((monotonic() - child.started_at) * 1000)
                self._events.event("process_started", pid=child.process.pid, launch_ms=started_ms)
            child.report = message
            if not self._serving.done() and len(self._reports()) == self._processes:
                self._serving.set_result(None)
        # The system closes a process's files a moment before its exit status is known. It is read
        # in this thread, so that metrics count the process's time once.
        while (code := child.process.poll()) is None:
            await asyncio.sleep(_CHECK_INTERVAL_S)
        self._living.remove(child)
        if child.report is not None:
            self._past = summed([self._past, child.report.without_gauges()])
        return child.failure or how_it_ended(code)


async def _first_of(*futures: asyncio.Future[Any]) -> None:
    """Wait until one is done; raise its exception if it has one."""
    done, _ = await asyncio.wait(futures, return_when=asyncio.FIRST_COMPLETED)
    for each in done:
        each.result()
