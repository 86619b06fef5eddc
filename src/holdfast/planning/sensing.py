"""Choosing what to sense.

Look ahead by one observation: for each sensing action, sample what it might show, update the belief
by it, and measure how uncertain the robot would then be about its next **action**. The sensing
action with the least expected entropy of the task actions wins (*action entropy*). The entropy of
the state (*state entropy*) spends sensing on differences that change no action. The spread of the
task actions (*action covariance*, the trace of their covariance) is simpler, and sees how far two
different actions are from each other, which entropy does not. Two methods that look ahead at
nothing, *random* and *fixed*, are there to compare with.

Sensing may have a price, and not to sense may be a choice, with the entropy of the belief as it is
and without a price. What wins then has the least sum of entropy and price: a sensing action is
performed only if it is expected to gain more than it costs. A weighted sum of uncertainties and
costs is the criterion of Mihaylova, Lefebvre, Bruyninckx, Gadeyne and De Schutter, "Active sensing
for robotics - a survey", NM&A 2002 (docs/decisions/sensing_price.md has the others).

Source: Greigarn, Branicky and Çavuşoğlu, "Task-oriented active sensing via action entropy
minimization", IEEE Access, 2019; Algorithm 2 of the thesis that the configuration files come from.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from holdfast import _kernel
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray, IntArray, in_brief
from holdfast.numerics.circular import embedded, unwrapped
from holdfast.numerics.randomness import Stream, Words
from holdfast.planning import estimators, interruption
from holdfast.planning.belief import Belief, estimate
from holdfast.planning.dominance import dominated
from holdfast.planning.expected_return import expected_returns
from holdfast.planning.policy_path import path_points
from holdfast.planning.settings import NEIGHBOR_ESTIMATORS, PlanningSettings, estimator_of
from holdfast.problems import attributes, checked
from holdfast.problems.problem import Problem

# Substreams of the stream of hypotheses; 1 is the kernel's own, for the observation noise.
_HORIZON_MOTION = 2
_GENERAL_OBSERVATIONS = 3

_ROUNDING = 2.0**-40
"""Relative difference below which two scores differ by rounding alone."""

_LARGEST_BLOCK = 2**20
"""Coordinates of the beliefs that are predicted at the same time: 8 MB."""


class SensingInfo(NamedTuple):
    """The values behind the choice of a sensing action.

    Attributes
    ----------
    entropies : array of shape (J,) or None
        Expected (discounted, summed) entropy after each sensing action, in nats; for
        ``action_covariance`` the trace of the covariance, in the actions' units squared, or in
        resolutions squared where there is one for each coordinate; for ``expected_return`` the
        return less the price of sensing, negated and up to a constant; None for ``random`` and
        ``fixed``. If sensing is optional, a last entry stands for not sensing: J is one more.
    samples : array of shape (J, M) or None
        The entropies of the single hypothetical observations, whose means ``entropies`` are. Those
        of not sensing differ by the motion of later steps alone (``horizon`` above 1).
    likelihoods, visits : int
        Work done: likelihoods evaluated and distances between points computed.
    prices : array of shape (J,) or None
        ``selector.nats_per_cost`` times the costs, in the unit of the entropies: what was chosen
        has the least sum of both. None if no cost counts, and for ``expected_return``, whose
        returns are less by the prices.
    """

    entropies: FloatArray | None
    samples: FloatArray | None
    likelihoods: int
    visits: int
    prices: FloatArray | None = None


class Predictions(NamedTuple):
    """What the problem's functions say of n particles, each by itself."""

    sets: FloatArray  # (K, n, d): points whose entropies count, each set by its one of the factors
    factors: tuple[float, ...]
    # Of :func:`holdfast.problems.checked.predictions`; None for a general likelihood.
    shown: tuple[list[int], FloatArray, FloatArray] | None

    def of(self, some: slice) -> Predictions:
        """Return those of some of the particles."""
        if self.shown is None:
            return self._replace(sets=self.sets[:, some])
        sizes, means, variances = self.shown
        if variances.shape[1] > 1:
            variances = np.ascontiguousarray(variances[:, some])
        shown = sizes, np.ascontiguousarray(means[:, some]), variances
        return Predictions(np.ascontiguousarray(self.sets[:, some]), self.factors, shown)


