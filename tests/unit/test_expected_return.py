"""Expected return: what a look is worth, and what it costs."""

from collections.abc import Sequence
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from tests.trial_inputs import sense

from holdfast.errors import ProblemError
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning import expected_return
from holdfast.planning.belief import Belief
from holdfast.planning.expected_return import rollout_returns
from holdfast.planning.inputs import Sensed
from holdfast.planning.planner import Planner
from holdfast.planning.sensing import SensingInfo, choose_sensing_action
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
    SimulatorSettings,
)
from holdfast.planning.tracking import Trial
from holdfast.problems.attributes import sensing_costs
from holdfast.problems.problem import ProblemBase
from holdfast.robot.trial import run_trial

HYPOTHESES = stream(43, 0, 0, Purpose.HYPOTHESES)
SELECTION = stream(43, 0, 0, Purpose.SELECTION)


class Dock(ProblemBase):
    """Go to the origin of the plane, 0.2 a step; the third sensing action shows nothing."""

    name = "dock"
    state_size = 2
    action_size = 2
    sensing_actions: Sequence[str] = ("x", "y", "nothing")
    resolution = 0.1
    motion_variance = np.array([0.0025, 0.0025])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return np.array([1.0, 1.0]) + 0.5 * stream.normal((count, 2))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        return np.asarray(states + actions + 0.05 * stream.normal(states.shape))

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., :1] if sensing_action == 2 else states[..., [sensing_action]]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.array([1e12 if sensing_action == 2 else 0.0025])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return -states

    def limit_action(self, actions: FloatArray) -> FloatArray:
        return np.clip(actions, -0.2, 0.2)

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        return np.asarray(-1.0 - np.abs(actions[..., 0]))

    def is_goal(self, states: FloatArray) -> npt.NDArray[np.bool_]:
        return np.asarray((np.abs(states) < 0.15).all(axis=-1))


class Free(Dock):
    """Has no reward."""

    reward = ProblemBase.reward


class TwoDocks(Dock):
    """First to x = 1, then to the origin."""

    num_stages = 2

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        first = np.expand_dims(np.asarray(stage) == 0, -1)
        return np.where(first, np.array([1.0, 0.0]) - states, -states)

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        there = np.abs(estimates[..., 0] - 1.0) < 0.15
        following = np.where(there, 1, stage)
        return following if following.ndim else int(following)


class Cliff(Dock):
    """One of the two rollouts below falls after the second observation, the other never."""

    def is_failure(self, states: FloatArray) -> npt.NDArray[np.bool_]:
        x, y = states[..., 0], states[..., 1]
        return np.asarray((x > 0.05) & (x < 0.2) & (y > 0.25))


class FreeCliff(Cliff, Free):
    """The same, judged by steps."""


class Sonar(Dock):
    """The same with a likelihood of its own."""

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        away = self.observation_mean(states, sensing_action)[..., 0] - observation[0]
        return np.asarray(-0.5 * away * away / self.observation_variance(states, sensing_action)[0])

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        return self.observation_mean(state, sensing_action) + 0.05 * stream.normal(1)


def settings_of(
    samples: int = 10,
    interval: int = 4,
    discount: float = 1.0,
    particles: int = 60,
    **selector: Any,
) -> PlanningSettings:
    selector = {
        "method": "expected_return",
        "rollout_steps": 60,
        "rollout_sensing_steps": 4,
        **selector,
    }
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=particles),
        active_sensing=ActiveSensingSettings(
            num_observation_samples=samples, discount=discount, num_cores=1
        ),
        selector=SelectorSettings(**selector),
        sensing_interval=interval,
    )


def belief_of(*spreads: float, count: int = 60) -> Belief:
    """Return a belief around (0.5, 0.5), spread by so much along x and y."""
    draws = stream(44, 0, 0, Purpose.INITIAL_BELIEF).normal((count, 2))
    return Belief.uniform(0.5 + np.array(spreads) * draws)


def choose(
    problem: Any, settings: PlanningSettings, belief: Belief, stage: int = 0
) -> tuple[int, SensingInfo]:
    return choose_sensing_action(problem, settings, belief, stage, HYPOTHESES, SELECTION)


