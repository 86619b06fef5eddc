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
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from holdfast.errors import InvalidValueError, TransportError
from holdfast.printable import printable

if TYPE_CHECKING:
    from holdfast.transport.endpoints import Endpoint, TlsFiles

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
        0 after SIGTERM or the end of standard input, 130 after SIGINT, 129 after SIGHUP.

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
    return _serve(options)


class _Parser(argparse.ArgumentParser):
    """Raises what another one would write as text, with its usage."""

    def error(self, message: str) -> NoReturn:
        raise InvalidValueError(message.removeprefix("argument "))


def _parser() -> _Parser:
    parser = _Parser(
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
        "--metrics",
        type=_port,
        metavar="PORT",
        help="offer metrics for Prometheus at http://127.0.0.1:PORT/metrics; 0 takes a free port",
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
        help="decisions computed at a time (default: one for each core)",
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
        help="robots remembered; the one unused the longest is forgotten first (default: 1000)",
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


def _port(text: str) -> int:
    return _whole_number(0, 65535)(text)


def _serve(options: argparse.Namespace) -> int:
    if options.until_stdin_closes and sys.stdin is None:
        raise InvalidValueError("--until-stdin-closes: this process has no standard input")
    # In the order in which they are needed, so that a mistake in the options is told at once.
    from holdfast.transport.endpoints import parse_endpoint

    tls = None
    if options.tls is not None:
        from holdfast.runtime.credentials import load_credentials

        tls = load_credentials(options.tls, "service", warn=lambda text: _warn(options, text))
    listen, connect = options.listen, options.connect
    if not listen and not connect:
        listen = [f"{'tcp' if tls is None else 'tls'}/{_DEFAULT_PLACE}"]
    for text in (*listen, *connect):
        _check_safe(parse_endpoint(text), tls, insecure=options.insecure)

    from holdfast.runtime.descriptors import NEEDED, allow_descriptors
    from holdfast.runtime.transport.zenoh_transport import MAX_ROBOTS, ZenohServiceTransport

    allow_descriptors(NEEDED + MAX_ROBOTS)
    boot = os.urandom(8).hex()
    transport = ZenohServiceTransport(
        options.name,
        boot=boot,
        listen=listen,
        connect=connect,
        lease_ms=options.lease_ms,
        tls=tls,
    )

    from holdfast.runtime.allocator import limit_arenas
    from holdfast.runtime.logs import EventLog
    from holdfast.runtime.service_shell import ServiceShell
    from holdfast.service.known_problems import KnownProblems
    from holdfast.session.service import Service
    from holdfast.session.service_limits import ServiceLimits

    limit_arenas()
    limits = ServiceLimits()
    if options.max_sessions is not None:
        limits = ServiceLimits(max_sessions=options.max_sessions)
    workers = options.workers or len(os.sched_getaffinity(0))
    problems = KnownProblems(options.problem, options.problem_directory or Path.cwd())

    def describe_error(error: BaseException) -> str:
        from holdfast.user_code import describe_problem_error

        return describe_problem_error("the problem", error)

    service = Service(problems, workers, limits, describe_error)
    events = EventLog(sys.stderr, format=options.log, component=options.name)
    metrics = metrics_server = None
    if options.metrics is not None:
        from holdfast.runtime.metrics import ServiceMetrics

        metrics = ServiceMetrics(lambda: shell.statistics(), name=options.name)
    shell = ServiceShell(
        service, transport, workers, events, None if metrics is None else metrics.on_decision
    )
    if metrics is not None:
        # Not before: who asks at once is told what the shell counts.
        metrics_server = metrics.start(options.metrics)
    sys.setswitchinterval(_SWITCH_INTERVAL_S)
    with _signals_to(shell.wakeup_descriptor):
        try:
            shell.start()
            # What was loaded stays; the collector need never look at it again.
            gc.freeze()
            gc.set_threshold(_BETWEEN_COLLECTIONS)
            gc.enable()
            where: dict[str, object] = {"listen": list(transport.endpoints)}
            if connect:
                where["connect"] = connect
            if metrics_server is not None:
                where["metrics_port"] = metrics_server.port
            _say_ready(options, boot, where)
            number = shell.wait([_STDIN] if options.until_stdin_closes else [])
            reason = signal.Signals(number).name if number else "standard input has ended"
            events.event("stopping", reason=reason)
        finally:
            shell.close(_CLOSE_TIMEOUT_S)
            if metrics_server is not None:
                metrics_server.close()
    return 0 if number in (0, signal.SIGTERM) else 128 + number


def _check_safe(endpoint: Endpoint, tls: TlsFiles | None, *, insecure: bool) -> None:
    """Refuse an address that other machines can reach, unless they have to prove who they are."""
    if endpoint.is_loopback or insecure or (endpoint.is_encrypted and tls is not None):
        return
    if endpoint.is_encrypted:
        return  # the transport says that credentials are missing
    raise TransportError(
        f"endpoint {endpoint}: other machines can reach it, and nobody there has to prove who he "
        f"is; use tls/... or quic/... with --tls DIR ('holdfast keys DIR' makes the credentials), "
        f"an address of this machine alone, as in tcp/{_DEFAULT_PLACE}, or say --insecure"
    )


def _warn(options: argparse.Namespace, text: str) -> None:
    if options.log == "json":
        from holdfast.runtime.logs import tell_event

        tell_event(options.name, "credentials", reason=text)
    else:
        sys.stderr.write(f"holdfast serve: warning: {printable(text)}\n")


def _say_ready(options: argparse.Namespace, boot: str, where: dict[str, object]) -> None:
    if options.log == "json":
        from holdfast.runtime.logs import EventLog

        EventLog(sys.stdout, format="json", component=options.name).event(
            "ready", service=options.name, boot=boot, pid=os.getpid(), **where
        )
        return
    parts = [
        f"{verb} {' and '.join(map(str, places))}"
        for verb, key in (("is listening on", "listen"), ("is connecting to", "connect"))
        if isinstance(places := where.get(key), list) and places
    ]
    if "metrics_port" in where:
        parts.append(f"offers metrics on port {where['metrics_port']}")
    # Nobody may be reading: that is no reason not to serve.
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.write(printable(f"{options.name} {', '.join(parts)}\n"))
        sys.stdout.flush()


@contextlib.contextmanager
def _signals_to(descriptor: int) -> Iterator[None]:
    """Have the numbers of signals that end a process written to a descriptor instead."""

    def note(number: int, frame: object) -> None:
        """Do nothing: without a handler of Python's own the number would not be written."""

    handled = [
        number
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if signal.getsignal(number) is not signal.SIG_IGN
    ]
    saved = {number: signal.signal(number, note) for number in handled}
    previous = signal.set_wakeup_fd(descriptor, warn_on_full_buffer=False)
    try:
        yield
    finally:
        signal.set_wakeup_fd(previous)
        for number, handler in saved.items():
            signal.signal(number, handler)
