"""The belief: weighted particles, and the operations on them.

A belief about the state is a set of states ("particles") with weights that sum to 1. Moving the
robot moves every particle (*predict*); an observation multiplies each weight by how well that
particle explains it (*update*); and when few particles carry most of the weight, new particles are
drawn from the set (*resample*). The functions are pure: they return a new belief and do not change
the old one.

Weights are multiplied as logarithms, so an observation that is very unlikely under every particle
still ranks them instead of turning every weight into zero.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast import _kernel
from holdfast.errors import InvalidValueError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray, floats, in_brief
from holdfast.numerics.circular import differences, mean_angles
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.numerics.randomness import Stream
from holdfast.planning.modes import heaviest_mode
from holdfast.planning.settings import Estimate
from holdfast.planning.validation_gate import gate, is_typical, is_within
from holdfast.problems import checked
from holdfast.problems.attributes import circular_observation, has_general_observations

VALIDATION_GATE_SQUARED = 64.0
"""Square of eight standard deviations. An observation further than this from every particle lies
outside the validation gate; under a correct model in one dimension its probability is below
2e-15."""


_DISCOUNT = 0.98
"""Discount factor of Liu and West's kernel; they propose 0.95 to 0.99."""

_SHRINKAGE = (3.0 * _DISCOUNT - 1.0) / (2.0 * _DISCOUNT)
_BANDWIDTH = float(np.sqrt(1.0 - _SHRINKAGE * _SHRINKAGE))


class Belief(NamedTuple):
    """Weighted particles.

    Attributes
    ----------
    states : array of shape (num_particles, state_size)
        C-contiguous, finite, read-only.
    weights : array of shape (num_particles,)
        Non-negative, read-only; their sum is 1 up to rounding.
    """

    states: FloatArray
    weights: FloatArray

    def __reduce__(self) -> tuple[Any, ...]:
        """Be pickled and copied as what is read-only: NumPy forgets that of its arrays."""
        return _restored, (self.states, self.weights)

    @classmethod
    def uniform(cls, states: npt.ArrayLike) -> Belief:
        """Return a belief of equally weighted particles, (num_particles, state_size).

        Raises InvalidValueError if there is no particle or a coordinate is not finite.
        """
        array = floats("states", states).copy()
        if array.ndim != 2 or array.shape[0] == 0 or array.shape[1] == 0:
            raise InvalidValueError(
                f"states of shape {array.shape}: need (num_particles, state_size), at least 1 each"
            )
        if not numerics.all_finite(array):
            bad = int(np.argmin(np.isfinite(array).all(axis=1)))
            raise InvalidValueError(f"state of particle {bad} is {array[bad]}: must be finite")
        array.setflags(write=False)
        return cls(array, uniform_weights(array.shape[0]))

    @classmethod
    @in_own_mode
    def weighted(cls, states: npt.ArrayLike, weights: npt.ArrayLike) -> Belief:
        """Return a belief of weighted particles; the weights are normalised.

        The weights, of shape (num_particles,), are non-negative and finite, not all zero; what is
        out of bounds raises InvalidValueError.
        """
        belief = cls.uniform(states)
        array = floats("weights", weights)
        count = belief.states.shape[0]
        if array.shape != (count,):
            raise InvalidValueError(f"weights of shape {array.shape}: need ({count},)")
        if not numerics.all_finite(array) or (array < 0.0).any():
            bad = int(np.argmin(np.isfinite(array) & (array >= 0.0)))
            raise InvalidValueError(
                f"weight of particle {bad} is {array[bad]}: must be >= 0, finite"
            )
        total = numerics.sum(array)
        if not 0.0 < total < np.inf:
            raise InvalidValueError(f"sum of the weights is {total}: must be positive and finite")
        normalized = array / total
        normalized.setflags(write=False)
        return cls(belief.states, normalized)


def _restored(states: FloatArray, weights: FloatArray) -> Belief:
    states.setflags(write=False)
    weights.setflags(write=False)
    return Belief(states, weights)


def uniform_weights(count: int) -> FloatArray:
    """Return ``count`` weights of ``1 / count``."""
    weights = np.full(count, 1.0 / count)
    weights.setflags(write=False)
    return weights


class ObservationInfo(NamedTuple):
    """The result of updating the belief by an observation.

    Attributes
    ----------
    effective_sample_size : float
        ``1 / sum(weights**2)`` after the update and before resampling, from 1 to the number of
        particles.
    explained : bool
        False if the observation lies outside the validation gate of every particle (for a general
        likelihood: is impossible under all of them): the belief is valid but not to be trusted.
    resampled : bool
        Whether the particles were drawn anew after the update.
    mahalanobis_distance : float or None
        Distance of the observation from the nearest particle's prediction, in standard deviations;
        None for a general likelihood, which has no such distance.
    within_gate : bool
        Whether the observation is one that the belief makes likely: within the gate of
        :mod:`holdfast.planning.validation_gate` (for a general likelihood: possible for some
        particle).
    distinct_particles : int
        How many different particles the observation weighed; copies of one count once. Far below
        their number the belief is depleted: a state that does not move gets no new particles.
    """

    effective_sample_size: float
    explained: bool
    resampled: bool
    mahalanobis_distance: float | None = None
    within_gate: bool = True
    distinct_particles: int = 0


