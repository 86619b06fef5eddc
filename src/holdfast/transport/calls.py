"""What all wires' robot ends have in common: the table of calls in flight.

A call that has ended must stay ended, although its end can come from four sides: the service ends
it, the service vanishes, the robot abandons it, the transport closes. Whoever takes the call out of
the table delivers its end, and what comes later finds nothing.
"""

from __future__ import annotations

from collections.abc import Callable

from holdfast.errors import InvalidValueError
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent, Vanished

__all__ = ["CallTable", "PendingCall", "too_large"]


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


class PendingCall:
    """A call in flight.

    Its number may be used again as soon as it is abandoned, so what comes of it is told apart by
    this object.

    Attributes
    ----------
    number : int
    peer : object
        Whoever was asked.
    """

    __slots__ = ("number", "peer")

    def __init__(self, number: int, peer: object) -> None:
        self.number = number
        self.peer = peer


class CallTable:
    """Calls in flight of one robot's end; delivers each one's events in order and one end."""

    def __init__(self) -> None:
        self._pending: dict[int, PendingCall] = {}
        self._deliver: Callable[[TransportEvent], None] | None = None

    def open(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to deliver."""
        self._deliver = deliver

    def begin(self, number: int, peer: object) -> PendingCall | None:
        """Enter a call to a peer; return None if the table is closed.

        Raises
        ------
        InvalidValueError
            If a call of this number is in flight.
        """
        if self._deliver is None:
            return None
        if number in self._pending:
            raise InvalidValueError(f"call {number} is in flight already")
        call = self._pending[number] = PendingCall(number, peer)
        return call

    def is_pending(self, call: PendingCall) -> bool:
        """Whether a call has neither ended nor been abandoned."""
        return self._pending.get(call.number) is call

    def replied(self, call: PendingCall, payload: bytes) -> None:
        """Deliver a reply, if the call is still in flight."""
        if self._deliver is not None and self.is_pending(call):
            self._deliver(Replied(call.number, payload))

    def ended(self, call: PendingCall) -> None:
        """Deliver the end of a call, if it is still in flight."""
        if self._deliver is not None and self.is_pending(call):
            del self._pending[call.number]
            self._deliver(Ended(call.number))

    def abandon(self, number: int) -> PendingCall | None:
        """Take a call out without delivering anything."""
        return self._pending.pop(number, None)

    def appeared(self, service: str, boot: str) -> None:
        """Deliver that a service is there."""
        if self._deliver is not None:
            self._deliver(Appeared(service, boot))

    def vanished(self, service: str, boot: str, peer: object) -> None:
        """Deliver that a service is gone, then the ends of its calls."""
        if self._deliver is None:
            return
        # Those of now: who hears that it is gone may at once use a number again.
        calls = [call for call in self._pending.values() if call.peer is peer]
        self._deliver(Vanished(service, boot))
        for call in calls:
            self.ended(call)

    def lost(self, peer: object) -> None:
        """Deliver the ends of the calls to a peer."""
        for call in [call for call in self._pending.values() if call.peer is peer]:
            self.ended(call)

    def close(self) -> None:
        """Forget all calls and deliver nothing more."""
        self._deliver = None
        self._pending.clear()
