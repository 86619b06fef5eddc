"""A robot and a service far from each other, emulated on one machine.

Where the machine permits it, each gets a network namespace with a tunnel device. This process reads
the packets of each device and writes them to the other half a round trip later, or drops them. Both
ends are the system's own TCP and UDP, so they treat late and lost packets as on a real line.
(``tc netem`` does the same, but not every kernel has it.)

Where the machine does not permit it, a proxy stands between them. It delays and drops datagrams as
well, but TCP ends at a proxy: it cannot drop TCP's packets, only deliver a piece later by the time
of a retransmission. Each route says how it is emulated.
"""

from __future__ import annotations

import contextlib
import functools
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple, TypeAlias, get_args

from holdfast.errors import InvalidValueError
from holdfast.lab.errors import CannotStartError
from holdfast.lab.testbed.datagrams import Carrier, DelayLine
from holdfast.lab.testbed.namespace import NetworkNamespace, why_no_namespace
from holdfast.lab.testbed.processes import free_port
from holdfast.lab.testbed.proxy import Impairment, Proxy

__all__ = ["Emulation", "Route", "Transport", "lay_route", "why_no_wide_area"]

Transport: TypeAlias = Literal["tcp", "tls", "udp"]

Emulation: TypeAlias = Literal["nothing", "packets", "tcp proxy", "datagram proxy"]
"""Nothing (robot and service share a loopback), packets between two namespaces, or a proxy."""

_ROBOT, _SERVICE = "10.77.0.1", "10.77.0.2"
"""Addresses in the two namespaces, which have no other members."""

_DEVICE = "wan"
_LARGEST = 65_536
_PATIENCE_S = 10.0

# Run in a namespace: makes its tunnel device and hands over the descriptor.
_OPEN = f"""
import fcntl, os, socket, struct, sys
device = os.open("/dev/net/tun", os.O_RDWR)
fcntl.ioctl(device, 0x400454CA, struct.pack("16sH", b"{_DEVICE}", 0x0001 | 0x1000))
socket.send_fds(socket.socket(fileno=int(sys.argv[1])), [b"."], [device])
"""


class Route(NamedTuple):
    """A route from a robot to a service.

    Attributes
    ----------
    robot_prefix, service_prefix : tuple of str
        Commands that run another one in the namespace of either end.
    listen : str
        The endpoint of the service.
    connect : str
        The same, as the robot has it.
    host : str
        By which the robot calls the service.
    emulated_by : str
        See :data:`Emulation`.
    carried_bytes : callable or None
        Returns the bytes of all packets sent so far, both ways, with headers and lost packets;
        None where no packets are seen.
    """

    robot_prefix: tuple[str, ...]
    service_prefix: tuple[str, ...]
    listen: str
    connect: str
    host: str
    emulated_by: Emulation
    carried_bytes: Callable[[], int] | None = None


@contextlib.contextmanager
def lay_route(
    transport: Transport, round_trip_ms: float, loss: float, seed: str, *, packets: bool = True
) -> Iterator[Route]:
    """Set up a route for as long as the ``with`` statement lasts.

    Parameters
    ----------
    transport : {"tcp", "tls", "udp"}
    round_trip_ms : float
        Half of it for each way. 0 without loss is the machine's own loopback.
    loss : float
        Share of packets that are lost, each way.
    seed : str
        Of the losses.
    packets : bool
        False uses a proxy even where namespaces are permitted.

    Raises
    ------
    InvalidValueError
        If there is no such transport, or a number is out of bounds.
    CannotStartError
        If it cannot be set up.
    """
    if transport not in get_args(Transport):
        raise InvalidValueError(
            f"transport {transport!r}: there are {', '.join(get_args(Transport))}"
        )
    port = free_port()
    near = f"{transport}/127.0.0.1:{port}"
    if round_trip_ms == 0.0 and loss == 0.0:
        yield Route((), (), near, near, "127.0.0.1", "nothing")
        return
    # Also checks the numbers.
    lines = [
        DelayLine[bytes](0.5e-3 * round_trip_ms, loss, f"{seed} {way}") for way in ("up", "down")
    ]
    if packets and why_no_wide_area() is None:
        with _two_networks(lines[0], lines[1]) as (robot, service, carried_bytes):
            far = f"{transport}/{_SERVICE}:{port}"
            yield Route(robot, service, far, far, _SERVICE, "packets", carried_bytes)
        return
    entry = free_port()
    through = f"{transport}/127.0.0.1:{entry}"
    round_trip_s = 1e-3 * round_trip_ms
    with Proxy(entry, port, seed, datagrams=transport == "udp") as proxy:
        proxy.impair(Impairment(latency_s=0.5 * round_trip_s, loss=loss))
        way: Emulation = "datagram proxy" if transport == "udp" else "tcp proxy"
        yield Route((), (), near, through, "127.0.0.1", way)


