"""A robot and a service far from each other, emulated on one machine.

Where the machine permits it, each gets a network namespace with a tunnel device. This process reads
the packets of each device and writes them to the other half a round trip later, or drops them
(:mod:`~holdfast_lab.testbed.bad_line`). Both ends are the system's own TCP and UDP, so they treat
late and lost packets as on a real line. (``tc netem`` does the same, but not every kernel has it.)

Where the machine does not permit it, a proxy stands between them. It delays and drops datagrams as
well, but TCP ends at a proxy: it cannot drop TCP's packets, only deliver a piece later by the time
of a retransmission. Each route says how it is emulated.
"""

from __future__ import annotations

import contextlib
import functools
import os
import selectors
import socket
import sys
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple, TypeAlias, get_args

from holdfast.errors import InvalidValueError
from holdfast_lab.errors import CannotStartError
from holdfast_lab.testbed.bad_line import BadLine, Direction, Impairment
from holdfast_lab.testbed.namespace import NetworkNamespace, why_no_namespace
from holdfast_lab.testbed.processes import free_port
from holdfast_lab.testbed.proxy import Proxy

Transport: TypeAlias = Literal["tcp", "tls", "udp"]

Emulation: TypeAlias = Literal["nothing", "packets", "tcp proxy", "datagram proxy"]
"""Nothing (robot and service share a loopback), packets between two namespaces, or a proxy."""

_ROBOT, _SERVICE = "10.77.0.1", "10.77.0.2"
"""Addresses in the two namespaces, which have no other members."""

_DEVICE = "wan"
_NO_DEVICE = "no tunnel device can be made"
_LARGEST = 65_536
_PATIENCE_S = 10.0
_PACKETS_A_TURN = 4096
_LONGEST_ROUND_TRIP_MS = 120_000.0

# Run in a namespace: makes its tunnel device and hands over the descriptor.
_OPEN = f"""
import fcntl, os, socket, struct, sys
device = os.open("/dev/net/tun", os.O_RDWR)
fcntl.ioctl(device, 0x400454CA, struct.pack("16sH", b"{_DEVICE}", 0x0001 | 0x1000))
socket.send_fds(socket.socket(fileno=int(sys.argv[1])), [b"."], [device])
"""


class Route(NamedTuple):
    """A route from a robot to a service."""

    # Commands that run another one in the namespace of either end.
    robot_prefix: tuple[str, ...]
    service_prefix: tuple[str, ...]
    listen: str
    connect: str
    host: str  # by which the robot calls the service
    emulated_by: Emulation
    # Returns the bytes of all packets sent so far, both ways, with headers and lost packets; None
    # where no packets are seen.
    carried_bytes: Callable[[], int] | None = None


@contextlib.contextmanager
def lay_route(
    transport: Transport, round_trip_ms: float, loss: float, seed: str, *, packets: bool = True
) -> Iterator[Route]:
    """Set up a route for as long as the ``with`` statement lasts.

    Raises InvalidValueError if there is no such transport, or a number is out of bounds;
    CannotStartError if it cannot be set up.

    Parameters
    ----------
    round_trip_ms : float
        Half of it for each way. 0 without loss is the machine's own loopback.
    loss : float
        Share of packets that are lost, each way.
    packets : bool
        False uses a proxy even where namespaces are permitted.
    """
    if transport not in get_args(Transport):
        raise InvalidValueError(
            f"transport {transport!r}: there are {', '.join(get_args(Transport))}"
        )
    if not 0.0 <= round_trip_ms <= _LONGEST_ROUND_TRIP_MS:
        raise InvalidValueError(
            f"round_trip_ms {round_trip_ms}: must be from 0 to {_LONGEST_ROUND_TRIP_MS:g}"
        )
    if not 0.0 <= loss <= 1.0:
        raise InvalidValueError(f"loss {loss}: must be from 0 to 1")
    port = free_port()
    near = f"{transport}/127.0.0.1:{port}"
    if round_trip_ms == 0.0 and loss == 0.0:
        yield Route((), (), near, near, "127.0.0.1", "nothing")
        return
    impairment = Impairment(latency_s=0.5e-3 * round_trip_ms, loss=loss)
    if packets and why_no_wide_area() is None:
        with _two_networks(seed) as (line, robot, service):
            line.impair(impairment)
            far = f"{transport}/{_SERVICE}:{port}"
            carried = lambda: line.carried_bytes  # noqa: E731
            yield Route(robot.prefix, service.prefix, far, far, _SERVICE, "packets", carried)
        return
    entry = free_port()
    through = f"{transport}/127.0.0.1:{entry}"
    with Proxy(entry, port, seed, datagrams=transport == "udp") as proxy:
        proxy.impair(impairment)
        way: Emulation = "datagram proxy" if transport == "udp" else "tcp proxy"
        yield Route((), (), near, through, "127.0.0.1", way)


