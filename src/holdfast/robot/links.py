"""From the configuration to a robot's links.

With services there is one link to each, and one at which the local service, once launched, connects
to the robot. Without services the planner is in the robot's process.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from holdfast.config.loader import Configuration
from holdfast.config.settings import OffloadSettings, PlanningSettings
from holdfast.errors import TransportError
from holdfast.planning import Planner
from holdfast.problems.problem import Problem
from holdfast.robot.memo_cache import MemoCache, MemoizingPlanner
from holdfast.robot.recovery_launcher import RecoveryExited, RecoveryLauncher
from holdfast.runtime.events import EventSink
from holdfast.transport.contract import RobotTransport

__all__ = ["RECOVERY_SERVICE", "Links", "check_services", "make_links"]

RECOVERY_SERVICE = "cloud_active_sensing_recovery"
"""The name of the local service (the thesis's)."""


class Links(NamedTuple):
    """A robot's links to services.

    Attributes
    ----------
    transport : RobotTransport or None
        Not started yet; None for a robot without services, which decides itself.
    services : tuple of str
        In order of preference.
    recovery : str or None
        The local service; None if there is none.
    launcher : callable or None
        Makes its launcher, given the callback for its end.
    offload : OffloadSettings
        For the dispatcher.
    close : callable
        Releases resources, after the transport is closed.
    make_planner : callable
        Joins the robot's problem and settings to the functions that lead from state to state.
    """

    transport: RobotTransport | None
    services: tuple[str, ...]
    recovery: str | None
    launcher: Callable[[Callable[[RecoveryExited], None]], RecoveryLauncher] | None
    offload: OffloadSettings
    close: Callable[[], None]
    make_planner: Callable[[Problem, PlanningSettings], Planner] = Planner


def check_services(configuration: Configuration, source: str | None = "") -> None:
    """Check what can be checked of the services before a run: endpoints and credentials.

    Parameters
    ----------
    source : str or None
        What stands before the key in a message; None leaves the key out, too, of services that
        were not given by it.

    Raises
    ------
    HoldfastError
        If one of them cannot be used; the message names its key.
    """
    offload = configuration.offload
    if not offload.services:
        return
    from holdfast.transport.endpoints import check_credentials, parse_endpoint

    tls = None
    if offload.tls is not None:
        from holdfast.transport.credentials import load_credentials

        # Warnings are reported when the run begins.
        tls = load_credentials(Path(offload.tls), "robot", warn=lambda _: None).files
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

    Raises
    ------
    TransportError
        If an endpoint is malformed, or does not go with the credentials.
    HoldfastError
        If the credentials cannot be used.
    """
    offload = configuration.offload
    if not offload.services:
        # The robot and its own planner come to the same states.
        make_planner = functools.partial(MemoizingPlanner, cache=MemoCache())
        return Links(None, (), None, None, offload, _nothing, make_planner)
    return _streams(configuration, log_path, events)


def _streams(configuration: Configuration, log_path: Path | None, events: EventSink) -> Links:
    # Only a robot that has services needs these.
    from holdfast.transport.credentials import load_credentials
    from holdfast.transport.endpoints import (
        ServiceAddress,
        check_credentials,
        check_name,
        parse_endpoint,
    )
    from holdfast.transport.private_socket import PrivateSocket
    from holdfast.transport.robot_end import StreamRobotTransport

    offload = configuration.offload
    if offload.name is not None:
        check_name("offload.name", offload.name)

    def tell_credentials(reason: str) -> None:
        events.event("credentials", reason=reason)

    tls = None
    name = offload.name or _machine_name()
    if offload.tls is not None:
        own = load_credentials(Path(offload.tls), "robot", warn=tell_credentials)
        tls = own.files
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
    for service in offload.services:
        endpoint = parse_endpoint(service)
        check_credentials(endpoint, tls)
        if not endpoint.is_encrypted and not endpoint.is_loopback:
            events.event(
                "insecure",
                service=service,
                reason="whoever is on the way can read along and decide in its place; "
                + (
                    "ROS_HOSTNAME=127.0.0.1 keeps ROS 1 on this machine"
                    if endpoint.is_ros1
                    else "use tls/... or udp/... with --tls"
                ),
            )
    addresses = {service: ServiceAddress(service) for service in offload.services}
    recovery = None
    launcher = None
    close: Callable[[], None] = _nothing
    if configuration.recovery.launch != "never":
        recovery = RECOVERY_SERVICE
        local = PrivateSocket()
        close = local.remove
        addresses[recovery] = ServiceAddress(local.endpoint, listens=True, name=recovery)
        arguments = [
            "--name",
            recovery,
            "--connect",
            local.endpoint,
            "--lease-ms",
            f"{offload.lease_ms:g}",
            "--until-stdin-closes",
            *_problem_arguments(configuration),
        ]

        def launcher(deliver: Callable[[RecoveryExited], None]) -> RecoveryLauncher:
            return RecoveryLauncher(arguments, deliver, log_path)

    try:
        transport = StreamRobotTransport(
            addresses,
            name=name,
            incarnation=os.urandom(8).hex(),
            lease_ms=offload.lease_ms,
            tls=tls,
            on_event=events.event,
        )
    except BaseException:
        close()
        raise
    return Links(transport, offload.services, recovery, launcher, offload, close)


def _problem_arguments(configuration: Configuration) -> list[str]:
    """Return what lets the local service build a problem that is not registered."""
    if ":" not in configuration.problem_name:
        return []
    arguments = ["--problem", configuration.problem_name]
    if configuration.problem_directory is not None:
        arguments += ["--problem-directory", str(configuration.problem_directory)]
    return arguments


def _machine_name() -> str:
    """Return the name of this machine in the characters that services accept."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", socket.gethostname()).lstrip("_.-")[:100]


def _nothing() -> None:
    pass
