"""The entropy estimates, written for reading: one point, one neighbour at a time.

Shares no code with the kernel; SciPy's digamma, NumPy's sorting.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from scipy.special import digamma

FloatArray = npt.NDArray[np.float64]


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


def nearest_neighbor_entropy(
    points: FloatArray, weights: FloatArray, neighbors: int, resolution: float
) -> float:
    kept = significant(weights)
    points, weights = points[kept], weights[kept] / weights[kept].sum()
    count, dimension = points.shape
    log_ball = log_unit_ball(dimension)
    if count == 1:
        return float(log_ball + dimension * math.log(resolution))
    k = min(neighbors, count - 1)
    total = 0.0
    for n in range(count):
        others = np.delete(np.arange(count), n)
        # Squares compared with squares, as a radius that is a square root would move ties apart.
        squared = np.zeros(count - 1)
        for coordinate in range(dimension):
            squared += (points[others, coordinate] - points[n, coordinate]) ** 2
        kth = np.partition(squared, k - 1)[k - 1]
        # Distances that differ by rounding alone are equal.
        tolerance = 1.0 + 2.0**-40
        resolved = kth > resolution * resolution * tolerance
        radius_squared = (kth if resolved else resolution * resolution) * tolerance
        within = squared <= radius_squared
        q = k if resolved else int(within.sum())
        mass = weights[others][within].sum() / weights[others].sum()
        total += weights[n] * (
            -math.log(mass)
            + log_ball
            + 0.5 * dimension * math.log(radius_squared)
            + math.log(q)
            - digamma(q)
        )
    return float(total)


def prior_neighbors_entropy(
    points: FloatArray,
    weights: FloatArray,
    prior: FloatArray,
    neighbors: int,
    resolution: float,
) -> float:
    weights = np.where(significant(weights), weights, 0.0)
    weights = weights / weights.sum()
    points, weights, prior = points[prior > 0.0], weights[prior > 0.0], prior[prior > 0.0]
    count, dimension = points.shape
    log_ball = log_unit_ball(dimension)
    if count == 1:
        return float(log_ball + dimension * math.log(resolution))
    k = min(neighbors, count - 1)
    total = 0.0
    for n in range(count):
        others = np.delete(np.arange(count), n)
        squared = np.zeros(count - 1)
        for coordinate in range(dimension):
            squared += (points[others, coordinate] - points[n, coordinate]) ** 2
        kth = np.partition(squared, k - 1)[k - 1]
        tolerance = 1.0 + 2.0**-40
        resolved = kth > resolution * resolution * tolerance
        radius_squared = (kth if resolved else resolution * resolution) * tolerance
        within = others[squared <= radius_squared]
        q = k if resolved else len(within)
        share = prior[within].sum() / prior[others].sum()
        total += prior[n] * (
            -math.log(share)
            + log_ball
            + 0.5 * dimension * math.log(radius_squared)
            + math.log(q)
            - digamma(q)
        )
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
