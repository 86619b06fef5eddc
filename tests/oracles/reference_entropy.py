"""The entropy estimates, written for reading: one point, one neighbour at a time.

Shares no code with the kernel; SciPy's digamma, NumPy's sorting.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import digamma

from holdfast.numerics.arrays import FloatArray, IntArray


def significant(weights: FloatArray) -> npt.NDArray[np.bool_]:
    """Tell which points count: all but those that weigh nothing next to the others.

    Of the thresholds 1e-2, 1e-3, ..., 1e-6, relative to the greatest weight, the largest below
    which lies at most 0.5 % of the sum; 1e-6 if there is none.
    """
    relative: FloatArray = weights / weights.max()
    hair = 1.0 - 2.0**-40  # weights that are such fractions themselves stay
    for threshold in (1e-2 * hair, 1e-3 * hair, 1e-4 * hair, 1e-5 * hair):
        if relative[relative < threshold].sum() <= 0.005 * relative.sum():
            return np.greater_equal(relative, threshold)
    return np.greater_equal(relative, 1e-6 * hair)


def log_unit_ball(dimension: int) -> float:
    """Return the logarithm of the volume of the unit ball."""
    return float(0.5 * dimension * math.log(math.pi) - math.lgamma(0.5 * dimension + 1.0))


class Neighborhood(NamedTuple):
    """What lies about one point."""

    within: IntArray
    others: IntArray
    terms: float


def neighborhoods(
    points: FloatArray, neighbors: int, resolution: float
) -> Iterator[tuple[int, Neighborhood]]:
    """Yield each of two or more points with its neighbourhood."""
    count, dimension = points.shape
    k = min(neighbors, count - 1)
    for n in range(count):
        others = np.delete(np.arange(count), n)
        # Squares compared with squares, as a radius that is a square root would move ties apart.
        squared = np.zeros(count)
        for coordinate in range(dimension):
            squared += (points[:, coordinate] - points[n, coordinate]) ** 2
        squared = squared[others]
        kth = np.partition(squared, k - 1)[k - 1]
        # Distances that differ by rounding alone are equal.
        tolerance = 1.0 + 2.0**-40
        resolved = kth > resolution * resolution * tolerance
        radius_squared = (kth if resolved else resolution * resolution) * tolerance
        within = others[squared <= radius_squared]
        q = k if resolved else len(within)
        terms = (
            log_unit_ball(dimension)
            + 0.5 * dimension * math.log(radius_squared)
            + math.log(q)
            - digamma(q)
        )
        yield n, Neighborhood(within, others, float(terms))


def single_point_entropy(dimension: int, resolution: float) -> float:
    return log_unit_ball(dimension) + dimension * math.log(resolution)


def nearest_neighbor_entropy(
    points: FloatArray, weights: FloatArray, neighbors: int, resolution: float
) -> float:
    kept = significant(weights)
    points, weights = points[kept], weights[kept] / weights[kept].sum()
    if len(points) == 1:
        return single_point_entropy(points.shape[1], resolution)
    return float(
        sum(
            weights[n]
            * (near.terms - math.log(weights[near.within].sum() / weights[near.others].sum()))
            for n, near in neighborhoods(points, neighbors, resolution)
        )
    )


def prior_neighbors_entropy(
    points: FloatArray, weights: FloatArray, prior: FloatArray, neighbors: int, resolution: float
) -> float:
    weights = np.where(significant(weights), weights, 0.0)
    weights = weights / weights.sum()
    points, weights, prior = points[prior > 0.0], weights[prior > 0.0], prior[prior > 0.0]
    if len(points) == 1:
        return single_point_entropy(points.shape[1], resolution)
    total = 0.0
    for n, (within, others, terms) in neighborhoods(points, neighbors, resolution):
        total += prior[n] * (terms - math.log(prior[within].sum() / prior[others].sum()))
        if weights[n] > 0.0:
            before, after = (
                (w[within].sum() + 0.05 * w[n]) / (w[others].sum() + 0.05 * w[n])
                for w in (prior, weights)
            )
            total -= weights[n] * math.log(after / before)
    return float(total)


def gaussian_mixture_entropy(
    points: FloatArray, weights: FloatArray, variance: FloatArray, upper: bool
) -> float:
    kept = significant(weights)
    points, weights = points[kept], weights[kept] / weights[kept].sum()
    dimension = points.shape[1]
    c = 0.5 if upper else 0.125
    squared = (((points[:, None, :] - points[None, :, :]) ** 2) / variance).sum(axis=2)
    mixture = -(weights * np.log((weights * np.exp(-c * squared)).sum(axis=1))).sum()
    return float(
        0.5 * dimension * math.log(2.0 * math.pi * math.e) + 0.5 * np.log(variance).sum() + mixture
    )
