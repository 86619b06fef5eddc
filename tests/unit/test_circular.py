"""Angles: pi is -pi in means, spreads, distances, observations and choices."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from scipy.special import digamma
from tests.line_problem import Line

import holdfast as hf
from holdfast import _kernel, numerics
from holdfast.errors import ProblemError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.circular import embedded, mean_angles, unwrapped
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.belief import Belief, estimate, standard_deviation, update
from holdfast.planning.sensing import choose_sensing_action
from holdfast.planning.settings import (
    ActiveSensingSettings,
    Method,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.problem import ProblemBase

fresh = partial(stream, 77, 0, 0, Purpose.HYPOTHESES)  # anew at each call


def headings(count: int, middle: float = np.pi, spread: float = 0.4) -> FloatArray:
    """Return headings about one, between -pi and pi, as robots keep them."""
    return numerics.wrapped(middle + spread * fresh().normal(count))


class TestBeliefs:
    def test_a_mean_is_the_direction_of_the_mean_vector(self) -> None:
        angles = fresh().normal((50, 3)) * [0.3, 2.0, 9.0]
        weights = fresh().substream(1).uniform(50)
        weights /= weights.sum()
        expected = np.angle(weights @ np.exp(1j * angles))
        np.testing.assert_allclose(mean_angles(angles, weights), expected, atol=1e-13)

    def test_headings_about_pi_mean_pi(self) -> None:
        states = np.stack([fresh().normal(400), headings(400)], axis=1)
        belief = Belief.uniform(states)
        mean = estimate(belief, circular=(1,))
        assert mean[0] == estimate(belief)[0]
        assert abs(numerics.wrapped(mean[1] - np.pi)) < 0.1  # 5 standard errors
        assert standard_deviation(belief, (1,))[1] == pytest.approx(0.4, abs=0.1)
        assert standard_deviation(belief)[1] > 2.0

    def test_nothing_known_has_the_spread_of_a_circle(self) -> None:
        angles = np.linspace(-np.pi, np.pi, 1000, endpoint=False)[:, np.newaxis]
        assert standard_deviation(Belief.uniform(angles), (0,))[0] == pytest.approx(1.814, abs=0.01)


def wrapped_distances(points: FloatArray, circular: tuple[int, ...]) -> FloatArray:
    difference = points[:, np.newaxis] - points[np.newaxis]
    for coordinate in circular:
        away = np.abs(difference[..., coordinate]) % (2.0 * np.pi)
        difference[..., coordinate] = np.minimum(away, 2.0 * np.pi - away)
    distances: FloatArray = np.sqrt((difference**2).sum(axis=-1))
    return distances


def brute_force_entropy(points: FloatArray, circular: tuple[int, ...], k: int) -> float:
    """Return the estimate of equally weighted points by Kraskov, with distances on the circle."""
    count, dimension = points.shape
    kth = np.sort(wrapped_distances(points, circular), axis=1)[:, k]
    log_ball = {1: np.log(2.0), 2: np.log(np.pi), 3: np.log(4.0 / 3.0 * np.pi)}[dimension]
    return float(np.log(count - 1) - digamma(k) + log_ball + dimension * np.log(kth).mean())


class TestEntropies:
    @pytest.mark.parametrize("dimension", [1, 2, 3])
    @pytest.mark.parametrize("middle", [0.0, 3.0, np.pi, -2.5])
    def test_as_with_distances_on_the_circle(self, dimension: int, middle: float) -> None:
        """Exact where the angles leave a gap, but for rounding."""
        points = fresh().substream(dimension).normal((200, dimension))
        points[:, -1] = headings(200, middle, 0.6)
        estimator = hf.NearestNeighbor(4, 1e-12)
        circular = (dimension - 1,)
        found = hf.entropy(points, estimator=estimator, circular=circular)
        assert found == pytest.approx(brute_force_entropy(points, circular, 4), abs=1e-9)

    @pytest.mark.parametrize("dimension", [1, 2])
    def test_all_around_the_circle_the_cut_costs_little(self, dimension: int) -> None:
        """What is lost beside it, over 50 seeds: 0.000 and 0.021 nats on average, 0.04 at most."""
        points = fresh().substream(dimension).normal((200, dimension))
        points[:, -1] = np.pi * (2.0 * fresh().substream(9).uniform(200) - 1.0)
        circular = (dimension - 1,)
        found = hf.entropy(points, estimator=hf.NearestNeighbor(4, 1e-12), circular=circular)
        assert abs(np.subtract(found, brute_force_entropy(points, circular, 4))) < 0.05

    def test_each_set_is_cut_where_it_has_its_widest_gap(self) -> None:
        sets = np.stack([headings(50)[:, np.newaxis], headings(50, 0.0)[:, np.newaxis]])
        opened = unwrapped(sets, (0,))
        for before, after in zip(sets, opened, strict=True):
            assert np.ptp(after) < np.pi
            np.testing.assert_allclose(
                wrapped_distances(before, (0,)), np.abs(after - after.T), atol=1e-14
            )

    def test_the_covariance_of_small_angles_is_that_of_their_vectors(self) -> None:
        points = np.stack([fresh().normal(500), headings(500, np.pi, 0.05)], axis=1)
        vectors = embedded(points, (1,))
        assert vectors.shape == (500, 3)
        assert vectors[:, 1:].var(axis=0).sum() == pytest.approx(0.0025, rel=0.2)


class Turret(ProblemBase):
    """Two motors, each of which turns to a mark; two sensors show a heading, one a number.

    All headings are counted from ``north``, which must not matter.
    """

    name = "turret"
    state_size = 3
    action_size = 2
    sensing_actions = ("first", "second", "number")
    resolution: Any = np.array([0.02, 0.02])
    state_resolution = 0.02
    motion_variance = np.array([0.0025, 0.0025])
    circular: Any = (0, 1)
    circular_actions: Any = (0, 1)
    circular_observations: Any = ((0,), (1,), ())

    def __init__(self, north: float) -> None:
        self.north = north

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        states = stream.normal((count, 3)) * [0.3, 0.6, 1.0]
        states[:, :2] = numerics.wrapped(states[:, :2] + self.north)
        return states

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        moved = states + 0.05 * stream.normal(states.shape)
        turns = 0.5 * numerics.wrapped(actions - states[..., :2])
        moved[..., :2] = numerics.wrapped(moved[..., :2] + turns)
        return moved

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        if sensing_action == 1:  # both a number and a heading
            return states[..., [2, 1]]
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.array([0.04, 0.01] if sensing_action == 1 else [0.01])

    def policy(self, states: FloatArray, stage: Any) -> FloatArray:
        """Return the headings to turn to: half-way to the mark."""
        return numerics.wrapped(0.5 * numerics.wrapped(states[..., :2] - self.north) + self.north)

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        away = numerics.wrapped(states[..., :2] - self.north)
        return -away[..., 0] * away[..., 0] - away[..., 1] * away[..., 1]

    def is_goal(self, states: FloatArray) -> Any:
        return np.zeros(states.shape[:-1], dtype=np.bool_)


class Numbers(Turret):
    """The same, without a word of angles."""

    circular = circular_actions = circular_observations = ()


def settings(method: Method, **more: Any) -> PlanningSettings:
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=100),
        selector=SelectorSettings(method=method),
        active_sensing=ActiveSensingSettings(**more),
        sensing_interval=1,
    )


EVERYWHERE = [
    settings("action_entropy"),
    settings("path_entropy"),
    settings("state_entropy"),
    settings("action_covariance"),
    settings("action_entropy", horizon=2),
    settings("action_covariance", horizon=2),
    settings("expected_return"),
]


@pytest.mark.parametrize("planning", EVERYWHERE, ids=lambda s: s.selector.method)
class TestChoices:
    """What is sensed does not depend on where north is: the scores differ by rounding alone."""

    def scores(self, problem: Any, planning: PlanningSettings) -> FloatArray:
        belief = hf.Planner(problem, planning).init(5).belief
        _, info = choose_sensing_action(problem, planning, belief, 0, fresh(), fresh())
        assert info.entropies is not None
        if planning.selector.method == "expected_return":  # known up to a constant
            return np.asarray(info.entropies - info.entropies[0])
        return info.entropies

    def test_north_does_not_matter(self, planning: PlanningSettings) -> None:
        about_zero, about_pi = (self.scores(Turret(north), planning) for north in (0.0, np.pi))
        # Neighbours that swap by rounding would show; a turn that is lost shows as tenths of a nat.
        np.testing.assert_allclose(about_pi, about_zero, rtol=1e-6, atol=1e-6)

    def test_without_a_word_of_angles_it_does(self, planning: PlanningSettings) -> None:
        about_zero, about_pi = (self.scores(Numbers(north), planning) for north in (0.0, np.pi))
        assert np.abs(about_pi - about_zero).max() > 1e-3


class TestObservations:
    def test_an_innovation_is_the_shorter_way_round(self) -> None:
        belief = Belief.uniform(np.stack([headings(80), headings(80), fresh().normal(80)], axis=1))
        found, info = update(Turret(np.pi), belief, 0, [np.pi])
        far = numerics.wrapped(belief.states[:, 0] - np.pi)
        expected = np.exp(-0.5 * far**2 / 0.01)
        np.testing.assert_allclose(
            found.weights, expected / expected.sum(), rtol=1e-10, atol=1e-300
        )
        assert info.mahalanobis_distance == pytest.approx(np.abs(far).min() / 0.1)
        turned, _ = update(Turret(np.pi), belief, 0, [-3.0 * np.pi])
        np.testing.assert_allclose(turned.weights, found.weights, rtol=1e-10, atol=1e-300)

    def test_a_bearing_from_behind_is_explained(self) -> None:
        belief = Belief.uniform([[0.0, np.pi - 0.01, 0.0]])
        _, info = update(Turret(0.0), belief, 1, [0.0, -np.pi + 0.01])
        assert info.explained
        _, info = update(Numbers(0.0), belief, 1, [0.0, -np.pi + 0.01])
        assert not info.explained

    def test_hypothetical_posteriors_are_those_of_an_update(self) -> None:
        """One particle is in front of the cut and one behind; both explain what is between them."""
        predicted = np.array([[3.1, -3.1, 0.0]])
        weights = np.full(3, 1.0 / 3.0)
        rows = (weights, [1], predicted, np.array([[0.01]]), 8, fresh().words)
        found = _kernel.hypothetical_weights(*rows, [1], False).reshape(8, 3)
        assert (found[:, :2].min(axis=1) > 0.05).sum() >= 5  # two thirds of eight begin there
        apart = _kernel.hypothetical_weights(*rows, [], False).reshape(8, 3)
        assert (apart.max(axis=1) > 1.0 - 1e-9).all()

    def test_a_coordinate_that_is_not_shown_is_named(self) -> None:
        class Wrong(Turret):
            circular_observations = ((1,), (), ())

        wrong: Any = Wrong(0.0)
        planner = hf.Planner(wrong, settings("action_entropy"))
        state = planner.init(1)
        message = r"circular_observations\[0\] of turret is \(1,\): sensing action 0 shows 1 coord"
        with pytest.raises(ProblemError, match=message):
            planner.choose_sensing_action(state)
        with pytest.raises(ProblemError, match=message):
            planner.observe(state, 0, [0.0])

    def test_a_likelihood_of_its_own_needs_none(self) -> None:
        class General(Line):
            circular_observations = ((0,), ())

            def log_likelihood(self, states: Any, sensing_action: int, observation: Any) -> Any:
                return states[..., 0]

            def sample_observation(self, state: Any, sensing_action: int, stream: Stream) -> Any:
                return state[:1]

        with pytest.raises(ProblemError, match="does nothing beside log_likelihood"):
            hf.Planner(General()).init(1)
