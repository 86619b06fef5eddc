"""A round-robin scheduler for links: a link that receives much does not delay the others.

One read of a socket can return hundreds of kilobytes with tens of thousands of messages. So a link
handles what it has received for a slice of one millisecond. What is left waits, and the link reads
nothing more meanwhile. In each turn of the event loop one waiting link runs for another slice, and
all other links are read in between.

Links of one *owner* share their slices, however many they are: those with the same certificate, and
all those with an unfinished handshake. A link without TLS is an owner of its own.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Final

__all__ = ["SLICE_S", "FairScheduler"]

SLICE_S: Final = 0.001

_WINDOW_S: Final = 0.005
"""An owner may use one slice per window without waiting."""


class FairScheduler:
    """Runs work that takes more than one slice, owners in turn.

    Parameters
    ----------
    pause_s : float
        Between two slices; 0 runs one in each turn of the loop.
    """

    def __init__(self, pause_s: float = 0.0) -> None:
        self._pause_s = pause_s
        self._waiting: OrderedDict[object, deque[Callable[[], None]]] = OrderedDict()
        self._used_s: dict[object, float] = {}
        self._window_ends_at = float("-inf")

    def may_run(self, owner: object, now: float) -> bool:
        """Return whether an owner may handle at once what it has just received."""
        if now >= self._window_ends_at:
            self._used_s.clear()
            self._window_ends_at = now + _WINDOW_S
        return owner not in self._waiting and self._used_s.get(owner, 0.0) < SLICE_S

    def charge(self, owner: object, seconds: float) -> None:
        """Add time that an owner has used."""
        self._used_s[owner] = self._used_s.get(owner, 0.0) + seconds

    def enqueue(self, owner: object, run_slice: Callable[[], None]) -> None:
        """Run a slice when the owner's turn comes; it enqueues again if there is more."""
        if not self._waiting:
            self._schedule()
        self._waiting.setdefault(owner, deque()).append(run_slice)

    def _run_next(self) -> None:
        owner, waiting = self._waiting.popitem(last=False)
        run_slice = waiting.popleft()
        if waiting:
            self._waiting[owner] = waiting
        if self._waiting:
            self._schedule()
        run_slice()

    def _schedule(self) -> None:
        loop = asyncio.get_running_loop()
        if self._pause_s:
            loop.call_later(self._pause_s, self._run_next)
        else:
            loop.call_soon(self._run_next)
