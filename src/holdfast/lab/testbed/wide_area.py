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
import math
import os
import random
import select
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar, get_args

from holdfast.errors import InvalidValueError
from holdfast.lab.errors import CannotStartError
from holdfast.lab.testbed.namespace import NetworkNamespace, why_no_namespace
from holdfast.lab.testbed.processes import free_port
from holdfast.lab.testbed.proxy import Impairment, Proxy

__all__ = ["DelayLine", "Emulation", "Route", "Transport", "lay_route", "why_no_wide_area"]

Transport: TypeAlias = Literal["tcp", "tls", "udp"]

Emulation: TypeAlias = Literal["nothing", "packets", "tcp proxy", "datagram proxy"]
"""Nothing (robot and service share a loopback), packets between two namespaces, or a proxy."""

_ROBOT, _SERVICE = "10.77.0.1", "10.77.0.2"
"""Addresses in the two namespaces, which have no other members."""

_DEVICE = "wan"
_NO_DEVICE = "no tunnel device can be made"
_LARGEST = 65_536
_PATIENCE_S = 10.0
_CAPACITY = 4096
"""Packets on the way in one direction: 6 MB of the usual size, as a router may hold."""

_LONGEST_DELAY_S = 60.0

Item = TypeVar("Item")

# Run in a namespace: makes its tunnel device and hands over the descriptor.
_OPEN = f"""
import fcntl, os, socket, struct, sys
device = os.open("/dev/net/tun", os.O_RDWR)
fcntl.ioctl(device, 0x400454CA, struct.pack("16sH", b"{_DEVICE}", 0x0001 | 0x1000))
socket.send_fds(socket.socket(fileno=int(sys.argv[1])), [b"."], [device])
"""


class DelayLine(Generic[Item]):
    """One direction of a line: items come out later, in order, or never.

    Parameters
    ----------
    delay_s : float
        From 0 to 60.
    loss : float
        Share of lost items, from 0 to 1.
    capacity : int
        Items put into a full line are lost, as in a router.

    Raises
    ------
    InvalidValueError
        If a number is out of bounds.
    """

    def __init__(self, delay_s: float, loss: float, seed: str, capacity: int = _CAPACITY) -> None:
        if not 0.0 <= delay_s <= _LONGEST_DELAY_S:
            raise InvalidValueError(f"delay_s {delay_s}: must be from 0 to {_LONGEST_DELAY_S:g}")
        if not 0.0 <= loss <= 1.0:
            raise InvalidValueError(f"loss {loss}: must be from 0 to 1")
        self._delay_s = delay_s
        self._loss = loss
        self._chance = random.Random(seed)
        self._capacity = capacity
        self._waiting: deque[tuple[float, Item]] = deque()
        self.lost = 0

    def put(self, item: Item, now: float) -> None:
        """Send an item; ``now``, in seconds, never goes back."""
        if len(self._waiting) >= self._capacity or self._chance.random() < self._loss:
            self.lost += 1
            return
        self._waiting.append((now + self._delay_s, item))

    def take(self, now: float) -> list[Item]:
        """Return the items that have arrived, in the order in which they were sent."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now:
            arrived.append(self._waiting.popleft()[1])
        return arrived

    @property
    def due(self) -> float:
        """When the next item arrives; infinite if there is none."""
        return self._waiting[0][0] if self._waiting else math.inf


class Route(NamedTuple):
    """A route from a robot to a service.

    Attributes
    ----------
    robot_prefix, service_prefix : tuple of str
        Commands that run another one in the namespace of either end.
    host : str
        By which the robot calls the service.
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
    round_trip_ms : float
        Half of it for each way. 0 without loss is the machine's own loopback.
    loss : float
        Share of packets that are lost, each way.
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


class _Way(NamedTuple):
    """From a readable descriptor, over a line, to a function that sends."""

    receive: Callable[[], Any]
    line: DelayLine[Any]
    send: Callable[[Any], object]


@contextlib.contextmanager
def _carried(ways: Mapping[int, _Way]) -> Iterator[None]:
    """Move packets from descriptors over lines, in a thread; what cannot be sent is lost."""
    ended, end = os.pipe()
    thread = threading.Thread(target=_carry, args=(ways, ended), name="wide-area", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.close(end)
        thread.join()
        os.close(ended)


def _carry(ways: Mapping[int, _Way], ended: int) -> None:
    while True:
        due = min(way.line.due for way in ways.values())
        wait_s = None if due == math.inf else max(0.0, due - time.monotonic())
        # poll has whole milliseconds, which would falsify short delays.
        ready, _, _ = select.select([ended, *ways], [], [], wait_s)
        if ended in ready:
            return
        for descriptor in ready:
            _receive(ways[descriptor])
        for way in ways.values():
            for packet in way.line.take(time.monotonic()):
                with contextlib.suppress(OSError):
                    way.send(packet)


def _receive(way: _Way) -> None:
    # Bounded, because other descriptors have packets too.
    for _ in range(_CAPACITY):
        try:
            packet = way.receive()
        except OSError:
            return  # there is no more, or the last one was refused
        way.line.put(packet, time.monotonic())


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
        ways = {
            robot_end.descriptor: _Way(robot_end.receive, up, service_end.send),
            service_end.descriptor: _Way(service_end.receive, down, robot_end.send),
        }
        stack.enter_context(_carried(ways))
        yield (
            robot.prefix,
            service.prefix,
            lambda: robot_end.received_bytes + service_end.received_bytes,
        )


class _Device:
    """The tunnel device of one namespace, read and written by this process."""

    def __init__(self, network: NetworkNamespace, own: str, other: str) -> None:
        self.received_bytes = 0
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

    def receive(self) -> bytes:
        packet = os.read(self.descriptor, _LARGEST)
        self.received_bytes += len(packet)
        return packet

    def send(self, packet: bytes) -> None:
        os.write(self.descriptor, packet)
