"""The options of ``holdfast serve``, read before anything that takes time is loaded."""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, NoReturn

from holdfast.errors import InvalidValueError, TransportError

if TYPE_CHECKING:
    from holdfast.service.health import HttpAddress
    from holdfast.transport.endpoints import Endpoint

__all__ = ["DEFAULT_NAME", "Options", "checked_endpoints", "options_of_each", "parse_options"]

DEFAULT_NAME = "cloud_active_sensing"
"""The name of the service in the cloud (the thesis's)."""

_DEFAULT_PLACE = "127.0.0.1:7447"

_DEFAULT_ROUTER = "tcp/localhost:7447"
"""Where nodes of ROS 2 with rmw_zenoh look for their router."""

_OF_THE_SUPERVISOR = ("--listen", "--processes", "--health", "--metrics", "--workers")
"""Options that the processes of a service do not get as they were given."""


class Options(argparse.Namespace):
    """What was given, or its default; ``--help`` says what each means."""

    listen: list[str]
    connect: list[str]
    name: str
    tls: Path | None
    insecure: bool
    processes: int
    health: HttpAddress | None
    metrics: HttpAddress | None
    log: Literal["text", "json"]
    workers: int | None
    lease_ms: float
    max_sessions: int | None
    drain_s: float
    max_sessions_per_robot: int | None
    problem: list[str]
    problem_directory: Path | None
    configuration: Path | None
    ros2_domain: int | None
    ros2_name: str
    ros2_router: str | None
    ros2_listen: str | None
    ros1: bool
    ros1_name: str
    until_stdin_closes: bool
    supervised: tuple[int, int] | None
    sockets: list[int]

    @property
    def ending_signals(self) -> list[signal.Signals]:
        """Those that end a service; whoever started it may have them ignored.

        With credentials, SIGHUP has them read again instead.
        """
        ending = [signal.SIGINT, signal.SIGTERM, *([] if self.tls else [signal.SIGHUP])]
        return [number for number in ending if signal.getsignal(number) is not signal.SIG_IGN]

    @property
    def has_beside(self) -> bool:
        """Whether something else is to be offered, besides the service."""
        return self.ros2_domain is not None or self.ros1


def parse_options(arguments: Sequence[str]) -> Options:
    """Read what follows ``serve`` on the command line.

    Raises
    ------
    InvalidValueError
        If an option cannot be used, or two do not go together.
    """
    options = _parser().parse_args(arguments, Options())
    _check_beside(options)
    if options.processes > 1:
        for option, given in (
            ("--connect", options.connect),
            ("--ros2-domain", options.ros2_domain is not None),
            ("--ros1", options.ros1),
            ("--listen ros1/NAME", any(each.startswith("ros1/") for each in options.listen)),
            ("--until-stdin-closes", options.until_stdin_closes),
        ):
            if given:
                raise InvalidValueError(
                    f"{option}: goes with one process only, not with --processes"
                )
    if not options.listen and not options.connect and not options.has_beside:
        options.listen = [f"{'tls' if options.tls else 'tcp'}/{_DEFAULT_PLACE}"]
    return options


def _check_beside(options: Options) -> None:
    """Refuse options of what is offered besides the service that are given without it, or lack."""
    if options.ros2_domain is None:
        for option, given in (
            ("--ros2-name", options.ros2_name != DEFAULT_NAME),
            ("--ros2-router", options.ros2_router),
            ("--ros2-listen", options.ros2_listen),
        ):
            if given:
                raise InvalidValueError(f"{option}: goes with --ros2-domain only")
    elif options.ros2_router and options.ros2_listen:
        raise InvalidValueError(
            "--ros2-router and --ros2-listen do not go together: nodes are reached through a "
            "router, or they connect to this service"
        )
    elif not options.ros2_listen:
        options.ros2_router = options.ros2_router or _DEFAULT_ROUTER
    if not options.ros1 and options.ros1_name != DEFAULT_NAME:
        raise InvalidValueError("--ros1-name: goes with --ros1 only")
    if options.has_beside and options.configuration is None:
        raise InvalidValueError(
            f"{'--ros1' if options.ros1 else '--ros2-domain'}: --configuration is missing; it says "
            "for which problem and with which settings this service decides in ROS"
        )
    if options.configuration is not None and not options.has_beside:
        raise InvalidValueError(
            "--configuration: goes with --ros2-domain or --ros1 only; other robots bring theirs "
            "along"
        )


def options_of_each(arguments: Sequence[str]) -> list[str]:
    """Return which of the options given hold for each process of a service as they are."""
    own = _Parser(allow_abbrev=False, add_help=False)
    for option in _OF_THE_SUPERVISOR:
        own.add_argument(option)
    _, others = own.parse_known_args(arguments)
    return others


