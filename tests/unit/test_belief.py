"""Weighted particles: Bayes' rule, means, resampling, and observations that nothing explains."""

from functools import partial

import numpy as np
import pytest
from scipy import stats

from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import (
    Belief,
    belief_sizes,
    estimate,
    regularised,
    resample,
    standard_deviation,
    uniform_weights,
    update,
)

fresh = partial(stream, 21, 0, 0, Purpose.RESAMPLING)  # anew at each call


class Direct:
    """Sensing action 0 shows the first coordinate, action 1 all of them."""

    def __init__(self, *variance: float) -> None:
        self.variance = np.array(variance)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., :1] if sensing_action == 0 else states

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return self.variance[:1] if sensing_action == 0 else self.variance


class Varying(Direct):
    """The further from zero, the more noise."""

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return 0.1 + states * states


class General(Direct):
    """A likelihood of its own: a box around the state, or what is given."""

    def __init__(self, log_likelihood: FloatArray | None = None) -> None:
        super().__init__(1.0)
        self.given = log_likelihood

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        if self.given is not None:
            return self.given
        return np.where(np.abs(states[..., 0] - observation[0]) < 1.0, 0.0, -np.inf)


def some_belief(count: int = 50, size: int = 2) -> Belief:
    return Belief.weighted(
        fresh().normal((count, size)), fresh().substream(1).uniform(count) + 0.01
    )


class TestMaking:
    def test_uniform(self) -> None:
        belief = Belief.uniform([[1.0, 2.0], [3.0, 4.0]])
        assert belief.states.dtype == np.float64
        assert belief.states.flags.c_contiguous
        assert belief.weights.tolist() == [0.5, 0.5]
        assert uniform_weights(3).tolist() == [1.0 / 3.0] * 3
        assert not (belief.weights.flags.writeable or belief.states.flags.writeable)

    def test_weights_are_normalised(self) -> None:
        belief = Belief.weighted([[1.0], [2.0], [3.0]], [2.0, 0.0, 6.0])
        assert belief.weights.tolist() == [0.25, 0.0, 0.75]

    @pytest.mark.parametrize("shape", [(0, 3), (3, 0), (3,), (2, 3, 1), ()])
    def test_shapes_of_states(self, shape: tuple[int, ...]) -> None:
        with pytest.raises(InvalidValueError, match=r"states of shape \(.*need \(num_particles"):
            Belief.uniform(np.zeros(shape))

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_states_must_be_finite(self, bad: float) -> None:
        states = np.zeros((4, 2))
        states[2, 1] = bad
        with pytest.raises(InvalidValueError, match=rf"particle 2 is \[\s*0\. +{bad}\]: must be"):
            Belief.uniform(states)

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -1e-9])
    def test_weights_must_be_finite_and_not_negative(self, bad: float) -> None:
        with pytest.raises(
            InvalidValueError, match=rf"weight of particle 1 is {bad}: must be >= 0"
        ):
            Belief.weighted(np.zeros((3, 1)), [0.0, bad, 0.5])

    @pytest.mark.parametrize("weights", [[0.0, 0.0], [1e308, 1e308]])
    def test_weights_must_have_a_sum(self, weights: list[float]) -> None:
        with pytest.raises(InvalidValueError, match=r"sum of the weights is (0\.0|inf): must be"):
            Belief.weighted(np.zeros((2, 1)), weights)

    def test_as_many_weights_as_states(self) -> None:
        with pytest.raises(InvalidValueError, match=r"weights of shape \(3,\): need \(2,\)"):
            Belief.weighted(np.zeros((2, 1)), [1.0, 1.0, 1.0])


class TestSummaries:
    def test_estimate_and_deviation(self) -> None:
        belief = some_belief()
        mean = np.average(belief.states, axis=0, weights=belief.weights)
        variance = np.average((belief.states - mean) ** 2, axis=0, weights=belief.weights)
        np.testing.assert_allclose(estimate(belief), mean, atol=1e-15)
        np.testing.assert_allclose(standard_deviation(belief), np.sqrt(variance), rtol=1e-14)

    def test_sizes(self) -> None:
        assert belief_sizes(Belief.uniform(np.zeros((8, 1)))) == (8.0, 1)
        one = Belief.weighted([[0.0], [-0.0], [1.0], [0.0]], [0.0, 1.0, 0.0, 0.0])
        assert belief_sizes(one) == (1.0, 3)
        assert belief_sizes(Belief.weighted(one.states, [0.0, 1.0, 1.0, 0.0])) == (2.0, 3)


