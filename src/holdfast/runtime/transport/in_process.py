"""A wire that is none: robots and services of one process, with the manners of a real one.

Everything goes over threads of its own, so that neither end ever runs inside the other, and a
service can be taken away and come back with a new memory. Nothing is copied.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from functools import partial
from time import monotonic

from holdfast.errors import InvalidValueError, TransportError
from holdfast.runtime.transport.calls import (
    DEFAULT_MAX_MESSAGE_BYTES,
    CallTable,
    Courier,
    PendingCall,
    too_large,
)
from holdfast.runtime.transport.contract import IncomingCall
from holdfast.session.events import TransportEvent

__all__ = ["InProcessNetwork", "InProcessRobotTransport", "InProcessServiceTransport"]


class InProcessNetwork:
    """Joins the robot's ends and the service's ends that it has made.

    Parameters
    ----------
    max_message_bytes : int
        A larger request is refused, a larger reply is dropped.
    """

    def __init__(self, *, max_message_bytes: int = DEFAULT_MAX_MESSAGE_BYTES) -> None:
        self._max_message_bytes = max_message_bytes
        self._lock = threading.RLock()
        self._robots: list[InProcessRobotTransport] = []
        self._services: list[InProcessServiceTransport] = []

    def robot(self, services: Iterable[str]) -> InProcessRobotTransport:
        """Make a robot's end that knows services of these names."""
        return InProcessRobotTransport(self, services, self._max_message_bytes)

    def service(self, name: str, boot: str) -> InProcessServiceTransport:
        """Make a service's end; it is there from its ``start`` to its ``close``."""
        return InProcessServiceTransport(self, name, boot, self._max_message_bytes)

    def _join_robot(self, robot: InProcessRobotTransport) -> None:
        with self._lock:
            self._robots.append(robot)
            for service in self._services:
                robot._appeared(service)

    def _leave_robot(self, robot: InProcessRobotTransport) -> None:
        with self._lock:
            if robot in self._robots:
                self._robots.remove(robot)

    def _join_service(self, service: InProcessServiceTransport) -> None:
        with self._lock:
            self._services.append(service)
            for robot in self._robots:
                robot._appeared(service)

    def _leave_service(self, service: InProcessServiceTransport) -> None:
        with self._lock:
            if service in self._services:
                self._services.remove(service)
                for robot in self._robots:
                    robot._vanished(service)

    def _send(self, robot: InProcessRobotTransport, call: _InProcessCall, name: str) -> None:
        """Hand a call to the service of this name that started last, or end it."""
        with self._lock:
            for service in reversed(self._services):
                if service.name == name:
                    call.peer = service
                    service._received(call)
                    return
        robot._ended(call)


class _InProcessCall(PendingCall):
    """A call, which both ends hold."""

    __slots__ = ("_payload", "_robot")

    def __init__(self, number: int, robot: InProcessRobotTransport, payload: bytes) -> None:
        super().__init__(number, None)
        self._robot = robot
        self._payload = payload

    @property
    def payload(self) -> bytes:
        return self._payload

    @property
    def size_bytes(self) -> int:
        return len(self._payload)

    def reply(self, payload: bytes) -> None:
        self._robot._replied(self, payload)

    def end(self) -> None:
        self._robot._ended(self)


class InProcessRobotTransport:
    """The robot's end; made by :meth:`InProcessNetwork.robot`."""

    def __init__(
        self, network: InProcessNetwork, services: Iterable[str], max_message_bytes: int
    ) -> None:
        self._network = network
        self._services = frozenset(services)
        self._max_message_bytes = max_message_bytes
        self._calls = CallTable()
        self._courier = Courier("holdfast-robot-end")

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to deliver events: see :class:`~holdfast.runtime.transport.contract`."""
        self._calls.open(deliver)
        self._network._join_robot(self)

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Send a request."""
        if service not in self._services:
            raise InvalidValueError(f"service {service!r}: known are {sorted(self._services)}")
        pending = _InProcessCall(call, self, payload)
        if not self._calls.begin(pending):
            return
        if len(payload) > self._max_message_bytes:
            self._replied(pending, too_large(len(payload), self._max_message_bytes))
            self._ended(pending)
        else:
            self._network._send(self, pending, service)

    def abandon(self, call: int) -> None:
        """Give a call up."""
        self._calls.abandon(call)

    def close(self, timeout_s: float = 1.0) -> None:
        """Leave the network. May be repeated."""
        self._network._leave_robot(self)
        self._calls.close()
        self._courier.stop(monotonic() + timeout_s)

    def _appeared(self, service: InProcessServiceTransport) -> None:
        if service.name in self._services:
            self._courier.post(partial(self._calls.appeared, service.name, service.boot))

    def _vanished(self, service: InProcessServiceTransport) -> None:
        if service.name in self._services:
            self._courier.post(partial(self._calls.vanished, service.name, service.boot, service))

    def _replied(self, call: PendingCall, payload: bytes) -> None:
        if len(payload) <= self._max_message_bytes:
            self._courier.post(partial(self._calls.replied, call, payload))

    def _ended(self, call: PendingCall) -> None:
        self._courier.post(partial(self._calls.ended, call))


class InProcessServiceTransport:
    """The service's end; made by :meth:`InProcessNetwork.service`.

    Attributes
    ----------
    name, boot : str
    """

    def __init__(
        self, network: InProcessNetwork, name: str, boot: str, max_message_bytes: int
    ) -> None:
        self.name = name
        self.boot = boot
        self._network = network
        self._max_message_bytes = max_message_bytes
        self._deliver: Callable[[IncomingCall], None] | None = None
        self._courier = Courier("holdfast-service-end")
        self._lock = threading.RLock()
        self._closed = False

    def start(self, deliver: Callable[[IncomingCall], None]) -> None:
        """Be seen, and deliver calls."""
        with self._lock:
            if self._closed:
                raise TransportError(f"service {self.name} {self.boot} is closed")
            self._deliver = deliver
        self._network._join_service(self)

    def close(self, timeout_s: float = 1.0) -> None:
        """Be seen no more, and end all calls. May be repeated."""
        deadline_s = monotonic() + timeout_s
        with self._lock:
            self._closed = True
            self._deliver = None
        self._network._leave_service(self)
        self._courier.stop(deadline_s)

    def _received(self, call: _InProcessCall) -> None:
        self._courier.post(partial(self._hand_over, call))

    def _hand_over(self, call: _InProcessCall) -> None:
        with self._lock:
            if self._deliver is not None:
                self._deliver(call)
