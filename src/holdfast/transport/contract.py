"""What a wire must do, for the robot's end and for the service's.

Everything happens on one thread, that of an asyncio event loop: there the methods are called, and
there what happens is delivered, to one callable. Nothing is delivered from inside a method of the
wire, so whoever calls one is never entered again on the way; and nothing here ever blocks. What is
delivered must return soon, too, for while it runs nothing else is heard.

Every implementation passes ``tests/contracts/test_transport``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from holdfast.session.events import TransportEvent

__all__ = ["DEFAULT_MAX_MESSAGE_BYTES", "IncomingCall", "RobotTransport", "ServiceTransport"]

DEFAULT_MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""Bound on a message, unless told otherwise: a state of a million particles fills 56 MB."""


class RobotTransport(Protocol):
    """The robot's end: it calls services by name."""

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to connect, in the running loop, and to deliver events.

        Events of one call come in the order in which they happened, and after its
        :class:`~holdfast.session.events.Ended` nothing more comes of it. A service that is there
        already is delivered as :class:`~holdfast.session.events.Appeared` as well. One that is gone
        is delivered as :class:`~holdfast.session.events.Vanished`, then the ends of its calls.

        Raises
        ------
        TransportError
            If the robot is to listen somewhere and cannot; the message names the endpoint.
        """
        ...

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Send a request; never raises for a lost service.

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

    async def close(self, timeout_s: float = 1.0) -> None:
        """Deliver nothing more, send what was to be sent, and close all links.

        It takes this long at most, whatever the other ends do. May be repeated.
        """
        ...


class IncomingCall(Protocol):
    """A request as the service sees it."""

    @property
    def payload(self) -> bytes:
        """The request."""
        ...

    @property
    def robot(self) -> str | None:
        """Name in the certificate with which the robot has proved who it is; None if it has not."""
        ...

    def reply(self, payload: bytes) -> None:
        """Send a reply; may be repeated. A robot that is gone is no error.

        A robot that does not read what it is sent loses its link, and nobody waits for it.
        """
        ...

    def end(self) -> None:
        """End the call; a call that is never ended would hold the robot until it gives up."""
        ...


class ServiceTransport(Protocol):
    """The service's end: it is seen, and is called."""

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where robots can connect; once started, with the ports that were free instead of 0."""
        ...

    async def start(self, deliver: Callable[[IncomingCall], None]) -> None:
        """Listen, be seen, and deliver calls; returns when robots can connect.

        Raises
        ------
        TransportError
            If it cannot listen there; the message names the endpoint.
        """
        ...

    def dismiss(self) -> asyncio.Future[None]:
        """Take no new links, and ask the robots to go elsewhere.

        Until they do, calls are delivered and answered as before. What is returned is done when all
        robots that can be told have gone.
        """
        ...

    async def close(self, timeout_s: float = 1.0) -> None:
        """End all calls, send what was to be sent, and close all links, within this time.

        May be repeated.
        """
        ...