def predict(
    problem: Problem, settings: PlanningSettings, states: FloatArray, stage: int
) -> Predictions:
    """Return what an entropy method needs of particles in one stage, shape (n, state_size)."""
    if settings.selector.method == "path_entropy":
        sets, factors = path_points(problem, settings, states, stage)
    else:
        sets, factors = _points_of(problem, settings)(states, stage)[np.newaxis], (1.0,)
    if attributes.has_general_observations(problem):
        return Predictions(sets, factors, None)
    every = range(len(problem.sensing_actions))
    return Predictions(sets, factors, checked.predictions(problem, states, every))


def choose_sensing_action(
    problem: Problem,
    settings: PlanningSettings,
    belief: Belief,
    stage: int,
    hypotheses: Stream,
    selection: Stream,
    *,
    predictions: Predictions | None = None,
) -> tuple[int, SensingInfo]:
    """Choose a sensing action for a belief: an index, the lowest of equally good ones.

    Of equal expected returns the method ``expected_return`` draws one: where nothing is gained
    within its rollouts, no sensor is preferred for its number.

    If ``selector.sensing_is_optional``, the index ``len(problem.sensing_actions)`` is the choice
    not to sense. It wins where nothing gains more than its price: of equally good choices it is the
    one without effort.

    The stream ``hypotheses`` has the random numbers of the hypothetical observations, ``selection``
    the one of the method ``random`` and of equal expected returns. Who has the ``predictions``
    already, those of :func:`predict` for this belief and stage, may give them to an entropy method.

    Raises
    ------
    InvalidValueError
        If a setting does not fit the problem or the belief.
    ProblemError
        If a function of the problem returns something out of its contract.
    """
    selector, sensing = settings.selector, settings.active_sensing
    count = len(problem.sensing_actions)
    choices = count + 1 if selector.sensing_is_optional else count
    if selector.method == "fixed":
        if selector.sensing_action >= choices:
            not_sensing = (
                f" (and {count}, not to sense, if selector.sensing_is_optional is true)"
                if selector.sensing_action == count
                else ""
            )
            raise InvalidValueError(
                f"selector.sensing_action {selector.sensing_action}: {problem.name} has sensing "
                f"actions 0 to {count - 1}{not_sensing}"
            )
        return selector.sensing_action, SensingInfo(None, None, 0, 0)
    if selector.method == "random":
        return int(float(selection.anew().uniform()) * choices), SensingInfo(None, None, 0, 0)

    if selector.method == "expected_return":
        return _greatest_return(problem, settings, belief, stage, hypotheses, selection)

    points_of = _points_of(problem, settings)
    sets, factors, shown = predictions or predict(problem, settings, belief.states, stage)
    estimator = _estimator(problem, settings, belief, sets[0])
    sets = _on_a_line(problem, settings, sets)
    threads, size = sensing.num_cores, sensing.num_observation_samples
    hypothetical = _hypotheses_of(problem, belief, shown)(range(count), size, hypotheses)
    entropies, samples, likelihoods, visits = hypothetical.entropies(
        estimators.scaled(sets.reshape(-1, sets.shape[-1]), estimator),
        estimator,
        threads,
        factors,
        selector.sensing_is_optional,
    )
    if sensing.horizon > 1 and not np.isnan(entropies).any():
        weights = hypothetical.weights(estimator.drops_negligible)
        if selector.sensing_is_optional:
            same = _kernel.normalize(numerics.log(belief.weights), estimator.drops_negligible)[0]
            weights = _with_unchanged(weights, same)
        later = _later_entropies(
            problem, settings, belief.states, weights, stage, hypotheses, estimator, points_of
        )
        samples = samples + later
        entropies = _row_means(samples)
    prices = _prices(problem, settings)
    scores = entropies if prices is None else entropies + prices
    if selector.estimator == "prior_neighbors_undominated" and isinstance(
        hypothetical, _GaussianHypotheses
    ):
        _, sizes, means, variances, _, _, angles = hypothetical.arguments
        own = np.zeros(count) if prices is None else prices
        if not any(angles) and (worse := dominated(sizes, means, variances, own)).any():
            scores = np.where(np.append(worse, [False] * (choices - count)), np.inf, scores)
    index = _least(scores, optional=selector.sensing_is_optional)
    if entropies[index] != entropies[index]:
        raise ProblemError(
            f"the entropy after sensing action {index} of {problem.name} is not a number: a "
            "hypothetical observation had no likelihood under any particle"
        )
    # After the choice: what is the same for all must not decide it by its rounding.
    volume = estimator.log_volume * sum(factors) * _total_factor(settings)
    return index, SensingInfo(entropies + volume, samples + volume, likelihoods, visits, prices)


