"""``holdfast serve --processes N``: several processes behind one address, and one that watches.

One interpreter computes on one core. So N processes serve, each an ordinary ``holdfast serve``, and
nothing is shared between them but the address: a robot that finds itself at another process than
before brings its state along, as it does after any lost link. Which process a connection goes to,
the system decides.

The supervisor binds the addresses and keeps them. It gives every process a listening socket of its
own, and when a process dies, keeps that socket for the next one: connections wait there meanwhile,
and are refused only if the process cannot be started again at once. It starts processes afresh,
never by fork, and they end when it does. It serves no robot itself, so it has next to nothing to
fail at.

Supervisor and process talk over a pair of sockets that keep messages apart: a process tells every
second, and whenever it is asked, what it has counted. So a message is a heartbeat as well.
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
from typing import Any, Protocol

import msgspec

from holdfast.errors import HoldfastError
from holdfast.runtime.logs import EventSink
from holdfast.runtime.service_manager import ServiceManager
from holdfast.service.metrics import Report, added

__all__ = ["ListeningSockets", "ServiceProcessError", "Supervised", "Supervisor", "supervise"]

_REPORT_EVERY_S = 1.0
_FRESH_WITHIN_S = 1.0
"""For how long whoever wants to know the metrics waits for the processes' newest reports."""

_SILENT_S = 10.0
_START_S = 60.0
"""A process that has said nothing for so long, once it served or since its start, is stuck."""

_STEADY_S = 10.0
"""A process that ends earlier than this has failed at its start, and is started again later."""

_END_S = 0.5
_FIRST_DELAY_S, _LAST_DELAY_S = 0.1, 30.0
_KEPT_S = 1.0
"""Connections are not kept waiting for a process that is started later than this."""

_MAX_MESSAGE_BYTES = 65_536
_MAX_TEXT = 4000


class ServiceProcessError(HoldfastError):
    """A process of a service has ended before it served."""


class ListeningSockets(Protocol):
    """The sockets at which processes listen."""

    def of(self, index: int) -> Sequence[socket.socket]:
        """Return those of a process, one for each endpoint; made anew if they were given up."""
        ...

    def give_up(self, index: int) -> None:
        """Refuse what waits at a process's own sockets, and what would."""
        ...

    def close(self) -> None:
        """Give up all sockets and addresses; may be repeated."""
        ...


class _Told(msgspec.Struct, tag="told"):
    """What a process tells; ``answers`` is the number of the question, 0 if there was none."""

    ready: bool
    report: Report
    answers: int = 0


class _Failed(msgspec.Struct, tag="failed"):
    """Why a process cannot serve."""

    text: str


class Supervised:
    """A process's end of the pair: tells the supervisor how it is.

    Parameters
    ----------
    descriptor : int
        Of this end, inherited.
    """

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

    def start(self, report: Callable[[], Report], lost: Callable[[], None]) -> None:
        """Say in the running loop that this process serves, and report from then on.

        Parameters
        ----------
        report : callable
            Returns what has been counted.
        lost : callable
            Is called when the supervisor is gone.
        """
        self._loop = asyncio.get_running_loop()
        self._report, self._lost = report, lost
        self._ready = True
        self._loop.add_reader(self._socket, self._asked)
        self._regularly()

    def not_ready(self) -> None:
        """Say that this process takes no more robots."""
        self._ready = False
        self._tell(0)

    def failed(self, text: str) -> None:
        """Say why this process cannot serve."""
        self._send(_Failed(text[:_MAX_TEXT]))

    def close(self) -> None:
        """Say nothing more. The end of the process closes this end, and so tells that it ended."""
        if self._timer is not None:
            self._timer.cancel()
            self._loop.remove_reader(self._socket)
        self._socket.detach()

    def _regularly(self) -> None:
        self._tell(0)
        self._timer = self._loop.call_later(_REPORT_EVERY_S, self._regularly)

    def _asked(self) -> None:
        with contextlib.suppress(BlockingIOError, ConnectionResetError):
            question = self._socket.recv(16)
            if question:
                self._tell(int.from_bytes(question, "big"))
                return
        self._loop.remove_reader(self._socket)
        self._lost()

    def _tell(self, answers: int) -> None:
        self._send(_Told(self._ready, self._report(), answers))

    def _send(self, message: _Told | _Failed) -> None:
        # A supervisor that does not listen for a while misses nothing: the next report has it all.
        with contextlib.suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
            self._socket.send(msgspec.msgpack.encode(message))


