"""From the configuration to a robot's links.

With services there is one link to each, and one to the local service, once that is launched.
Without services the planner is in the robot's process.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from holdfast.config.loader import Configuration
from holdfast.errors import TransportError
from holdfast.planning.planner import Planner
from holdfast.planning.settings import OffloadSettings, PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.robot.memo_cache import MemoCache, MemoizingPlanner
from holdfast.robot.recovery_launcher import RecoveryLauncher
from holdfast.runtime.events import EventSink
from holdfast.transport.contract import RobotTransport

if TYPE_CHECKING:
    from holdfast.transport.endpoints import TlsFiles

RECOVERY_SERVICE = "cloud_active_sensing_recovery"
"""The name of the local service (the thesis's)."""


class Links(NamedTuple):
    """A robot's links to services."""

    transport: RobotTransport | None
    """Not started yet; None for a robot without services, which decides itself."""
    launcher: RecoveryLauncher | None = None
    """Launches the local service; None if there is none."""
    make_planner: Callable[[Problem, PlanningSettings], Planner] = Planner
    """Joins the robot's problem and settings to the functions that lead from state to state."""


def check_services(configuration: Configuration, source: str | None = "") -> None:
    """Check what can be checked of the services before a run: endpoints and credentials.

    Raises HoldfastError if one of them cannot be used; the message names its key, after ``source``.
    None leaves the key out, too, of services that were not given by it.
    """
    offload = configuration.offload
    if not offload.services:
        return
    from holdfast.transport.endpoints import check_credentials, parse_endpoint

    # Warnings are reported when the run begins.
    _, tls = _identity(offload, lambda _: None)
    for index, service in enumerate(offload.services):
        try:
            endpoint = parse_endpoint(service)
            check_credentials(endpoint, tls)
            if endpoint.protocol == "udp":
                from holdfast.transport.datagram_cipher import require_cryptography

                require_cryptography()
        except TransportError as error:
            if source is None:
                raise
            raise TransportError(f"{source}offload.services[{index}]: {error}") from error


def make_links(configuration: Configuration, log_path: Path | None, events: EventSink) -> Links:
    """Make the links that a configuration asks for.

    Raises HoldfastError if an endpoint or the credentials cannot be used.
    """
    offload = configuration.offload
    if not offload.services:
        # The robot and its own planner come to the same states.
        return Links(None, make_planner=functools.partial(MemoizingPlanner, cache=MemoCache()))
    # Only a robot that has services needs these.
    from holdfast.transport.endpoints import parse_endpoint
    from holdfast.transport.robot_end import StreamRobotTransport

    def tell_credentials(reason: str) -> None:
        events.event("credentials", reason=reason)

    name, tls = _identity(offload, tell_credentials)
    for service in offload.services:
        endpoint = parse_endpoint(service)
        if not endpoint.is_encrypted and not endpoint.is_loopback:
            events.event(
                "insecure",
                service=service,
                reason="whoever is on the way can read along and decide in its place; use tls/... "
                "or udp/... with --tls",
            )
    endpoints: dict[str, str | None] = {service: service for service in offload.services}
    launches = configuration.recovery.launch != "never"
    if launches:
        endpoints[RECOVERY_SERVICE] = None
    transport = StreamRobotTransport(
        endpoints,
        name=name,
        incarnation=os.urandom(8).hex(),
        lease_ms=offload.lease_ms,
        tls=tls,
        on_event=events.event,
    )
    if not launches:
        return Links(transport)
    arguments = ["--name", RECOVERY_SERVICE, "--lease-ms", f"{offload.lease_ms:g}"]
    # The most there is: it decides for this robot alone, as a run without services would.
    arguments += ["--max-decision-s", "3600", "--max-decision-mb", "1000000"]
    if ":" in configuration.problem_name:
        arguments += ["--problem", configuration.problem_name]
        if configuration.problem_directory is not None:
            arguments += ["--problem-directory", str(configuration.problem_directory)]
    attach = functools.partial(transport.attach, RECOVERY_SERVICE)
    return Links(transport, RecoveryLauncher(arguments, attach, log_path))


def _identity(offload: OffloadSettings, warn: Callable[[str], None]) -> tuple[str, TlsFiles | None]:
    """Return the robot's name for its services, and its credentials."""
    from holdfast.transport.credentials import load_credentials
    from holdfast.transport.endpoints import check_name

    if offload.name is not None:
        check_name("offload.name", offload.name)
    if offload.tls is None:
        # The name of this machine in the characters that services accept.
        machine = re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname()).lstrip("_.-")[:100]
        return offload.name or machine, None
    own = load_credentials(Path(offload.tls), "robot", warn=warn)
    name = offload.name or ""
    with contextlib.suppress(TransportError):  # what another program made may have any name
        check_name("", own.name)
        name = name or own.name
    if name not in ("", own.name):
        raise TransportError(
            f"offload.name {name!r}: the certificate in {offload.tls} is {own.name}'s; copy "
            f"that robot's own credentials here ('holdfast keys DIR --robot {name}' makes "
            "them), or leave the key out"
        )
    return name, own.files
