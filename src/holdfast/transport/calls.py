"""What all wires' robot ends have in common: the table of calls in flight.

A call that has ended must stay ended, although its end can come from four sides: the service ends
it, the service vanishes, the robot abandons it, the transport closes. Whoever takes the call out of
the table delivers its end, and what comes later finds nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable

from holdfast.errors import InvalidValueError
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent, Vanished

__all__ = ["CallTable", "too_large"]


def too_large(size_bytes: int, max_message_bytes: int) -> bytes:
    """Return the reply to a request that is larger than allowed, which therefore nobody reads."""
    # Imported here because it brings NumPy along, which a transport does not need otherwise.
    from holdfast.session.messages import Refused, encode

    return encode(
        Refused(
            0,
            "too_large",
            f"a request of {size_bytes} bytes: at most {max_message_bytes} are allowed",
        )
    )


class CallTable:
    """Calls in flight of one robot's end; delivers each one's events in order and one end."""

    def __init__(self) -> None:
        self._peers: dict[int, Hashable] = {}
        self._deliver: Callable[[TransportEvent], None] | None = None

    def open(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to deliver."""
        self._deliver = deliver

    def begin(self, call: int, peer: Hashable) -> bool:
        """Enter a call to a peer; return False if the table is closed.

        Raises
        ------
        InvalidValueError
            If a call of this number is in flight.
        """
        if self._deliver is None:
            return False
        if call in self._peers:
            raise InvalidValueError(f"call {call} is in flight already")
        self._peers[call] = peer
        return True

    def is_pending(self, call: int, peer: Hashable) -> bool:
        """Whether a call to this peer has neither ended nor been abandoned."""
        return call in self._peers and self._peers[call] == peer

    def replied(self, call: int, peer: Hashable, payload: bytes) -> None:
        """Deliver a reply, if the call is still in flight."""
        if self._deliver is not None and self.is_pending(call, peer):
            self._deliver(Replied(call, payload))

    def ended(self, call: int, peer: Hashable) -> None:
        """Deliver the end of a call, if it is still in flight."""
        if self._deliver is not None and self.is_pending(call, peer):
            del self._peers[call]
            self._deliver(Ended(call))

    def abandon(self, call: int) -> None:
        """Take a call out without delivering anything."""
        self._peers.pop(call, None)

    def appeared(self, service: str, boot: str) -> None:
        """Deliver that a service is there."""
        if self._deliver is not None:
            self._deliver(Appeared(service, boot))

    def vanished(self, service: str, boot: str, peer: Hashable) -> None:
        """Deliver that a service is gone, then the ends of its calls."""
        if self._deliver is None:
            return
        self._deliver(Vanished(service, boot))
        for call in [call for call, asked in self._peers.items() if asked == peer]:
            self.ended(call, peer)

    def close(self) -> None:
        """Forget all calls and deliver nothing more."""
        self._deliver = None
        self._peers.clear()
