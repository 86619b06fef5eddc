"""The choice of a sensing action against Algorithm 2 written out in NumPy and SciPy.

One hypothetical observation at a time, one particle at a time, from the same random draws: the
stream of hypotheses gives the stratified particles, its substream 1 the observation noise (sample i
takes the numbers i L, i L + 1, ..., with L the size of the largest observation), its substream 2
the noise of predicted motion. Both sides round differently, so they agree to 1e-9, not to the bit.
"""

from collections.abc import Sequence
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats
from tests.oracles.reference_entropy import (
    gaussian_mixture_entropy,
    nearest_neighbor_entropy,
    prior_neighbors_entropy,
    significant,
)

from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.belief import Belief
from holdfast.planning.sensing import choose_sensing_action
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.problem import Problem, ProblemBase

TOLERANCE = 1e-9


class Plane(ProblemBase):
    """A point in space goes home, coordinate by coordinate; its sensors show 1, 3 and 2 numbers."""

    name = "plane"
    state_size = 3
    action_size = 3
    num_stages = 3
    sensing_actions: Sequence[str] = ("first", "all, badly", "last two, well")
    resolution = 0.1
    motion_variance = np.array([0.01, 0.02, 0.03])
    rows: Sequence[Sequence[int]] = ((0,), (0, 1, 2), (1, 2))
    variances: Sequence[float] = (0.05, 0.5, 0.02)

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return np.asarray(1.0 + stream.normal((count, 3)))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        noise = np.sqrt(self.motion_variance) * stream.normal(states.shape)
        return np.asarray(states + actions + noise)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.ascontiguousarray(states[..., list(self.rows[sensing_action])])

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        size = len(self.rows[sensing_action])
        return self.variances[sensing_action] * np.arange(1.0, size + 1.0)

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        actions: FloatArray = -np.asarray(states) + np.asarray(stage)[..., np.newaxis]
        far = np.abs(states[..., :1]) > 0.5
        actions[..., 1:] = np.where(far, 0.0, actions[..., 1:])
        return actions

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        arrived = np.abs(estimates[..., 0] - stage) < 0.3
        following: IntArray = np.minimum(stage + arrived, 2)
        return following

    def limit_action(self, actions: FloatArray) -> FloatArray:
        return np.clip(actions, -0.4, 0.4)

    def is_goal(self, states: FloatArray) -> npt.NDArray[np.bool_]:
        return np.asarray(np.abs(states[..., 0]) < 0.1)


class LightDark(Plane):
    """The same, but the last sensor sees well only where it is light."""

    name = "light dark"

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        variance = super().observation_variance(states, sensing_action)
        if sensing_action != 2:
            return variance
        return np.asarray(variance + 0.5 * np.square(states[..., :1] - 2.0))


class General:
    """A problem by its likelihood and by draws of its own, not by a mean and a variance.

    The draws are those of the way for Gaussian observations, found by the name of the stream.
    """

    def __init__(self, problem: Plane, hypotheses: Stream, samples: int) -> None:
        self._problem = problem
        own = hypotheses.substream(3)
        self._sample = {own.substream(i): i for i in range(samples)}
        self._noise = hypotheses.substream(1).normal((samples, 3))

    def __getattr__(self, name: str) -> object:
        if name in {"observation_mean", "observation_variance"}:
            raise AssertionError("a general problem is asked for its likelihood alone")
        return getattr(self._problem, name)

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        mean = self._problem.observation_mean(state, sensing_action)
        variance = self._problem.observation_variance(state, sensing_action)
        noise = self._noise[self._sample[stream], : mean.shape[-1]]
        return np.asarray(mean + np.sqrt(variance) * noise)

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        mean = self._problem.observation_mean(states, sensing_action)
        deviation = np.sqrt(self._problem.observation_variance(states, sensing_action))
        return np.asarray(stats.norm.logpdf(observation, mean, deviation).sum(axis=-1))


def reference_points(
    problem: Problem, settings: PlanningSettings, states: FloatArray, stage: int
) -> FloatArray:
    selector = settings.selector
    points = []
    for state in states:
        if selector.method == "state_entropy":
            points.append(state)
        elif selector.actions == "executed":
            points.append(problem.limit_action(problem.policy(state, stage)))
        else:
            points.append(problem.policy(state, stage))
    return np.array(points)


