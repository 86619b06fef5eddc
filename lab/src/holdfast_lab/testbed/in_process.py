"""A transport without a wire, for robots and services in one event loop.

Each event is delivered in a later turn of the loop, as with a real transport, so neither end runs
inside the other. A service can be removed and come back with a new memory. Nothing is copied.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable

import msgspec

from holdfast.errors import InvalidValueError, TransportError
from holdfast.protocol.robot_events import TransportEvent
from holdfast.transport.calls import CallTable
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES, IncomingCall, too_large


class InProcessNetwork:
    """Connects the robot's ends and the service's ends that it has made.

    Parameters
    ----------
    max_message_bytes : int
        A larger request is refused, a larger reply is dropped.
    """

    def __init__(self, *, max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES) -> None:
        self._max_message_bytes = max_message_bytes
        self._robots: list[InProcessRobotTransport] = []
        self._services: list[InProcessServiceTransport] = []

    def robot(self, services: Iterable[str]) -> InProcessRobotTransport:
        """Make a robot's end that knows services of these names."""
        return InProcessRobotTransport(self, services, self._max_message_bytes)

    def service(
        self, name: str, incarnation: str, robot: str | None = None
    ) -> InProcessServiceTransport:
        """Make a service's end, reachable from its ``start`` to its ``close``.

        Its calls have the name ``robot``, as if from a certificate.
        """
        return InProcessServiceTransport(self, name, incarnation, robot, self._max_message_bytes)

    def _find(self, name: str) -> InProcessServiceTransport | None:
        """Return the service of this name that started last."""
        return next((each for each in reversed(self._services) if each.name == name), None)


class _InProcessCall(msgspec.Struct, eq=False):
    """A call; both ends hold it."""

    number: int
    robot_end: InProcessRobotTransport
    service_end: InProcessServiceTransport
    payload: bytes
    on_gone: Callable[[], object] | None = None  # no link here ends before its calls

    @property
    def robot(self) -> str | None:
        return self.service_end.robot

    def reply(self, payload: bytes, *, last: bool = False) -> None:
        if len(payload) <= self.service_end.max_message_bytes:
            asyncio.get_running_loop().call_soon(self.robot_end.calls.replied, self.number, payload)
        if last:
            self.end()

    def end(self) -> None:
        asyncio.get_running_loop().call_soon(self.robot_end.calls.ended, self.number)
        self.service_end.open_calls.discard(self)


class InProcessRobotTransport:
    """The robot's end; made by :meth:`InProcessNetwork.robot`."""

    def __init__(
        self, network: InProcessNetwork, services: Iterable[str], max_message_bytes: int
    ) -> None:
        self._network = network
        self._services = frozenset(services)
        self._max_message_bytes = max_message_bytes
        self.calls = CallTable()

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to deliver events: see :mod:`~holdfast.transport.contract`."""
        self.calls.open(deliver)
        self._network._robots.append(self)
        for service in self._network._services:
            if service.listens:
                self.appeared(service)

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Send a request."""
        if service not in self._services:
            raise InvalidValueError(f"service {service!r}: known are {sorted(self._services)}")
        peer = self._network._find(service)
        if not self.calls.begin(call, peer):
            return
        loop = asyncio.get_running_loop()
        if len(payload) > self._max_message_bytes:
            refusal = too_large(len(payload), self._max_message_bytes)
            loop.call_soon(self.calls.replied, call, refusal)
        elif peer is not None:
            loop.call_soon(peer.received, _InProcessCall(call, self, peer, payload))
            return
        loop.call_soon(self.calls.ended, call)

    def abandon(self, call: int) -> None:
        """Abandon a call."""
        self.calls.abandon(call)

    async def close(self, timeout_s: float = 1.0) -> None:
        """Forget all calls and deliver nothing more. May be repeated."""
        del timeout_s
        self.calls.close()
        if self in self._network._robots:
            self._network._robots.remove(self)

    def appeared(self, service: InProcessServiceTransport) -> None:
        """Deliver, in a later turn, that a service has appeared."""
        if service.name in self._services:
            asyncio.get_running_loop().call_soon(
                self.calls.appeared, service.name, service.incarnation
            )

    def vanished(self, service: InProcessServiceTransport) -> None:
        """Deliver, in a later turn, that a service has vanished."""
        if service.name in self._services:
            asyncio.get_running_loop().call_soon(
                self.calls.vanished, service.name, service.incarnation, service
            )


class InProcessServiceTransport:
    """The service's end; made by :meth:`InProcessNetwork.service`."""

    def __init__(
        self,
        network: InProcessNetwork,
        name: str,
        incarnation: str,
        robot: str | None,
        max_message_bytes: int,
    ) -> None:
        self._network = network
        self._deliver: Callable[[IncomingCall], None] | None = None
        self._started = False
        self.name = name
        self.incarnation = incarnation
        self.robot = robot
        self.max_message_bytes = max_message_bytes
        self.listens = True
        self.open_calls: set[_InProcessCall] = set()

    @property
    def endpoints(self) -> tuple[str, ...]:
        """No endpoints: there is nothing to connect to."""
        return ()

    async def start(self, deliver: Callable[[IncomingCall], None]) -> None:
        """Appear to the robots; raise TransportError if it was started before."""
        if self._started:
            raise TransportError(f"service {self.name}/{self.incarnation} was started before")
        self._started = True
        self._deliver = deliver
        self._network._services.append(self)
        for robot in self._network._robots:
            robot.appeared(self)

    def dismiss(self) -> asyncio.Future[None]:
        """Appear to no further robots; those that know the service are not notified."""
        self.listens = False
        gone: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        gone.set_result(None)
        return gone

    async def close(self, timeout_s: float = 1.0) -> None:
        """Vanish, and end all calls. May be repeated."""
        del timeout_s
        deliver, self._deliver = self._deliver, None
        if deliver is None:
            return
        self._network._services.remove(self)
        for robot in self._network._robots:
            robot.vanished(self)
        for call in list(self.open_calls):
            call.end()

    def received(self, call: _InProcessCall) -> None:
        """Deliver a robot's call."""
        if self._deliver is None:
            call.end()
            return
        self.open_calls.add(call)
        self._deliver(call)
