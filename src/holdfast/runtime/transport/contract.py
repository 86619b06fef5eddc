"""What a wire must do, for the robot's end and for the service's.

Both ends deliver what happens to one callable, from threads of their own; it must not block, so it
is usually the ``put`` of a queue. To reply can block. Every implementation passes
``tests/contracts/test_transport``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from holdfast.session.events import TransportEvent

__all__ = ["IncomingCall", "RobotTransport", "ServiceTransport"]


class RobotTransport(Protocol):
    """The robot's end: it calls services by name."""

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to connect, and to deliver events; returns at once, connected or not.

        Events of one call come in the order in which they happened, and after its
        :class:`~holdfast.session.events.Ended` nothing more comes of it. A service that is there
        already is delivered as :class:`~holdfast.session.events.Appeared` as well.
        """
        ...

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Send a request; it never blocks for an answer and never raises for a lost service.

        Whatever happens is delivered as events, and the last one is always ``Ended``: soon if the
        service is not there, or is lost before the call has ended.

        Parameters
        ----------
        service : str
            One of those that the transport was made for.
        call : int
            Number by which the events name this call; unique while the transport is open.
        payload : bytes
            The request.
        """
        ...

    def abandon(self, call: int) -> None:
        """Give a call up: nothing more of it is delivered, not even its end."""
        ...

    def close(self, timeout_s: float = 1.0) -> None:
        """Close all links, within about this time whatever the other ends do. May be repeated."""
        ...


class IncomingCall(Protocol):
    """A request as the service sees it."""

    @property
    def payload(self) -> bytes:
        """The request."""
        ...

    @property
    def size_bytes(self) -> int:
        """Of the request, without a copy of it."""
        ...

    def reply(self, payload: bytes) -> None:
        """Send a reply; may be repeated, from any thread. A robot that is gone is no error."""
        ...

    def end(self) -> None:
        """End the call; a call that is never ended would hold the robot until it gives up."""
        ...


class ServiceTransport(Protocol):
    """The service's end: it is seen, and is called."""

    def start(self, deliver: Callable[[IncomingCall], None]) -> None:
        """Listen, be seen, and deliver calls; returns when robots can connect.

        Raises
        ------
        TransportError
            If it cannot listen there; the message names the endpoint.
        """
        ...

    def close(self, timeout_s: float = 1.0) -> None:
        """Be seen no more, end all calls, and close all links, within about this time."""
        ...