def reference_sets(
    problem: Problem, settings: PlanningSettings, states: FloatArray, stage: int
) -> list[tuple[float, FloatArray]]:
    """Return factors and points of the entropies that are added up.

    Along the path, one particle and one step at a time; without noise, these problems move a state
    by the action itself.
    """
    selector = settings.selector
    if selector.method != "path_entropy":
        return [(1.0, reference_points(problem, settings, states, stage))]
    unit = settings.sensing_interval + 1 if selector.path_unit == "sensing_intervals" else 1
    sets = []
    for offset in selector.path_offsets:
        points = []
        for start in states:
            state, own_stage = start, stage
            for _ in range(unit * offset):
                state = state + problem.limit_action(problem.policy(state, own_stage))
                own_stage = int(problem.next_stage(state, own_stage))
            points.append(problem.policy(state, own_stage))
            if selector.actions == "executed":
                points[-1] = problem.limit_action(points[-1])
        sets.append((selector.path_discount**offset, np.array(points)))
    return sets


def reference_entropy(
    problem: Problem,
    settings: PlanningSettings,
    points: FloatArray,
    weights: FloatArray,
    prior: FloatArray,
) -> float:
    selector = settings.selector
    if selector.method == "action_covariance":
        if isinstance(selector.resolution, tuple):
            points = points / np.array(selector.resolution)
        return float(np.trace(np.atleast_2d(np.cov(points.T, aweights=weights, ddof=0))))
    if selector.estimator in {"nearest_neighbor", "prior_neighbors"}:
        neighbors = settings.active_sensing.num_nearest_neighbors
        resolution = selector.resolution or problem.resolution
        if not isinstance(resolution, float):
            scaled = points / np.array(resolution)
            volume = float(np.log(resolution).sum())
            if selector.estimator == "prior_neighbors":
                return prior_neighbors_entropy(scaled, weights, prior, neighbors, 1.0) + volume
            return nearest_neighbor_entropy(scaled, weights, neighbors, 1.0) + volume
        if selector.estimator == "prior_neighbors":
            return prior_neighbors_entropy(points, weights, prior, neighbors, resolution)
        return nearest_neighbor_entropy(points, weights, neighbors, resolution)
    variance = problem.motion_variance
    if selector.resolution is not None:
        variance = np.full(points.shape[1], np.square(selector.resolution))
    upper = selector.estimator == "gaussian_mixture_upper"
    return gaussian_mixture_entropy(points, weights, variance, upper)


def algorithm_2(
    problem: Problem, settings: PlanningSettings, belief: Belief, stage: int, hypotheses: Stream
) -> FloatArray:
    """Return the discounted entropies of all hypothetical observations, shape (J, M)."""
    sensing = settings.active_sensing
    samples = sensing.num_observation_samples
    states, weights = belief
    count = len(problem.sensing_actions)
    offsets = hypotheses.uniform(samples)
    means = [problem.observation_mean(states, j) for j in range(count)]
    largest = max(mean.shape[1] for mean in means)
    noise = hypotheses.substream(1).normal(samples * largest)
    found = np.zeros((count, samples))
    sets = reference_sets(problem, settings, states, stage)
    for j in range(count):
        mean = means[j]
        size = mean.shape[1]
        variance = np.broadcast_to(problem.observation_variance(states, j), mean.shape)
        for i in range(samples):
            position = (i + offsets[i]) / samples
            particle = int(np.flatnonzero(np.cumsum(weights) > position)[0])
            observation = np.empty(size)
            for c in range(size):
                deviation = np.sqrt(variance[particle, c])
                observation[c] = mean[particle, c] + deviation * noise[i * largest + c]
            log_posterior = np.full(len(weights), -np.inf)
            for n in np.flatnonzero(weights):
                log_posterior[n] = np.log(weights[n]) + sum(
                    stats.norm.logpdf(observation, mean[n], np.sqrt(variance[n]))
                )
            posterior = np.exp(log_posterior - log_posterior.max())
            posterior /= posterior.sum()
            found[j, i] = sum(
                factor * reference_entropy(problem, settings, points, posterior, weights)
                for factor, points in sets
            )

            # The belief moved on by its own action; negligible particles are gone by then, except
            # where they count.
            if settings.selector.method != "action_covariance":
                posterior = np.where(significant(posterior), posterior, 0.0)
                posterior /= posterior.sum()
            later_states, later_stage = states, stage
            for step in range(1, sensing.horizon):
                estimate = posterior @ later_states
                if settings.particle_filter.estimate == "most_likely":
                    estimate = later_states[int(np.argmax(posterior))]
                later_stage = int(problem.next_stage(estimate, later_stage))
                action = problem.limit_action(problem.policy(estimate, later_stage))
                motion = hypotheses.substream(2).substream(i).substream(step)
                later_states = problem.move(later_states, action, motion)
                points = reference_points(problem, settings, later_states, later_stage)
                found[j, i] += sensing.discount**step * reference_entropy(
                    problem, settings, points, posterior, weights
                )
    return found


