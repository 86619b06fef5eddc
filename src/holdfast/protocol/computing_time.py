"""How long a computation is expected to take, estimated from earlier ones."""

from __future__ import annotations

import math

_TYPICAL_INERTIA = 16.0
"""A longer time raises the typical time by one such part of the difference."""


class ExpectedTime:
    """Two estimates of how long one kind of computation takes."""

    def __init__(self, mean_s: float = 0.0, inertia: float = 8.0) -> None:
        self.mean_s = mean_s  # a moving average: what each computation of a queue costs
        self._inertia = inertia  # a time moves the mean by one such part of its distance
        # How long one takes on a free core; infinite before the first. That is its processor time:
        # on a busy machine a computation is put aside, and on a thread it waits for the
        # interpreter. If that counted, a busy process would send brief work to threads, which makes
        # it busier. Contention lengthens even processor time (cold caches), so a shorter time
        # counts at once and a longer one little.
        self.typical_s = math.inf

    def learn(self, computed_s: float, processor_s: float | None = None) -> None:
        """Include the time of one computation, and its processor time if that is known."""
        own_s = computed_s if processor_s is None else processor_s
        # One outlier (a stopped process) moves the mean little, so that robots are not turned away
        # for it.
        bounded_s = min(computed_s, 4.0 * self.mean_s + 0.01)
        self.mean_s += (bounded_s - self.mean_s) / self._inertia
        if own_s > self.typical_s:
            own_s = self.typical_s + (own_s - self.typical_s) / _TYPICAL_INERTIA
        self.typical_s = own_s

    def expect_long(self) -> None:
        """Predict nothing of the next one, which may take any time."""
        self.typical_s = math.inf
