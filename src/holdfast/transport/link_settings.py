"""What all links of one end share: their settings, a receive buffer and a bound on memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from holdfast.transport.fair_scheduler import FairScheduler
from holdfast.transport.frames import HEADER_BYTES

if TYPE_CHECKING:
    from holdfast.transport.links import Link

__all__ = ["LinkSettings", "PartialMessageBudget"]

_RECEIVED_AT_ONCE_BYTES: Final = 256 * 1024


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


class LinkSettings:
    """What all links of one end have in common.

    Parameters
    ----------
    hello : callable
        Returns this end's first bytes.
    lease_ms : float
        This end sends something several times in this time.
    pauses_for_readers : bool
        Whether reading pauses while the other end does not read.
    pause_s : float
        Of the :class:`~holdfast.transport.fair_scheduler.FairScheduler`.

    Attributes
    ----------
    buffer : memoryview
        Takes received bytes. A link copies them out at once, so links on one event loop can share
        it. Allocating a buffer takes longer than handling a short message.
    """

    def __init__(
        self,
        hello: Callable[[], bytes],
        lease_ms: float,
        max_message_bytes: int,
        *,
        pauses_for_readers: bool,
        pause_s: float = 0.0,
    ) -> None:
        self.hello = hello
        self.lease_ms = lease_ms
        self.max_message_bytes = max_message_bytes
        self.pauses_for_readers = pauses_for_readers
        self.partial_messages = PartialMessageBudget(2 * (max_message_bytes + HEADER_BYTES))
        self.scheduler = FairScheduler(pause_s)
        self.buffer = memoryview(bytearray(_RECEIVED_AT_ONCE_BYTES))