class TestUpdate:
    @pytest.mark.parametrize("sensing_action", [0, 1])
    def test_bayes(self, sensing_action: int) -> None:
        """Against SciPy's normal density, for variances that are the same for all states or not."""
        belief = some_belief()
        observation = np.array([0.3, -0.2])[: 1 + sensing_action]
        models: list[Direct] = [Direct(0.2, 0.5)]
        if sensing_action == 1:
            models.append(Varying())
        for model in models:
            mean = model.observation_mean(belief.states, sensing_action)
            deviation = np.sqrt(model.observation_variance(belief.states, sensing_action))
            likelihood = stats.norm.pdf(observation, mean, deviation).prod(axis=-1)
            expected = belief.weights * likelihood / (belief.weights * likelihood).sum()
            after, info = update(model, belief, sensing_action, observation)
            np.testing.assert_allclose(after.weights, expected, rtol=1e-12)
            assert after.states is belief.states
            assert info.explained
            assert np.isclose(info.effective_sample_size, 1.0 / (expected**2).sum(), rtol=1e-12)

    def test_general_likelihood(self) -> None:
        belief = Belief.weighted([[0.0], [0.5], [5.0]], [0.2, 0.6, 0.2])
        after, info = update(General(), belief, 0, [0.1])
        np.testing.assert_allclose(after.weights, [0.25, 0.75, 0.0], rtol=1e-15)
        assert info.explained


class TestUnexplained:
    """An observation that no particle can have made: the belief stays valid, and it is said."""

    @pytest.mark.parametrize("away", [1e3, 1e6, 1e100, 1e150, -1e151])
    @pytest.mark.parametrize("count", [1, 7, 8, 50])
    def test_far_away(self, away: float, count: int) -> None:
        belief = some_belief(count)
        after, info = update(Direct(1e-3, 1e-3), belief, 1, [away, away])
        assert not info.explained
        assert np.isfinite(after.weights).all()
        assert (after.weights >= 0.0).all()
        assert np.isclose(after.weights.sum(), 1.0, rtol=0.0, atol=1e-12)
        assert 1.0 <= info.effective_sample_size <= count * (1.0 + 1e-12)

    def test_it_ranks_the_particles_all_the_same(self) -> None:
        """A thousand deviations away every likelihood underflows, but their ratio does not."""
        belief = Belief.uniform([[0.0], [1e-4]])
        after, info = update(Direct(1.0), belief, 0, [1000.0])
        assert not info.explained
        ratio = after.weights[1] / after.weights[0]
        assert np.isclose(ratio, np.exp(0.1 - 0.5e-8), rtol=1e-9)

    def test_so_far_that_squares_overflow(self) -> None:
        belief = some_belief()
        with np.errstate(over="ignore"):
            after, info = update(Direct(1e-3), belief, 0, [1e200])
        assert not info.explained
        assert info.mahalanobis_distance == np.inf
        assert after is belief

    @pytest.mark.parametrize(("away", "explained"), [(7.99, True), (8.0, True), (8.01, False)])
    def test_the_limit_is_eight_deviations_from_the_nearest(
        self, away: float, explained: bool
    ) -> None:
        belief = Belief.uniform([[0.0], [-1.0], [-2.0]])
        info = update(Direct(0.25), belief, 0, [0.5 * away])[1]
        assert info.explained is explained
        assert info.mahalanobis_distance == pytest.approx(away)

    def test_a_particle_of_weight_zero_is_not_the_nearest(self) -> None:
        belief = Belief.weighted([[0.0], [10.0]], [1.0, 0.0])
        info = update(Direct(1.0), belief, 0, [10.0])[1]
        assert not info.explained
        assert info.mahalanobis_distance == 10.0

    def test_only_particles_of_weight_zero_could_have_made_it(self) -> None:
        belief = Belief.weighted([[0.0], [10.0]], [1.0, 0.0])
        after, info = update(General(), belief, 0, [10.0])
        assert after is belief
        assert not info.explained
        assert not info.within_gate

    @pytest.mark.parametrize("log_likelihood", [-1e300, -1e305, -1e6, 1e6])
    @pytest.mark.parametrize("count", [1, 4, 8, 13])
    def test_extreme_but_finite_likelihoods(self, log_likelihood: float, count: int) -> None:
        """Equal likelihoods leave the weights as they are, as far as there are digits for them."""
        belief = some_belief(count)
        after, info = update(General(np.full(count, log_likelihood)), belief, 0, [0.0])
        lost = abs(log_likelihood) > 1e15
        expected = uniform_weights(count) if lost else belief.weights
        np.testing.assert_allclose(after.weights, expected, rtol=1e-9)
        assert info.explained


