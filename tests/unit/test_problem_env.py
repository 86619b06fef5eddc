"""A problem as a gymnasium environment, in which an agent chooses what is sensed."""

import copy
import pickle
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from holdfast.config.loader import load
from holdfast.config.registry import BUILT_IN, make_problem
from holdfast.errors import ConfigurationError, HoldfastError, InvalidValueError
from holdfast.planning.planner import Planner
from holdfast.planning.settings import PlanningSettings, SelectorSettings
from holdfast.problems.attributes import circular_states
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.robot.problem_env import ProblemEnv
from holdfast.robot.trial import run_trial

EXAMPLES = Path(__file__).parents[2] / "examples"
ID = "holdfast_env:Problem-v0"
SMALL: dict[str, Any] = {"problem": "peg_in_hole_2d", "particles": 40, "max_steps": 60}


def made(**arguments: Any) -> tuple[gymnasium.Env[Any, Any], ProblemEnv]:
    """Return an environment as gymnasium makes it, and the one inside its wrappers."""
    wrapped = gymnasium.make(ID, **{**SMALL, **arguments})
    inner = wrapped.unwrapped
    assert isinstance(inner, ProblemEnv)
    return wrapped, inner


def episode(environment: Any, choose: Any, **reset: Any) -> list[Any]:
    """Return all that an episode has shown."""
    shown: list[Any] = [environment.reset(**reset)]
    over = False
    while not over:
        shown.append(environment.step(choose()))
        over = shown[-1][2] or shown[-1][3]
    return shown


class TestItIsAGymnasiumEnvironment:
    @pytest.mark.parametrize("problem", BUILT_IN)
    def test_the_checker_finds_nothing_in_our_problems(self, problem: str) -> None:
        check_env(made(problem=problem)[1])  # a warning is an error

    @pytest.mark.parametrize("name", ["corridor_doors", "priced_looks", "wrapping_heading"])
    def test_nor_in_the_examples(self, name: str) -> None:
        """Observations that are not Gaussian, prices, a circular coordinate."""
        path = str(EXAMPLES / f"{name}.yaml")
        check_env(made(problem=path, observation="particles", sensing_is_optional=True)[1])

    def test_another_reset_is_the_next_trial(self) -> None:
        _, inner = made()
        numbers = [inner.reset(seed=5)[1], inner.reset()[1], inner.reset()[1]]
        assert [(each["seed"], each["trial"]) for each in numbers] == [(5, 0), (5, 1), (5, 2)]
        assert inner.reset(options={"trial": 9})[1]["trial"] == 9
        assert inner.reset(seed=5)[1]["trial"] == 0

    def test_without_a_seed_episodes_differ(self) -> None:
        first, second = made()[1].reset()[1], made()[1].reset()[1]
        assert first["seed"] != second["seed"]  # equal once in 2**63

    def test_a_seed_reproduces_every_bit(self) -> None:
        def shown() -> bytes:
            environment, inner = made(observation="particles")
            inner.action_space.seed(3)
            return pickle.dumps(episode(environment, inner.action_space.sample, seed=7))

        assert shown() == shown()

    def test_what_is_returned_is_the_callers(self) -> None:
        _, inner = made(observation="particles")
        observation, info = inner.reset(seed=1)
        kept = copy.deepcopy(observation)
        _, later = inner.reset(seed=1)
        for array in (*observation.values(), info["true_state"]):
            array[...] = 0.0
        again, _ = inner.reset(seed=1)
        assert all(np.array_equal(again[key], kept[key]) for key in kept)
        assert later["true_state"].any()

    def test_it_can_be_made_again_from_its_spec(self) -> None:
        environment, _ = made(sensing_interval=3)
        spec = pickle.loads(pickle.dumps(environment.spec))
        assert gymnasium.envs.registration.EnvSpec.from_json(spec.to_json()).kwargs == spec.kwargs
        again = gymnasium.make(spec)
        assert np.array_equal(again.reset(seed=2)[0], environment.reset(seed=2)[0])

    def test_a_vector_of_them(self) -> None:
        vector = gymnasium.make_vec(ID, num_envs=2, vectorization_mode="sync", **SMALL)
        rows, infos = vector.reset(seed=4)
        for index, row in enumerate(rows):
            assert np.array_equal(row, made()[1].reset(seed=4 + index)[0])
        assert infos["seed"].tolist() == [4, 5]
        rows, *_ = vector.step(np.array([0, 2]))
        assert rows.shape == vector.observation_space.shape
        vector.close()