class TestWhatIsChosen:
    @pytest.mark.parametrize("problem", [Dock(), Free(), Sonar()])
    @pytest.mark.parametrize(("spreads", "best"), [((0.5, 0.01), 0), ((0.01, 0.5), 1)])
    def test_what_the_robot_does_not_know(
        self, problem: Any, spreads: tuple[float, float], best: int
    ) -> None:
        chosen, info = choose(problem, settings_of(), belief_of(*spreads))
        assert chosen == best
        assert info.entropies is not None
        assert int(info.entropies.argmin()) == best

    def test_not_looking_where_looks_cost_more_than_they_gain(self) -> None:
        for price, looks in ((0.01, True), (100.0, False)):
            problem = Dock()
            problem.sensing_costs = (price, price, 0.0)  # type: ignore[attr-defined]
            chosen, _ = choose(problem, settings_of(), belief_of(0.5, 0.5))
            assert (chosen != 2) is looks

    def test_a_price_is_subtracted(self) -> None:
        # So long an interval that no look comes later.
        settings = settings_of(max_observation_samples=1, interval=100)
        belief = belief_of(0.5, 0.5)
        _, free = choose(Dock(), settings, belief)
        priced = Dock()
        priced.sensing_costs = [0.25, 0.5, 0.0]  # type: ignore[attr-defined]
        _, paid = choose(priced, settings, belief)
        assert free.samples is not None
        assert paid.samples is not None
        more = np.broadcast_to([[0.25], [0.5], [0.0]], free.samples.shape)
        np.testing.assert_allclose(paid.samples - free.samples, more, atol=1e-12)

    def test_equal_ones_cost_no_more_samples_and_one_is_drawn(self) -> None:
        belief = Belief.uniform(np.full((60, 2), 0.5))
        drawn = set()
        # A false alarm, that one of three is never drawn: 3 (2/3)^40 < 1e-6.
        for trial in range(40):
            selection = stream(43, trial, 0, Purpose.SELECTION)
            chosen, info = choose_sensing_action(
                Dock(), settings_of(samples=5), belief, 0, HYPOTHESES, selection
            )
            drawn.add(chosen)
            assert info.samples is not None
            assert info.samples.shape == (3, 5)
        assert drawn == {0, 1, 2}

    def test_close_ones_are_sampled_more_than_others(self) -> None:
        _, info = choose(Dock(), settings_of(samples=5), belief_of(0.3, 0.3, count=200))
        assert info.samples is not None
        drawn = np.isfinite(info.samples).sum(axis=1)
        assert drawn.max() <= 40
        assert drawn.min() >= 5
        assert drawn[2] < drawn[:2].max()

    def test_one_sample_is_doubled(self) -> None:
        settings = settings_of(samples=1, max_observation_samples=8)
        _, info = choose(Dock(), settings, belief_of(0.3, 0.3, count=200))
        assert info.samples is not None
        assert np.isfinite(info.samples).sum(axis=1).min() >= 2

    def test_a_horizon_changes_nothing(self) -> None:
        near = settings_of(samples=5)
        far = msgspec.structs.replace(
            near, active_sensing=msgspec.structs.replace(near.active_sensing, horizon=3)
        )
        first, second = (choose(Dock(), each, belief_of(0.5, 0.5))[1] for each in (near, far))
        assert first.entropies is not None
        assert second.entropies is not None
        assert first.entropies.tobytes() == second.entropies.tobytes()

    def test_an_observation_that_no_particle_explains(self) -> None:
        class Impossible(Sonar):
            def log_likelihood(
                self, states: FloatArray, sensing_action: int, observation: FloatArray
            ) -> FloatArray:
                return np.full(states.shape[:-1], -np.inf)

        with pytest.raises(ProblemError, match="dock had no likelihood under any particle"):
            choose(Impossible(), settings_of(), belief_of(0.5, 0.5))


