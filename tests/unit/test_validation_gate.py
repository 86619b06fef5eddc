"""The validation gate: its odds, its two distances, its covariance."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from holdfast import numerics
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning import validation_gate
from holdfast.planning.belief import Belief, uniform_weights, update
from holdfast.planning.planner import Planner
from holdfast.planning.validation_gate import (
    NUM_RANKED,
    OUTSIDE_PROBABILITY,
    _squared_distance,
    gate,
    is_typical,
    is_within,
)
from holdfast.problems.problem import ProblemBase


@pytest.mark.parametrize("size", [1, 3, 100])
def test_the_quantile(size: int) -> None:
    exact = stats.chi2.isf(OUTSIDE_PROBABILITY, size)
    assert gate(size) == pytest.approx(exact, rel=0.01)
    assert stats.chi2.sf(gate(size), size) == pytest.approx(OUTSIDE_PROBABILITY, rel=0.03)


@pytest.mark.parametrize("size", [1, 2, 5])
@pytest.mark.parametrize("varying", [False, True])
def test_the_distance_is_that_of_the_whole_covariance(size: int, varying: bool) -> None:
    draws = np.random.default_rng(3)
    mean = draws.normal(size=(40, size)) @ draws.normal(size=(size, size))
    variance = draws.uniform(0.1, 2.0, (40, size) if varying else size)
    weights = draws.dirichlet(np.ones(40))
    observed = draws.normal(size=size)
    residual = observed - weights @ mean
    noise = weights @ variance if varying else variance
    covariance = np.cov(mean.T, aweights=weights, ddof=0).reshape(size, size) + np.diag(noise)
    expected = residual @ np.linalg.solve(covariance, residual)
    assert _squared_distance(observed, mean, variance, weights) == pytest.approx(expected)


@pytest.mark.parametrize("variance", [1e-2, 1e-20])
@pytest.mark.parametrize("varying", [False, True])
def test_two_channels_that_show_the_same(variance: float, varying: bool) -> None:
    """Their mean and their difference are independent, which gives the distance exactly."""
    draws = np.random.default_rng(7)
    deviation, count = np.sqrt(variance), 100
    outside = 0
    for _ in range(300):
        place = draws.normal(size=(count, 1))
        shown = draws.normal() + deviation * draws.normal(size=2)
        weights = draws.dirichlet(np.ones(count))
        noise = np.full((count, 2) if varying else 2, variance)
        found = _squared_distance(shown, np.repeat(place, 2, axis=1), noise, weights)
        spread = float(weights @ (place[:, 0] - weights @ place[:, 0]) ** 2)
        middle = shown.mean() - float(weights @ place[:, 0])
        expected = middle**2 / (spread + variance / 2) + (shown[0] - shown[1]) ** 2 / (2 * variance)
        # A number near 1 is rounded by 1e-16, which is much beside a deviation of 1e-10.
        assert found == pytest.approx(expected, rel=1e-6, abs=20.0 * (1e-16 / deviation) ** 1.0)
        outside += found > gate(2)
    # The belief is the truth's, up to the sample of it: 3 are expected, more than 15 not in 1e-6.
    assert outside <= 15


@pytest.mark.parametrize("size", [2, 5])
@pytest.mark.parametrize("scale", [1e-150, 1e-5, 1e5, 1e140])
def test_units_do_not_matter(size: int, scale: float) -> None:
    draws = np.random.default_rng(3)
    mean, observed = draws.normal(size=(40, size)), draws.normal(size=size)
    weights, variance = np.full(40, 1 / 40), np.full(size, 0.1)
    usual = _squared_distance(observed, mean, variance, weights)
    units = np.ones(size)
    units[0] = scale
    found = _squared_distance(observed * units, mean * units, variance * units * units, weights)
    assert found == pytest.approx(usual, rel=1e-9)


def within(belief: Belief, variance: float, *observed: float) -> bool:
    """Tell what the gate says of an observation of the state's coordinates."""
    problem: Any = SimpleNamespace(
        observation_mean=lambda states, _: states,
        observation_variance=lambda states, _: np.full(states.shape[-1], variance),
    )
    return update(problem, belief, 0, observed)[1].within_gate


def test_modes_and_gaps_are_no_alarm() -> None:
    """Far from the mean of a belief that is nearly sure of another place; between few particles."""
    two, three = Belief.weighted([[0.0], [10.0]], [0.999, 0.001]), Belief.uniform([[-1], [0], [1]])
    for belief, variance, near, far in ((two, 0.01, 10.1, 12.0), (three, 0.0004, 0.5, 3.0)):
        assert within(belief, variance, near)
        assert not within(belief, variance, far)


def test_angles_are_near_across_the_cut() -> None:
    mean = np.array([[3.10], [-3.12], [3.14], [-3.08]])
    for observed, near in ((3.12, True), (-3.11, True), (0.0, False), (2.0, False)):
        shown = np.array([observed]), mean, np.array([1e-4]), uniform_weights(4)
        assert is_within(*shown, circular=(0,)) is near
    assert not is_within(np.array([3.0]), mean, np.array([1e-4]), uniform_weights(4), (0,))


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("observed", [1e200, -1e308])
def test_what_overflows_is_outside(observed: float) -> None:
    with np.errstate(over="raise", invalid="raise"):
        assert not is_within(
            np.array([observed]), np.zeros((3, 1)), np.array([1.0]), uniform_weights(3)
        )