class TestAnEpisodeIsATrial:
    @pytest.mark.parametrize("method", ["path_entropy", "random"])
    @pytest.mark.parametrize("problem", ["peg_in_hole_2d", "capsule_robot"])
    def test_our_methods_as_agents_decide_as_in_run_trial(self, problem: str, method: Any) -> None:
        environment, inner = made(problem=problem)
        *_, last = episode(environment, lambda: inner.choose(method), seed=3, options={"trial": 2})
        planner = Planner(make_problem(problem), particles=40, method=method)
        result = run_trial(planner, 3, 2, max_steps=60)
        assert last[4]["digest"] == result.digest
        assert last[4]["steps"] == result.steps
        assert (last[2], last[4]["success"]) == (result.success, result.success)
        assert last[3] == (result.outcome == "truncated")

    @pytest.mark.parametrize("name", ["priced_looks", "corridor_doors"])
    def test_with_the_settings_of_a_configuration(self, name: str) -> None:
        path = EXAMPLES / f"{name}.yaml"
        configuration = load(path)
        environment, inner = made(problem=str(path), max_steps=None, particles=60)
        assert inner.max_steps == configuration.simulator.max_steps
        shown = episode(environment, inner.choose, seed=1)
        planner = Planner(configuration.problem, configuration.planning, particles=60)
        result = run_trial(planner, 1, 0, max_steps=inner.max_steps)
        assert shown[-1][4]["digest"] == result.digest
        total = sum(step[1] for step in shown[1:])
        expected = -result.steps if result.reward is None else result.reward
        assert total == pytest.approx(expected, abs=1e-9)

    def test_sensing_may_be_left_out(self) -> None:
        environment, inner = made(sensing_is_optional=True)
        assert inner.action_space == gymnasium.spaces.Discrete(4)
        environment.reset(seed=1)
        before = inner.state.belief
        observation, *_ = environment.step(3)
        # Nothing was folded in: only the moves have changed the particles.
        assert np.array_equal(inner.state.belief.weights, before.weights)
        assert observation[inner.observation_labels.index("since no sensing")] == 1.0

    def test_a_trial_that_begins_at_the_goal_is_over_at_once(self) -> None:
        class AtTheGoal(PegInHole2D):
            def is_goal(self, states: Any) -> Any:
                return np.ones(states.shape[:-1], dtype=bool)

        problem = AtTheGoal.from_settings({}, {})
        environment, _ = made(problem=problem)
        environment.reset(seed=1)
        _, reward, terminated, truncated, info = environment.step(0)
        assert (reward, terminated, truncated, info["steps"]) == (0.0, True, False, 0)
        result = run_trial(Planner(problem, particles=40), 1)
        assert info["digest"] == result.digest


class TestWhatTheAgentSees:
    def test_each_number_has_a_name(self) -> None:
        environment, inner = made()
        observation, _ = environment.reset(seed=3)
        values = dict(zip(inner.observation_labels, observation.tolist(), strict=True))
        assert values["since x"] == 0.0
        low, high = inner.state_low[0], inner.state_high[0]
        mean = inner.state.belief.states[:, 0].mean()
        assert values["estimate of x (m)"] == pytest.approx(2 * (mean - low) / (high - low) - 1)
        half, spread = 0.5 * (high - low), inner.state.belief.states[:, 0].std()
        assert values["spread of x (m)"] == pytest.approx(1 + np.log10(spread / half) / 2)
        assert values["action 0"] < 0.0  # the hole is to the left

    def test_an_observation_narrows_what_was_sensed(self) -> None:
        environment, inner = made()
        before, _ = environment.reset(seed=3)
        index = inner.observation_labels.index("spread of θ (rad)")
        after, _, _, _, _ = environment.step(2)
        assert after[index] < before[index] - 0.2
        assert after[inner.observation_labels.index("since θ")] == 1.0
        later, _, _, _, _ = environment.step(0)
        assert later[inner.observation_labels.index("since θ")] == 0.5

    def test_an_angle_has_no_end(self) -> None:
        _, inner = made(problem=str(EXAMPLES / "wrapping_heading.yaml"), observation="particles")
        labels = [label for label in inner.observation_labels if "sine" in label]
        assert [label.split()[0] for label in labels] == ["sine", "cosine"]
        observation, _ = inner.reset(seed=1)
        sine, cosine = (
            observation["summary"][inner.observation_labels.index(label)] for label in labels
        )
        assert sine * sine + cosine * cosine == pytest.approx(1.0, abs=1e-6)
        (angle,) = circular_states(inner.problem)
        turned = inner.state.belief.states[:, angle] / np.pi
        seen = observation["states"][:, angle]
        assert np.allclose(np.mod(seen - turned + 1.0, 2.0), 1.0, atol=1e-5)

    def test_ranges_are_of_the_problem_alone(self) -> None:
        first, second = made(max_steps=200)[1], made(particles=60, max_steps=200)[1]
        first.reset(seed=1)
        assert np.array_equal(first.state_low, second.state_low)
        assert np.array_equal(first.state_high, second.state_high)
        assert (first.state_low < 0.0).all()  # the goal is inside
        assert (first.state_high > 0.0).all()