def _least(scores: FloatArray, *, optional: bool) -> int:
    """Return the choice with the least score; a NaN, if there is one.

    If sensing is optional, the last choice is not to sense. It also wins if it is worse by no more
    than rounding, as where all actions are alike already.
    """
    index = int(scores.argmin())
    # A comparison with NaN is false.
    if optional and scores[-1] - scores[index] <= _ROUNDING * abs(scores[-1]):
        return len(scores) - 1
    return index


def _prices(problem: Problem, settings: PlanningSettings) -> FloatArray | None:
    """Return what the entropy of each choice is raised by; None if no cost counts."""
    rate = settings.selector.nats_per_cost
    if rate == 0.0:
        return None
    optional = settings.selector.sensing_is_optional
    return rate * attributes.sensing_costs(problem, otherwise=1.0, optional=optional)


def _with_unchanged(weights: FloatArray, same: FloatArray) -> FloatArray:
    """Append to posteriors, shape (J, M, N), those of not sensing: M times the same weights."""
    rows = np.broadcast_to(same, (1, *weights.shape[1:]))
    return np.concatenate([weights, rows])


def _total_factor(settings: PlanningSettings) -> float:
    """Return how often an entropy counts over the horizon, discounted."""
    total = factor = 1.0
    for _ in range(1, settings.active_sensing.horizon):
        factor *= settings.active_sensing.discount
        total += factor
    return total


def _greatest_return(
    problem: Problem,
    settings: PlanningSettings,
    belief: Belief,
    stage: int,
    hypotheses: Stream,
    selection: Stream,
) -> tuple[int, SensingInfo]:
    likelihoods = 0
    not_sensing = len(problem.sensing_actions)
    hypotheses_of = _hypotheses_of(problem, belief)

    def posteriors(
        actions: Sequence[int], samples: int, stream: Stream
    ) -> tuple[IntArray, FloatArray]:
        nonlocal likelihoods
        sensing = [action for action in actions if action != not_sensing]
        likelihoods += len(sensing) * samples * belief.weights.shape[0]
        weights = hypotheses_of(sensing, samples, stream).weights(False)
        if len(sensing) < len(actions):
            weights = _with_unchanged(weights, belief.weights)
        return _kernel.stratified(belief.weights, samples, stream.words), weights

    returns = expected_returns(problem, settings, belief, stage, hypotheses, posteriors)
    # What is least: as for the other methods.
    losses = -returns.means
    index = _least(losses, optional=settings.selector.sensing_is_optional)
    if index != not_sensing:
        best = np.flatnonzero(losses == losses[index])
        index = int(best[int(float(selection.anew().uniform()) * len(best))])
    return index, SensingInfo(losses, -returns.samples, likelihoods, 0)


def _points_of(
    problem: Problem, settings: PlanningSettings
) -> Callable[[FloatArray, int], FloatArray]:
    """Return the map from states to the points whose entropy counts."""
    if settings.selector.method == "state_entropy":
        return lambda states, _: states
    if settings.selector.actions == "executed":
        return lambda states, stage: checked.executed_action(
            problem, checked.policy(problem, states, stage)
        )
    return lambda states, stage: checked.policy(problem, states, stage)


