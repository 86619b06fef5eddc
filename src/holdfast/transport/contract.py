"""The contract of transports, for the robot's end and for the service's.

Everything happens on the thread of an asyncio event loop: methods are called there, and events are
delivered there, to one callable. No event is delivered from inside a method, so callers need not be
reentrant. No method blocks, and the callable must return soon, because it blocks the loop.

Every implementation passes ``tests/contracts/test_transport_contract``.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from holdfast.protocol.robot_events import TransportEvent

DEFAULT_MAX_MESSAGE_BYTES = 64 * 1024 * 1024
"""Default bound on a message: a state of a million particles fills 56 MB."""


def too_large(size_bytes: int, max_message_bytes: int) -> bytes:
    """Return the reply to a request that is larger than allowed."""
    # Imported here because it imports NumPy, which no transport needs.
    from holdfast.protocol.messages import Refused, encode

    return encode(
        Refused(
            0,
            "too_large",
            f"a request of {size_bytes} bytes: at most {max_message_bytes} are allowed",
        )
    )


class RobotTransport(Protocol):
    """The robot's end: it calls services by name."""

    def start(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to connect, in the running loop, and to deliver events.

        They are the transport events of :mod:`holdfast.protocol.robot_events`. Those of one call
        come in the order in which they happened, and after its ``CallEnded`` nothing more comes of
        it. A service that is already there is delivered as ``ServiceAppeared`` as well. One that is
        gone is delivered as ``ServiceVanished``, then the ends of its calls.
        """

    def call(self, service: str, call: int, payload: bytes) -> None:
        """Send a request to a known service; never raises for a lost one.

        The results are events with the number ``call``, which is unique while the transport is
        open. The last event is always ``CallEnded``, soon if the service is absent or lost.
        """

    def abandon(self, call: int) -> None:
        """Abandon a call: nothing more of it is delivered, not even its end."""

    async def close(self, timeout_s: float = 1.0) -> None:
        """Deliver nothing more, flush, and close all links, within this time. May be repeated."""


class IncomingCall(Protocol):
    """A request as the service sees it."""

    on_gone: Callable[[], object] | None
    """Called when the link has ended before the call: nobody awaits replies any more."""

    @property
    def payload(self) -> bytes:
        """The request."""

    @property
    def robot(self) -> str | None:
        """Name in the robot's certificate; None without one."""

    def reply(self, payload: bytes, *, last: bool = False) -> None:
        """Send a reply; the last one ends the call. A robot that is gone is no error.

        A robot that does not read loses its link, and nothing waits for it.
        """

    def end(self) -> None:
        """End the call; the robot waits for the end of every call. May be repeated."""


class ServiceTransport(Protocol):
    """The service's end: robots find it and call it."""

    @property
    def endpoints(self) -> tuple[str, ...]:
        """Where robots can connect; once started, with the ports that were free instead of 0."""

    async def start(self, deliver: Callable[[IncomingCall], None]) -> None:
        """Listen and deliver calls; returns when robots can connect.

        Raises TransportError if it cannot listen there; the message names the endpoint.
        """

    def dismiss(self) -> asyncio.Future[None]:
        """Take no new links, and ask the robots to go elsewhere.

        Until they do, calls are delivered and answered as before. The future is done when all
        robots that can be asked have left.
        """

    async def close(self, timeout_s: float = 1.0) -> None:
        """End all calls, flush, and close all links, within this time. May be repeated."""
