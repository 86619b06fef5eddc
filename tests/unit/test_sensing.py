"""Choosing what to sense: ties, the choices that imagine nothing, and what is refused."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from scipy import stats

from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.belief import Belief
from holdfast.planning.estimators import GaussianMixture, NearestNeighbor, PriorNeighbors, entropy
from holdfast.planning.sensing import SensingInfo, choose_sensing_action
from holdfast.planning.settings import (
    FEW_PARTICLES,
    ActiveSensingSettings,
    Estimator,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.problem import Problem, ProblemBase

HYPOTHESES = stream(41, 0, 0, Purpose.HYPOTHESES)
SELECTION = stream(41, 0, 0, Purpose.SELECTION)


class Coordinates(ProblemBase):
    """Go to the origin of the plane; each sensing action shows the coordinate given in ``rows``."""

    name = "coordinates"
    state_size = 2
    action_size = 2
    resolution = 0.1
    motion_variance = np.array([0.01, 0.01])

    def __init__(self, rows: Sequence[int] = (0, 1), variance: float = 0.01) -> None:
        self.rows = rows
        self.sensing_actions: Sequence[str] = [f"coordinate {row}" for row in rows]
        self.variance = np.array([variance])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return stream.normal((count, 2))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        return np.asarray(states + actions + 0.1 * stream.normal(states.shape))

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        row = self.rows[sensing_action]
        return states[..., row : row + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return self.variance

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return -states

    def is_goal(self, states: FloatArray) -> npt.NDArray[np.bool_]:
        return np.asarray((np.abs(states) < 0.1).all(axis=-1))


def settings_of(selector: SelectorSettings | None = None, **sensing: float) -> PlanningSettings:
    active_sensing = msgspec.structs.replace(ActiveSensingSettings(num_cores=1), **sensing)
    return PlanningSettings(
        active_sensing=active_sensing,
        selector=selector
        or SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    )


def belief_of(*deviations: float, count: int = 60) -> Belief:
    noise = stream(41, 1, 0, Purpose.INITIAL_BELIEF).normal((count, 2))
    return Belief.uniform(noise * np.array(deviations))


def choose(
    problem: Problem, settings: PlanningSettings, belief: Belief, stage: int = 0
) -> tuple[int, SensingInfo]:
    return choose_sensing_action(problem, settings, belief, stage, HYPOTHESES, SELECTION)


def entropies(problem: Problem, settings: PlanningSettings, belief: Belief) -> FloatArray:
    found = choose(problem, settings, belief)[1].entropies
    assert found is not None
    return found


class TestWhatIsChosen:
    @pytest.mark.parametrize(
        ("rows", "expected"), [([0, 0, 0], 0), ([1, 0, 0, 1], 1), ([1, 1, 0, 0], 2), ([0, 1, 0], 0)]
    )
    def test_of_equals_the_lowest(self, rows: list[int], expected: int) -> None:
        """Sensing actions share their random numbers, so equal ones are equal to the last bit."""
        index, info = choose(Coordinates(rows), settings_of(), belief_of(2.0, 0.2))
        assert info.entropies is not None
        for j, row in enumerate(rows):
            assert info.entropies[j] == info.entropies[rows.index(row)]
        assert index == expected

    @pytest.mark.parametrize("horizon", [1, 3])
    def test_the_same_resolution_for_each_coordinate(self, horizon: int) -> None:
        found = []
        for resolution in (0.1, (0.1, 0.1)):
            selector = SelectorSettings(
                method="action_entropy", estimator="nearest_neighbor", resolution=resolution
            )
            settings = settings_of(selector, horizon=horizon, discount=0.5)
            found.append(choose(Coordinates(), settings, belief_of(2.0, 0.2))[1])
        for own, other in zip(*(each[:2] for each in found), strict=True):
            np.testing.assert_allclose(own, other, rtol=1e-12)

    @pytest.mark.parametrize(
        ("count", "estimator"),
        [(FEW_PARTICLES, "prior_neighbors"), (FEW_PARTICLES + 1, "nearest_neighbor")],
    )
    def test_few_particles_have_an_estimator_of_their_own(
        self, count: int, estimator: Estimator
    ) -> None:
        belief, found = belief_of(2.0, 0.2, count=count), []
        for given in (None, estimator):
            selector = SelectorSettings(method="path_entropy", estimator=given)
            found.append(entropies(Coordinates(), settings_of(selector), belief).tolist())
        assert found[0] == found[1]


class TestBlindChoices:
    def test_fixed(self) -> None:
        for index in (0, 1, 2):
            selector = SelectorSettings(method="fixed", sensing_action=index)
            problem = Coordinates([0, 1, 0])
            chosen, info = choose(problem, settings_of(selector), belief_of(1.0, 1.0))
            assert chosen == index
            assert info == SensingInfo(None, None, 0, 0)

    @pytest.mark.parametrize(("count", "optional"), [(1, False), (2, False), (3, True), (7, False)])
    def test_random_is_uniform(self, count: int, optional: bool) -> None:
        """Chi-square at 1e-6 over 7,000 steps, and no memory from one step to the next.

        If sensing is optional, not to sense is one of the choices.
        """
        problem = Coordinates([0] * (count - optional))
        selector = SelectorSettings(method="random", sensing_is_optional=optional)
        settings = settings_of(selector)
        belief = belief_of(1.0, 1.0)
        steps = 7000
        chosen = np.array(
            [
                choose_sensing_action(
                    problem, settings, belief, 0, HYPOTHESES, stream(42, 0, step, Purpose.SELECTION)
                )[0]
                for step in range(steps)
            ]
        )
        observed = np.bincount(chosen, minlength=count)
        assert len(observed) == count
        if count > 1:
            assert stats.chisquare(observed).pvalue > 1e-6
            pairs = np.bincount(chosen[:-1] * count + chosen[1:], minlength=count * count)
            assert stats.chisquare(pairs).pvalue > 1e-6

    def test_random_is_a_function_of_its_stream(self) -> None:
        settings = settings_of(SelectorSettings(method="random"))
        problem = Coordinates([0, 1] * 50)
        first = choose(problem, settings, belief_of(1.0, 1.0))
        assert choose(problem, settings, belief_of(3.0, 0.1, count=10)) == first
        assert first[1] == SensingInfo(None, None, 0, 0)


def unequal(belief: Belief) -> Belief:
    """Return the belief with weights that differ, some of them zero."""
    weights = stream(41, 2, 0, Purpose.INITIAL_BELIEF).uniform(belief.weights.size)
    weights[::7] = 0.0
    return Belief.weighted(belief.states, weights)


class Nothing(Coordinates):
    """Its last sensing action shows the same in every state."""

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        shown = super().observation_mean(states, sensing_action)
        return np.zeros_like(shown) if sensing_action == len(self.rows) - 1 else shown


class GeneralNothing(Nothing):
    """The same with a likelihood of its own."""

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        away = self.observation_mean(states, sensing_action)[..., 0] - observation[0]
        return np.asarray(-0.5 * away * away / self.variance[0])

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        noise = np.sqrt(self.variance) * stream.normal(1)
        return np.asarray(self.observation_mean(state, sensing_action) + noise)


OPTIONAL = [
    SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    SelectorSettings(method="action_entropy", estimator="gaussian_mixture_upper"),
    SelectorSettings(method="state_entropy", estimator="gaussian_mixture_lower"),
    SelectorSettings(method="path_entropy", estimator="prior_neighbors"),
    SelectorSettings(method="action_covariance"),
]


def optional(selector: SelectorSettings, nats_per_cost: float = 0.0) -> SelectorSettings:
    return msgspec.structs.replace(selector, sensing_is_optional=True, nats_per_cost=nats_per_cost)


class TestNotSensing:
    @pytest.mark.parametrize(
        ("selector", "estimator"),
        [
            (OPTIONAL[0], NearestNeighbor(5, 0.1)),
            (OPTIONAL[1], GaussianMixture(np.array([0.01, 0.01]))),
            (
                SelectorSettings(method="action_entropy", estimator="prior_neighbors"),
                PriorNeighbors(unequal(belief_of(1.0, 2.0)).weights, 5, 0.1),
            ),
        ],
    )
    def test_it_has_the_entropy_of_the_belief(
        self,
        selector: SelectorSettings,
        estimator: NearestNeighbor | GaussianMixture | PriorNeighbors,
    ) -> None:
        belief = unequal(belief_of(1.0, 2.0))
        found = entropies(Coordinates(), settings_of(optional(selector)), belief)
        expected = entropy(-belief.states, belief.weights, estimator)
        np.testing.assert_allclose(found[2], expected, rtol=1e-13)

    def test_path_entropy_adds_up_those_along_the_path(self) -> None:
        belief = belief_of(1.0, 2.0)
        found = entropies(Coordinates(), settings_of(optional(OPTIONAL[3])), belief)
        # Without limits all particles are at the goal after a step, and there every action is 0.
        estimator = PriorNeighbors(belief.weights, 5, 0.1)
        now, later = (
            entropy(points, belief.weights, estimator)
            for points in (-belief.states, np.zeros((60, 2)))
        )
        np.testing.assert_allclose(found[2], now + 0.5 * later, rtol=1e-13)

    @pytest.mark.parametrize("selector", OPTIONAL)
    @pytest.mark.parametrize("kind", [Nothing, GeneralNothing])
    @pytest.mark.parametrize("horizon", [1, 3])
    def test_it_is_as_an_observation_that_says_nothing(
        self, selector: SelectorSettings, kind: type[Nothing], horizon: int
    ) -> None:
        if selector.method == "path_entropy" and horizon > 1:
            return  # It looks ahead by offsets.
        problem, belief = kind([0, 1, 0]), unequal(belief_of(1.0, 2.0))
        _, info = choose(problem, settings_of(optional(selector), horizon=horizon), belief)
        _, without = choose(problem, settings_of(selector, horizon=horizon), belief)
        for own, other in ((info.entropies, without.entropies), (info.samples, without.samples)):
            assert own is not None
            assert other is not None
            np.testing.assert_allclose(own[3], own[2], rtol=1e-11)
            # Whether sensing is optional changes no bit of what sensing is worth.
            np.testing.assert_array_equal(own[:3], other)

    def test_it_wins_ties(self) -> None:
        """Where nothing can be gained, be it that rounding says otherwise, nothing is sensed."""
        spread, alike = unequal(belief_of(1.0, 2.0)), unequal(belief_of(1e-9, 1e-9))
        for selector in OPTIONAL:
            settings = settings_of(optional(selector))
            assert choose(Nothing([0]), settings, spread)[0] == 1
            assert choose(GeneralNothing([0]), settings, spread)[0] == 1
            assert choose(Coordinates([0], variance=0.1), settings, spread)[0] == 0
        for selector in OPTIONAL[:4]:
            assert choose(Coordinates([0, 1]), settings_of(optional(selector)), alike)[0] == 2

    def test_fixed_may_name_it_only_where_sensing_is_optional(self) -> None:
        belief = belief_of(1.0, 1.0)
        never = SelectorSettings(method="fixed", sensing_action=2)
        assert choose(Coordinates(), settings_of(optional(never)), belief)[0] == 2
        with pytest.raises(InvalidValueError, match=r"0 to 1 \(and 2, not to sense, if selector\."):
            choose(Coordinates(), settings_of(never), belief)
        beyond = optional(SelectorSettings(method="fixed", sensing_action=3))
        with pytest.raises(InvalidValueError, match=r"sensing_action 3: .* 0 to 1$"):
            choose(Coordinates(), settings_of(beyond), belief)


class TestPrices:
    @pytest.mark.parametrize("selector", OPTIONAL)
    def test_a_sensing_action_must_gain_more_than_its_price(
        self, selector: SelectorSettings
    ) -> None:
        problem, belief = Coordinates([0]), belief_of(1.0, 1.0)
        problem.sensing_costs = (4.0,)  # type: ignore[attr-defined]
        chosen, info = choose(problem, settings_of(optional(selector)), belief)
        assert chosen == 0
        assert info.prices is None
        assert info.entropies is not None
        gain = float(info.entropies[1] - info.entropies[0])
        assert gain > 0.0
        for factor, expected in ((0.99, 0), (1.01, 1)):
            rate = factor * gain / 4.0
            chosen, priced = choose(problem, settings_of(optional(selector, rate)), belief)
            assert chosen == expected
            # Entropies stay entropies; what is added stands beside them.
            assert priced.entropies is not None
            assert priced.entropies.tolist() == info.entropies.tolist()
            assert priced.prices is not None
            assert priced.prices.tolist() == [rate * 4.0, 0.0]

    def test_the_cheaper_of_two_wins_if_it_shows_as_much(self) -> None:
        problem = Coordinates([0, 0, 0])
        problem.sensing_costs = (3.0, 1.0, 2.0)  # type: ignore[attr-defined]
        belief = belief_of(1.0, 1.0)
        assert choose(problem, settings_of(), belief)[0] == 0
        cheap = SelectorSettings(
            method="action_entropy", estimator="nearest_neighbor", nats_per_cost=1e-6
        )
        assert choose(problem, settings_of(cheap), belief)[0] == 1

    def test_each_counts_one_where_the_problem_has_no_costs(self) -> None:
        """The price is then the least gain for which the robot senses."""
        _, info = choose(
            Coordinates(), settings_of(optional(OPTIONAL[0], 0.25)), belief_of(1.0, 1.0)
        )
        assert info.prices is not None
        assert info.prices.tolist() == [0.25, 0.25, 0.0]

    def test_the_greatest_price(self) -> None:
        problem = Coordinates()
        problem.sensing_costs = (1e150, 1e150)  # type: ignore[attr-defined]
        with np.errstate(all="raise"):
            selector = optional(OPTIONAL[0], 1e150)
            assert choose(problem, settings_of(selector), belief_of(1.0, 1.0))[0] == 2


class Broken(Coordinates):
    """Returns what it is told to."""

    def __init__(self, **returned: FloatArray) -> None:
        super().__init__()
        self.returned = returned

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return self.returned.get("mean", super().observation_mean(states, sensing_action))

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return self.returned.get("variance", self.variance)

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return self.returned.get("policy", -states)


class TestBadInput:
    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_policy_not_finite(self, bad: float) -> None:
        belief = belief_of(1.0, 1.0)
        actions = -belief.states
        actions[7, 1] = bad
        for actions_that_count in ("commanded", "executed"):
            selector = SelectorSettings(
                method="action_entropy", estimator="nearest_neighbor", actions=actions_that_count
            )
            with pytest.raises(ProblemError, match=rf"policy of coordinates returned \[.*{bad}\]"):
                choose(Broken(policy=actions), settings_of(selector), belief)

    def test_policy_of_a_predicted_state_out_of_bounds(self) -> None:
        class Far(Coordinates):
            def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
                return np.full(states.shape, 1e160)

        with pytest.raises(ProblemError, match=r"returned \[-1\.e.*in the predicted state \[1\.e"):
            choose(Far(), settings_of(horizon=2), belief_of(1.0, 1.0))

    @pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
    def test_observation_mean_not_finite(self, bad: float) -> None:
        mean = np.zeros((60, 1))
        mean[3] = bad
        with pytest.raises(
            ProblemError,
            match=r"observation_mean of coordinates, sensing action 0, is \S+ at \(3, 0\)",
        ):
            choose(Broken(mean=mean), settings_of(), belief_of(1.0, 1.0))

    @pytest.mark.parametrize("bad", [0.0, -0.25, np.nan, np.inf])
    def test_variance_not_positive(self, bad: float) -> None:
        of_one_particle = np.full((60, 1), 0.1)
        of_one_particle[3] = bad
        for variance in (np.array([bad]), of_one_particle):
            with pytest.raises(
                ProblemError,
                match=r"observation_variance of coordinates, sensing action 0, is \S+ at \([03]",
            ):
                choose(Broken(variance=variance), settings_of(), belief_of(1.0, 1.0))

    def test_mixture_without_a_motion_variance_for_the_states(self) -> None:
        class Flat(Coordinates):
            action_size = 1
            motion_variance = np.array([0.01])

            def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
                return -states[..., :1]

        selector = SelectorSettings(method="state_entropy", estimator="gaussian_mixture_upper")
        # The resolution stands in for noise that is not there.
        same = msgspec.structs.replace(selector, resolution=Flat.resolution)
        self.assert_same_entropies(Flat(), selector, same)

    def test_a_resolution_of_states_blurs_the_states_of_a_mixture(self) -> None:
        class OfStates(Coordinates):
            state_resolution = np.array([0.1, 0.5])

        for estimator in ("nearest_neighbor", "gaussian_mixture_upper"):
            selector = SelectorSettings(method="state_entropy", estimator=estimator)
            same = msgspec.structs.replace(selector, resolution=(0.1, 0.5))
            self.assert_same_entropies(OfStates(), selector, same)

    def test_an_array_stands_in_for_noise_that_is_not_there(self) -> None:
        class Exact(Coordinates):
            motion_variance = np.array([0.0, 0.0625])

        problem = Exact()
        vars(problem)["resolution"] = np.array([0.5, 1.0])
        selector = SelectorSettings(method="action_entropy", estimator="gaussian_mixture_lower")
        same = msgspec.structs.replace(selector, resolution=(0.5, 0.25))
        self.assert_same_entropies(problem, selector, same)

    @staticmethod
    def assert_same_entropies(
        problem: Problem, first: SelectorSettings, second: SelectorSettings
    ) -> None:
        belief = belief_of(1.0, 1.0)
        one, other = (entropies(problem, settings_of(each), belief) for each in (first, second))
        assert one.tolist() == other.tolist()

    def test_mixture_of_a_negative_motion_variance(self) -> None:
        class Wrong(Coordinates):
            motion_variance = np.array([-1.0, 0.01])

        selector = SelectorSettings(method="action_entropy", estimator="gaussian_mixture_lower")
        with pytest.raises(InvalidValueError, match=r"variance \[.*\]: every entry must be > 0"):
            choose(Wrong(), settings_of(selector), belief_of(1.0, 1.0))

    @pytest.mark.parametrize("method", ["path_entropy", "expected_return"])
    def test_likelihoods_at_once_have_the_same_bits(self, method: Any) -> None:
        asked = []

        class General(Coordinates):
            def log_likelihood(self, states: Any, sensing_action: int, observation: Any) -> Any:
                asked.append(1)
                away = observation[0] - states[:, sensing_action]
                return -50.0 * away * away

            def sample_observation(self, state: Any, sensing_action: int, stream: Stream) -> Any:
                return state[sensing_action : sensing_action + 1] + 0.1 * stream.normal(1)

        class Together(General):
            def log_likelihoods(self, states: Any, sensing_action: int, observations: Any) -> Any:
                assert not observations.flags.writeable
                asked.append(len(observations))
                away = observations - states[:, sensing_action]
                return -50.0 * away * away

        class Another(Together):
            """Has a likelihood of which the inherited method knows nothing."""

            log_likelihood = General.log_likelihood

        found, calls = [], []
        settings = settings_of(SelectorSettings(method=method))
        for problem in (General(), Together(), Another()):
            asked.clear()
            chosen, info = choose(problem, settings, belief_of(1.0, 0.5))
            assert info.entropies is not None
            found.append((chosen, info.entropies.tobytes(), info.likelihoods))
            calls.append((len(asked), sum(asked)))
            assert info.likelihoods == 60 * sum(asked)
        assert found[0] == found[1] == found[2]
        samples = settings.active_sensing.num_observation_samples
        assert calls[0] == calls[2] == (sum(asked), sum(asked))
        assert calls[1][0] <= calls[1][1] // samples
        assert calls[1][1] == sum(asked)

    @pytest.mark.parametrize(
        ("bad", "message"),
        [
            (np.nan, "log_likelihood of coordinates.* is NaN or plus infinity"),
            (-np.inf, "sensing action 0 of coordinates is not a number"),
        ],
    )
    @pytest.mark.parametrize("horizon", [1, 2])
    def test_general_likelihood_that_is_none(self, bad: float, message: str, horizon: int) -> None:
        """Its own draws are impossible under every particle: no entropy can be told."""

        class General(Coordinates):
            def log_likelihood(
                self, states: FloatArray, sensing_action: int, observation: FloatArray
            ) -> FloatArray:
                return np.full(states.shape[:-1], bad)

            def sample_observation(
                self, state: FloatArray, sensing_action: int, stream: Stream
            ) -> FloatArray:
                return state[:1]

        with pytest.raises(ProblemError, match=message):
            choose(General(), settings_of(horizon=horizon), belief_of(1.0, 1.0))
