"""The options of ``holdfast serve``, read before anything slow is loaded."""

from __future__ import annotations

import argparse
import re
import signal
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from holdfast.config.reading import absolute_endpoint
from holdfast.errors import InvalidValueError, TransportError
from holdfast.printable import brief
from holdfast.runtime.command_line import Options, flag, location, number, option, whole_number
from holdfast.runtime.log_lines import LogFormat
from holdfast.runtime.logs import log_option
from holdfast.runtime.watchdog import DEFAULT_WATCHDOG_S, watchdog_option

if TYPE_CHECKING:
    from holdfast.runtime.monitoring import HttpAddress
    from holdfast.transport.endpoints import Endpoint

DEFAULT_NAME = "cloud_active_sensing"
"""The name of the service in the cloud (the thesis's)."""

_DEFAULT_PLACE = "127.0.0.1:7447"


def http_address(text: str) -> HttpAddress:
    """Read the address at which HTTP is answered: ``HOST:PORT``, or ``PORT`` of the loopback."""
    from holdfast.runtime.monitoring import HttpAddress
    from holdfast.transport.endpoints import parse_host

    host, colon, port = text.rpartition(":")
    try:
        host = parse_host(host) if colon else "127.0.0.1"
    except TransportError as error:
        raise argparse.ArgumentTypeError(f"is {brief(text)}: {error}") from None
    if not re.fullmatch("[0-9]{1,5}", port) or int(port) > 65535:
        raise argparse.ArgumentTypeError(
            f"is {brief(text)}: port {brief(port)} is not a whole number from 0 to 65535"
        )
    return HttpAddress(host, int(port))


def _descriptors(text: str) -> tuple[int, ...]:
    return tuple(int(word) for word in text.split(","))


class ServeOptions(Options):
    """Decide for robots, as a service: many at once, on all cores."""

    exit_codes: ClassVar = {0: "after SIGTERM or the end of standard input"}

    listen: tuple[str, ...] = option(
        many=True,
        read=absolute_endpoint,
        metavar="ENDPOINT",
        help=f"Where robots can connect (default: tcp/{_DEFAULT_PLACE}, with --tls over TLS).",
    )
    name: str = option(metavar="NAME", default=DEFAULT_NAME, help="Name of the service.")
    tls: Path | None = option(
        read=location,
        metavar="DIR",
        help="This service's credentials, as holdfast keys makes them. Robots need theirs of the "
        "same authority.",
    )
    insecure: bool = flag(
        help="Allow an address that other machines can reach without --tls: any of them can then "
        "use the service and read along."
    )
    processes: int = option(
        read=whole_number(1, 256),
        default=1,
        metavar="N",
        help="Processes behind the same address, watched by one more.",
    )
    health: HttpAddress | None = option(
        read=http_address,
        metavar="HOST:PORT",
        help="Answer http://HOST:PORT/livez and /readyz. A PORT alone is one of 127.0.0.1; 0 takes "
        "a free one.",
    )
    metrics: HttpAddress | None = option(
        read=http_address,
        metavar="HOST:PORT",
        help="Offer metrics for Prometheus at http://HOST:PORT/metrics. The address may be that of "
        "--health.",
    )
    log: LogFormat = log_option()
    watchdog_s: float = watchdog_option(DEFAULT_WATCHDOG_S)
    workers: int | None = option(
        read=whole_number(1, 256),
        metavar="N",
        help="Decisions that each process computes at a time (default: its share of the cores).",
    )
    lease_ms: float = option(
        read=number(50.0, 60_000.0, "ms"),
        default=400.0,
        metavar="MS",
        help="Robots consider this service lost after this long a silence. For the silence of a "
        "robot, its configuration has offload.lease_ms.",
    )
    max_sessions: int | None = option(
        read=whole_number(1, 1_000_000),
        metavar="N",
        help="Robots that each process remembers; the one unused the longest is forgotten first "
        "(default: 1000).",
    )
    drain_s: float = option(
        read=number(0.0, 3600.0, "s"),
        default=5.0,
        metavar="S",
        help="Time for pending answers after SIGTERM.",
    )
    max_sessions_per_robot: int | None = option(
        read=whole_number(1, 1_000_000),
        metavar="N",
        help="Runs remembered for the certificate of one robot (default: as many as there is room "
        "for).",
    )
    max_decision_s: float = option(
        read=number(0.01, 3600.0, "s"),
        default=10.0,
        metavar="S",
        help="Refuse a robot whose settings ask for decisions that are estimated to take longer, "
        "on one core of this machine.",
    )
    max_decision_mb: int = option(
        read=whole_number(1, 1_000_000),
        default=256,
        metavar="MB",
        help="The same for the memory of a decision, and a bound on that of all long decisions "
        "that a process computes at a time.",
    )
    problem: tuple[str, ...] = option(
        many=True,
        metavar="NAME",
        help="A problem to load at the start. Your own, module:Class, is served only if it is "
        "named here.",
    )
    problem_directory: Path | None = option(
        read=location,
        metavar="DIR",
        help="Where the modules of --problem are looked for first (default: the current "
        "directory).",
    )
    until_stdin_closes: bool = flag(
        help="Stop when standard input ends, as it does when the process that started this one "
        "dies."
    )
    # For a process that a robot launches: the descriptor of the connection to it.
    robot: int | None = option(metavar="N", read=int, help="", hidden=True)
    # For the processes that a supervisor starts: its number, and the descriptors they inherit.
    supervised: tuple[int, int] | None = option(
        metavar="N,N", read=_descriptors, help="", hidden=True
    )
    sockets: tuple[int, ...] = option(
        metavar="N,N", read=_descriptors, default=(), help="", hidden=True
    )

    @property
    def ending_signals(self) -> list[signal.Signals]:
        """Return those that end the service, but for those that are ignored from the start.

        With credentials, SIGHUP reads them again instead.
        """
        ending = [signal.SIGINT, signal.SIGTERM, *([] if self.tls else [signal.SIGHUP])]
        return [number for number in ending if signal.getsignal(number) is not signal.SIG_IGN]