def _on_a_line(problem: Problem, settings: PlanningSettings, sets: FloatArray) -> FloatArray:
    """Return sets of points, shape (..., n, d), as the kernel takes them, which knows no angles."""
    method = settings.selector.method
    angles = (
        attributes.circular_states if method == "state_entropy" else attributes.circular_actions
    )
    if not (circular := angles(problem)):
        return sets
    return (embedded if method == "action_covariance" else unwrapped)(sets, circular)


def _estimator(
    problem: Problem, settings: PlanningSettings, belief: Belief, points: FloatArray
) -> estimators.KernelEstimator:
    selector = settings.selector
    if selector.method != "path_entropy":  # whose points have been checked
        _require_bounded(problem, points, belief.states, "state")
    dimension = points.shape[1]
    of_states = selector.method == "state_entropy"
    resolution = attributes.resolution_of(problem, selector.resolution, of_states=of_states)
    each_its_own = not isinstance(resolution, (int, float))
    if selector.method == "action_covariance":
        if not each_its_own:
            return estimators.TOTAL_VARIANCE
        scale, _ = estimators.scale_of(np.asarray(resolution), dimension)
        # An angle has two coordinates there.
        scale = np.concatenate([scale, scale[list(attributes.circular_actions(problem))]])
        return estimators.TOTAL_VARIANCE._replace(scale=scale)
    kind = estimator_of(selector, points.shape[0])
    if kind in NEIGHBOR_ESTIMATORS:
        neighbors = settings.active_sensing.num_nearest_neighbors
        nearest = estimators.kernel_estimator if each_its_own else _kept_estimator
        found = nearest(estimators.NearestNeighbor(neighbors, resolution), dimension)
        if kind == "nearest_neighbor":
            return found
        return found._replace(kind=estimators.EstimatorKind.PRIOR_NEIGHBORS, prior=belief.weights)
    upper = kind == "gaussian_mixture_upper"
    own = np.full(dimension, resolution * resolution)
    states_have_their_own = of_states and getattr(problem, "state_resolution", None) is not None
    if selector.resolution is None and not states_have_their_own:
        own = _noise_variance(problem, own)
    return estimators.kernel_estimator(
        estimators.GaussianMixture(own, upper), dimension, split_volume=each_its_own
    )


_kept_estimator = functools.lru_cache(maxsize=100)(estimators.kernel_estimator)


def _noise_variance(problem: Problem, own: FloatArray) -> FloatArray:
    """Return the variances of the motion noise, by which a mixture's points are blurred.

    Where it has none for a coordinate (it moves without noise, or the points are states, of which
    there may be more than actions), the resolution stands in, whose square is ``own``.
    """
    variance = np.asarray(problem.motion_variance, dtype=np.float64)
    if variance.shape != own.shape:
        return own
    return np.where(variance == 0.0, own, variance)


def _require_bounded(problem: Problem, points: FloatArray, states: FloatArray, which: str) -> None:
    if (bad := estimators.first_unbounded(points)) is not None:
        raise ProblemError(
            f"policy of {problem.name} returned {in_brief(points[bad])} in {which} "
            f"{in_brief(states[bad])}: every coordinate must be finite and at most "
            f"{estimators.LARGEST:g}"
        )


class _GaussianHypotheses(NamedTuple):
    """Hypothetical observations of J sensing actions, M each, which the kernel draws.

    ``arguments`` are what its functions take: the particles' weights, N; the sizes of the
    observations, D in all; their means in each particle's state, (D, N); their variances, (D, N),
    or (D, 1) where none depends on the state; M; the words of the stream; and, unless none is an
    angle, whether each of the D is one.
    """

    arguments: tuple[FloatArray, list[int], FloatArray, FloatArray, int, Words, list[int]]

    def entropies(
        self,
        points: FloatArray,
        estimator: estimators.KernelEstimator,
        threads: int,
        factors: tuple[float, ...],
        unchanged: bool,
    ) -> tuple[FloatArray, FloatArray, int, int]:
        """Return the mean entropies (J,), the single ones (J, M), likelihoods and visits.

        With ``unchanged`` the belief as it is comes last, as if it were one more sensing action.
        """
        return _kernel.hypothetical_entropies(
            *self.arguments,
            points,
            *estimator.parameters,
            threads,
            factors,
            estimator.prior,
            unchanged,
        )

    def weights(self, drop_negligible: bool) -> FloatArray:
        """Return the posteriors' weights, shape (J, M, N)."""
        weights = _kernel.hypothetical_weights(*self.arguments, drop_negligible)
        _, sizes, _, _, samples, _, _ = self.arguments
        return weights.reshape(len(sizes), samples, -1)