class _Child:
    """A process as the supervisor sees it."""

    def __init__(self, process: subprocess.Popen[bytes], control: socket.socket) -> None:
        self.process = process
        self.control = control
        self.started_at = self.heard_at = monotonic()
        self.report: Report | None = None
        self.ready = False
        self.reload = False
        self.answered = 0
        self.failure: str | None = None

    def ask(self, number: int) -> None:
        """Have it report."""
        with contextlib.suppress(OSError):
            self.control.send(number.to_bytes(8, "big"))

    def trouble(self, now: float) -> str | None:
        """Return what is wrong with it, if anything."""
        silent_s = now - self.heard_at
        if silent_s <= (_START_S if self.report is None else _SILENT_S):
            return None
        return f"process {self.process.pid} has said nothing for {silent_s:.0f} s"


class Supervisor:
    """Starts a service's processes, watches them, starts again what dies, and ends them.

    Belongs to the event loop that runs when it is made.

    Parameters
    ----------
    arguments : sequence of str
        Of ``holdfast serve``, for every process.
    processes : int
    listening : ListeningSockets
        Closed when the processes are to end.
    events : EventSink
    """

    def __init__(
        self,
        arguments: Sequence[str],
        processes: int,
        listening: ListeningSockets,
        events: EventSink,
    ) -> None:
        # -P: what lies in the directory that this one was started in is nobody's module.
        self._command = [sys.executable, "-P", "-m", "holdfast", "serve", *arguments]
        self._listening = listening
        self._events = events
        self._children: list[_Child | None] = [None] * processes
        self._early_ends = [0] * processes
        self._delayed: dict[int, asyncio.TimerHandle] = {}
        self._past = Report()
        self._asked = 0
        self._stopping = False
        self._loop = asyncio.get_running_loop()
        self._change: asyncio.Future[None] = self._loop.create_future()
        self._failure: str | None = None
        self._has_served = False
        self._restarts = 0

    async def start(self) -> None:
        """Start all processes; return when all of them serve.

        Raises
        ------
        ServiceProcessError
            If one has ended before; the message says why.
        """
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

    def reload(self) -> None:
        """Have all processes read their credentials again."""
        for child in self._living():
            if child.ready:
                child.process.send_signal(signal.SIGHUP)
            else:
                child.reload = True  # it may have read the old ones a moment ago

    async def stop(self, number: int, timeout_s: float) -> None:
        """Have all processes end, at the same time; kill those that do not.

        Parameters
        ----------
        number : int
            The signal that they get: at SIGTERM they finish what they owe.
        timeout_s : float
            How long they may take.
        """
        self._stopping = True
        for timer in self._delayed.values():
            timer.cancel()
        # As long as this end is open, the system would go on accepting for nobody.
        self._listening.close()
        for child in self._living():
            child.process.send_signal(number)
        await self._until(lambda: not self._living(), timeout_s)
        self.kill()

    def kill(self) -> None:
        """End all processes now; may be repeated."""
        self._stopping = True
        for timer in self._delayed.values():
            timer.cancel()
        self._listening.close()
        for child in self._living():
            child.process.kill()
        for index, dead in enumerate(self._children):
            if dead is not None:
                self._bury(index, dead)
        self._changed()

    def process_ids(self) -> list[int]:
        """Return this process's number, then those of the processes."""
        return [os.getpid(), *(child.process.pid for child in self._living())]

    def why_not_ready(self) -> str | None:
        """Return why no robot is welcome; None if some process takes robots."""
        if self._stopping:
            return "draining"
        if any(child.ready for child in self._living()):
            return None
        return "starting"

    def why_not_alive(self) -> str | None:
        """Return which process is stuck; None if none is."""
        now = monotonic()
        return next(filter(None, (child.trouble(now) for child in self._living())), None)

    def status(self) -> str:
        """Return how it is, in a few words, as far as the processes have told by themselves."""
        living = self._living()
        sessions = sum(each.report.statistics.sessions for each in living if each.report)
        serving = (
            f"serving, {sessions} session{'' if sessions == 1 else 's'} at "
            f"{sum(each.ready for each in living)} of {len(self._children)} processes"
        )
        return self.why_not_alive() or self.why_not_ready() or serving

    async def report(self) -> Report:
        """Return what all processes have counted, those that have ended too."""
        self._asked = asked = self._asked + 1
        for child in self._living():
            child.ask(asked)
        await self._until(
            lambda: all(child.answered >= asked for child in self._living() if child.ready),
            _FRESH_WITHIN_S,
        )
        reports = (child.report for child in self._living())
        total = added([self._past, *(report for report in reports if report is not None)])
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
                descriptors = [each.fileno() for each in self._listening.of(index)]
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
        self._loop.add_reader(ours, self._hear, index, child)

    def _hear(self, index: int, child: _Child) -> None:
        try:
            data = child.control.recv(_MAX_MESSAGE_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._ended(index, child)
            return
        message = msgspec.msgpack.decode(data, type=_Told | _Failed)
        child.heard_at = monotonic()
        if isinstance(message, _Failed):
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
        """Take note that a process has closed its end, as the system does when it ends."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            # The system closes what a process has open a moment before it says how that ended.
            child.process.wait(_END_S)
        child.process.kill()
        code = self._bury(index, child)
        if code < 0:
            reason = f"was ended by {signal.Signals(-code).name}"
        else:
            reason = f"ended with exit code {code}"
        if not self._stopping:
            self._restart(index, child.failure or reason, monotonic() - child.started_at, child)
        self._changed()

    def _bury(self, index: int, child: _Child) -> int:
        """Keep what a process has counted, and wait for it, which has ended or been killed."""
        self._loop.remove_reader(child.control)
        child.control.close()
        self._children[index] = None
        if child.report is not None:
            self._past = added([self._past, child.report.without_gauges()])
        return child.process.wait()

    def _restart(
        self, index: int, reason: str, lived_s: float, child: _Child | None = None
    ) -> None:
        """Start a process again: at once, or later if it keeps failing at its start."""
        if not self._has_served:
            self._failure = reason
            return
        early = self._early_ends[index] = 0 if lived_s >= _STEADY_S else self._early_ends[index] + 1
        delay_s = min(_FIRST_DELAY_S * 2 ** (early - 1), _LAST_DELAY_S) if early > 1 else 0.0
        fields = {} if child is None else {"pid": child.process.pid}
        self._events.event("process_ended", reason=reason, **fields, again_in_s=delay_s)
        if delay_s > _KEPT_S:
            self._listening.give_up(index)
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


async def supervise(
    supervisor: Supervisor,
    events: EventSink,
    ending: Iterable[signal.Signals],
    drain_s: float,
    ready: Callable[[], None],
    manager: ServiceManager,
) -> int:
    """Run a service's processes until a signal says that they are to end.

    Parameters
    ----------
    supervisor : Supervisor
    events : EventSink
    ending : iterable of signal.Signals
        Those that end the service. If SIGHUP is none of them, the processes get it.
    drain_s : float
        How long the processes may take to end in order. A second signal ends them at once.
    ready : callable
        Is called once, when all of them serve.
    manager : ServiceManager
        Is told so as well, and that all of them live, as long as they do.

    Returns
    -------
    int
        The signal.

    Raises
    ------
    ServiceProcessError
        If a process cannot serve.
    """
    loop = asyncio.get_running_loop()
    stopping: asyncio.Future[int] = loop.create_future()

    def stop(number: int) -> None:
        if stopping.done():
            supervisor.kill()
        else:
            stopping.set_result(number)

    def reload() -> None:
        manager.reloading()
        supervisor.reload()
        if starting.done():
            manager.ready()

    loop.add_signal_handler(signal.SIGHUP, reload)
    for each in ending:
        loop.add_signal_handler(each, stop, each)
    starting = loop.create_task(supervisor.start())
    try:
        awaited: set[asyncio.Future[Any]] = {starting, stopping}
        await asyncio.wait(awaited, return_when=asyncio.FIRST_COMPLETED)
        if starting.done():
            starting.result()
            ready()
            manager.watch(loop, supervisor.status, lambda: supervisor.why_not_alive() is None)
            manager.ready()
        number = await stopping
        events.event("stopping", reason=signal.Signals(number).name)
        manager.stopping(drain_s)
        await supervisor.stop(number, drain_s)
        return number
    finally:
        starting.cancel()
        supervisor.kill()