def estimate(belief: Belief, kind: Estimate = "mean", circular: Sequence[int] = ()) -> FloatArray:
    """Return a point estimate of the state, shape ``(state_size,)``.

    It is the mean, the mean of the heaviest mode (:mod:`holdfast.planning.modes`), or the particle
    of the greatest weight (the first of equals). The mean of a ``circular`` coordinate, an angle in
    radians, is the mean direction, in (-pi, pi].
    """
    if kind == "most_likely":
        # A copy: the belief may be large, and what is returned may outlive it.
        likely: FloatArray = belief.states[int(np.argmax(belief.weights))].copy()
        return likely
    weights = belief.weights
    if kind == "heaviest_mode":
        weights = heaviest_mode(belief.states, weights, circular)
    mean = _kernel.weighted_sums(weights, belief.states)
    if circular:
        angles = list(circular)
        mean[angles] = mean_angles(belief.states[:, angles], weights)
    return mean


@in_own_mode
def standard_deviation(belief: Belief, circular: Sequence[int] = ()) -> FloatArray:
    """Return the standard deviation of each coordinate, shape ``(state_size,)``.

    Of a ``circular`` coordinate it is that of the shorter ways round from the mean direction to the
    particles: at most pi, and 1.81 for a heading of which nothing is known.
    """
    difference = differences(belief.states, estimate(belief, circular=circular), circular)
    return np.sqrt(_kernel.weighted_sums(belief.weights, difference * difference))


def belief_sizes(belief: Belief) -> tuple[float, int]:
    """Return ``1 / sum(weights**2)`` (Kong, Liu and Wong 1994), and how many particles differ.

    Copies of one count once as far as they stand side by side: resampling puts them there, and
    nothing moves them apart. Equal states that are no copies of one (where a state has few values)
    count as often as they do not meet.
    """
    return _kernel.belief_sizes(*belief)


def update(
    problem: Any,
    belief: Belief,
    sensing_action: int,
    observation: npt.ArrayLike,
    rank_stream: Stream | None = None,
) -> tuple[Belief, ObservationInfo]:
    """Multiply the weights by the likelihood of an observation (Bayes' rule); do not resample.

    If the log-likelihood is minus infinity for every particle, the belief stays as it is.

    Parameters
    ----------
    problem : Problem
        Has the mean and variance of the observation in each state, or a method
        ``log_likelihood(states, sensing_action, observation)``.
    observation : array of shape (observation_size,)
    rank_stream : Stream, optional
        For a general likelihood: draws what the rank test of the validation gate compares with.

    Raises
    ------
    InvalidValueError
        If the observation is not finite, or its size differs from the prediction.
    ProblemError
        If the problem violates its contract.
    """
    observed = finite(observation)
    if has_general_observations(problem):
        log_likelihood = checked.log_likelihood(problem, belief.states, sensing_action, observed)
        within_gate = possible = _is_possible(belief, log_likelihood)
        if possible and rank_stream is not None:
            within_gate = _is_typical(problem, belief, sensing_action, log_likelihood, rank_stream)
        return _reweighed(belief, log_likelihood, possible, within_gate)
    mean, variance = checked.prediction(problem, belief.states, sensing_action)
    size = mean.shape[-1]
    if size != observed.shape[0]:
        raise InvalidValueError(
            f"observation of {observed.shape[0]} coordinates: sensing action {sensing_action} "
            f"gives {size}"
        )
    angles = circular_observation(problem, sensing_action, size)
    posterior = np.empty(belief.weights.shape)
    found = _kernel.update_by_gaussian(*belief, observed, mean, variance, angles, posterior)
    if found is None:
        raise checked.unusable(problem, sensing_action, mean, variance)
    squared = found[3]
    explained = squared <= VALIDATION_GATE_SQUARED
    # Most observations are near a particle, and cost no more than this comparison.
    within_gate = squared <= gate(size) or is_within(
        observed, mean, variance, belief.weights, angles
    )
    return _updated(belief, posterior, found[:3], explained, math.sqrt(squared), within_gate)


def _is_possible(belief: Belief, log_likelihood: FloatArray) -> bool:
    return bool(((log_likelihood > -np.inf) & (belief.weights > 0.0)).any())


def _is_typical(
    problem: Any, belief: Belief, sensing_action: int, log_likelihood: FloatArray, random: Stream
) -> bool:
    """Tell whether an observation is as likely as others that the belief makes."""
    states, weights = belief

    def predictive(log_likelihoods: FloatArray) -> float:
        peak = float(log_likelihoods.max())
        if peak == -np.inf:
            return peak
        total = numerics.sum(weights * numerics.exp(log_likelihoods - peak))
        return peak + float(numerics.log(total))

    def draw(number: int) -> float:
        own = random.substream(number)
        drawn = _kernel.systematic_resample(weights, float(own.substream(0).uniform()))
        chosen = states[drawn[int(own.substream(1).uniform() * drawn.shape[0])]]
        shown = checked.sample_observation(problem, chosen, sensing_action, own.substream(2))
        return predictive(checked.log_likelihood(problem, states, sensing_action, shown))

    return is_typical(predictive(log_likelihood), draw)