class _GeneralHypotheses(NamedTuple):
    """The same for a problem that gives ``log_likelihood`` and ``sample_observation``.

    ``log_weights`` are those of the posteriors, shape (J * M, N), and ``log_prior``, (N,), those of
    the belief.
    """

    log_weights: FloatArray
    log_prior: FloatArray
    samples: int

    def entropies(
        self,
        points: FloatArray,
        estimator: estimators.KernelEstimator,
        threads: int,
        factors: tuple[float, ...],
        unchanged: bool,
    ) -> tuple[FloatArray, FloatArray, int, int]:
        rows = np.vstack([self.log_weights, self.log_prior]) if unchanged else self.log_weights
        found, likelihoods, visits, _ = _kernel.entropies(
            np.ascontiguousarray(points),
            rows,
            True,
            *estimator.parameters,
            threads,
            factors,
            estimator.prior,
            True,
        )
        samples = found[: len(self.log_weights)].reshape(-1, self.samples)
        means = _row_means(samples)
        if unchanged:
            means = np.append(means, found[-1])
            samples = np.vstack([samples, np.full(self.samples, found[-1])])
        return means, samples, likelihoods, visits

    def weights(self, drop_negligible: bool) -> FloatArray:
        rows = [_kernel.normalize(row, drop_negligible)[0] for row in self.log_weights]
        return np.array(rows).reshape(-1, self.samples, self.log_weights.shape[1])


def _hypotheses_of(
    problem: Problem, belief: Belief, shown: tuple[list[int], FloatArray, FloatArray] | None = None
) -> Callable[[Sequence[int], int, Stream], _GaussianHypotheses | _GeneralHypotheses]:
    """Return what draws hypothetical observations of some sensing actions, so many of each."""
    if attributes.has_general_observations(problem):
        return functools.partial(_general_hypotheses, problem, belief)
    every = range(len(problem.sensing_actions))
    sizes, predicted, variances = shown or checked.predictions(problem, belief.states, every)
    angles: list[int] = []
    if attributes.has_circular_observations(problem):
        for action, size in zip(every, sizes, strict=True):
            own = attributes.circular_observation(problem, action, size)
            angles += [int(coordinate in own) for coordinate in range(size)]

    def draw(actions: Sequence[int], samples: int, stream: Stream) -> _GaussianHypotheses:
        chosen, means, own_variances, own_angles = sizes, predicted, variances, angles
        if len(actions) < len(sizes):
            ends = np.cumsum(sizes)
            rows = [row for j in actions for row in range(ends[j] - sizes[j], ends[j])]
            own_angles = [angles[row] for row in rows] if angles else angles
            if variances.shape[1] == 1:
                chosen = [sizes[j] for j in actions]
                means, own_variances = predicted[rows], variances[rows]
            else:  # Alone, some may have variances that do not depend on the state: other bits.
                chosen, means, own_variances = checked.predictions(problem, belief.states, actions)
        return _GaussianHypotheses(
            (belief.weights, chosen, means, own_variances, samples, stream.words, own_angles)
        )

    return draw


def _general_hypotheses(
    problem: Problem, belief: Belief, actions: Sequence[int], samples: int, stream: Stream
) -> _GeneralHypotheses:
    log_prior = numerics.log(belief.weights)
    particles = _kernel.stratified(belief.weights, samples, stream.words)
    streams = stream.substream(_GENERAL_OBSERVATIONS)
    together = attributes.has_batched_likelihoods(problem)
    rows = np.empty((len(actions), samples, len(log_prior)))
    for own_rows, action in zip(rows, actions, strict=True):
        observations = []
        for i, particle in enumerate(particles):
            interruption.check()
            shown = checked.sample_observation(
                problem, belief.states[particle], action, streams.substream(i)
            )
            observations.append(shown)
            if not together:
                own_rows[i] = checked.log_likelihood(problem, belief.states, action, shown)
        if together:
            own_rows[:] = checked.log_likelihoods(problem, belief.states, action, observations)
        own_rows += log_prior
    return _GeneralHypotheses(rows.reshape(-1, len(log_prior)), log_prior, samples)


