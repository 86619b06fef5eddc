"""How long a computation usually takes, learnt from how long it took before."""

from __future__ import annotations

import math

__all__ = ["UsualTime"]

_INERTIA = 16.0
"""What is usual grows by one part in so many with each time that is longer."""


class UsualTime:
    """How long a computation takes if nobody else has the core.

    Others only make it longer, so a shorter time counts at once and a longer one little: else
    whoever is busy would send each brief computation to a thread, which keeps it busier still.

    Attributes
    ----------
    seconds : float
        Infinite before anything was computed.
    """

    __slots__ = ("seconds",)

    def __init__(self) -> None:
        self.seconds = math.inf

    def learn(self, computed_s: float) -> None:
        """Let the time of one computation count."""
        if computed_s > self.seconds:
            computed_s = self.seconds + (computed_s - self.seconds) / _INERTIA
        self.seconds = computed_s
