"""Deadlines of calls to a robot; time in which this process was stopped does not count."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

_SUSPENDED_S = 1.0
"""A wait that wakes this much too late was in a stopped process; it gets the time back."""


class Deadline:
    """The end of a wait that is made of short waits; messages name the parameter ``key``."""

    def __init__(
        self, limit_s: float, key: str, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.limit_s = limit_s
        self.key = key
        self._clock = clock
        self._begun = clock()
        self._end = self._begun + limit_s

    def waited_s(self) -> float:
        """Return the time since the beginning, in seconds."""
        return self._clock() - self._begun

    def is_over(self) -> bool:
        """Return whether the time is over."""
        return self._clock() >= self._end

    def wait(self, condition: threading.Condition, at_most_s: float) -> None:
        """Wait for a condition, at most ``at_most_s`` and not past the deadline."""
        before = self._clock()
        planned = max(0.0, min(at_most_s, self._end - before))
        condition.wait(planned)
        late = self._clock() - before - planned
        if late > _SUSPENDED_S:
            self._end += late


class Absence:
    """How long a service has been missing."""

    key = "environment.discovery_timeout_ms"

    def __init__(
        self,
        is_present: Callable[[], bool],
        limit_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._is_present = is_present
        self.limit_s = limit_s
        self._clock = clock
        self._since: float | None = None

    def is_over(self) -> bool:
        """Return whether it has been missing for ``limit_s``, as seen by calls of this method."""
        if self._is_present():
            self._since = None
            return False
        if self._since is None:
            self._since = self._clock()
        return self._clock() >= self._since + self.limit_s
