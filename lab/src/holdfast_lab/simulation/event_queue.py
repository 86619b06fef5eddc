"""Virtual time: what is to happen, and in which order.

Time passes only from one event to the next, so a second of silence costs nothing. Events of the
same time come in the order in which they were added, so a run is reproducible.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from typing import Any


class EventQueue:
    """Events in the order of their time."""

    def __init__(self) -> None:
        self.now = 0.0  # seconds since the beginning
        self._heap: list[tuple[float, int, Callable[..., None], tuple[Any, ...]]] = []
        self.count = 0  # of all events that were added

    def after(self, seconds: float, do: Callable[..., None], *arguments: Any) -> None:
        """Let something happen after some seconds."""
        self.count += 1
        heapq.heappush(self._heap, (self.now + seconds, self.count, do, arguments))

    def at(self, time: float, do: Callable[..., None], *arguments: Any) -> None:
        """Let something happen at a time; at once if that has passed."""
        self.count += 1
        heapq.heappush(self._heap, (max(time, self.now), self.count, do, arguments))

    def step(self) -> bool:
        """Let the next thing happen; False if there is none."""
        if not self._heap:
            return False
        self.now, _, do, arguments = heapq.heappop(self._heap)
        do(*arguments)
        return True


class Clock:
    """What a process reads as the time: it never goes back, but it may be off, and fast or slow.

    It shows ``offset_s`` at the beginning, and ``rate`` seconds for each second.
    """

    def __init__(self, queue: EventQueue, offset_s: float, rate: float) -> None:
        self._queue = queue
        self._offset_s = offset_s
        self._rate = rate
        self._latest = offset_s

    def now(self) -> float:
        """Return what it shows."""
        self._latest = max(self._latest, self._offset_s + self._rate * self._queue.now)
        return self._latest

    def until(self, shown: float) -> float:
        """Return the seconds of the world until it will show this; 0 if it has done so."""
        return max(0.0, (shown - self._offset_s) / self._rate - self._queue.now)

    def reached(self, shown: float) -> float:
        """Return the time, now that it is no earlier than this whatever rounding says."""
        self._latest = max(self.now(), shown)
        return self._latest