class TestBadInput:
    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_observation_not_finite(self, bad: float) -> None:
        with pytest.raises(InvalidValueError, match=rf"observation \[ *0\.5 +{bad}\]: every coord"):
            update(Direct(1.0, 1.0), some_belief(), 1, [0.5, bad])
        with pytest.raises(InvalidValueError, match=rf"observation \[ *{bad}\]: every coordinate"):
            update(General(), some_belief(), 0, [bad])

    @pytest.mark.parametrize("size", [0, 1, 3])
    def test_observation_of_another_size(self, size: int) -> None:
        with pytest.raises(
            InvalidValueError, match=rf"observation of {size} coordinates: sensing action 1 gives 2"
        ):
            update(Direct(1.0, 1.0), some_belief(), 1, np.zeros(size))

    @pytest.mark.parametrize("bad", [np.nan, np.inf])
    def test_likelihood_not_a_number(self, bad: float) -> None:
        values = np.zeros(50)
        values[7] = bad
        with pytest.raises(ProblemError, match=r"log_likelihood of General, .* NaN or plus"):
            update(General(values), some_belief(), 0, [0.0])


class TestResample:
    @pytest.mark.parametrize("substream", range(5))
    def test_the_comb_begins_at_the_number_drawn(self, substream: int) -> None:
        """Tooth j is at (j + u) / N of the weights, u being what the stream gives.

        Any other number of [0, 1) would be as good for a filter, but decide otherwise.
        """
        belief = some_belief(40)
        draws = fresh().substream(substream)
        teeth = (np.arange(40) + draws.uniform()) / 40
        found = np.searchsorted(np.cumsum(belief.weights), teeth, side="right")
        states = resample(belief, draws).states
        np.testing.assert_array_equal(states, belief.states[found])
        assert not states.flags.writeable


class TestRegularised:
    """Liu and West's kernel: new values of what does not move, and the moments as they were."""

    def test_mean_and_covariance_stay(self) -> None:
        count = 20_000
        states = fresh().substream(1).normal((count, 4))
        states[:, 2] = 3.0 + 0.5 * states[:, 1] + 0.1 * states[:, 2]
        weighted = Belief.weighted(states, np.exp(-np.abs(states[:, 0])))
        drawn = resample(weighted, fresh())
        moved = regularised(drawn, weighted, (1, 2), (), fresh().substream(2))
        for again in range(100):
            # Without the shrinkage the variance would grow sevenfold.
            moved = regularised(moved, moved, (1, 2), (), fresh().substream(3 + again))
        assert moved.states[:, [0, 3]].tobytes() == drawn.states[:, [0, 3]].tobytes()
        assert not moved.states.flags.writeable
        assert len(np.unique(moved.states[:, 1])) == count > len(np.unique(drawn.states[:, 1]))
        # Each time the variance errs by 2 * 0.14 / sqrt(count) = 0.002 of itself and the mean by
        # 0.001: in a hundred steps by 0.02 and 0.01, and these are five times that.
        own = np.cov(moved.states[:, 1:3].T)
        expected = np.cov(states[:, 1:3].T, aweights=weighted.weights)
        np.testing.assert_allclose(own, expected, rtol=0.1)
        mean = estimate(weighted)[1:3]
        np.testing.assert_allclose(moved.states[:, 1:3].mean(axis=0), mean, atol=0.05)

    def test_an_angle_goes_round_the_circle(self) -> None:
        angles = np.pi + 0.1 * fresh().substream(1).normal((500, 1))
        belief = Belief.uniform(np.where(angles > np.pi, angles - 2.0 * np.pi, angles))
        moved = regularised(belief, belief, (0,), (0,), fresh())
        assert standard_deviation(moved, (0,))[0] == pytest.approx(0.1, rel=0.1)

    @pytest.mark.parametrize("states", [np.ones((30, 2)), np.full((30, 2), 1e200)])
    def test_what_is_not_spread_stays(self, states: FloatArray) -> None:
        belief = Belief.uniform(states)
        assert regularised(belief, belief, (0, 1), (), fresh()).states.tobytes() == states.tobytes()

    def test_coordinates_that_move_together_stay_together(self) -> None:
        one = fresh().substream(1).normal((200, 1))
        belief = Belief.uniform(np.concatenate([one, 2.0 * one], axis=1))
        moved = regularised(belief, belief, (0, 1), (), fresh()).states
        np.testing.assert_allclose(moved[:, 1], 2.0 * moved[:, 0], atol=1e-5)
        assert np.abs(moved - belief.states).max() > 0.01
        # Noise with the other sign would be as good for a filter, but decide otherwise.
        noise = fresh().substream(0).normal((200, 2))[:, 0]
        assert np.corrcoef((moved - belief.states)[:, 0], noise)[0, 1] > 0.9