def _later_entropies(
    problem: Problem,
    settings: PlanningSettings,
    states_now: FloatArray,
    weights: FloatArray,
    stage: int,
    hypotheses: Stream,
    estimator: estimators.KernelEstimator,
    points_of: Callable[[FloatArray, int], FloatArray],
) -> FloatArray:
    """Return the discounted entropies of the steps after the first, shape (J, M).

    ``weights`` are those of the hypothetical posteriors, shape (J, M, N).
    Each hypothetical belief takes the action of its own estimate and is moved by it. The motion
    noise is the same for every sensing action, as the observation noise is.
    """
    sensing = settings.active_sensing
    motion = hypotheses.substream(_HORIZON_MOTION)
    motions = [motion.substream(i) for i in range(weights.shape[1])] * weights.shape[0]
    rows = weights.reshape(len(motions), -1)
    later = np.zeros(len(motions))
    size = max(1, _LARGEST_BLOCK // states_now.size)
    for first in range(0, len(motions), size):
        block = slice(first, first + size)
        own = np.ascontiguousarray(rows[block])
        states = np.broadcast_to(states_now, (len(own), *states_now.shape))
        stages = [stage] * len(own)
        factor = 1.0
        for step in range(1, sensing.horizon):
            actions = np.empty((len(own), problem.action_size))
            for row, each in enumerate(own):
                interruption.check()
                # One by one, as in planning: the policy of a user who does not keep to exact
                # operations may have other bits for many estimates at once.
                estimated = estimate(
                    Belief(states[row], each),
                    settings.particle_filter.estimate,
                    attributes.circular_states(problem),
                )
                stages[row] = checked.next_stage(problem, estimated, stages[row])
                commanded = checked.policy(problem, estimated, stages[row])
                actions[row] = checked.executed_action(problem, commanded)
            interruption.check()
            streams = [own_motion.substream(step) for own_motion in motions[block]]
            states = checked.move_each(problem, states, actions, streams, sensing.num_cores)
            factor *= sensing.discount
            points = _points_by_stage(points_of, states, stages)
            flat_states = states.reshape(-1, states.shape[-1])
            _require_bounded(problem, points, flat_states, "the predicted state")
            sets = _on_a_line(problem, settings, points.reshape(len(own), -1, points.shape[1]))
            rows_of_points = estimators.scaled(sets.reshape(-1, sets.shape[-1]), estimator)
            later[block] += factor * _kernel.entropies_of_each(
                rows_of_points.reshape(sets.shape),
                own,
                *estimator.parameters,
                sensing.num_cores,
                estimator.prior,
            )
    return later.reshape(weights.shape[:2])


def _points_by_stage(
    points_of: Callable[[FloatArray, int], FloatArray], states: FloatArray, stages: Sequence[int]
) -> FloatArray:
    """Return the points of several beliefs one below the other, those of a stage at once."""
    size = states.shape[-1]
    if len(set(stages)) == 1:
        return np.ascontiguousarray(points_of(states.reshape(-1, size), stages[0]))
    found: dict[int, FloatArray] = {}
    for stage in sorted(set(stages)):
        own = [row for row, other in enumerate(stages) if other == stage]
        chosen = states[own].reshape(-1, size)
        chosen.setflags(write=False)
        found |= zip(
            own, points_of(chosen, stage).reshape(len(own), states.shape[1], -1), strict=True
        )
    return np.concatenate([found[row] for row in range(len(stages))])


def _row_means(rows: FloatArray) -> FloatArray:
    """Return the mean of each row, added from left to right."""
    return np.asarray(functools.reduce(np.add, rows.T) / rows.shape[1])
