"""What all links of one end share: settings, a receive buffer, time slices, a bound on memory."""

from __future__ import annotations

import asyncio
import math
from collections import OrderedDict, deque
from collections.abc import Callable
from time import thread_time
from typing import Final, Protocol

from holdfast.transport.frames import HEADER_BYTES

_RECEIVED_AT_ONCE_BYTES: Final = 256 * 1024

SLICE_S: Final = 0.001

_WINDOW_S: Final = 0.005
"""An owner may use one slice per window without waiting."""

_TURN_S: Final = 0.001
"""For so long waiting links run in one turn of the event loop."""


class FairScheduler:
    """A round-robin scheduler: a link that receives much does not delay the others.

    One read of a socket can return hundreds of kilobytes with tens of thousands of messages. So a
    link handles what it has received for a slice of one millisecond. What is left waits, and the
    link reads nothing more meanwhile. In each turn of the event loop (or after ``pause_s``) waiting
    links run for another slice each, until :data:`_TURN_S` is over, and other links are read in
    between. All that is handled as it is read takes half of the time at most. So a turn is short,
    and a link waits for as many slices as there are others with much to do.

    Slices are measured in the thread's processor time: a link that was interrupted has not used it.

    Links of one *owner* share their slices, however many they are: those with the same certificate,
    and all those with an unfinished handshake. A link without TLS is an owner of its own.
    """

    def __init__(self, pause_s: float = 0.0) -> None:
        self._pause_s = pause_s
        self._waiting: OrderedDict[object, deque[Callable[[], None]]] = OrderedDict()
        self._used_s: dict[object, float] = {}
        self._all_used_s = 0.0
        self._window_ends_at = float("-inf")
        self._is_scheduled = False

    def may_run(self, owner: object, now: float) -> bool:
        """Return whether an owner may handle at once what it has just received."""
        if now >= self._window_ends_at:
            self._used_s.clear()
            self._all_used_s = 0.0
            self._window_ends_at = now + _WINDOW_S
        return (
            owner not in self._waiting
            and self._used_s.get(owner, 0.0) < SLICE_S
            and self._all_used_s < _WINDOW_S / 2
        )

    def num_waiting(self, owner: object) -> int:
        """Return how many links of an owner wait for a slice."""
        return len(self._waiting.get(owner, ()))

    def charge(self, owner: object, seconds: float) -> None:
        """Add time that an owner has used."""
        self._used_s[owner] = self._used_s.get(owner, 0.0) + seconds
        self._all_used_s += seconds

    def enqueue(self, owner: object, run_slice: Callable[[], None]) -> None:
        """Run a slice when the owner's turn comes; it enqueues again if there is more."""
        if not self._is_scheduled:
            self._schedule()
        self._waiting.setdefault(owner, deque()).append(run_slice)

    def _run_waiting(self) -> None:
        ends_at = thread_time() + _TURN_S
        try:
            while self._waiting and thread_time() < ends_at:
                owner, waiting = self._waiting.popitem(last=False)
                run_slice = waiting.popleft()
                if waiting:
                    self._waiting[owner] = waiting
                run_slice()
        finally:
            self._is_scheduled = False
            if self._waiting:
                self._schedule()

    def _schedule(self) -> None:
        self._is_scheduled = True
        loop = asyncio.get_running_loop()
        if self._pause_s:
            loop.call_later(self._pause_s, self._run_waiting)
        else:
            loop.call_soon(self._run_waiting)


class _Holder(Protocol):
    """A link, as far as a :class:`MemoryBudget` knows it."""

    @property
    def owner(self) -> object: ...
    @property
    def unsent_bytes(self) -> int: ...
    def end(self, reason: str, *, abort: bool = False) -> None: ...


class MemoryBudget:
    """Bounds the memory that all links together take for one purpose.

    Above the bound a link is ended: among the owners that hold at least half of the largest share,
    the link that has held something for longest. So an owner that takes much cannot end the links
    of owners that take little.

    ``reason`` says why a link is ended, as the rest of a sentence about the other end; ``measure``
    what a link holds now, where that shrinks without a :meth:`note`.
    """

    def __init__(
        self, max_bytes: float, reason: str, measure: Callable[[_Holder], int] | None = None
    ) -> None:
        self._max_bytes = max_bytes
        self._reason = reason
        self._measure = measure
        self._sizes: dict[_Holder, int] = {}
        self._total = 0

    def note(self, link: _Holder, size_bytes: int) -> None:
        """Note how many bytes a link holds now."""
        if not size_bytes and link not in self._sizes:
            return  # nearly always
        self._set(link, size_bytes)
        if self._total > self._max_bytes and self._measure is not None:
            for each in list(self._sizes):
                self._set(each, self._measure(each))
        while self._total > self._max_bytes:
            held: dict[object, int] = {}
            for each, its_bytes in self._sizes.items():
                held[each.owner] = held.get(each.owner, 0) + its_bytes
            least = max(held.values()) / 2
            oldest = next(each for each in self._sizes if held[each.owner] >= least)
            self._set(oldest, 0)
            oldest.end(self._reason, abort=self._measure is not None)

    def _set(self, link: _Holder, size_bytes: int) -> None:
        before = self._sizes.get(link, 0)
        if size_bytes:
            self._sizes[link] = size_bytes
        elif before:
            del self._sizes[link]
        self._total += size_bytes - before


class LinkSettings:
    """What all links of one end have in common."""

    def __init__(
        self,
        hello: Callable[[], bytes],  # returns this end's first bytes
        lease_ms: float,  # this end sends something several times in this time
        max_message_bytes: int,
        *,
        pauses_for_readers: bool,  # whether reading pauses while the other end does not read
        # Bound on the bytes of all links together that wait for the other ends to read.
        max_unsent_bytes: float = math.inf,
        pause_s: float = 0.0,  # of the :class:`FairScheduler`
    ) -> None:
        self.hello = hello
        self.lease_ms = lease_ms
        self.max_message_bytes = max_message_bytes
        self.pauses_for_readers = pauses_for_readers
        self.partial_messages = MemoryBudget(
            2 * (max_message_bytes + HEADER_BYTES),
            "has not finished a message, and others need the memory",
        )
        self.unsent = MemoryBudget(
            max_unsent_bytes,
            "does not read what it is sent, and others need the memory",
            lambda link: link.unsent_bytes,
        )
        self.scheduler = FairScheduler(pause_s)
        # Takes received bytes. Links copy them out at once and so can share it: allocating one
        # takes longer than handling a short message.
        self.buffer = memoryview(bytearray(_RECEIVED_AT_ONCE_BYTES))