class Heavy(ProblemBase):
    """Observes a place with noise of long tails (Cauchy), whose likelihood is zero nowhere."""

    name = "heavy"
    state_size = action_size = 1
    sensing_actions = ("look",)
    asked = 0

    def initial_states(self, stream: Any, count: int) -> Any:
        return stream.normal((count, 1))

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        return states

    def policy(self, states: Any, stage: Any) -> Any:
        return states

    def is_goal(self, states: Any) -> Any:
        return states[..., 0] > 99.0

    def log_likelihood(self, states: Any, sensing_action: int, observation: Any) -> Any:
        self.asked += 1
        away = (observation[0] - states[:, 0]) / 0.1
        return -numerics.log(1.0 + away * away)

    def sample_observation(self, state: Any, sensing_action: int, stream: Any) -> Any:
        above, below = stream.normal(2)
        return state + 0.1 * above / below


def ranked(problem: Heavy, belief: Belief, observed: np.ndarray, trial: int) -> bool:
    random = stream(7, trial, 0, Purpose.RANK_TEST)
    return update(problem, belief, 0, observed, random)[1].within_gate


def test_the_rank_test_is_exact() -> None:
    """Of 2,000 observations that the belief itself makes 5 % are outside, which is 100.

    More than 140 or fewer than 62 come once in 10,000 series. It takes few draws.
    """
    outside = 0
    problem = Heavy()
    for trial in range(2000):
        random = stream(5, trial, 0, Purpose.INITIAL_BELIEF)
        states = np.concatenate([random.normal((20, 1)), 5.0 + random.substream(0).normal((20, 1))])
        truth = states[int(40 * random.substream(1).uniform())]
        observed = problem.sample_observation(truth, 0, random.substream(2))
        problem.asked -= 1  # the update itself
        outside += not ranked(problem, Belief.uniform(states), observed, trial)
    assert 62 <= outside <= 140
    assert problem.asked / 2000 < 4.5


def test_the_rank_test_finds_what_is_far_and_repeats_itself() -> None:
    belief = Belief.uniform(stream(3, 0, 0, Purpose.PREDICTION).normal((50, 1)))
    far = [ranked(Heavy(), belief, np.array([80.0]), trial) for trial in range(20)]
    near = [ranked(Heavy(), belief, np.array([0.5]), trial) for trial in range(20)]
    assert sum(far) <= 4
    assert all(near)
    assert far == [ranked(Heavy(), belief, np.array([80.0]), trial) for trial in range(20)]
    # Who does not ask for it gets none: every observation is possible.
    assert update(Heavy(), belief, 0, [80.0])[1].within_gate


def test_the_rank_test_draws_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any other numbers would be as good for a filter, but decide otherwise."""
    drawn: list[tuple[float, Stream]] = []
    densities: list[float] = []

    class Noting(Heavy):
        def sample_observation(self, state: np.ndarray, action: int, stream: Stream) -> np.ndarray:
            drawn.append((float(state[0]), stream))
            return state

    random = stream(7, 0, 0, Purpose.RANK_TEST)
    belief = Belief.weighted(random.normal((40, 1)), random.uniform(40))
    monkeypatch.setattr(
        "holdfast.planning.belief.is_typical",
        lambda density, draw: densities.extend((density, *map(draw, range(NUM_RANKED)))),
    )
    update(Noting(), belief, 0, [80.0], random)
    likelihoods = np.exp(Heavy().log_likelihood(belief.states, 0, np.array([80.0])))
    assert densities[0] == pytest.approx(np.log(belief.weights @ likelihoods))
    expected = []
    for own in map(random.substream, range(NUM_RANKED)):
        teeth = (np.arange(40) + own.substream(0).uniform()) / 40
        comb = np.searchsorted(np.cumsum(belief.weights), teeth, side="right")
        chosen = belief.states[comb[int(40 * own.substream(1).uniform())], 0]
        expected.append((float(chosen), own.substream(2)))
    assert drawn == expected


def test_a_problem_asks_for_the_rank_test() -> None:
    class Asking(Heavy):
        rank_test = True

    reached = []
    problem: Any
    for problem, within in ((Heavy(), True), (Asking(), False)):
        planner = Planner(problem, particles=50)
        after, info = planner.observe(planner.init(3), 0, np.array([1e3]))
        assert info.within_gate is within
        assert info.explained
        reached.append(planner.digest(after))
    assert reached[0] == reached[1], "it draws from a stream of its own"


def test_an_equally_likely_draw_decides_the_rank_test() -> None:
    """Else whatever takes few values, all of them likely, would be outside."""
    assert is_typical(-1.0, lambda _: -1.0)
    assert not is_typical(-1.0, lambda _: -0.5)
    asked: list[int] = []

    def draw(number: int) -> float:
        asked.append(number)
        return -1.0 if number == NUM_RANKED - 1 else 0.0

    assert is_typical(-1.0, draw)  # the last of 19 counts
    assert asked == list(range(19))


def test_at_the_gate_is_within(monkeypatch: pytest.MonkeyPatch) -> None:
    """Four states that predict the same, and a noise of variance 4: the distance of 4 is exact."""
    mean = np.zeros((4, 1))
    weights = np.full(4, 0.25)
    for limit, within in ((4.0, True), (3.9999999999999996, False)):
        monkeypatch.setattr(validation_gate, "gate", lambda _, limit=limit: limit)
        assert is_within(np.array([4.0]), mean, np.array([4.0]), weights) is within
