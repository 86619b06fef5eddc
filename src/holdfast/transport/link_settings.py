"""What all links of one end share: their settings, a receive buffer and a bound on memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from holdfast.transport.fair_scheduler import FairScheduler
    from holdfast.transport.links import Link

__all__ = ["LinkSettings", "PartialMessageBudget", "receive_buffer"]

_RECEIVED_AT_ONCE_BYTES: Final = 256 * 1024


def receive_buffer() -> memoryview:
    """Return a receive buffer for all links of one end.

    A link copies its bytes out at once, so links on one event loop can share it. Allocating a
    buffer takes longer than handling a short message.
    """
    return memoryview(bytearray(_RECEIVED_AT_ONCE_BYTES))


class PartialMessageBudget:
    """Bounds the memory that half-received messages of all links together take.

    Parameters
    ----------
    max_bytes : int
        Above it a link is ended: among the owners that hold at least half of the largest share,
        the link whose message began first. So an owner that sends much cannot end the links of
        owners that hold little.
    """

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = max_bytes
        self._sizes: dict[Link, int] = {}
        self._total = 0

    def note(self, link: Link, size_bytes: int) -> None:
        """Note how many bytes a link holds now."""
        before = self._sizes.get(link, 0)
        if size_bytes:
            self._sizes[link] = size_bytes
        elif before:
            del self._sizes[link]
        self._total += size_bytes - before
        while self._total > self._max_bytes:
            held: dict[object, int] = {}
            for each, its_bytes in self._sizes.items():
                held[each.owner] = held.get(each.owner, 0) + its_bytes
            least = max(held.values()) / 2
            oldest = next(each for each in self._sizes if held[each.owner] >= least)
            self._total -= self._sizes.pop(oldest)
            oldest.end("has not finished a message, and others need the memory")


class LinkSettings(NamedTuple):
    """What all links of one end have in common.

    Attributes
    ----------
    hello : callable
        Returns this end's first bytes.
    lease_ms : float
        This end sends something several times in this time.
    buffer : memoryview
        From :func:`receive_buffer`.
    pauses_for_readers : bool
        Whether reading pauses while the other end does not read.
    """

    hello: Callable[[], bytes]
    lease_ms: float
    max_message_bytes: int
    partial_messages: PartialMessageBudget
    scheduler: FairScheduler
    buffer: memoryview
    pauses_for_readers: bool
