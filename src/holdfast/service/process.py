"""``holdfast serve``: one service as a process of its own.

A service is often started because another one has died, and a robot waits for it. So it must be
ready a fraction of a second after its start, and what it does not need by then it does not load:
this module imports nothing at its top that takes time, and the options are read before NumPy is.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import os
import signal
import socket
import sys
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from holdfast.errors import HoldfastError, InvalidValueError, TransportError
from holdfast.printable import printable

if TYPE_CHECKING:
    import asyncio

    from holdfast.runtime.logs import EventLog
    from holdfast.service.health import HttpAddress, Watched
    from holdfast.service.metrics import DecisionTimes, Report
    from holdfast.service.shell import ServiceShell
    from holdfast.service.supervisor import Supervised
    from holdfast.transport.endpoints import Endpoint, TlsFiles
    from holdfast.transport.service_end import StreamServiceTransport

__all__ = ["DEFAULT_NAME", "main"]

DEFAULT_NAME = "cloud_active_sensing"
"""The name of the service in the cloud (the thesis's)."""

_DEFAULT_PLACE = "127.0.0.1:7447"
_SWITCH_INTERVAL_S = 0.0005
"""How long a thread may hold the interpreter while the one that has the answer waits for it."""

_BETWEEN_COLLECTIONS = 10_000
_CLOSE_TIMEOUT_S = 0.7
_STDIN = 0


def main(arguments: Sequence[str]) -> int:
    """Run ``holdfast serve`` until it is told to stop.

    Parameters
    ----------
    arguments : sequence of str
        What follows ``serve`` on the command line.

    Returns
    -------
    int
        0 after SIGTERM or the end of standard input, 130 after SIGINT, 129 after SIGHUP. With
        credentials it is SIGHUP that has them read again.

    Raises
    ------
    HoldfastError
        If an option cannot be used; the message says which and why.
    """
    options = _parser().parse_args(arguments)
    # Nothing is thrown away while modules are loaded, so there is nothing to look for.
    gc.disable()
    # NumPy's BLAS would start threads that nothing here has work for.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if options.processes > 1:
        return _serve_with_several(options, arguments)
    if options.supervised is not None:
        return _serve_supervised(options)
    return _serve(options)


class _Parser(argparse.ArgumentParser):
    """Raises what another one would write as text, with its usage."""

    def error(self, message: str) -> NoReturn:
        raise InvalidValueError(message.removeprefix("argument "))


def _formatter(prog: str) -> argparse.HelpFormatter:
    """Return what writes the help; it is told its width, and so need not load shutil for that."""
    columns = 80
    with contextlib.suppress(OSError):
        columns = os.get_terminal_size().columns
    return argparse.HelpFormatter(prog, width=columns - 2)


def _parser() -> _Parser:
    parser = _Parser(
        formatter_class=_formatter,
        prog="holdfast serve",
        description="Decide for robots, as a service: many at once, on all cores.",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add(
        "--listen",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help=f"where robots can connect; may be repeated (default: tcp/{_DEFAULT_PLACE}, "
        "with --tls over TLS)",
    )
    add(
        "--connect",
        action="append",
        default=[],
        metavar="ENDPOINT",
        help="a robot that listens; may be repeated. Then nothing listens here unless --listen "
        "says so",
    )
    add("--name", default=DEFAULT_NAME, help=f"name of the service (default: {DEFAULT_NAME})")
    add(
        "--tls",
        type=_directory,
        metavar="DIR",
        help="directory with this service's credentials, as 'holdfast keys' makes it; robots must "
        "have theirs of the same authority",
    )
    add(
        "--insecure",
        action="store_true",
        help="allow an address that other machines can reach without --tls: whoever reaches it "
        "can use the service and read along",
    )
    add(
        "--processes",
        type=_whole_number(1, 256),
        default=1,
        metavar="N",
        help="processes behind the same address, watched by one more (default: 1)",
    )
    add(
        "--health",
        type=_http_address,
        metavar="HOST:PORT",
        help="answer http://HOST:PORT/livez and /readyz; a PORT alone is one of 127.0.0.1, 0 takes "
        "a free one",
    )
    add(
        "--metrics",
        type=_http_address,
        metavar="HOST:PORT",
        help="offer metrics for Prometheus at http://HOST:PORT/metrics, which may be the address "
        "of --health, too",
    )
    add(
        "--log",
        choices=("text", "json"),
        default="text",
        help="form of the ready line and of the log on standard error (default: text)",
    )
    add(
        "--workers",
        type=_whole_number(1, 256),
        metavar="N",
        help="decisions that each process computes at a time (default: its share of the cores)",
    )
    add(
        "--lease-ms",
        type=_number(50.0, 60_000.0),
        default=400.0,
        metavar="MS",
        help="robots give up this service when nothing comes from it for this long (default: 400); "
        "how long a robot may be silent, the robot says: offload.lease_ms",
    )
    add(
        "--max-sessions",
        type=_whole_number(1, 1_000_000),
        metavar="N",
        help="robots that each process remembers; the one unused the longest is forgotten first "
        "(default: 1000)",
    )
    add(
        "--drain-s",
        type=_number(0.0, 3600.0),
        default=5.0,
        metavar="S",
        help="after SIGTERM, time for the answers that are owed (default: 5)",
    )
    add(
        "--max-sessions-per-robot",
        type=_whole_number(1, 1_000_000),
        metavar="N",
        help="runs remembered of those that use the certificate of one robot (default: as many as "
        "there is room for)",
    )
    add(
        "--problem",
        action="append",
        default=[],
        metavar="NAME",
        help="a problem to have loaded from the start; one of your own, module:Class, is only "
        "served if it is named here. May be repeated",
    )
    add(
        "--problem-directory",
        type=_directory,
        metavar="DIR",
        help="where the modules of --problem are looked for first (default: the current directory)",
    )
    add(
        "--until-stdin-closes",
        action="store_true",
        help="stop when standard input ends, as it does when the process that started this one "
        "dies",
    )
    # For the processes that a supervisor starts: its number, and the descriptors that they inherit.
    add("--supervised", type=_whole_numbers, help=argparse.SUPPRESS)
    add("--sockets", type=_whole_numbers, default=[], help=argparse.SUPPRESS)
    return parser


def _whole_number(least: int, most: int) -> type[int]:
    def number(text: str) -> int:
        with contextlib.suppress(ValueError):
            if least <= int(text) <= most:
                return int(text)
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {least} to {most}")

    return number  # type: ignore[return-value]


def _number(least: float, most: float) -> type[float]:
    def number(text: str) -> float:
        with contextlib.suppress(ValueError):
            if least <= float(text) <= most:
                return float(text)
        raise argparse.ArgumentTypeError(f"{text!r} is not a number from {least:g} to {most:g}")

    return number  # type: ignore[return-value]


def _directory(text: str) -> Path:
    if not text:
        raise argparse.ArgumentTypeError("'' is no path (. is the current directory)")
    return Path(text)


def _http_address(text: str) -> HttpAddress:
    from holdfast.service.health import HealthError, parse_http_address

    try:
        return parse_http_address(text)
    except HealthError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _whole_numbers(text: str) -> list[int]:
    return [int(word) for word in text.split(",")]


def _serve_with_several(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Watch several processes that serve, each with the same options but for the supervisor's."""
    for option, given in (
        ("--connect", options.connect),
        ("--until-stdin-closes", options.until_stdin_closes),
    ):
        if given:
            raise InvalidValueError(f"{option}: goes with one process only, not with --processes")
    listen, _ = _checked_endpoints(options, _credentials(options))

    import asyncio

    from holdfast.runtime.logs import EventLog
    from holdfast.service.listening import SharedEndpoints
    from holdfast.service.supervisor import Supervisor, supervise

    own = _Parser(allow_abbrev=False, add_help=False)
    for option in ("--listen", "--processes", "--health", "--metrics", "--workers"):
        own.add_argument(option)
    _, others = own.parse_known_args(arguments)
    workers = options.workers or max(1, len(os.sched_getaffinity(0)) // options.processes)
    shared = SharedEndpoints(listen)
    events = EventLog(sys.stderr, format=options.log, component=options.name)
    endpoints = [str(endpoint) for endpoint in shared.endpoints]

    async def run() -> int:
        supervisor = Supervisor(
            [*others, f"--workers={workers}", *(f"--listen={each}" for each in endpoints)],
            options.processes,
            shared,
            events,
        )
        watched = _watched(
            options,
            supervisor.why_not_alive,
            supervisor.why_not_ready,
            supervisor.report,
            supervisor.process_ids,
        )
        where: dict[str, object] = {"listen": endpoints, "processes": options.processes}
        try:
            where.update(await watched.start())
            return await supervise(
                supervisor,
                events,
                [
                    number
                    for number in _handled_signals()
                    if options.tls is None or number != signal.SIGHUP
                ],
                options.drain_s + 2 * _CLOSE_TIMEOUT_S,
                lambda: _say_ready(options, None, where),
            )
        finally:
            watched.close()

    try:
        return _exit_status(signal.Signals(asyncio.run(run())).name)
    finally:
        shared.close()
        events.close()


def _serve_supervised(options: argparse.Namespace) -> int:
    """Be one of several processes, and end with the one that watches them."""
    from holdfast.runtime.leash import end_with_parent
    from holdfast.service.supervisor import Supervised

    parent, descriptor = options.supervised
    end_with_parent(parent)
    supervised = Supervised(descriptor)
    try:
        return _serve(options, supervised)
    except HoldfastError as error:
        if supervised.has_served:
            raise
        # The supervisor says it, once.
        supervised.failed(str(error))
        return 2


def _credentials(options: argparse.Namespace) -> TlsFiles | None:
    if options.tls is None:
        return None
    from holdfast.transport.credentials import load_credentials

    return load_credentials(options.tls, "service", warn=lambda text: _warn(options, text))


def _checked_endpoints(
    options: argparse.Namespace, tls: TlsFiles | None
) -> tuple[list[Endpoint], list[Endpoint]]:
    """Return where to listen and where to connect."""
    from holdfast.transport.endpoints import parse_endpoint

    if not options.listen and not options.connect:
        options.listen = [f"{'tcp' if tls is None else 'tls'}/{_DEFAULT_PLACE}"]
    listen, connect = (
        [parse_endpoint(text) for text in texts] for texts in (options.listen, options.connect)
    )
    for endpoint in (*listen, *connect):
        _check_safe(endpoint, tls, insecure=options.insecure)
    return listen, connect


def _watched(
    options: argparse.Namespace,
    why_not_alive: Callable[[], str | None],
    why_not_ready: Callable[[], str | None],
    report: Callable[[], Awaitable[Report]],
    processes: Callable[[], Sequence[int]] = lambda: (os.getpid(),),
) -> Watched:
    """Return what --health and --metrics ask for."""
    from holdfast.service.health import Page, Watched

    async def alive() -> Page:
        return Page.of(why_not_alive())

    async def ready() -> Page:
        return Page.of(why_not_ready())

    watched = Watched()
    if options.health is not None:
        watched.add("health", options.health, {"/livez": alive, "/readyz": ready})
    if options.metrics is not None:
        from holdfast.service.metrics import CONTENT_TYPE, Exposition

        exposition = Exposition(options.name, processes)

        async def metrics() -> Page:
            return Page(200, exposition.text(await report()), CONTENT_TYPE)

        watched.add("metrics", options.metrics, {"/metrics": metrics})
    return watched


def _serve(options: argparse.Namespace, supervised: Supervised | None = None) -> int:
    if options.until_stdin_closes and sys.stdin is None:
        raise InvalidValueError("--until-stdin-closes: this process has no standard input")
    # In the order in which they are needed, so that a mistake in the options is told at once.
    tls = _credentials(options)
    _checked_endpoints(options, tls)

    if tls is None:
        _import_without_openssl()

    from holdfast.runtime.descriptors import NEEDED, allow_descriptors
    from holdfast.transport.service_end import MAX_LINKS, StreamServiceTransport

    allow_descriptors(NEEDED + MAX_LINKS)
    boot = os.urandom(8).hex()
    transport = StreamServiceTransport(
        options.name,
        boot=boot,
        listen=options.listen,
        connect=options.connect,
        listening=[socket.socket(fileno=each) for each in options.sockets],
        lease_ms=options.lease_ms,
        tls=tls,
        on_event=lambda event, **fields: shell.note(event, **fields),
    )

    import asyncio

    import msgspec

    from holdfast.runtime.allocator import limit_arenas
    from holdfast.runtime.logs import EventLog
    from holdfast.service.known_problems import KnownProblems
    from holdfast.service.metrics import DecisionTimes
    from holdfast.service.shell import ServiceShell
    from holdfast.session.service import Service
    from holdfast.session.service_limits import ServiceLimits

    limit_arenas()
    limits = ServiceLimits(max_sessions_per_robot=options.max_sessions_per_robot)
    if options.max_sessions is not None:
        limits = msgspec.structs.replace(limits, max_sessions=options.max_sessions)
    workers = options.workers or len(os.sched_getaffinity(0))
    problems = KnownProblems(options.problem, options.problem_directory or Path.cwd())

    def describe_error(error: BaseException) -> str:
        from holdfast.user_code import describe_problem_error

        return describe_problem_error("the problem", error)

    service = Service(problems, workers, limits, describe_error)
    events = EventLog(sys.stderr, format=options.log, component=options.name)
    times = DecisionTimes()
    shell = ServiceShell(service, transport, workers, events, times.add)
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    try:
        status = asyncio.run(_run(options, boot, transport, shell, events, times, supervised))
    finally:
        events.close()
    if shell.is_computing:
        # A thread that comes back from foreign code while the interpreter goes down would abort
        # the process.
        _end_at_once(status)
    return status


def _import_without_openssl() -> None:
    """Load asyncio and hashlib as they are where there is no OpenSSL, which takes long to load.

    Neither needs it here: the links do TLS by themselves, and the digests are Python's own.
    """
    hidden = [name for name in ("ssl", "_hashlib") if name not in sys.modules]
    for name in hidden:
        sys.modules[name] = None  # type: ignore[assignment]
    try:
        import asyncio  # noqa: F401
        import hashlib  # noqa: F401
    finally:
        for name in hidden:
            del sys.modules[name]


async def _run(
    options: argparse.Namespace,
    boot: str,
    transport: StreamServiceTransport,
    shell: ServiceShell,
    events: EventLog,
    times: DecisionTimes,
    supervised: Supervised | None,
) -> int:
    """Serve until there is a reason to stop; return the exit status."""
    import asyncio

    from holdfast.service.metrics import Report

    loop = asyncio.get_running_loop()
    is_serving = False

    def why_not_ready() -> str | None:
        return "draining" if shell.is_draining else None if is_serving else "starting"

    async def report() -> Report:
        return Report(shell.statistics(), times)

    watched = _watched(options, lambda: None, why_not_ready, report)
    try:
        where: dict[str, object] = dict(await watched.start())
        for number in _handled_signals():
            loop.add_signal_handler(number, shell.stop, number.name)
        if options.tls is not None:
            loop.add_signal_handler(signal.SIGHUP, _reload, options, transport, events)
        await shell.start()
        if options.until_stdin_closes:
            _watch_stdin(loop, shell)
        # What was loaded stays; the collector need never look at it again.
        gc.freeze()
        gc.set_threshold(_BETWEEN_COLLECTIONS)
        gc.enable()
        is_serving = True
        if supervised is None:
            where["listen"] = list(transport.endpoints)
            if options.connect:
                where["connect"] = options.connect
            _say_ready(options, boot, where)
        else:
            supervised.start(
                lambda: Report(shell.statistics(), times),
                lambda: shell.stop("the supervisor is gone"),
            )
        reason = await shell.wait()
        if supervised is None:
            events.event("stopping", reason=reason)
        else:
            supervised.not_ready()
        if reason == signal.SIGTERM.name:
            draining = loop.create_task(shell.drain(options.drain_s))
            for number in _handled_signals():
                if options.tls is None or number != signal.SIGHUP:
                    loop.add_signal_handler(number, draining.cancel)
            await asyncio.wait((draining,))
    finally:
        await shell.close(_CLOSE_TIMEOUT_S)
        watched.close()
        if supervised is not None:
            supervised.close()
    return _exit_status(reason)


def _reload(
    options: argparse.Namespace, transport: StreamServiceTransport, events: EventLog
) -> None:
    """Read the credentials and the list of what is revoked again."""
    try:
        _credentials(options)  # it knows more of what can be wrong with them
        ended = transport.reload_credentials()
    except HoldfastError as error:
        events.event("credentials", reason=f"{error}; those of before stay in use")
    else:
        events.event("credentials_reloaded", links_ended=ended)


def _exit_status(reason: str) -> int:
    number = getattr(signal, reason, signal.SIGTERM)
    return 0 if number == signal.SIGTERM else 128 + int(number)


def _handled_signals() -> list[signal.Signals]:
    """Return the signals that end a service; whoever started it may have them ignored."""
    ending = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    return [number for number in ending if signal.getsignal(number) is not signal.SIG_IGN]


def _watch_stdin(loop: asyncio.AbstractEventLoop, shell: ServiceShell) -> None:
    """Stop the service when standard input ends; what is read from it is dropped."""

    def read() -> None:
        if not os.read(_STDIN, 4096):
            loop.remove_reader(_STDIN)
            shell.stop("standard input has ended")

    try:
        loop.add_reader(_STDIN, read)
    except PermissionError:
        # A file, or the null device: nobody will ever close it.
        shell.stop("standard input has ended")


def _end_at_once(status: int) -> NoReturn:
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(status)


def _check_safe(endpoint: Endpoint, tls: TlsFiles | None, *, insecure: bool) -> None:
    """Refuse an address that other machines can reach, unless they have to prove who they are."""
    if endpoint.is_loopback or insecure or (endpoint.is_encrypted and tls is not None):
        return
    if endpoint.is_encrypted:
        return  # the transport says that credentials are missing
    raise TransportError(
        f"endpoint {endpoint}: other machines can reach it, and nobody there has to prove who he "
        f"is; use tls/... or udp/... with --tls DIR ('holdfast keys DIR' makes the credentials), "
        f"an address of this machine alone, as in tcp/{_DEFAULT_PLACE}, or say --insecure"
    )


def _warn(options: argparse.Namespace, text: str) -> None:
    if options.log == "json":
        from holdfast.runtime.logs import tell_event

        tell_event(options.name, "credentials", reason=text)
    else:
        sys.stderr.write(f"holdfast serve: warning: {printable(text)}\n")


def _say_ready(options: argparse.Namespace, boot: str | None, where: dict[str, object]) -> None:
    if options.log == "json":
        from holdfast.runtime.logs import EventLog

        EventLog(sys.stdout, format="json", component=options.name).event(
            "ready",
            service=options.name,
            pid=os.getpid(),
            **({} if boot is None else {"boot": boot}),
            **where,
        )
        return
    parts = [
        f"{verb} {' and '.join(map(str, places))}"
        for verb, key in (("is listening on", "listen"), ("is connecting to", "connect"))
        if isinstance(places := where.get(key), list) and places
    ]
    if "processes" in where:
        parts[-1] += f" with {where['processes']} processes"
    parts += [f"offers {what} at {where[what]}" for what in ("health", "metrics") if what in where]
    # Nobody may be reading: that is no reason not to serve.
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.write(printable(f"{options.name} {', '.join(parts)}\n"))
        sys.stdout.flush()
