"""The time of a decision on other cores, and from where on a service further away is faster.

A service has more cores, and is a path away. More cores shorten only the part of a decision that is
divided among threads (Amdahl's law): of a time T on one core, with the share f divided, c cores
need T (1 - f + f / c). So a service saves f T (1 - 1 / c), and is worth its path from the number of
particles on at which that is more than the path costs.

The share f is taken from times on few threads and used for more cores than were there: an
extrapolation, which leaves out that memory and waking are shared, too. Two lines therefore stand
around it: all of the work divided evenly (nothing can be faster), and the least share that the
measurement allows.

Everything here is arithmetic on numbers that were measured elsewhere.

Source: G. M. Amdahl, "Validity of the single processor approach to achieving large scale computing
capabilities", 1967; D. C. Montgomery, E. A. Peck, G. G. Vining, "Introduction to Linear Regression
Analysis" (the interval of a slope); H. A. David, H. N. Nagaraja, "Order Statistics" (the interval
of a median).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from holdfast.arrays import FloatArray
from holdfast.errors import InvalidValueError
from holdfast.lab.studies.statistics import Interval

__all__ = [
    "BreakEven",
    "Curve",
    "Scaling",
    "break_even",
    "busy_cores",
    "parallel_share",
    "power_law",
]


_LEVEL = 0.95


def parallel_share(times: Mapping[int, float]) -> float:
    """Return the share f of a time on one thread that is divided among threads.

    The least-squares fit of T(p) / T(1) = 1 - f (1 - 1 / p) to all numbers of threads p, which with
    two of them is exact.

    Parameters
    ----------
    times : mapping of int to float
        By numbers of threads; 1 and at least one more.

    Returns
    -------
    float
        From 0 to 1; where threads made it slower, 0.

    Raises
    ------
    InvalidValueError
        If there are too few times, or one is not positive.
    """
    if 1 not in times or len(times) < 2 or min(times) < 1:
        raise InvalidValueError(f"times of {sorted(times)} threads: 1 and one more are needed")
    if not all(time > 0.0 for time in times.values()):
        raise InvalidValueError(f"times {list(times.values())}: must be positive")
    numbers = [number for number in times if number > 1]
    gained = [1.0 - times[number] / times[1] for number in numbers]
    possible = [1.0 - 1.0 / number for number in numbers]
    share = sum(g * p for g, p in zip(gained, possible, strict=True))
    share /= sum(p * p for p in possible)
    return min(max(share, 0.0), 1.0)


def busy_cores(cores: int, pieces: int | None) -> float:
    """Return how many of some cores equal pieces of work keep busy on average.

    Nine pieces on eight cores take two turns, as sixteen would: 4.5 cores' worth.

    Raises
    ------
    InvalidValueError
        If one is below 1.
    """
    if pieces is None and cores >= 1:
        return float(cores)
    if pieces is None or cores < 1 or pieces < 1:
        raise InvalidValueError(f"{pieces} pieces on {cores} cores: both must be at least 1")
    return pieces / math.ceil(pieces / cores)


def power_law(sizes: FloatArray, times: FloatArray) -> tuple[float, Interval]:
    """Fit ``times = a sizes^b``, by least squares of logarithms.

    Returns
    -------
    a : float
    b : Interval
        Student's; without bounds for two points.

    Raises
    ------
    InvalidValueError
        If there are fewer than two different sizes, or a number is not positive.
    """
    from scipy import stats

    if sizes.shape != times.shape or np.unique(sizes).size < 2:
        raise InvalidValueError(f"a power law of {np.unique(sizes).size} sizes: 2 are needed")
    if not (np.all(sizes > 0.0) and np.all(times > 0.0)):
        raise InvalidValueError("a power law of sizes and times that are not all positive")
    fit = stats.linregress(np.log(sizes), np.log(times))
    slope = float(fit.slope)
    half = math.inf
    if sizes.size > 2:
        half = float(stats.t.ppf(0.5 + 0.5 * _LEVEL, sizes.size - 2)) * float(fit.stderr)
    return math.exp(float(fit.intercept)), Interval(slope, slope - half, slope + half)


class Curve(NamedTuple):
    """A positive quantity over numbers of particles, straight between points in logarithms.

    Attributes
    ----------
    particles : tuple of float
        Rising.
    """

    particles: tuple[float, ...]
    values: tuple[float, ...]

    def at(self, particles: FloatArray) -> FloatArray:
        """Return the values at some numbers of particles; NaN outside of what was measured."""
        inside = np.interp(
            np.log(particles),
            np.log(self.particles),
            np.log(self.values),
            left=np.nan,
            right=np.nan,
        )
        return np.asarray(np.exp(inside))

    def beyond(self, particles: FloatArray) -> FloatArray:
        """Return the values, outside of what was measured by the last two points: for figures."""
        values = self.at(particles)
        (first, last), (low, high) = np.log(self.particles[-2:]), np.log(self.values[-2:])
        larger = particles > self.particles[-1]
        slope = (high - low) / (last - first)
        values[larger] = np.exp(high + slope * (np.log(particles[larger]) - last))
        return values


class Scaling(NamedTuple):
    """What was measured of decisions of one kind, over numbers of particles.

    Attributes
    ----------
    particles : tuple of int
        Rising.
    times : tuple of Interval
        On one thread, in milliseconds.
    shares : tuple of Interval
        Of that, what is divided among threads, from 0 to 1.
    pieces : int or None
        Into which the divided part falls; None for as many as one likes.
    """

    particles: tuple[int, ...]
    times: tuple[Interval, ...]
    shares: tuple[Interval, ...]
    pieces: int | None

    def on_cores(self, cores: int) -> Curve:
        """Return the time on some cores, as extrapolated from what was measured."""
        busy = busy_cores(cores, self.pieces)
        return Curve(
            self.particles,
            tuple(
                time.value * (1.0 - share.value + share.value / busy)
                for time, share in zip(self.times, self.shares, strict=True)
            ),
        )

    def band(self, cores: int) -> tuple[Curve, Curve]:
        """Return what the time on some cores is at least, and at most.

        At least: all of the work divided evenly. At most: the least share that the measurement
        allows, in pieces that cannot be divided further. Both about the median on one core.
        """
        busy = busy_cores(cores, self.pieces)
        least = tuple(time.value / cores for time in self.times)
        lows = [_bounded(share.low) for share in self.shares]
        most = tuple(
            time.value * (1.0 - low + low / busy)
            for time, low in zip(self.times, lows, strict=True)
        )
        return Curve(self.particles, least), Curve(self.particles, most)

    def bounds(self) -> tuple[Scaling, Scaling, Scaling]:
        """Return what is favourable to few cores, favourable to many, and divided evenly.

        The first has the low ends of both intervals, the second their high ends, and the third the
        medians with all of the work divided, in as many pieces as one likes.
        """
        low = [Interval(*[max(time.low, 1e-9)] * 3) for time in self.times]
        high = [
            Interval(*[time.high if math.isfinite(time.high) else time.value] * 3)
            for time in self.times
        ]
        least = [Interval(*[_bounded(share.low)] * 3) for share in self.shares]
        most = [Interval(*[_bounded(share.high)] * 3) for share in self.shares]
        even = [Interval(1.0, 1.0, 1.0)] * len(self.shares)
        return (
            self._replace(times=tuple(low), shares=tuple(least)),
            self._replace(times=tuple(high), shares=tuple(most)),
            self._replace(shares=tuple(even), pieces=None),
        )

    def saved_ms(self, robot_cores: int, cores: int, ahead_ms: float = 0.0) -> Curve | None:
        """Return how much less a robot waits for some cores than for its own, but for the path.

        Parameters
        ----------
        robot_cores, cores : int
            The robot's own, and those elsewhere.
        ahead_ms : float
            How long before it is needed a decision is begun. Only what it takes longer is waited
            for, by whomever it is made.

        Returns
        -------
        Curve or None
            From the number of particles on above which something is saved; None if nothing is.
        """
        own, elsewhere = self.on_cores(robot_cores), self.on_cores(cores)
        first, last = math.log(self.particles[0]), math.log(self.particles[-1])
        # Both are straight between what was measured; the difference of the waits is not.
        numbers = np.unique(
            np.concatenate(
                [np.array(self.particles, dtype=np.float64), np.exp(np.linspace(first, last, 400))]
            )
        ).clip(self.particles[0], self.particles[-1])
        waits = [np.maximum(curve.at(numbers) - ahead_ms, 0.0) for curve in (own, elsewhere)]
        saved = waits[0] - waits[1]
        # Where nothing is saved a logarithm has no place; from there on up is what counts.
        nothing = np.flatnonzero(saved <= 0.0)
        start = int(nothing[-1]) + 1 if nothing.size else 0
        if start >= numbers.size:
            return None
        return Curve(tuple(map(float, numbers[start:])), tuple(map(float, saved[start:])))


def _bounded(share: float) -> float:
    return min(max(share, 0.0), 1.0)


class BreakEven(NamedTuple):
    """From how many particles on a service is faster.

    Attributes
    ----------
    particles : float or None
        None if it was not within what was measured.
    words : str
        Where it is, for people.
    """

    particles: float | None
    words: str


def break_even(saved_ms: Curve | None, cost_ms: float) -> BreakEven:
    """Return from where on what is saved is more than what it costs.

    If the curve crosses the cost several times, the last time counts: beyond it the service stays
    faster as far as was measured.

    Parameters
    ----------
    saved_ms : Curve or None
        None saves nothing.
    cost_ms : float
        Of the path and of asking.

    Raises
    ------
    InvalidValueError
        If the cost is not positive.
    """
    if not cost_ms > 0.0:
        raise InvalidValueError(f"a cost of {cost_ms} ms: must be positive")
    if saved_ms is None:
        return BreakEven(None, "not within what was measured: nothing is saved there")
    particles, values = saved_ms
    if values[-1] <= cost_ms:
        return BreakEven(
            None,
            f"not up to {particles[-1]:,.0f} particles, where {values[-1]:.3g} ms are saved "
            f"and {cost_ms:.3g} ms paid",
        )
    if all(value > cost_ms for value in values):
        # The curve begins where it was measured first, or where the first time is saved.
        return BreakEven(particles[0], f"at {_rounded(particles[0])} particles or fewer")
    after = max(i for i, value in enumerate(values) if value <= cost_ms) + 1
    low, high = math.log(values[after - 1]), math.log(values[after])
    way = (math.log(cost_ms) - low) / (high - low)
    first, second = math.log(particles[after - 1]), math.log(particles[after])
    found = math.exp(first + way * (second - first))
    return BreakEven(found, f"from {_rounded(found)} particles on")


def _rounded(particles: float) -> str:
    digits = max(0, math.floor(math.log10(particles)) - 1)
    return f"{round(particles, -digits):,.0f}"
