"""The robot's table of calls in flight, common to all transports.

A call can end for four reasons: the service ends it, the service vanishes, the robot abandons it,
or the transport closes. It must end only once, so the first of these removes it from the table.
"""

from __future__ import annotations

from collections.abc import Callable

from holdfast.errors import InvalidValueError
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)


class CallTable:
    """Calls in flight of one robot's end; delivers each one's events in order and one end."""

    def __init__(self) -> None:
        self._peers: dict[int, object] = {}
        self._deliver: Callable[[TransportEvent], None] | None = None

    def open(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to deliver."""
        self._deliver = deliver

    def begin(self, number: int, peer: object) -> bool:
        """Add a call to a peer; return False if the table is closed.

        Raises InvalidValueError if a call of this number is in flight.
        """
        if self._deliver is None:
            return False
        if number in self._peers:
            raise InvalidValueError(f"call {number} is in flight already")
        self._peers[number] = peer
        return True

    def to(self, peer: object) -> list[int]:
        """Return the calls to a peer."""
        return [number for number, its_peer in self._peers.items() if its_peer is peer]

    def replied(self, number: int, payload: bytes) -> None:
        """Deliver a reply, if the call is still in flight."""
        if self._deliver is not None and number in self._peers:
            self._deliver(ReplyReceived(number, payload))

    def ended(self, number: int) -> None:
        """Deliver the end of a call, if it is still in flight."""
        if self._deliver is not None and number in self._peers:
            del self._peers[number]
            self._deliver(CallEnded(number))

    def abandon(self, number: int) -> object | None:
        """Remove a call without delivering anything; return its peer."""
        return self._peers.pop(number, None)

    def appeared(self, service: str, incarnation: str) -> None:
        """Deliver that a service has appeared."""
        if self._deliver is not None:
            self._deliver(ServiceAppeared(service, incarnation))

    def vanished(self, service: str, incarnation: str, peer: object, reason: str = "") -> None:
        """Deliver that a service has vanished, then the ends of its calls."""
        if self._deliver is not None:
            self._deliver(ServiceVanished(service, incarnation, reason))
            self.peer_lost(peer)

    def peer_lost(self, peer: object) -> None:
        """Deliver the ends of the calls to a peer."""
        for number in self.to(peer):
            self.ended(number)

    def close(self) -> None:
        """Forget all calls and deliver nothing more."""
        self._deliver = None
        self._peers.clear()
