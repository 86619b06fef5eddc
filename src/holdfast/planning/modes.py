"""Beliefs with several modes: which particles are of the heaviest one.

A robot in a corridor with equal doors may be at any of them. The mean of such a belief is a place
between the doors where the robot is not; and where the mean happens to be the goal, the robot stays
put for good. So one mode has to be taken for the truth: the one with the greatest weight.

Modes that are apart are apart in some coordinate. So each coordinate is looked at by itself, which
takes few particles, however many coordinates there are. A kernel around each particle estimates the
density; from places at even shares of the weight on, the way uphill is followed to the peaks (mean
shift); and each particle belongs to the nearest peak. What belongs to the heaviest peak is looked
at again, for it may have several modes, too.

Estimated densities have peaks by chance as well. So all this is done only where some place is
clearly denser than the mean. Else all particles are of one mode, and the mean stays as it is, where
it is a good estimate.

Source: Fukunaga and Hostetler, "The estimation of the gradient of a density function", IEEE
Transactions on Information Theory 21(1), 1975; bandwidth by Silverman, "Density estimation", 1986,
equation 3.28.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holdfast import _kernel
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.circular import unwrapped

_STARTS = 16
"""Places from which peaks are looked for."""

_CLIMBS = 10
"""Steps of mean shift."""

_SPLITS = 3
"""So often the heaviest mode may be one of several again."""

_MOST_PARTICLES = 1000
"""So many of a larger belief show its density."""

_BROADER = 1.2
"""By which the bandwidth exceeds Silverman's: fewer peaks by chance."""

_DENSER = 1.5
"""How much denser than the mean a place must be."""


def heaviest_mode(
    states: FloatArray, weights: FloatArray, circular: Sequence[int] = ()
) -> FloatArray:
    """Return the weights of the heaviest mode's particles, normalised; 0 for all others.

    They are the belief's own weights if it has one mode. The shapes are (n, state_size) and (n,);
    ``circular`` coordinates are angles. The units of the coordinates do not matter.
    """
    opened = unwrapped(states, circular) if circular else states
    for _ in range(_SPLITS):
        own = _heaviest_in_a_coordinate(opened, weights)
        if own is None:
            break
        weights = own / numerics.sum(own)
    return weights


def _heaviest_in_a_coordinate(states: FloatArray, weights: FloatArray) -> FloatArray | None:
    """Return the weights of the heaviest mode in the coordinate with the most distinct ones."""
    away = states - _kernel.weighted_sums(weights, states)
    deviations = np.sqrt(_kernel.weighted_sums(weights, away * away))
    effective_size = 1.0 / _kernel.sum(weights * weights)
    bandwidth = _BROADER * float(numerics.exp(0.2 * numerics.log(4.0 / (3.0 * effective_size))))
    densest, found = _DENSER, None
    for coordinate in np.flatnonzero(deviations > 0.0):
        points = away[:, coordinate] / deviations[coordinate]
        sample, shares = _sample(points, weights)
        starts = _at_even_shares(sample, shares, _STARTS)
        # The mean is 0.
        kernels = _kernels(sample, np.append(starts, 0.0), bandwidth)
        densities = _kernel.weighted_sums(shares, kernels)
        ratio = float(densities[:-1].max() / densities[-1])
        if ratio > densest:
            densest, found = ratio, (points, sample, shares, starts)
    if found is None:
        return None
    points, sample, shares, starts = found
    peaks = _peaks(sample, shares, starts, bandwidth)
    nearest = np.searchsorted(0.5 * (peaks[1:] + peaks[:-1]), points)
    masses = np.bincount(nearest, weights, peaks.size)
    if np.count_nonzero(masses) == 1:
        return None
    return np.asarray(np.where(nearest == masses.argmax(), weights, 0.0))


def _sample(points: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return so many of the points and their weights that their density shows, in order."""
    order = np.argsort(points, kind="stable")
    sample, shares = points[order], weights[order]
    if points.size <= _MOST_PARTICLES:
        return sample, shares
    chosen = _at_even_shares(sample, shares, _MOST_PARTICLES)
    return chosen, np.full(_MOST_PARTICLES, 1.0 / _MOST_PARTICLES)


def _at_even_shares(points: FloatArray, weights: FloatArray, count: int) -> FloatArray:
    """Return points, of sorted ones, at even shares of the cumulated weight."""
    # np.cumsum adds one by one, in order, unlike np.sum.
    cumulated = np.cumsum(weights)
    shares = (np.arange(count) + 0.5) / count * cumulated[-1]
    return np.asarray(points[np.searchsorted(cumulated, shares, side="right")])


def _kernels(sample: FloatArray, places: FloatArray, bandwidth: float) -> FloatArray:
    """Return the kernel of each particle at each place, shape (n, places)."""
    distances = np.subtract.outer(sample, places) / bandwidth
    return numerics.exp(-0.5 * distances * distances)


def _peaks(
    sample: FloatArray, shares: FloatArray, places: FloatArray, bandwidth: float
) -> FloatArray:
    """Return the peaks above ascending places, ascending; those closer than a bandwidth are one."""
    moments = shares * sample
    for _ in range(_CLIMBS):
        kernels = _kernels(sample, places, bandwidth)
        places = _kernel.weighted_sums(moments, kernels) / _kernel.weighted_sums(shares, kernels)
    peaks = [places[0]]
    for place in places[1:]:
        if place - peaks[-1] > bandwidth:
            peaks.append(place)
    return np.array(peaks)
