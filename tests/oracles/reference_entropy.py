"""The entropy estimates, written for reading: all points with all.

Shares no code with the kernel; SciPy's digamma, NumPy's sorting.
"""

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import digamma

from holdfast.numerics.arrays import FloatArray


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


class Neighborhoods(NamedTuple):
    """What lies about each point: a row for each, and a column for each that may lie there."""

    within: npt.NDArray[np.bool_]
    terms: FloatArray

    def shares(self, weights: FloatArray, own: float = 0.0) -> FloatArray:
        """Return the weight within, of that of all other points, both with a part of their own."""
        others = ~np.eye(len(weights), dtype=bool)
        near, all_others = (
            np.where(each, weights, 0.0).sum(axis=1) + own * weights
            for each in (self.within, others)
        )
        return np.asarray(near / all_others)


def neighborhoods(points: FloatArray, neighbors: int, resolution: float) -> Neighborhoods:
    """Return the neighbourhoods of two or more points."""
    count, dimension = points.shape
    k = min(neighbors, count - 1)
    # Squares compared with squares, as a radius that is a square root would move ties apart.
    squared = np.zeros((count, count))
    for coordinates in points.T:
        squared += (coordinates[:, np.newaxis] - coordinates) ** 2
    np.fill_diagonal(squared, np.inf)
    kth = np.partition(squared, k - 1)[:, k - 1]
    # Distances that differ by rounding alone are equal.
    tolerance = 1.0 + 2.0**-40
    resolved = kth > resolution * resolution * tolerance
    radius_squared = np.where(resolved, kth, resolution * resolution) * tolerance
    within = squared <= radius_squared[:, np.newaxis]
    q = np.where(resolved, k, within.sum(axis=1))
    terms = 0.5 * dimension * np.log(radius_squared) + np.log(q) - digamma(q)
    return Neighborhoods(within, log_unit_ball(dimension) + terms)


def single_point_entropy(dimension: int, resolution: float) -> float:
    return log_unit_ball(dimension) + dimension * math.log(resolution)


def nearest_neighbor_entropy(
    points: FloatArray, weights: FloatArray, neighbors: int, resolution: float
) -> float:
    kept = significant(weights)
    points, weights = points[kept], weights[kept] / weights[kept].sum()
    if len(points) == 1:
        return single_point_entropy(points.shape[1], resolution)
    near = neighborhoods(points, neighbors, resolution)
    return float((weights * (near.terms - np.log(near.shares(weights)))).sum())


def prior_neighbors_entropy(
    points: FloatArray, weights: FloatArray, prior: FloatArray, neighbors: int, resolution: float
) -> float:
    weights = np.where(significant(weights), weights, 0.0)
    weights = weights / weights.sum()
    points, weights, prior = points[prior > 0.0], weights[prior > 0.0], prior[prior > 0.0]
    if len(points) == 1:
        return single_point_entropy(points.shape[1], resolution)
    near = neighborhoods(points, neighbors, resolution)
    total = (prior * (near.terms - np.log(near.shares(prior)))).sum()
    counts = weights > 0.0
    changes = near.shares(weights, 0.05)[counts] / near.shares(prior, 0.05)[counts]
    total -= (weights[counts] * np.log(changes)).sum()
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