class TestRollouts:
    """Against one robot after another, in plain Python."""

    ESTIMATES = np.array([[[0.7, 0.2], [-0.4, 0.9]], [[0.5, 0.6], [-0.6, 1.2]]])
    STATES = np.array([[0.5, 0.5], [-0.5, 1.0]])

    def returns(
        self,
        problem: Any,
        settings: PlanningSettings | None = None,
        estimates: FloatArray = ESTIMATES,
        states: FloatArray = STATES,
        clouds: FloatArray | None = None,
    ) -> FloatArray:
        """Return those of beliefs that have one particle each, at the estimate."""
        if clouds is None:
            clouds = estimates[:, :, np.newaxis]
        settings = settings or settings_of()
        return rollout_returns(problem, settings, states, estimates, clouds, 0, HYPOTHESES)

    @pytest.mark.parametrize("problem", [Dock(), Free(), TwoDocks(), Cliff(), FreeCliff()])
    @pytest.mark.parametrize("discount", [1.0, 0.9])
    def test_against_single_robots(self, problem: Dock, discount: float) -> None:
        """Without noise: then it does not matter which column has which."""
        noiseless: Any = type("Noiseless", (type(problem),), {"move": lambda _, s, a, __: s + a})()
        settings = settings_of(discount=discount)
        clouds = self.ESTIMATES[:, :, np.newaxis] + np.array([[0.1, 0.0], [-0.1, 0.2]])
        found = self.returns(noiseless, settings, clouds=clouds)
        gains = []
        for i in range(2):
            first, second = (
                self.alone(noiseless, settings, self.STATES[i], self.ESTIMATES[j, i])
                for j in range(2)
            )
            gains.append(first - second)
        assert max(map(abs, gains)) > 1e-3
        # What the two have in common may be missing.
        np.testing.assert_allclose(found[0] - found[1], gains, atol=1e-10)

    def test_alone_it_is_followed_to_the_end_or_not_at_all(self) -> None:
        """One sensing action differs from none: nothing is left once the state is known."""
        asked = []

        class Noted(Dock):
            def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
                asked.append(len(states))
                return super().policy(states, stage)

        settings = settings_of(rollout_steps=1000)
        self.returns(Noted(), settings, self.ESTIMATES[:1])
        assert len(asked) <= settings.selector.rollout_sensing_steps * (
            settings.sensing_interval + 1
        )

    def alone(
        self, problem: Any, settings: PlanningSettings, state: FloatArray, estimate: FloatArray
    ) -> float:
        """Return the mean over the sensing step at which the state gets known."""
        total, left = 0.0, 1.0
        for later in range(1, settings.selector.rollout_sensing_steps + 1):
            last = later == settings.selector.rollout_sensing_steps
            share = left if last else left / 4.0
            known_from = later * (settings.sensing_interval + 1)
            total += share * self.one(problem, settings, state, estimate, known_from)
            left -= share
        return total

    def one(
        self,
        problem: Any,
        settings: PlanningSettings,
        state: FloatArray,
        estimate: FloatArray,
        known_from: int,
    ) -> float:
        stage, total = 0, 0.0
        for step in range(settings.selector.rollout_steps):
            if isinstance(problem, Cliff) and problem.is_failure(state):
                left = range(step, settings.selector.rollout_steps)
                rest = sum(settings.active_sensing.discount**later for later in left)
                return total - isinstance(problem, Free) * rest
            if problem.is_goal(state):
                break
            if step >= known_from:
                estimate = state
            stage = problem.next_stage(estimate, stage)
            action = problem.limit_action(problem.policy(estimate, stage))
            state, estimate = state + action, estimate + action
            reward = -1.0 if isinstance(problem, Free) else float(problem.reward(state, action))
            total += settings.active_sensing.discount**step * reward
        return total

    def test_steps_instead_of_rewards(self) -> None:
        by_steps = self.returns(Dock(), settings_of(rollout_reward="steps"))
        assert by_steps.tobytes() == self.returns(Free()).tobytes()

    def test_all_sensing_actions_have_the_same_noise(self) -> None:
        """Equal beliefs have equal returns, whatever the others are like."""
        estimates = np.concatenate([self.ESTIMATES, self.ESTIMATES[:1]])
        clouds = np.repeat(estimates[:, :, np.newaxis], 3, axis=2)
        found = self.returns(Dock(), None, estimates, clouds=clouds)
        assert found[0].tobytes() == found[2].tobytes()
        assert found[0].tobytes() != found[1].tobytes()

    def test_later_looks_have_a_price_too(self) -> None:
        """At each sensing step up to the goal the mean price: who is there sooner has fewer."""
        estimates = np.stack([self.STATES, self.STATES + np.array([1.0, 0.0])])
        found = []
        for price in (0.0, 3.0):
            problem: Any = type("Exact", (Free,), {"move": lambda _, s, a, __: s + a})()
            problem.sensing_costs = (price, 2.0 * price, 0.0)
            returns = self.returns(problem, settings_of(interval=1), estimates)
            found.append(returns[0] - returns[1])
        assert found[0][0] == found[1][0] == 0.0  # the first robot is as soon there as the other
        assert found[0][1] > 1.0
        assert found[1][1] > found[0][1] + 1.0

    def test_a_problem_may_know_what_known_states_are_worth(self) -> None:
        asked = []

        class Told(Free):
            def known_state_return(self, states: FloatArray, stages: IntArray) -> FloatArray:
                asked.append((states.shape, stages.shape))
                return np.full(states.shape[0], 1000.0)

        found = self.returns(Told(), states=self.STATES + 50.0)
        # Known at steps 5, 10, 15 and 20 with the probabilities 1/4, 3/16, 9/64 and 27/64.
        steps = 5 / 4 + 10 * 3 / 16 + 15 * 9 / 64 + 20 * 27 / 64
        np.testing.assert_allclose(found, 1000.0 - steps, rtol=1e-12)
        assert asked == [((4, 2), (4,))] * 4

    @pytest.mark.parametrize("changed", [0, 1])
    def test_a_return_of_its_own_cannot_change_the_rollouts(self, changed: int) -> None:
        class InPlace(Dock):
            def known_state_return(self, *known: Any) -> FloatArray:
                known[changed][...] = 0
                return np.zeros(known[0].shape[0])

        with pytest.raises(ValueError, match="read-only"):
            self.returns(InPlace(), states=self.STATES + 50.0)

    @pytest.mark.parametrize(
        ("function", "own", "message"),
        [
            ("is_goal", lambda _, s: s[..., 0], "is_goal of dock returned float64"),
            ("is_failure", lambda _, s: s[..., 0], "is_failure of dock returned float64"),
            ("reward", lambda *_: 0.0, "reward of dock returned float"),
            ("reward", lambda _, s, __: np.full(s.shape[:-1], np.nan), "all must be finite"),
            ("move", lambda _, s, *__: s * np.inf, "move of dock put particle 0 at"),
            ("known_state_return", lambda *_: 0.0, "known_state_return of dock returned float"),
            ("next_stage", lambda *_: 0, "next_stage of dock returned int"),
        ],
    )
    def test_what_breaks_the_contract_is_named(self, function: str, own: Any, message: str) -> None:
        broken: Any = type("Broken", (TwoDocks,), {function: own})()
        with pytest.raises(ProblemError, match=message):
            self.returns(broken)


