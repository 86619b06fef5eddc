"""Algorithm 2 as it is written: the peer that holdfast's speed is measured against.

For every sensing action and every hypothetical observation: draw a state, draw the observation,
reweight the particles, ask the policy for every particle's action, build a k-d tree of the actions
and estimate their entropy. Nothing is shared between two observations. Within one, NumPy and
SciPy's compiled tree do the work: this is what a researcher who knows both would write from the
definition.

The entropy comes in three forms. The literal one takes every particle of non-zero weight, as the
published algorithm does. The second leaves out particles of negligible weight, as holdfast does: it
computes the same numbers (tests/oracles/test_literal_algorithm.py holds both to 1e-9) from the same
random draws, so that a ratio of times compares the same work. The third, *tuned*, shows what some
hours more would bring.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.special import digamma

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import Belief
from holdfast.planning.planner import PlanningState
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem

__all__ = [
    "choose_sensing_action",
    "literal_entropy",
    "nearest_neighbor_entropy",
    "tuned_nearest_neighbor_entropy",
]


# As `holdfast.planning.estimators.NearestNeighbor` says: weights below one of these fractions of
# the greatest are left out, the first that loses no more than this share of the sum, else the last.
NEGLIGIBLE = tuple(10.0**-i * (1.0 - 2.0**-40) for i in range(2, 7))
LOST_SHARE = 0.005
# Two distances count as equal if they differ by no more than rounding.
TIE = 1.0 + 2.0**-41

Entropy = Callable[[FloatArray, FloatArray, int, float], float]


def choose_sensing_action(
    problem: Problem,
    settings: PlanningSettings,
    state: PlanningState,
    entropy: Entropy | None = None,
) -> tuple[int, FloatArray]:
    """Choose the sensing action with the least expected entropy of the task actions.

    Parameters
    ----------
    problem : Problem
        With observations of state-independent variance and one coordinate per sensing action.
    settings : PlanningSettings
        Of a horizon of 1 and the nearest-neighbour estimate of commanded actions.
    entropy : callable, optional
        Default: :func:`nearest_neighbor_entropy`.

    Returns
    -------
    index : int
    entropies : array of shape (J,)
        Expected entropy after each sensing action, in nats.
    """
    entropy = entropy or nearest_neighbor_entropy
    sensing = settings.active_sensing
    samples = sensing.num_observation_samples
    own = settings.selector.resolution or problem.resolution
    # With one for each coordinate actions are measured in it.
    units = None if isinstance(own, (int, float)) else np.array(own)
    resolution = float(own) if isinstance(own, (int, float)) else 1.0
    states, weights = state.belief

    draws = stream(state.seed, state.trial, state.step, Purpose.HYPOTHESES)
    positions = (np.arange(samples) + draws.uniform(samples)) / samples
    noise = draws.substream(1).normal(samples)
    cumulated = np.cumsum(weights)

    entropies = np.zeros(len(problem.sensing_actions))
    for j in range(len(problem.sensing_actions)):
        for i in range(samples):
            drawn = min(int(np.searchsorted(cumulated, positions[i], "right")), len(weights) - 1)
            variance = problem.observation_variance(states[drawn], j)
            observation = problem.observation_mean(states[drawn], j) + np.sqrt(variance) * noise[i]
            posterior = _reweighted(problem, state.belief, j, observation)
            actions = problem.policy(states, state.stage)
            if units is not None:
                actions = actions / units
            entropies[j] += entropy(actions, posterior, sensing.num_nearest_neighbors, resolution)
    entropies /= samples
    if units is not None:
        entropies += np.log(units).sum()
    return int(np.argmin(entropies)), entropies


def _reweighted(
    problem: Problem, belief: Belief, sensing_action: int, observation: FloatArray
) -> FloatArray:
    """Multiply the weights by the likelihood of an observation and normalise them."""
    difference = observation - problem.observation_mean(belief.states, sensing_action)
    variance = problem.observation_variance(belief.states, sensing_action)
    exponent = -0.5 * (difference * difference / variance).sum(axis=-1)
    weights: FloatArray = belief.weights * np.exp(exponent - exponent.max())
    weights /= weights.sum()
    return weights


def nearest_neighbor_entropy(
    points: FloatArray,
    weights: FloatArray,
    neighbors: int,
    resolution: float,
    negligible: tuple[float, ...] = NEGLIGIBLE,
) -> float:
    """Estimate the entropy of weighted points as ``NearestNeighbor`` defines it.

    Parameters
    ----------
    points : array of shape (n, d)
    weights : array of shape (n,)
    negligible : tuple of float
        Fractions of the greatest weight to cut at; none keeps every point of non-zero weight.

    Returns
    -------
    float
        In nats.
    """
    points, weights = _significant(points, weights, negligible)
    if len(points) == 1:
        return _entropy_of_one(points.shape[1], resolution)
    k = min(neighbors, len(points) - 1)

    tree = cKDTree(points)
    distances, _ = tree.query(points, k + 1)  # the nearest point is the point itself
    resolved = distances[:, k] > resolution * TIE
    radius = np.where(resolved, distances[:, k], resolution) * TIE
    balls = tree.query_ball_point(points, radius)
    mass = np.array([weights[ball].sum() for ball in balls]) - weights
    within = np.where(resolved, k, np.array([len(ball) for ball in balls]) - 1)
    return _weighted_sum(weights, mass, radius, within, points.shape[1])


def literal_entropy(
    points: FloatArray, weights: FloatArray, neighbors: int, resolution: float
) -> float:
    """Estimate with every point of non-zero weight, as published; for its time only.

    The value is another one, and a poor one: weights of 1e-200 count as neighbours, and masses of
    so little cancel to nothing. Parameters are those of :func:`nearest_neighbor_entropy`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        return nearest_neighbor_entropy(points, weights, neighbors, resolution, negligible=())


