"""The robot's table of calls in flight, common to all transports.

A call can end for four reasons: the service ends it, the service vanishes, the robot abandons it,
or the transport closes. It must end only once, so the first of these removes it from the table.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from holdfast.errors import InvalidValueError
from holdfast.protocol.events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)

__all__ = ["CallTable", "PendingCall", "too_large"]


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


class PendingCall(msgspec.Struct, eq=False):
    """A call in flight to ``peer``.

    Its number may be used again as soon as it is abandoned; this object identifies it.
    """

    number: int
    peer: object


class CallTable:
    """Calls in flight of one robot's end; delivers each one's events in order and one end."""

    def __init__(self) -> None:
        self._pending: dict[int, PendingCall] = {}
        self._deliver: Callable[[TransportEvent], None] | None = None

    def open(self, deliver: Callable[[TransportEvent], None]) -> None:
        """Begin to deliver."""
        self._deliver = deliver

    def begin(self, number: int, peer: object) -> PendingCall | None:
        """Add a call to a peer; return None if the table is closed.

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
            self._deliver(ReplyReceived(call.number, payload))

    def ended(self, call: PendingCall) -> None:
        """Deliver the end of a call, if it is still in flight."""
        if self._deliver is not None and self.is_pending(call):
            del self._pending[call.number]
            self._deliver(CallEnded(call.number))

    def abandon(self, number: int) -> PendingCall | None:
        """Remove a call without delivering anything."""
        return self._pending.pop(number, None)

    def appeared(self, service: str, incarnation: str) -> None:
        """Deliver that a service has appeared."""
        if self._deliver is not None:
            self._deliver(ServiceAppeared(service, incarnation))

    def vanished(self, service: str, incarnation: str, peer: object) -> None:
        """Deliver that a service has vanished, then the ends of its calls."""
        if self._deliver is None:
            return
        # Listed first: the receiver of ServiceVanished may reuse their numbers at once.
        calls = [call for call in self._pending.values() if call.peer is peer]
        self._deliver(ServiceVanished(service, incarnation))
        for call in calls:
            self.ended(call)

    def peer_lost(self, peer: object) -> None:
        """Deliver the ends of the calls to a peer."""
        for call in [call for call in self._pending.values() if call.peer is peer]:
            self.ended(call)

    def close(self) -> None:
        """Forget all calls and deliver nothing more."""
        self._deliver = None
        self._pending.clear()