@functools.cache
def why_no_wide_area() -> str | None:
    """Return why no two networks can be made on this machine; None if they can."""
    reason = why_no_namespace()
    if reason is not None:
        return reason
    try:
        with _two_networks(DelayLine(0.0, 0.0, ""), DelayLine(0.0, 0.0, "")):
            return None
    except CannotStartError as error:
        return str(error).partition("\n")[0]


@contextlib.contextmanager
def _two_networks(
    up: DelayLine[bytes], down: DelayLine[bytes]
) -> Iterator[tuple[tuple[str, ...], tuple[str, ...], Callable[[], int]]]:
    """Yield the two commands that enter the namespaces, and a counter of all sent bytes."""
    with contextlib.ExitStack() as stack:
        robot = stack.enter_context(NetworkNamespace())
        service = stack.enter_context(NetworkNamespace())
        robot_end = stack.enter_context(_Device(robot, _ROBOT, _SERVICE))
        service_end = stack.enter_context(_Device(service, _SERVICE, _ROBOT))
        carrier = Carrier("wide-area")
        stack.callback(carrier.close)
        carrier.add(robot_end.descriptor, robot_end.receive, up, service_end.send)
        carrier.add(service_end.descriptor, service_end.receive, down, robot_end.send)
        carrier.start()
        yield (
            robot.prefix,
            service.prefix,
            lambda: robot_end.received_bytes + service_end.received_bytes,
        )


class _Device:
    """The tunnel device of one namespace, read and written by this process."""

    def __init__(self, network: NetworkNamespace, own: str, other: str) -> None:
        self._prefix = network.prefix
        self.received_bytes = 0
        here, there = socket.socketpair()
        with here, there:
            here.settimeout(_PATIENCE_S)
            passed = [sys.executable, "-I", "-S", "-c", _OPEN, str(there.fileno())]
            self._run(passed, (there.fileno(),))
            try:
                _, descriptors, _, _ = socket.recv_fds(here, 1, 1)
            except OSError as error:
                raise CannotStartError(f"no tunnel device can be made: {error}") from error
        (self.descriptor,) = descriptors
        try:
            os.set_blocking(self.descriptor, False)
            for command in (
                f"ip addr add {own} peer {other} dev {_DEVICE}",
                f"ip link set {_DEVICE} up",
            ):
                self._run(command.split(), ())
        except BaseException:
            os.close(self.descriptor)
            raise

    def __enter__(self) -> _Device:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.descriptor)

    def receive(self) -> bytes:
        packet = os.read(self.descriptor, _LARGEST)
        self.received_bytes += len(packet)
        return packet

    def send(self, packet: bytes) -> None:
        os.write(self.descriptor, packet)

    def _run(self, command: list[str], descriptors: tuple[int, ...]) -> None:
        try:
            done = subprocess.run(
                [*self._prefix, *command],
                pass_fds=descriptors,
                capture_output=True,
                timeout=_PATIENCE_S,
                check=False,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise CannotStartError(f"{command[0]} cannot be run: {error}") from error
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip().rpartition("\n")[2]
            raise CannotStartError(f"no tunnel device can be made: {said}")
