"""The validation gate: which observations a belief makes likely.

A correct belief is surprised now and then, by known odds. The squared distance between an
observation and its prediction, in units of their covariance, follows a chi-square distribution
(the normalised innovation squared: Bar-Shalom, Li and Kirubarajan, "Estimation with Applications to
Tracking and Navigation", 2001, section 5.4), and one observation in a hundred lies outside the 99 %
gate.

Particles need two distances. From the *nearest particle*, in units of the sensor's noise: only what
no particle explains can say that all of them are wrong, so several modes are no alarm. From the
*mean prediction*, in units of its whole covariance: between few particles there are gaps, which a
sharp sensor finds, and there the belief's spread says what is near. An observation is outside the
gate if it is far in both. If the truth is a draw from the belief, that is rarer than either.

A likelihood of its own has no such distance. There an observation is outside if no particle can
have made it; and if the problem asks for it, a rank test takes the distance's place.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import numpy as np

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.circular import differences, mean_angles

OUTSIDE_PROBABILITY = 0.01
"""Probability that an observation is outside, if the belief and the model are right."""

NUM_RANKED = 19
"""Drawn observations of a rank test: 1 / (19 + 1) is what :mod:`holdfast.planning.lost` allows."""

_QUANTILE = 2.3263478740408408
"""Quantile of the standard normal distribution at 1 - OUTSIDE_PROBABILITY."""


@functools.cache
def gate(size: int) -> float:
    """Return the squared distance that an observation of ``size`` coordinates rarely exceeds.

    It is the quantile of the chi-square distribution at 0.99, by the approximation of Wilson and
    Hilferty (1931), "The distribution of chi-square", PNAS 17: within 1 %, for every size, from
    arithmetic that has the same bits everywhere.
    """
    variance = 2.0 / (9.0 * size)
    root = 1.0 - variance + _QUANTILE * float(np.sqrt(variance))
    return size * root * root * root


def is_within(
    observed: FloatArray,
    mean: FloatArray,
    variance: FloatArray,
    weights: FloatArray,
    circular: Sequence[int] = (),
) -> bool:
    """Tell whether an observation is near the mean prediction of all particles.

    ``mean``, of shape (num_particles, observation_size), is what each particle predicts, and
    ``variance`` that of the sensor's noise, of this shape or one row for all. ``circular`` are the
    coordinates of the observation that are angles.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        squared = _squared_distance(observed, mean, variance, weights, circular)
    return squared <= gate(observed.shape[0])


def is_typical(log_density: float, draw_log_density: Callable[[int], float]) -> bool:
    """Tell whether an observation is as likely as one of 19 that the belief itself makes.

    ``draw_log_density(n)`` draws the n-th one and returns the logarithm of its predictive density.
    If the observation is drawn from the same distribution, it is the least likely of the 20 with
    probability at most 1 / 20, exactly, for any distribution: Barnard (1963), Journal of the Royal
    Statistical Society B 25. The draws end with the first that decides (Besag and Clifford 1991,
    "Sequential Monte Carlo p-values", Biometrika 78): after 3.5 of them on average.
    """
    return any(draw_log_density(n) <= log_density for n in range(NUM_RANKED))


def _squared_distance(
    observed: FloatArray,
    mean: FloatArray,
    variance: FloatArray,
    weights: FloatArray,
    circular: Sequence[int] = (),
) -> float:
    """Return ``r' S^-1 r``, r the innovation and S its covariance.

    S is never formed: where two channels show nearly the same, its digits do not suffice. With A
    the rows that make ``S = A' A`` (a row for each particle, and one for each channel's noise), it
    is the triangle of a QR factorisation of A, by Gram and Schmidt's modified method.
    """
    size, count = observed.shape[0], mean.shape[0]
    predicted = _kernel.weighted_sums(weights, mean)
    if circular:
        angles = list(circular)
        predicted[angles] = mean_angles(mean[:, angles], weights)
    spread = differences(mean, predicted, circular)
    noise = variance if variance.ndim == 1 else _kernel.weighted_sums(weights, variance)
    # In units of its whole deviation each column has the length 1.
    unit = np.sqrt(_kernel.weighted_sums(weights, spread * spread) + noise)
    rows = np.zeros((count + size, size))
    rows[:count] = np.sqrt(weights)[:, np.newaxis] * (spread / unit)
    rows[np.arange(count, count + size), np.arange(size)] = np.sqrt(noise) / unit
    innovation = differences(observed, predicted, circular) / unit
    squared = 0.0
    for column in range(size):
        own = np.ascontiguousarray(rows[:, column])
        later = np.ascontiguousarray(rows[:, column + 1 :])
        length = np.sqrt(_kernel.sum(own * own))
        direction = own / length
        scaled = innovation[column] / length
        squared += float(scaled * scaled)
        if later.shape[1]:
            along = _kernel.weighted_sums(direction, later)
            rows[:, column + 1 :] = later - direction[:, np.newaxis] * along
            innovation[column + 1 :] -= along * scaled
    return squared