def tuned_nearest_neighbor_entropy(
    points: FloatArray, weights: FloatArray, neighbors: int, resolution: float
) -> float:
    """Estimate the same with what a profiler suggests: no Python list of every point's ball.

    The k nearest are at hand from the query already; balls of the resolution come as one array of
    pairs; a ball of its own is asked for only where distances tie. Parameters and result are those
    of :func:`nearest_neighbor_entropy`.
    """
    points, weights = _significant(points, weights)
    count, dimension = points.shape
    if count == 1:
        return _entropy_of_one(dimension, resolution)
    k = min(neighbors, count - 1)

    tree = cKDTree(points)
    distances, indices = tree.query(points, min(k + 2, count))
    resolved = distances[:, k] > resolution * TIE
    radius = np.where(resolved, distances[:, k], resolution) * TIE
    mass = weights[indices[:, : k + 1]].sum(axis=1) - weights
    within = np.full(count, k)
    if not resolved.all():
        pairs = tree.query_pairs(resolution * TIE, output_type="ndarray")
        first, second = pairs[:, 0], pairs[:, 1]
        number = np.bincount(pairs.ravel(), minlength=count)
        total = np.bincount(first, weights[second], count)
        total += np.bincount(second, weights[first], count)
        within = np.where(resolved, within, number)
        mass = np.where(resolved, mass, total)
    if k + 1 < count:
        tied = resolved & (distances[:, k + 1] <= radius)
        for n in np.flatnonzero(tied):
            mass[n] = weights[tree.query_ball_point(points[n], radius[n])].sum() - weights[n]
    return _weighted_sum(weights, mass, radius, within, dimension)


def _significant(
    points: FloatArray, weights: FloatArray, negligible: tuple[float, ...] = NEGLIGIBLE
) -> tuple[FloatArray, FloatArray]:
    light = weights == 0.0
    for fraction in negligible:
        light = weights < fraction * weights.max()
        if weights[light].sum() <= LOST_SHARE * weights.sum():
            break
    return points[~light], weights[~light] / weights[~light].sum()


def _log_unit_ball(dimension: int) -> float:
    return 0.5 * dimension * math.log(math.pi) - math.lgamma(0.5 * dimension + 1.0)


def _entropy_of_one(dimension: int, resolution: float) -> float:
    return _log_unit_ball(dimension) + dimension * math.log(resolution)


def _weighted_sum(
    weights: FloatArray,
    mass: FloatArray,
    radius: FloatArray,
    within: npt.NDArray[np.int64],
    dimension: int,
) -> float:
    log_density = np.log(mass / (1.0 - weights)) - _log_unit_ball(dimension)
    log_density -= dimension * np.log(radius)
    return float((weights * (np.log(within) - digamma(within) - log_density)).sum())
