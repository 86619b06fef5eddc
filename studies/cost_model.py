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
capabilities", 1967.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from holdfast.numerics.arrays import FloatArray


def parallel_share(times: Mapping[int, float]) -> float:
    """Return the share f of a time on one thread that is divided among threads, from 0 to 1.

    The least-squares fit of T(p) / T(1) = 1 - f (1 - 1 / p) to all numbers of threads p, which with
    two of them is exact. Where threads made it slower it is 0.
    """
    more = [number for number in times if number > 1]
    gained = np.array([1.0 - times[number] / times[1] for number in more])
    possible = np.array([1.0 - 1.0 / number for number in more])
    return float(np.clip(gained @ possible / (possible @ possible), 0.0, 1.0))


def busy_cores(cores: int, pieces: int) -> float:
    """Return how many of some cores equal pieces of work keep busy on average.

    Nine pieces on eight cores take two turns, as sixteen would: 4.5 cores' worth.
    """
    return pieces / math.ceil(pieces / cores)


class Curve(NamedTuple):
    """A positive quantity over rising numbers of particles, straight between points in logarithms.

    Both of shape (n,).
    """

    particles: FloatArray
    values: FloatArray

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


class Scaling(NamedTuple):
    """What was measured of decisions of one kind, over rising numbers of particles, shape (n,).

    Times on one thread in milliseconds, and the shares of these that are divided among threads, in
    so many pieces; both of shape (3, n), with the ends of their intervals, infinite where there is
    none.
    """

    particles: FloatArray
    times: FloatArray
    shares: FloatArray
    pieces: int

    def on_cores(self, cores: int) -> Curve:
        """Return the time on some cores, as extrapolated from what was measured."""
        return Curve(self.particles, self._times_on(cores, self.shares[0]))

    def _times_on(self, cores: int, shares: FloatArray) -> FloatArray:
        times: FloatArray = self.times[0] * (1.0 - shares + shares / busy_cores(cores, self.pieces))
        return times

    def band(self, cores: int) -> tuple[Curve, Curve]:
        """Return what the time on some cores is at least, and at most.

        At least: all of the work divided evenly. At most: the least share that the measurement
        allows, in pieces that cannot be divided further. Both about the median on one core.
        """
        most = self._times_on(cores, self.shares[1].clip(0.0, 1.0))
        return Curve(self.particles, self.times[0] / cores), Curve(self.particles, most)

    def bounds(self) -> tuple[Scaling, Scaling]:
        """Return what is favourable to few cores, and favourable to many.

        The first has the low ends of both intervals, the second their high ends.
        """
        value, low, high = self.times
        _, least, most = self.shares.clip(0.0, 1.0)
        slow = np.where(np.isfinite(high), high, value)
        return (
            self._replace(times=_always(np.maximum(low, 1e-9)), shares=_always(least)),
            self._replace(times=_always(slow), shares=_always(most)),
        )

    def saved_ms(self, robot_cores: int, cores: int, ahead_ms: float = 0.0) -> Curve | None:
        """Return how much less a robot waits for some cores than for its own, but for the path.

        From the number of particles on above which something is saved; None if nothing is. A
        decision is begun ``ahead_ms`` before it is needed: only what it takes longer is waited for.
        """
        first, last = self.particles[0], self.particles[-1]
        # Both are straight between what was measured; the difference of the waits is not.
        dense = np.exp(np.linspace(math.log(first), math.log(last), 400))
        numbers = np.unique(np.concatenate([self.particles, dense])).clip(first, last)
        own, elsewhere = (
            np.maximum(self.on_cores(each).at(numbers) - ahead_ms, 0.0)
            for each in (robot_cores, cores)
        )
        saved = own - elsewhere
        # Where nothing is saved a logarithm has no place; from there on up is what counts.
        nothing = np.flatnonzero(saved <= 0.0)
        start = int(nothing[-1]) + 1 if nothing.size else 0
        return Curve(numbers[start:], saved[start:]) if start < numbers.size else None


def _always(values: FloatArray) -> FloatArray:
    """Return values that are also the ends of their intervals."""
    return np.tile(values, (3, 1))


def break_even(saved_ms: Curve | None, cost_ms: float) -> float:
    """Return the number of particles from which on more is saved (None: nothing) than it costs.

    NaN if that is not within what was measured. If the curve crosses the cost several times, the
    last time counts: beyond it the service stays faster as far as was measured.
    """
    if saved_ms is None or saved_ms.values[-1] <= cost_ms:
        return math.nan
    particles, values = saved_ms
    too_little = np.flatnonzero(values <= cost_ms)
    if too_little.size == 0:
        # The curve begins where it was measured first, or where the first time is saved.
        return float(particles[0])
    around = slice(too_little[-1], too_little[-1] + 2)
    found = np.interp(math.log(cost_ms), np.log(values[around]), np.log(particles[around]))
    return float(np.exp(found))
