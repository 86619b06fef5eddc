"""``holdfast serve``: one service as a process of its own.

A service is often started because another one has died, while a robot waits. So it must be ready in
a fraction of a second: this module imports nothing slow at its top, and reads the options before it
imports NumPy.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import os
import signal
import socket
import sys
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from holdfast.errors import DEFECT, HoldfastError, InvalidValueError, defect_fields
from holdfast.printable import printable
from holdfast.service.garbage import collect_in_loop
from holdfast.service.options import ServeOptions, checked_endpoints, parse_options

if TYPE_CHECKING:
    import asyncio

    from holdfast.runtime.monitoring import HttpAddress, Pages
    from holdfast.service.credentials import ServiceCredentials
    from holdfast.service.metrics import ServiceReport
    from holdfast.service.shell import ServiceShell
    from holdfast.service.supervisor import Supervised
    from holdfast.transport.endpoints import Endpoint

IS_SERVICE = True

_SWITCH_INTERVAL_S = 0.0005
"""How long a thread may hold the interpreter while another waits for it."""

_CLOSE_TIMEOUT_S = 0.7
_CHECK_INTERVAL_S = 0.01
_STDIN = 0

_OFFERED = ("health", "metrics", "ros1")
"""Keys of the ready line for what else is offered, and where."""


class Extension(Protocol):
    """Something else that runs in a service's process, on threads of its own: a service in ROS 1.

    This package knows none. The package ``holdfast_ros`` passes a function that makes it.
    """

    @property
    def is_busy(self) -> bool:
        """Whether it owes answers."""

    def start(
        self, on_event: Callable[..., None], on_shutdown: Callable[[str], None]
    ) -> Mapping[str, str]:
        """Start; return what is offered where, for the ready line.

        ``on_event(name, **fields)`` logs an event, and ``on_shutdown(reason)`` tells that ROS asks
        this to end; both from any thread. A start that raises a HoldfastError has released
        everything.
        """

    def take_no_more(self) -> None:
        """Finish open requests and refuse new ones."""

    def close(self, timeout_s: float) -> None:
        """Stop; wait at most this long for a running computation. May be repeated."""


def main(arguments: Sequence[str]) -> int:
    """Run ``holdfast serve`` until it has to stop, and return the exit code: see :func:`serve`."""
    return serve(parse_options(arguments))


def serve(options: ServeOptions, make_extension: Callable[[], Extension] | None = None) -> int:
    """Serve until there is a reason to stop.

    ``make_extension`` is called once the options are checked; it raises a HoldfastError if there
    can be none.

    Returns 0 after SIGTERM or the end of standard input, 130 after SIGINT, 129 after SIGHUP. With
    credentials, SIGHUP reloads them instead. Raises HoldfastError if an option cannot be used; the
    message says which and why.
    """
    # Importing modules leaves no garbage to collect.
    gc.disable()
    # Threads of NumPy's BLAS would have no work here.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if options.processes > 1:
        return _serve_with_several(options)
    if options.supervised is not None:
        return _serve_supervised(options, *options.supervised)
    return _serve(options, make_extension=make_extension)


def _serve_with_several(options: ServeOptions) -> int:
    """Supervise several processes."""
    _credentials(options)
    listen = checked_endpoints(options)

    import asyncio

    from holdfast.runtime.logs import EventLog
    from holdfast.runtime.service_manager import ServiceManager
    from holdfast.service.listening import SharedEndpoints
    from holdfast.service.supervisor import Supervisor

    manager = ServiceManager(options.watchdog_s)
    workers = options.workers or max(1, len(os.sched_getaffinity(0)) // options.processes)
    shared = SharedEndpoints(listen)
    events = EventLog(sys.stderr, format=options.log, component=options.name)
    endpoints = [str(endpoint) for endpoint in shared.endpoints]
    of_each = options.words("listen", "processes", "health", "metrics", "workers")
    of_each += [f"--workers={workers}"]
    of_each += [f"--listen={endpoint}" for endpoint in endpoints]

    async def run() -> int:
        supervisor = Supervisor(of_each, options.processes, shared, events, options.watchdog_s)
        async with _watched(
            options,
            supervisor.why_not_alive,
            supervisor.why_not_ready,
            supervisor.report,
            supervisor.process_ids,
        ) as watched:
            where = {"listen": endpoints, "processes": options.processes, **watched}
            number = await supervisor.run(
                options.ending_signals,
                options.drain_s + 2 * _CLOSE_TIMEOUT_S,
                lambda: _say_ready(options, where),
                manager,
            )
            return _exit_status(number.name)

    try:
        return asyncio.run(run())
    finally:
        shared.close()
        events.close()


def _serve_supervised(options: ServeOptions, parent: int, descriptor: int) -> int:
    """Serve as one of several processes, and end with the supervisor."""
    from holdfast.runtime.parent_death import end_with_parent
    from holdfast.service.supervisor import Supervised

    end_with_parent(parent)
    supervised = Supervised(descriptor)
    try:
        return _serve(options, supervised)
    except HoldfastError as error:
        if supervised.has_served:
            raise
        # The supervisor reports it, once.
        supervised.tell(str(error)[:4000])
        return 2


def _serve(
    options: ServeOptions,
    supervised: Supervised | None = None,
    make_extension: Callable[[], Extension] | None = None,
) -> int:
    if options.until_stdin_closes and sys.stdin is None:
        raise InvalidValueError("--until-stdin-closes: this process has no standard input")
    # In this order, so that wrong options are reported before anything is loaded.
    credentials = _credentials(options)
    endpoints = checked_endpoints(options)

    if credentials is None:
        _import_without_openssl()
    with contextlib.ExitStack() as stack:
        sockets: Sequence[socket.socket | None]
        sockets = [socket.socket(fileno=each) for each in options.sockets]
        sockets = sockets or [_listen_early(each, credentials, stack) for each in endpoints]
        # Not from a module that others import: docs/decisions/start.md.
        import numpy as np  # noqa: F401

        extension = None if make_extension is None else make_extension()
        process = _ServiceProcess(options, credentials, extension, supervised, sockets)

        import asyncio

        sys.setswitchinterval(_SWITCH_INTERVAL_S)
        try:
            status = asyncio.run(process.run())
        finally:
            process.events.close()
    if process.is_computing:
        # A thread that returns from native code during interpreter shutdown would abort the
        # process.
        _end_at_once(status)
    return status


class _ServiceProcess:
    """The parts of a service's process, from its start to its end."""

    def __init__(
        self,
        options: ServeOptions,
        credentials: ServiceCredentials | None,
        extension: Extension | None,
        supervised: Supervised | None,
        sockets: Sequence[socket.socket | None],
    ) -> None:
        # First the transport, which refuses options.
        from holdfast.runtime.descriptors import NEEDED, allow_descriptors
        from holdfast.transport.service_end import MAX_LINKS, MAX_UNKNOWN, StreamServiceTransport

        self._options = options
        self._credentials = credentials
        self._extension = extension
        self._supervised = supervised
        self._is_serving = False
        self._withdrawing: asyncio.Task[None] | None = None
        self._incarnation = os.urandom(8).hex()
        reserved = NEEDED + MAX_UNKNOWN
        allowed = allow_descriptors(reserved + MAX_LINKS)
        self._transport = StreamServiceTransport(
            options.name,
            incarnation=self._incarnation,
            listen=options.listen,
            robot=None if options.robot is None else socket.socket(fileno=options.robot),
            shared=sockets,
            lease_ms=options.lease_ms,
            # Otherwise robots with many links would leave no descriptor for a new one.
            max_links=min(MAX_LINKS, max(allowed // 4, allowed - reserved)),
            tls=None if credentials is None else credentials.files,
            on_event=lambda event, **fields: self._shell.note(event, **fields),
        )

        import msgspec

        from holdfast.protocol.decision_cost import Pricing
        from holdfast.protocol.service import Service
        from holdfast.protocol.service_limits import ServiceLimits
        from holdfast.runtime.logs import EventLog
        from holdfast.runtime.service_manager import ServiceManager
        from holdfast.service.allocator import limit_arenas
        from holdfast.service.calibration import measure_problem, measure_slowness
        from holdfast.service.metrics import DecisionTimes
        from holdfast.service.problem_factory import ProblemFactory
        from holdfast.service.shell import ServiceShell

        limit_arenas()
        limits = ServiceLimits(
            max_sessions_per_robot=options.max_sessions_per_robot,
            max_decision_s=options.max_decision_s,
            max_decision_bytes=options.max_decision_mb << 20,
        )
        if options.max_sessions is not None:
            limits = msgspec.structs.replace(limits, max_sessions=options.max_sessions)
        workers = options.workers or len(os.sched_getaffinity(0))
        problems = ProblemFactory(options.problem, options.problem_directory or Path.cwd())
        pricing = Pricing(measure_slowness(), measure_problem)
        service = Service(problems, workers, limits, _describe_error, pricing)
        self.events = EventLog(sys.stderr, format=options.log, component=options.name)
        self._times = DecisionTimes()
        self._shell = ServiceShell(service, self._transport, self.events, self._times.add)
        self._manager = ServiceManager(options.watchdog_s)

    @property
    def is_computing(self) -> bool:
        """Whether a thread is still computing."""
        extension = self._extension
        return self._shell.is_computing or (extension is not None and extension.is_busy)

    async def run(self) -> int:
        """Serve until there is a reason to stop; return the exit status."""
        import asyncio

        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._loop_failed)
        options, shell, supervised = self._options, self._shell, self._supervised
        async with _watched(options, lambda: None, self._why_not_ready, self._report) as watched:
            try:
                for number in options.ending_signals:
                    loop.add_signal_handler(number, shell.stop, number.name)
                if self._credentials is not None:
                    loop.add_signal_handler(signal.SIGHUP, self._reload, self._credentials)
                await shell.start()
                if self._credentials is not None:
                    self._credentials.watch(loop, self._transport, self.events)
                offered: Mapping[str, str] = {}
                if (extension := self._extension) is not None:
                    offered = extension.start(
                        functools.partial(_call_soon, loop, shell.note),
                        functools.partial(_call_soon, loop, self._end_for_ros, extension),
                    )
                if options.until_stdin_closes:
                    _watch_stdin(loop, shell)
                collect_in_loop(loop)
                self._is_serving = True
                if supervised is None:
                    where: dict[str, object] = {"boot": self._incarnation, **watched, **offered}
                    where["listen"] = list(self._transport.endpoints)
                    _say_ready(options, where)
                else:
                    supervised.start(self._report)
                self._manager.watch(loop, self.events, self._status)
                self._manager.ready()
                reason = await shell.wait()
                if supervised is None:
                    self.events.event("stopping", reason=reason)
                    self._manager.stopping(options.drain_s + 2 * _CLOSE_TIMEOUT_S)
                if reason == signal.SIGTERM.name:
                    draining = loop.create_task(self._drain())
                    for number in options.ending_signals:
                        loop.add_signal_handler(number, draining.cancel)
                    await asyncio.wait((draining,))
            finally:
                try:
                    await shell.close(_CLOSE_TIMEOUT_S)
                finally:
                    if self._extension is not None:
                        self._extension.close(_CLOSE_TIMEOUT_S)
            if supervised is not None:
                supervised.tell(self._report())
        return _exit_status(reason)

    def _why_not_ready(self) -> str | None:
        if self._shell.is_draining:
            return "draining"
        if not self._is_serving:
            return "starting"
        return None if self._credentials is None else self._credentials.why_gone()

    def _status(self) -> str:
        sessions = self._shell.statistics().sessions
        serving = f"serving, {sessions} session{'' if sessions == 1 else 's'}"
        return self._why_not_ready() or serving

    def _report(self) -> ServiceReport:
        from holdfast.service.metrics import ServiceReport

        report = ServiceReport(
            self._shell.statistics(), self._times, why_not_ready=self._why_not_ready()
        )
        if self._credentials is not None:
            report.certificate_expires_s = self._credentials.expires_s
            report.stale_credentials = int(self._credentials.is_stale)
        return report

    def _reload(self, credentials: ServiceCredentials) -> None:
        self._manager.reloading()
        credentials.reload(self._transport, self.events)
        self._manager.ready()

    def _loop_failed(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log an exception that nothing else has handled, in a callback or task of the loop."""
        del loop
        error = context.get("exception")
        told = {"reason": str(context["message"])} if error is None else defect_fields(error)
        self._shell.note(DEFECT, **told)

    def _end_for_ros(self, extension: Extension, reason: str) -> None:
        """Withdraw the service in ROS 1, which ROS asks to end.

        Anybody who reaches a node's port can ask for it, so it must not end what is served beside
        it, to robots that have to prove who they are. If nothing is, the process ends as after
        SIGTERM: ``rosnode kill`` and a second node of the same name are to end a node.
        """
        goes_on = bool(self._transport.endpoints)
        self._shell.note("ros_shutdown", reason=reason, goes_on=goes_on)
        if not goes_on:
            os.kill(os.getpid(), signal.SIGTERM)
            return
        import asyncio

        if self._withdrawing is None:  # it may be asked again
            # Kept, because the loop's own references are weak.
            self._withdrawing = asyncio.get_running_loop().create_task(self._withdraw(extension))

    async def _withdraw(self, extension: Extension) -> None:
        import asyncio

        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(_drained(extension), self._options.drain_s)
        await asyncio.to_thread(extension.close, _CLOSE_TIMEOUT_S)

    async def _drain(self) -> None:
        import asyncio

        drain_s = self._options.drain_s
        extensions = [] if self._extension is None else [_drained(self._extension)]
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(asyncio.gather(self._shell.drain(drain_s), *extensions), drain_s)


async def _drained(extension: Extension) -> None:
    """Have it refuse new requests, and wait until it owes no answer."""
    import asyncio

    extension.take_no_more()
    while extension.is_busy:
        await asyncio.sleep(_CHECK_INTERVAL_S)


def _describe_error(error: BaseException) -> str:
    from holdfast.config.user_code import describe_problem_error

    return describe_problem_error("the problem", error)


def _credentials(options: ServeOptions) -> ServiceCredentials | None:
    if options.tls is None:
        return None
    from holdfast.service.credentials import ServiceCredentials

    return ServiceCredentials(options.tls, functools.partial(_warn, options))


@contextlib.asynccontextmanager
async def _watched(
    options: ServeOptions,
    why_not_alive: Callable[[], str | None],
    why_not_ready: Callable[[], str | None],
    report: Callable[[], ServiceReport],
    processes: Callable[[], Sequence[int]] = lambda: (os.getpid(),),
) -> AsyncIterator[dict[str, str]]:
    """Serve health and metrics if the options say so; yield their addresses."""
    if options.health is None and options.metrics is None:
        yield {}
        return
    from holdfast.runtime.monitoring import MonitoringServers, Page

    offered: dict[str, tuple[HttpAddress, Pages]] = {}
    if options.health is not None:
        offered["health"] = (
            options.health,
            {
                "/livez": lambda: Page.of(why_not_alive()),
                "/readyz": lambda: Page.of(why_not_ready()),
            },
        )
    if options.metrics is not None:
        from holdfast.runtime.exposition import CONTENT_TYPE, require_prometheus
        from holdfast.service.metrics import service_exposition

        require_prometheus()

        def metrics() -> Page:
            is_ready = why_not_ready() is None
            text = service_exposition(options.name, report(), processes(), is_ready=is_ready)
            return Page(200, text, CONTENT_TYPE)

        offered["metrics"] = options.metrics, {"/metrics": metrics}
    watched = MonitoringServers()
    try:
        yield await watched.start(offered)
    finally:
        await watched.close()


def _listen_early(
    endpoint: Endpoint, credentials: ServiceCredentials | None, stack: contextlib.ExitStack
) -> socket.socket | None:
    """Listen before anything slow is loaded; None if the transport is to do it, or to refuse.

    The system answers who connects meanwhile, so a robot far away saves a round trip.
    """
    from holdfast.transport.endpoints import check_credentials
    from holdfast.transport.listener import listen

    with contextlib.suppress(OSError, HoldfastError):
        check_credentials(endpoint, None if credentials is None else credentials.files)
        return None if endpoint.is_local_socket else stack.enter_context(listen(endpoint))
    return None


def _import_without_openssl() -> None:
    """Import asyncio and hashlib without OpenSSL, which is slow to load and not needed."""
    hidden = [name for name in ("ssl", "_hashlib") if name not in sys.modules]
    for name in hidden:
        sys.modules[name] = None  # type: ignore[assignment]
    try:
        import asyncio  # noqa: F401
        import hashlib  # noqa: F401
    finally:
        for name in hidden:
            del sys.modules[name]


def _exit_status(reason: str) -> int:
    number = getattr(signal, reason, signal.SIGTERM)
    return 0 if number == signal.SIGTERM else 128 + int(number)


def _call_soon(
    loop: asyncio.AbstractEventLoop, call: Callable[..., None], /, *arguments: Any, **fields: Any
) -> None:
    """Call something on the loop's thread, from any thread."""
    with contextlib.suppress(RuntimeError):  # the loop is closed
        loop.call_soon_threadsafe(functools.partial(call, *arguments, **fields))


def _watch_stdin(loop: asyncio.AbstractEventLoop, shell: ServiceShell) -> None:
    """Stop the service when standard input ends; what is read from it is dropped."""

    def read() -> None:
        if not os.read(_STDIN, 4096):
            loop.remove_reader(_STDIN)
            shell.stop("standard input has ended")

    try:
        loop.add_reader(_STDIN, read)
    except PermissionError:
        # A file or the null device never reports its end.
        shell.stop("standard input has ended")


def _end_at_once(status: int) -> NoReturn:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def _warn(options: ServeOptions, text: str) -> None:
    if options.log == "json":
        from holdfast.runtime.logs import write_event

        write_event(options.name, "credentials", reason=text)
    else:
        sys.stderr.write(f"holdfast serve: warning: {printable(text)}\n")


def _say_ready(options: ServeOptions, where: Mapping[str, object]) -> None:
    from holdfast.transport.endpoints import REVOKED_FILE

    if options.tls is not None and not (revoked := options.tls / REVOKED_FILE).exists():
        where = {**where, "revokes_nobody_without": str(revoked)}
    if options.log == "json":
        from holdfast.runtime.logs import EventLog

        EventLog(sys.stdout, format="json", component=options.name).event(
            "ready", service=options.name, pid=os.getpid(), **where
        )
        return
    places = where["listen"]
    assert isinstance(places, list)
    parts = [f"is listening on {' and '.join(map(str, places))}"] if places else []
    if options.robot is not None:
        parts.append("decides for the robot that has launched it")
    if "processes" in where:
        parts[-1] += f" with {where['processes']} processes"
    if "revokes_nobody_without" in where:
        parts.append(f"revokes nobody without {where['revokes_nobody_without']}")
    parts += [f"offers {what} at {where[what]}" for what in _OFFERED if what in where]
    # A closed standard output is no reason not to serve.
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.write(printable(f"{options.name} {', '.join(parts)}\n"))
        sys.stdout.flush()
