"""Deadlines of calls to a robot; time in which this process was stopped does not count."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Deadline:
    """The end of a wait that is made of short waits; messages name the parameter ``key``.

    What was waited for counts, not the clock.
    """

    def __init__(
        self, limit_s: float, key: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.limit_s = limit_s
        self.key = key
        self.waited_s = 0.0
        self._clock = clock

    def is_over(self) -> bool:
        """Return whether the time is over."""
        return self.waited_s >= self.limit_s

    def wait(self, condition: threading.Condition, at_most_s: float) -> float:
        """Wait for a condition, not past the deadline; return the time that counts."""
        before = self._clock()
        planned = max(0.0, min(at_most_s, self.limit_s - self.waited_s))
        condition.wait(planned)
        waited = min(planned, self._clock() - before)
        self.waited_s += waited
        return waited