def update_by_move(
    problem: Any, belief: Belief, task_action: FloatArray, observation: npt.ArrayLike
) -> tuple[Belief, ObservationInfo]:
    """Multiply the weights by the likelihood of what came with a move; do not resample.

    ``belief`` is the one after the move. Raises as :func:`update`, and ProblemError if the problem
    has no ``move_log_likelihood``.
    """
    observed = finite(observation)
    log_likelihood = checked.move_log_likelihood(problem, belief.states, task_action, observed)
    possible = _is_possible(belief, log_likelihood)
    return _reweighed(belief, log_likelihood, possible, possible)


def finite(observation: npt.ArrayLike) -> FloatArray:
    """Return an observation as numbers; raise InvalidValueError if one is not finite."""
    observed = floats("observation", observation).reshape(-1)
    if not numerics.all_finite(observed):
        raise InvalidValueError(
            f"observation {in_brief(observed)}: every coordinate must be finite"
        )
    return observed


def _reweighed(
    belief: Belief, log_likelihood: FloatArray, explained: bool, within_gate: bool
) -> tuple[Belief, ObservationInfo]:
    """Update a belief by a general likelihood, whose array becomes the posterior weights."""
    sizes = _kernel.update(*belief, log_likelihood)
    return _updated(belief, log_likelihood, sizes, explained, None, within_gate)


def _updated(
    belief: Belief,
    posterior: FloatArray,
    sizes: tuple[int, float, int],
    explained: bool,
    distance: float | None,
    within_gate: bool,
) -> tuple[Belief, ObservationInfo]:
    survivors, effective, distinct = sizes
    explained = explained and survivors > 0
    info = ObservationInfo(effective, explained, False, distance, within_gate, distinct)
    return reweighted(belief, posterior, survivors), info


def reweighted(belief: Belief, posterior: FloatArray, survivors: int) -> Belief:
    """Return a belief with the kernel's posterior weights; as it is if no particle survives."""
    if not survivors:
        return belief
    posterior.setflags(write=False)
    return Belief(belief.states, posterior)


def resample(belief: Belief, stream: Stream) -> Belief:
    """Draw the same number of equally weighted particles, by systematic resampling.

    The stream gives the one uniform offset. Particle n occurs ``floor(N w_n)`` or ``ceil(N w_n)``
    times: Carpenter, Clifford and Fearnhead (1999), "Improved particle filter for nonlinear
    problems".
    """
    states, weights = np.empty(belief.states.shape), np.empty(belief.weights.shape)
    _kernel.resample(*belief, stream.words, states, weights)
    return _restored(states, weights)


def regularised(
    drawn: Belief, weighted: Belief, static: Sequence[int], circular: Sequence[int], stream: Stream
) -> Belief:
    """Return resampled particles with new values of the coordinates that do not move.

    Each is drawn from a normal kernel about its particle's value, which is first shrunk towards the
    mean: so mean and covariance stay those of the belief, however often it is resampled. Source:
    Liu and West, "Combined parameter and state estimation in simulation-based filtering", 2001.
    ``weighted`` is the belief before resampling; ``circular`` are all coordinates that are angles.
    """
    own = list(static)
    angles = [own.index(each) for each in circular if each in own]
    middle = estimate(weighted, circular=circular)[own]
    away = differences(weighted.states[:, own], middle, angles)
    factor = _cholesky(weighted.weights, away)
    noise = stream.substream(0).normal((drawn.states.shape[0], len(own)))
    moved = middle + _SHRINKAGE * differences(drawn.states[:, own], middle, angles)
    for row in range(len(own)):
        for column in range(row + 1):
            moved[:, row] += _BANDWIDTH * factor[row, column] * noise[:, column]
    states = drawn.states.copy()
    states[:, own] = moved
    if not numerics.all_finite(states):
        return drawn  # squares of what is spread so far overflow
    states.setflags(write=False)
    return Belief(states, drawn.weights)


def _cholesky(weights: FloatArray, away: FloatArray) -> FloatArray:
    """Return the lower factor of a covariance; where nothing is spread, zeros."""
    size = away.shape[1]
    factor = np.zeros((size, size))
    for column in range(size):
        products = np.ascontiguousarray(away * away[:, [column]])
        rest = _kernel.weighted_sums(weights, products)
        for earlier in range(column):
            rest = rest - factor[:, earlier] * factor[column, earlier]
        # Below rounding it is a combination of the columns before.
        if rest[column] > 1e-12 * products[:, column].max():
            factor[column:, column] = rest[column:] / np.sqrt(rest[column])
    return factor