def parse_options(arguments: Sequence[str]) -> ServeOptions:
    """Read what follows ``serve`` on the command line.

    Raises HoldfastError if an option cannot be used, or two do not go together.
    """
    options = ServeOptions.parse("serve", arguments)
    if options.processes > 1 and options.until_stdin_closes:
        raise InvalidValueError(
            "--until-stdin-closes: goes with one process only, not with --processes"
        )
    if not options.listen and options.robot is None:
        options.listen = (f"{'tls' if options.tls else 'tcp'}/{_DEFAULT_PLACE}",)
    return options


def checked_endpoints(options: ServeOptions) -> list[Endpoint]:
    """Return where to listen.

    Raises TransportError if an endpoint is malformed or cannot be used so, or is one that other
    machines can reach although they do not have to prove who they are; the message names the
    option; InvalidValueError if health or metrics are to be offered at the same port.
    """
    from holdfast.transport.endpoints import check_endpoint, check_name

    check_name("name of a service", options.name)
    listen = []
    for text in options.listen:
        try:
            endpoint = check_endpoint(text, "service")
        except TransportError as error:
            raise TransportError(f"--listen: {error}") from None
        # Of an encrypted one without credentials the transport says that they are missing.
        if not (endpoint.is_loopback or options.insecure or endpoint.is_encrypted):
            raise TransportError(
                f"--listen: endpoint {endpoint}: other machines can reach it, and no peer "
                f"proves its identity; use tls/... or udp/... with --tls KEYS/service "
                f"('holdfast keys KEYS' makes it), an address of this machine alone, as in "
                f"tcp/{_DEFAULT_PLACE}, or say --insecure"
            )
        listen.append(endpoint)
    for name, address in (("--health", options.health), ("--metrics", options.metrics)):
        for endpoint in listen:
            if address is not None and _is_same_port(endpoint, address):
                raise InvalidValueError(
                    f"{name} {address} and --listen {endpoint} name the same port; robots need "
                    f"one of their own"
                )
    return listen


def _is_same_port(endpoint: Endpoint, address: HttpAddress) -> bool:
    hosts = {endpoint.host, address.host}
    return endpoint.port == address.port != 0 and (
        len(hosts) == 1 or not hosts.isdisjoint(("0.0.0.0", "::"))  # all that this machine has
    )