class TestRewards:
    @pytest.mark.parametrize(
        ("arguments", "each"),
        [
            ({}, -0.1),  # the problem's own
            ({"reward": "steps"}, -1.0),
            ({"problem": str(EXAMPLES / "corridor_doors.yaml")}, -1.0),  # it has none
        ],
    )
    def test_it_is_the_sum_over_the_moves(self, arguments: Any, each: float) -> None:
        environment, inner = made(**arguments)
        environment.reset(seed=3)
        _, reward, _, _, info = environment.step(0)
        assert info["steps"] == inner.planner.settings.sensing_interval + 1 > 1
        assert reward == pytest.approx(each * info["steps"])

    def test_a_sensing_action_has_its_price(self) -> None:
        arguments = {"problem": str(EXAMPLES / "priced_looks.yaml"), "reward": "steps"}
        environment, inner = made(**arguments)
        environment.reset(seed=3)
        moves = inner.planner.settings.sensing_interval + 1
        assert environment.step(0)[1] == -4.0 - moves
        assert environment.step(2)[1] == -moves

    @pytest.mark.parametrize("reward", ["problem", "steps"])
    def test_a_failure_ends_the_episode_and_costs_the_steps_that_are_left(
        self, reward: Any
    ) -> None:
        class Wall(PegInHole2D):
            def is_failure(self, states: Any) -> Any:
                return states[..., 0] < 3.0  # the peg starts at 4 and goes to 0

        environment, _ = made(problem=Wall.from_settings({}, {}), reward=reward)
        shown = episode(environment, lambda: 0, seed=1)
        _, _, terminated, truncated, info = shown[-1]
        assert (terminated, truncated, info["success"]) == (True, False, False)
        assert 0 < info["steps"] < 60
        total = sum(step[1] for step in shown[1:])
        assert (total == -60.0) if reward == "steps" else -0.2 * info["steps"] < total < 0.0


class TestWhatIsRefused:
    @pytest.mark.parametrize(
        ("arguments", "says"),
        [
            ({"problem": "peg"}, "peg"),
            ({"model": {"peg_with": 1.0}}, "peg_with"),
            ({"observation": "all"}, "observation is 'all'; allowed: summary, particles"),
            ({"reward": "one"}, "reward is 'one'; allowed: problem, steps"),
            ({"max_steps": 0}, "max_steps 0: allowed are whole numbers from 1"),
            ({"particles": 0}, "num_particles"),
            ({"sensing_interval": -1}, "sensing_interval"),
            ({"problem": "no_such_file.yaml"}, "no_such_file.yaml"),
            (
                {"problem": str(EXAMPLES / "priced_looks.yaml"), "model": {"price": 1.0}},
                "model is {'price': 1.0}; it goes with the name of a problem alone",
            ),
        ],
    )
    def test_an_argument_out_of_bounds(self, arguments: dict[str, Any], says: str) -> None:
        with pytest.raises((HoldfastError, ConfigurationError)) as caught:
            ProblemEnv(**{**SMALL, **arguments})
        assert says in str(caught.value)

    def test_a_step_without_a_reset(self) -> None:
        inner = ProblemEnv(**SMALL)
        with pytest.raises(gymnasium.error.ResetNeeded, match="no episode has begun"):
            inner.step(0)
        episode(inner, lambda: 0, seed=1)
        with pytest.raises(gymnasium.error.ResetNeeded, match="has ended"):
            inner.step(0)

    @pytest.mark.parametrize("begun", [False, True])
    @pytest.mark.parametrize(
        "refused",
        [
            {"options": {"trial": -1}},
            {"options": {"trial": "2"}},
            {"seed": -1},
            {"seed": 2**63},
            {"seed": 3, "options": {"trial": 2**32}},
        ],
    )
    def test_a_refused_reset_leaves_the_episode_as_it_was(
        self, begun: bool, refused: dict[str, Any]
    ) -> None:
        def following(env: ProblemEnv) -> list[Any]:
            if not begun:
                return [str(env.reset(seed=7))]
            return [str(env.step(1)), str(env.reset()), str(env.reset(options={"trial": 5}))]

        asked, other = ProblemEnv(**SMALL), ProblemEnv(**SMALL)
        if begun:
            asked.reset(seed=7)
            other.reset(seed=7)
        with pytest.raises(InvalidValueError):
            asked.reset(**refused)
        assert following(asked) == following(other)

    @pytest.mark.parametrize("action", [-1, 3, 1.0, True, "1", None])
    def test_a_refused_step_leaves_the_episode_as_it_was(self, action: Any) -> None:
        asked, other = ProblemEnv(**SMALL), ProblemEnv(**SMALL)
        for env in (asked, other):
            env.reset(seed=7)
        with pytest.raises(InvalidValueError, match="peg_in_hole_2d has 0 to 2"):
            asked.step(action)
        assert str(asked.step(1)) == str(other.step(1))

    def test_settings_of_python(self) -> None:
        settings = PlanningSettings(selector=SelectorSettings(method="fixed", sensing_action=2))
        inner = ProblemEnv("peg_in_hole_2d", settings=settings)
        inner.reset(seed=1)
        assert inner.choose() == 2