def settings_of(
    *,
    samples: int = 6,
    neighbors: int = 5,
    horizon: int = 1,
    discount: float = 1.0,
    selector: SelectorSettings | None = None,
    estimate: Literal["mean", "most_likely"] = "mean",
) -> PlanningSettings:
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=40, estimate=estimate),
        active_sensing=ActiveSensingSettings(
            horizon=horizon,
            discount=discount,
            num_observation_samples=samples,
            num_nearest_neighbors=neighbors,
            num_cores=1,
        ),
        selector=selector
        or SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    )


def some_belief(problem: Problem, count: int, kind: str) -> Belief:
    draws = stream(31, count, 0, Purpose.INITIAL_BELIEF)
    states = problem.initial_states(draws, count)
    if kind == "uniform":
        return Belief.uniform(states)
    if kind == "copies":
        return Belief.uniform(states[np.arange(count) // 4])
    weights = draws.substream(1).uniform(count)
    if kind == "zeros":
        weights = np.where(weights < 0.4, 0.0, weights)
        weights[[0, -1]] = 0.0
    return Belief.weighted(states, weights)


def compare(
    problem: Problem, settings: PlanningSettings, belief: Belief, stage: int = 0, step: int = 0
) -> FloatArray:
    hypotheses = stream(32, 0, step, Purpose.HYPOTHESES)
    selection = stream(32, 0, step, Purpose.SELECTION)
    expected = algorithm_2(problem, settings, belief, stage, hypotheses)
    index, info = choose_sensing_action(problem, settings, belief, stage, hypotheses, selection)
    assert info.samples is not None
    assert info.entropies is not None
    np.testing.assert_allclose(info.samples, expected, rtol=0.0, atol=TOLERANCE)
    np.testing.assert_allclose(info.entropies, expected.mean(axis=1), rtol=0.0, atol=TOLERANCE)
    assert index == int(info.entropies.argmin())
    # The three sensors differ, or the comparison would say little.
    assert np.ptp(expected.mean(axis=1)) > 1e-3
    return expected


@pytest.mark.parametrize("kind", ["uniform", "weighted", "zeros", "copies"])
@pytest.mark.parametrize("count", [8, 40, 200])
@pytest.mark.parametrize("problem", [Plane(), LightDark()], ids=lambda p: p.name)
def test_beliefs(problem: Problem, count: int, kind: str) -> None:
    """Observations of several sizes, of a variance that depends on the state or does not."""
    compare(problem, settings_of(samples=3), some_belief(problem, count, kind), stage=1)


@pytest.mark.parametrize("actions", ["commanded", "executed"])
@pytest.mark.parametrize("method", ["action_entropy", "state_entropy"])
@pytest.mark.parametrize(
    "estimator",
    ["nearest_neighbor", "prior_neighbors", "gaussian_mixture_lower", "gaussian_mixture_upper"],
)
@pytest.mark.parametrize("resolution", [None, 0.4])
def test_selectors(method: str, actions: str, estimator: str, resolution: float | None) -> None:
    selector = SelectorSettings(
        method=method,  # type: ignore[arg-type]
        actions=actions,  # type: ignore[arg-type]
        estimator=estimator,  # type: ignore[arg-type]
        resolution=resolution,
    )
    problem = LightDark()
    compare(problem, settings_of(selector=selector), some_belief(problem, 60, "weighted"))


@pytest.mark.parametrize("horizon", [1, 3])
@pytest.mark.parametrize(
    ("method", "estimator"),
    [
        ("action_covariance", "nearest_neighbor"),
        ("action_entropy", "nearest_neighbor"),
        ("action_entropy", "prior_neighbors"),
        ("action_entropy", "gaussian_mixture_upper"),
        ("state_entropy", "nearest_neighbor"),
        ("state_entropy", "gaussian_mixture_lower"),
    ],
)
def test_a_resolution_for_each_coordinate(method: str, estimator: str, horizon: int) -> None:
    """The reference divides the points by it; the entropies stay those in the points' units."""
    selector = SelectorSettings(
        method=method,  # type: ignore[arg-type]
        estimator=estimator,  # type: ignore[arg-type]
        resolution=(0.05, 0.4, 3.0),
    )
    settings = settings_of(samples=4, horizon=horizon, selector=selector)
    compare(Plane(), settings, some_belief(Plane(), 50, "weighted"))


@pytest.mark.parametrize(
    ("method", "horizon"), [("action_entropy", 1), ("action_entropy", 3), ("path_entropy", 1)]
)
@pytest.mark.parametrize("kind", ["uniform", "weighted", "zeros", "copies"])
def test_prior_neighbors(method: str, horizon: int, kind: str) -> None:
    """The prior is the belief's own, along a path and in predicted steps as well."""
    selector = SelectorSettings(method=method, estimator="prior_neighbors")  # type: ignore[arg-type]
    settings = settings_of(samples=4, horizon=horizon, selector=selector)
    problem = LightDark()
    compare(problem, settings, some_belief(problem, 50, kind))


@pytest.mark.parametrize("actions", ["commanded", "executed"])
@pytest.mark.parametrize("horizon", [1, 3])
@pytest.mark.parametrize("kind", ["uniform", "weighted", "zeros"])
@pytest.mark.parametrize("problem", [Plane(), LightDark()], ids=lambda p: p.name)
def test_action_covariance(
    problem: Problem, kind: str, horizon: int, actions: Literal["commanded", "executed"]
) -> None:
    selector = SelectorSettings(method="action_covariance", actions=actions)
    settings = settings_of(samples=4, horizon=horizon, selector=selector)
    compare(problem, settings, some_belief(problem, 50, kind))


def test_action_covariance_counts_far_particles_of_small_weight() -> None:
    """An entropy estimate takes no notice of them; they are most of the variance here."""
    selector = SelectorSettings(method="action_covariance")
    problem = Plane()
    states = some_belief(problem, 50, "uniform").states.copy()
    states[0] = [0.2, 40.0, -40.0]
    weights = np.ones(50)
    weights[0] = 1e-3
    found = compare(problem, settings_of(selector=selector), Belief.weighted(states, weights))
    # Sensed without noise to speak of, the far one is ruled out; else it is not.
    assert found.max() > 10.0 * found.min()


@pytest.mark.parametrize("neighbors", [1, 5, 30])
@pytest.mark.parametrize("samples", [1, 2, 13])
def test_numbers_of_samples_and_neighbours(samples: int, neighbors: int) -> None:
    problem = Plane()
    settings = settings_of(samples=samples, neighbors=neighbors)
    compare(problem, settings, some_belief(problem, 50, "weighted"))


@pytest.mark.parametrize(("horizon", "discount"), [(2, 1.0), (2, 0.5), (3, 0.7), (2, 0.0)])
@pytest.mark.parametrize("problem", [Plane(), LightDark()], ids=lambda p: p.name)
def test_horizon(problem: Problem, horizon: int, discount: float) -> None:
    """Entropies of the steps to come, after moving by each hypothetical belief's own action."""
    settings = settings_of(samples=3, horizon=horizon, discount=discount)
    belief = some_belief(problem, 50, "weighted")
    found = compare(problem, settings, belief)
    at_once = compare(problem, settings_of(samples=3), belief)
    if discount > 0.0:
        assert np.abs(found - at_once).max() > 0.1
    else:
        np.testing.assert_allclose(found, at_once, rtol=0.0, atol=TOLERANCE)


def test_horizon_by_the_most_likely_particle() -> None:
    problem = LightDark()
    belief = some_belief(problem, 50, "weighted")
    found = compare(problem, settings_of(samples=3, horizon=3, estimate="most_likely"), belief)
    by_mean = compare(problem, settings_of(samples=3, horizon=3), belief)
    assert np.abs(found - by_mean).max() > 1e-3


@pytest.mark.parametrize("inner", [Plane(), LightDark()], ids=lambda p: p.name)
@pytest.mark.parametrize(
    ("selector", "horizon"),
    [
        (None, 1),
        (SelectorSettings(method="action_covariance"), 2),
        (SelectorSettings(method="path_entropy", estimator="nearest_neighbor"), 1),
        (SelectorSettings(method="path_entropy", estimator="gaussian_mixture_upper"), 1),
    ],
)
def test_general_likelihood_with_the_same_draws(
    inner: Plane, selector: SelectorSettings | None, horizon: int
) -> None:
    """A problem that gives its log-likelihood and draws as a Gaussian would decides the same."""
    settings = settings_of(samples=8, horizon=horizon, selector=selector)
    for kind in ("weighted", "zeros"):
        belief = some_belief(inner, 70, kind)
        hypotheses = stream(33, 0, 1, Purpose.HYPOTHESES)
        selection = stream(33, 0, 1, Purpose.SELECTION)
        general: Problem = General(inner, hypotheses, 8)  # type: ignore[assignment]
        index, info = choose_sensing_action(general, settings, belief, 0, hypotheses, selection)
        expected_index, expected = choose_sensing_action(
            inner, settings, belief, 0, hypotheses, selection
        )
        assert info.samples is not None
        assert expected.samples is not None
        np.testing.assert_allclose(info.samples, expected.samples, rtol=0.0, atol=TOLERANCE)
        assert index == expected_index


@pytest.mark.parametrize("kind", ["equal", "spread", "extreme", "zeros", "short", "one"])
@pytest.mark.parametrize("samples", [1, 10, 97])
def test_both_paths_imagine_from_the_same_particles(kind: str, samples: int) -> None:
    """Problems with a general likelihood draw particles in Python, Gaussian ones in the kernel.

    In the kernel a particle betrays itself: each one predicts its own number with hardly any noise,
    so that of each hypothetical posterior only the particle that was drawn is left.
    """
    count = 50
    for trial in range(20):
        rng = np.random.default_rng([trial, samples])
        weights = rng.exponential(size=count)
        if kind == "equal":
            weights[:] = 1.0
        elif kind == "extreme":
            weights = 10.0 ** rng.uniform(-12.0, 0.0, size=count)
        elif kind in ("zeros", "short"):
            weights[rng.random(count) < 0.5] = 0.0
            weights[:2] = weights[-2:] = 0.0
            weights[7] = 1.0
        elif kind == "one":
            weights[:] = 0.0
            weights[rng.integers(count)] = 1.0
        # "short": as if rounding had lost a tenth, so that draws go beyond the end.
        weights *= (0.9 if kind == "short" else 1.0) / weights.sum()
        hypotheses = stream(61, trial, 0, Purpose.HYPOTHESES)
        posteriors = _kernel.hypothetical_weights(
            weights,
            [1],
            np.arange(count, dtype=np.float64).reshape(1, -1),
            np.full((1, 1), 1e-8),
            samples,
            hypotheses.words,
            [],
            True,
        ).reshape(samples, count)
        assert (posteriors.max(axis=1) == 1.0).all()
        drawn = _kernel.stratified(weights, samples, hypotheses.words).tolist()
        assert posteriors.argmax(axis=1).tolist() == drawn
        assert (weights[drawn] > 0.0).all()
        if kind == "equal" and samples == 97:
            assert len(set(drawn)) > count // 2
