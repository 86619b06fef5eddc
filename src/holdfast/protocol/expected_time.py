"""How long a computation is expected to take, estimated from earlier ones.

Two estimates serve two purposes. :class:`TypicalTime` follows the shortest times: how long it takes
on a free core. :class:`ExpectedTimes` follows the mean: how long a queue of such work takes.
"""

from __future__ import annotations

import math

__all__ = ["ExpectedTimes", "TypicalTime"]

_INERTIA = 16.0
"""A longer time raises the typical time by one such part of the difference."""


class TypicalTime:
    """How long a computation takes on a free core.

    Contention only lengthens a computation, so a shorter time counts at once and a longer one
    little. Else a busy process would send brief work to threads, which makes it busier.

    Attributes
    ----------
    seconds : float
        Infinite before the first computation.
    """

    def __init__(self) -> None:
        self.seconds = math.inf

    def learn(self, computed_s: float) -> None:
        """Include the time of one computation."""
        if computed_s > self.seconds:
            computed_s = self.seconds + (computed_s - self.seconds) / _INERTIA
        self.seconds = computed_s


class ExpectedTimes:
    """Running means and typical times of the two parts of an answer.

    Parameters
    ----------
    inertia : float
        A sample moves a mean by its distance divided by this.
    task_s, sensing_s : float
        Initial means.
    """

    def __init__(self, inertia: float, task_s: float, sensing_s: float) -> None:
        self._inertia = inertia
        self.typical_task = TypicalTime()
        self.typical_sensing = TypicalTime()
        self.task_s = task_s
        self.sensing_s = sensing_s

    def learn(self, computed_s: float, *, sensing: bool) -> None:
        """Include the time of one job."""
        if sensing:
            self.typical_sensing.learn(computed_s)
            self.sensing_s = self._moved(self.sensing_s, computed_s)
        else:
            self.typical_task.learn(computed_s)
            self.task_s = self._moved(self.task_s, computed_s)

    def _moved(self, mean_s: float, sample_s: float) -> float:
        """Return the updated mean.

        One outlier (a stopped process) moves it little, so that robots are not turned away for it.
        """
        return mean_s + (min(sample_s, 4.0 * mean_s + 0.01) - mean_s) / self._inertia