class TestSamples:
    def test_contenders(self) -> None:
        draws = stream(45, 0, 0, Purpose.HYPOTHESES).normal((4, 20))
        best = 5.0 + draws[0]
        samples = np.stack([best, best - 1.0, best - 0.1 * draws[1] - 0.01, best - draws[2]])
        # The second is worse by 1 without a doubt; the third by less than its error.
        assert expected_return._contenders(samples, [0, 1, 2, 3]) == [0, 2, 3]
        assert expected_return._contenders(samples, [1, 3])[-1] == 3
        # Equal rows are not contended; a single sample tells nothing about its error.
        assert expected_return._contenders(np.ones((3, 4)), [0, 1, 2]) == [0]
        assert expected_return._contenders(np.array([[1.0], [2.0]]), [0, 1]) == [0, 1]

    def test_paired_means(self) -> None:
        nan = np.nan
        samples = np.array([[1.0, 2.0, 9.0, 8.0], [0.0, 1.5, nan, nan], [1.0, 2.5, 7.0, 8.0]])
        found = expected_return._paired_means(samples)
        np.testing.assert_allclose(found, [5.0, 5.0 - 0.75, 4.625])


class Priced(Dock):
    sensing_costs: Any = (0.5, 0.25, 0.0)


class TestSensingCosts:
    def test_a_trial_pays_for_each_look(self) -> None:
        settings = settings_of(method="random", particles=30)
        simulator = SimulatorSettings(max_steps=60, sensing_intervals=4)
        free, paid = (
            run_trial(Planner(each, settings), simulator.seed, 1, max_steps=simulator.max_steps)
            for each in (Dock(), Priced())
        )
        assert free.digest == paid.digest
        assert free.decisions is not None
        prices = Priced.sensing_costs
        looks = [d.sensing_action for d in free.decisions if isinstance(d, Sensed)]
        assert len(looks) > 1
        assert free.reward is not None
        assert paid.reward is not None
        expected = free.reward - sum(prices[look] for look in looks)
        np.testing.assert_allclose(paid.reward, expected, rtol=1e-12)

    def test_a_robot_pays_for_each_look(self) -> None:
        planner = Planner(Priced(), settings_of(method="random", particles=30))
        for trial, price in enumerate((0.5, 0.25, 0.0)):
            history = Trial(planner, 0, trial)
            sense(history, trial, np.array([0.5]), 0.0)
            assert history.rewards.total == -price

    @pytest.mark.parametrize(
        ("costs", "of_a_look"),
        [((0.0, 0.0, 1.0), -1.0), ((1.0, 1.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 0.0), (None, None)],
    )
    def test_a_price_alone_is_a_reward(self, costs: Any, of_a_look: float | None) -> None:
        problem: Any = Free()
        problem.sensing_costs = costs
        planner = Planner(problem, settings_of(method="fixed", particles=30, sensing_action=2))
        result = run_trial(planner, SimulatorSettings().seed, 0, max_steps=10)
        assert result.sensing_decisions > 1
        paid = None if of_a_look is None else of_a_look * result.sensing_decisions
        assert result.reward == paid
        assert Trial(planner, 0, 0).rewards.total == (None if paid is None else 0.0)

    @pytest.mark.parametrize("kind", [Dock, Sonar])
    def test_not_to_sense_is_as_an_observation_that_says_nothing(self, kind: type[Dock]) -> None:
        problem, belief = kind(), belief_of(0.5, 0.4)
        problem.sensing_costs = (0.5, 0.25, 0.0)  # type: ignore[attr-defined]
        _, info = choose(problem, settings_of(sensing_is_optional=True), belief)
        assert info.samples is not None
        assert info.samples.shape[0] == 4
        assert info.prices is None
        if kind is Dock:  # The sonar's third sensing action shows a little.
            np.testing.assert_allclose(info.samples[3], info.samples[2], rtol=1e-6)

    def test_sensing_is_left_out_where_it_costs_more_than_it_gains(self) -> None:
        class Sensing(Dock):
            sensing_actions = ("x", "y")

        problem, belief = Sensing(), belief_of(0.5, 0.4)
        for price, left_out in ((0.0, False), (1e3, True)):
            problem.sensing_costs = (price, price)  # type: ignore[attr-defined]
            chosen, info = choose(problem, settings_of(sensing_is_optional=True), belief)
            assert (chosen == 2) is left_out
            assert info.entropies is not None
            assert info.entropies.shape == (3,)

    def test_costs_with_the_choice_not_to_sense(self) -> None:
        assert sensing_costs(Priced(), optional=True).tolist() == [0.5, 0.25, 0.0, 0.0]
        assert sensing_costs(Dock(), otherwise=1.0).tolist() == [1.0, 1.0, 1.0]
        assert sensing_costs(Priced(), otherwise=1.0).tolist() == [0.5, 0.25, 0.0]
        assert sensing_costs(Dock()).tolist() == [0.0, 0.0, 0.0]
        for costs in (None, (0.0, 0.0, 0.0), np.zeros(3), [0, 0, 0]):
            problem: Any = Dock()
            problem.sensing_costs = costs
            assert sensing_costs(problem).tolist() == [0.0, 0.0, 0.0]

    def test_the_greatest_price(self) -> None:
        problem = Dock()
        problem.sensing_costs = (1e150, 1e150, 0.0)  # type: ignore[attr-defined]
        with np.errstate(all="raise"):
            chosen, _ = choose(problem, settings_of(), belief_of(0.5, 0.5))
        assert chosen == 2

    def test_rewards_whose_sum_is_not_finite(self) -> None:
        class Huge(Dock):
            def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
                return np.full(states.shape[:-1], -1.7e308)

        with (
            np.errstate(all="ignore"),
            pytest.raises(ProblemError, match="rewards of dock add up to more than a number can"),
        ):
            choose(Huge(), settings_of(), belief_of(0.5, 0.5))

    def test_a_greater_price_is_refused_with_its_bound(self) -> None:
        problem = Dock()
        problem.sensing_costs = (1.7e308, 1.7e308, 0.0)  # type: ignore[attr-defined]
        with pytest.raises(ProblemError, match=r"1.7e\+308.*from 0 to 1e\+150"):
            choose(problem, settings_of(), belief_of(0.5, 0.5))

    @pytest.mark.parametrize(
        "costs",
        [(1.0,), (1.0, -0.5, 0.0), (0.0, np.nan, 0.0), (0.0, np.inf, 0.0), 1.0, ("a", "b", "c")],
    )
    def test_a_wrong_price_is_named(self, costs: object) -> None:
        broken: Any = type("Broken", (Dock,), {"sensing_costs": costs})()
        with pytest.raises(ProblemError, match=r"sensing_costs of dock is .*: must be 3 numbers"):
            Planner(broken, settings_of()).init(0, 0)