def checked_endpoints(options: Options) -> list[Endpoint]:
    """Return where to listen.

    Raises
    ------
    TransportError
        If an endpoint is malformed or cannot be used so, or is one that other machines can reach
        although they do not have to prove who they are; the message names the option.
    InvalidValueError
        If health or metrics are to be offered, or a router of ROS 2 is, at the same port.
    """
    from holdfast.transport.endpoints import check_direction, check_endpoint

    listen = []
    for option, texts in (("--listen", options.listen), ("--connect", options.connect)):
        listens = option == "--listen"
        for text in texts:
            try:
                endpoint = check_endpoint(text, listens=listens)
                check_direction(endpoint, service_listens=listens)
            except TransportError as error:
                raise TransportError(f"{option}: {error}") from None
            # Of an encrypted one without credentials the transport says that they are missing.
            if endpoint.is_ros1 and not (endpoint.is_loopback or options.insecure):
                raise TransportError(
                    f"{option}: endpoint {endpoint}: other machines can reach it, and nobody there "
                    f"has to prove who he is; set ROS_HOSTNAME=127.0.0.1, so that nobody can, or "
                    f"say --insecure"
                )
            if not (endpoint.is_loopback or options.insecure or endpoint.is_encrypted):
                raise TransportError(
                    f"{option}: endpoint {endpoint}: other machines can reach it, and nobody there "
                    f"has to prove who he is; use tls/... or udp/... with --tls DIR ('holdfast "
                    f"keys DIR' makes the credentials), an address of this machine alone, as in "
                    f"tcp/{_DEFAULT_PLACE}, or say --insecure"
                )
            if listens:
                listen.append(endpoint)
    _check_ros2_endpoint("--ros2-listen", options.ros2_listen, options)
    router = _check_ros2_endpoint("--ros2-router", options.ros2_router, options)
    for endpoint in listen:
        if router is not None and router.port == endpoint.port and router.is_loopback:
            raise InvalidValueError(
                f"--listen {endpoint} and --ros2-router {router} name the same port, which "
                f"rmw_zenohd needs; robots need one of their own"
            )
    for option, address in (("--health", options.health), ("--metrics", options.metrics)):
        for endpoint in listen:
            if address is not None and _is_same_port(endpoint, address):
                raise InvalidValueError(
                    f"{option} {address} and --listen {endpoint} name the same port; robots need "
                    f"one of their own"
                )
    return listen


def _check_ros2_endpoint(option: str, text: str | None, options: Options) -> Endpoint | None:
    from holdfast.transport.endpoints import parse_endpoint

    if text is None:
        return None
    try:
        endpoint = parse_endpoint(text)
    except TransportError as error:
        raise TransportError(f"{option}: {error}") from None
    if endpoint.protocol != "tcp" or not endpoint.port:
        raise TransportError(
            f"{option}: endpoint {endpoint}: rmw_zenoh is spoken over tcp, at a port that is "
            f"given, as in tcp/localhost:7447"
        )
    if not (endpoint.is_loopback or options.insecure):
        raise TransportError(
            f"{option}: endpoint {endpoint}: it is on other machines or they can reach it, and "
            f"nobody there has to prove who he is; use one of this machine alone, as in "
            f"tcp/localhost:7447, or say --insecure"
        )
    return endpoint


def _is_same_port(endpoint: Endpoint, address: HttpAddress) -> bool:
    hosts = {endpoint.host, address.host}
    return endpoint.port == address.port != 0 and (
        len(hosts) == 1 or not hosts.isdisjoint(("0.0.0.0", "::"))  # all that this machine has
    )


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
    add(
        "--configuration",
        type=Path,
        metavar="FILE",
        help="the configuration by which this service decides in ROS, whose nodes bring none along",
    )
    add(
        "--ros2-domain",
        type=_whole_number(0, 232),
        metavar="N",
        help="offer a service to ROS 2 nodes of this domain that use rmw_zenoh, too; it needs no "
        "ROS (pip install 'holdfast[ros]'). Then nothing else listens here unless --listen says so",
    )
    add(
        "--ros2-name",
        default=DEFAULT_NAME,
        metavar="NAME",
        help=f"name of that service in ROS 2 (default: {DEFAULT_NAME})",
    )
    add(
        "--ros2-router",
        metavar="ENDPOINT",
        help=f"where rmw_zenohd listens (default: {_DEFAULT_ROUTER}); it may come later, and go",
    )
    add(
        "--ros2-listen",
        metavar="ENDPOINT",
        help="where nodes of ROS 2 can connect, instead of a router",
    )
    add(
        "--ros1",
        action="store_true",
        help="offer a service in ROS 1, too, where ROS_MASTER_URI and the like say; it needs no "
        "ROS (pip install 'holdfast[ros]'). Then nothing else listens here unless --listen says so",
    )
    add(
        "--ros1-name",
        default=DEFAULT_NAME,
        metavar="NAME",
        help=f"name of that service and of its node in ROS 1 (default: {DEFAULT_NAME})",
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