@functools.cache
def why_no_wide_area() -> str | None:
    """Return why no two networks can be made on this machine; None if they can."""
    reason = why_no_namespace()
    if reason is not None:
        return reason
    try:
        with _two_networks(""):
            return None
    except CannotStartError as error:
        return str(error).partition("\n")[0]


class _PacketLine(BadLine):
    """A line between the tunnel devices of two networks."""

    def __init__(self, robot_end: _Device, service_end: _Device, seed: str) -> None:
        super().__init__("wide-area", seed, selector=selectors.SelectSelector())
        self._ends = (robot_end, service_end)
        self.carried_bytes = 0
        self._call(self._open())

    async def _open(self) -> None:
        robot_end, service_end = self._ends
        self._loop.add_reader(
            robot_end.descriptor, self._receive, robot_end, service_end, "to_service"
        )
        self._loop.add_reader(
            service_end.descriptor, self._receive, service_end, robot_end, "to_robot"
        )

    async def _end(self) -> None:
        await super()._end()
        for each in self._ends:
            self._loop.remove_reader(each.descriptor)

    def _receive(self, source: _Device, sink: _Device, direction: Direction) -> None:
        # Bounded, because the other device has packets too.
        with contextlib.suppress(OSError):  # there is no more
            for _ in range(_PACKETS_A_TURN):
                packet = os.read(source.descriptor, _LARGEST)
                self.carried_bytes += len(packet)
                self._carry_datagram(packet, direction, sink.send)


@contextlib.contextmanager
def _two_networks(seed: str) -> Iterator[tuple[_PacketLine, NetworkNamespace, NetworkNamespace]]:
    """Yield a line and the namespaces of the robot and the service at its ends."""
    with contextlib.ExitStack() as stack:
        robot = stack.enter_context(NetworkNamespace())
        service = stack.enter_context(NetworkNamespace())
        robot_end = stack.enter_context(_Device(robot, _ROBOT, _SERVICE))
        service_end = stack.enter_context(_Device(service, _SERVICE, _ROBOT))
        line = stack.enter_context(_PacketLine(robot_end, service_end, seed))
        yield line, robot, service


class _Device:
    """The tunnel device of one namespace, read and written by this process."""

    def __init__(self, network: NetworkNamespace, own: str, other: str) -> None:
        here, there = socket.socketpair()
        with here, there:
            here.settimeout(_PATIENCE_S)
            passed = [sys.executable, "-I", "-S", "-c", _OPEN, str(there.fileno())]
            network.run(passed, _NO_DEVICE, descriptors=(there.fileno(),))
            try:
                _, descriptors, _, _ = socket.recv_fds(here, 1, 1)
            except OSError as error:
                raise CannotStartError(f"{_NO_DEVICE}: {error}") from error
        (self.descriptor,) = descriptors
        try:
            os.set_blocking(self.descriptor, False)
            for command in (
                f"ip addr add {own} peer {other} dev {_DEVICE}",
                f"ip link set {_DEVICE} up",
            ):
                network.run(command.split(), _NO_DEVICE)
        except BaseException:
            os.close(self.descriptor)
            raise

    def __enter__(self) -> _Device:
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.descriptor)

    def send(self, packet: bytes) -> None:
        os.write(self.descriptor, packet)
