"""The simulated world: a function of its seed, its trial and what is done in it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats

from holdfast.arrays import FloatArray
from holdfast.config.loader import load
from holdfast.errors import (
    ConfigurationError,
    EnvironmentFailedError,
    HoldfastError,
    InvalidValueError,
    ProblemError,
)
from holdfast.outcome import MoveResult
from holdfast.problems import registry
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import Problem
from holdfast.randomness import Purpose, Stream, stream
from holdfast.robot.environment import (
    CountingEnvironment,
    Environment,
    EnvironmentMaker,
    SimulatedEnvironment,
    load_environment,
)

EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module", params=registry.names())
def problem(request: pytest.FixtureRequest) -> Problem:
    built = registry.problem_class(request.param).from_settings({}, {})
    assert isinstance(built, Problem)
    return built


def small_action(problem: Problem) -> FloatArray:
    return problem.execute(np.full(problem.action_size, -0.05))


def test_it_is_an_environment(problem: Problem) -> None:
    environment = SimulatedEnvironment(problem, 1, 2)
    assert isinstance(environment, Environment)
    assert environment.state.shape == (problem.state_size,)
    assert environment.step == 0
    assert environment.is_done() is False
    reward = environment.perform(small_action(problem))
    assert type(reward) is float
    assert environment.step == 1
    observation = environment.perform_sensing(0)
    assert observation.dtype == np.float64
    assert np.isfinite(observation).all()


def test_the_same_is_done_the_same_happens(problem: Problem) -> None:
    def history(seed: int, trial: int) -> list[bytes]:
        environment = SimulatedEnvironment(problem, seed, trial)
        seen = [environment.state.tobytes()]
        for step in range(6):
            seen.append(environment.perform_sensing(step % 2).tobytes())
            reward = environment.perform(small_action(problem))
            assert not isinstance(reward, MoveResult)
            seen.append(np.float64(reward).tobytes())
            seen.append(environment.state.tobytes())
        return seen

    assert history(1, 2) == history(1, 2)
    assert history(1, 2)[0] != history(1, 3)[0]
    assert history(1, 2)[0] != history(2, 2)[0]


def test_sensing_does_not_change_how_the_world_moves(problem: Problem) -> None:
    quiet, watched = (SimulatedEnvironment(problem, 3, 1) for _ in range(2))
    for step in range(5):
        for sensing_action in range(step % (len(problem.sensing_actions) + 1)):
            watched.perform_sensing(sensing_action)
        quiet.perform(small_action(problem))
        watched.perform(small_action(problem))
        assert watched.state.tobytes() == quiet.state.tobytes()


def test_sensing_again_shows_the_same(problem: Problem) -> None:
    """A repeated request, after a reply was lost, must not be another look."""
    environment = SimulatedEnvironment(problem, 3, 1)
    noise = []
    for _ in range(3):
        shown = environment.perform_sensing(1)
        assert environment.perform_sensing(1).tobytes() == shown.tobytes()
        noise.append(shown - problem.observation_mean(environment.state, 1))
        environment.perform(small_action(problem))
    # At the next step the noise is another, and by far more than it is rounded.
    assert np.abs(np.diff(noise, axis=0)).min() > 1e-9


def test_the_world_is_not_what_the_planner_believes(problem: Problem) -> None:
    """Its streams are its own, so no particle of the belief is the truth by construction."""
    world = SimulatedEnvironment(problem, 5, 0)
    believed = problem.initial_states(stream(5, 0, 0, Purpose.INITIAL_BELIEF), 50)
    assert not (believed == world.state).all(axis=1).any()
    predicted = problem.move(
        world.state, small_action(problem), stream(5, 0, 0, Purpose.PREDICTION)
    )
    world.perform(small_action(problem))
    assert predicted.tobytes() != world.state.tobytes()


def test_observations_follow_the_model(problem: Problem) -> None:
    """Normal about the mean with the stated variance, by Kolmogorov and Smirnov at 1e-6."""
    sensing_actions = len(problem.sensing_actions)
    residuals: list[list[float]] = [[] for _ in range(sensing_actions)]
    for trial in range(400):
        environment = SimulatedEnvironment(problem, 6, trial)
        for j in range(sensing_actions):
            mean = problem.observation_mean(environment.state, j)
            deviation = np.sqrt(problem.observation_variance(environment.state, j))
            residuals[j] += ((environment.perform_sensing(j) - mean) / deviation).tolist()
    for sample in residuals:
        assert stats.kstest(sample, "norm").pvalue > 1e-6


def test_a_problem_may_draw_its_observations_itself() -> None:
    class Rounded(PegInHole2D):
        def sample_observation(
            self, state: FloatArray, sensing_action: int, stream: Stream
        ) -> FloatArray:
            return np.round(state[sensing_action : sensing_action + 1]) + stream.uniform(1)

    environment = SimulatedEnvironment(Rounded(), 1, 0)
    shown = environment.perform_sensing(1)
    noise = stream(1, 0, 0, Purpose.WORLD_OBSERVATION).uniform(1)
    assert shown.tolist() == (np.round(environment.state[1:2]) + noise).tolist()


def test_goal_and_reward() -> None:
    environment = SimulatedEnvironment(PegInHole2D(), 1, 0)
    assert environment.perform(np.array([0.03, 0.0, 0.04])) == pytest.approx(-0.05, abs=1e-15)
    environment.state = np.array([0.05, -0.05, 0.0])
    assert environment.is_done() is True


@pytest.mark.parametrize("sensing_action", [-1, 3, 10**9])
def test_sensing_action_out_of_range(sensing_action: int) -> None:
    environment = SimulatedEnvironment(PegInHole2D(), 1, 0)
    with pytest.raises(
        InvalidValueError, match=rf"sensing action {sensing_action}: peg_in_hole_2d has 0 to 2"
    ):
        environment.perform_sensing(sensing_action)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_task_action_not_finite(problem: Problem, bad: float) -> None:
    environment = SimulatedEnvironment(problem, 1, 0)
    before = environment.state.tobytes()
    with pytest.raises(InvalidValueError):
        environment.perform(np.full(problem.action_size, bad))
    assert environment.state.tobytes() == before
    assert environment.step == 0


def test_a_move_that_fails_leaves_the_world_as_it_was() -> None:
    class Unpaid(PegInHole2D):
        paid = False

        def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
            return super().reward(states, actions) if self.paid else np.full(2, np.nan)

    problem = Unpaid()
    world, other = SimulatedEnvironment(problem, 1), SimulatedEnvironment(problem, 1)
    action = np.array([0.1, 0.0, 0.0])
    for wrong in (action, np.zeros(2), "0.1", [True, 0.0, 0.0]):
        with pytest.raises((HoldfastError, ValueError)):
            world.perform(wrong)  # type: ignore[arg-type]
    problem.paid = True
    assert world.step == 0
    assert world.perform(action) == other.perform(action)
    assert world.state.tolist() == other.state.tolist()


@pytest.mark.parametrize(("seed", "trial"), [(-1, 0), (2**63, 0), (0, -1), (0, 2**32)])
def test_seed_and_trial_out_of_range(seed: int, trial: int) -> None:
    with pytest.raises(InvalidValueError, match=r"(seed|trial) (-1|\d+).*: allowed are whole numb"):
        SimulatedEnvironment(PegInHole2D(), seed, trial)


class TestAfter:
    def test_it_stands_where_the_actions_led_to(self, problem: Problem) -> None:
        actions = [small_action(problem) * scale for scale in (1.0, 0.5, 0.25, 1.0)]
        lived = SimulatedEnvironment(problem, 4, 2)
        for action in actions[:3]:
            lived.perform_sensing(0)
            lived.perform(action)
        again = SimulatedEnvironment.after(problem, 4, 2, actions[:3])
        assert again.steps_performed() == 3
        assert again.state.tobytes() == lived.state.tobytes()
        assert again.perform_sensing(1).tobytes() == lived.perform_sensing(1).tobytes()
        assert again.perform(actions[3]) == lived.perform(actions[3])
        assert again.state.tobytes() == lived.state.tobytes()

    def test_after_nothing_it_is_at_the_start(self, problem: Problem) -> None:
        again = SimulatedEnvironment.after(problem, 4, 2, [])
        assert again.state.tobytes() == SimulatedEnvironment(problem, 4, 2).state.tobytes()
        assert again.steps_performed() == 0
        assert isinstance(again, CountingEnvironment)


ROBOTS = """\
class Robot:
    made = []

    def __init__(self, port=7500, *, places=(), trial, resumed, problem):
        self.port, self.places, self.trial = port, places, trial
        self.resumed, self.problem = resumed, problem
        self.made.append(self)

    def perform_sensing(self, sensing_action): return [0.0]
    def perform(self, task_action): return None
    def is_done(self): return False


class Plain:
    perform_sensing = perform = is_done = lambda self, *_: None


class AnyArguments(Plain):
    def __init__(self, **options): self.options = options


class Late:
    def __init__(self):
        self.perform_sensing = self.perform = self.is_done = print


class Half:
    is_done = True
    def perform(self, task_action): return None


class Needy(Plain):
    def __init__(self, port): pass


robot = Robot
number = 3
"""


class TestLoadEnvironment:
    @pytest.fixture
    def loaded(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> Iterator[Callable[..., EnvironmentMaker]]:
        """Load what is named, beside a configuration file."""
        monkeypatch.setattr(sys, "path", [*sys.path])
        (tmp_path / "robots.py").write_text(ROBOTS)
        (tmp_path / "broken_robots.py").write_text("1 + 'one'\n")
        (tmp_path / "lonely_robots.py").write_text("import absent_library\n")

        def load_one(name: str, **settings: object) -> EnvironmentMaker:
            section = json.dumps({"object": name, **settings})
            (tmp_path / "run.yaml").write_text(
                f"problem: peg_in_hole_2d\nsimulator: {{seed: 5}}\nenvironment: {section}\n"
            )
            return load_environment(load(tmp_path / "run.yaml"))

        yield load_one
        for name in ("robots", "broken_robots", "lonely_robots"):
            sys.modules.pop(name, None)

    def test_without_a_name_the_world_is_simulated(self) -> None:
        maker = load_environment(load(EXAMPLES / "peg_in_hole_2d.yaml", seed=8))
        assert maker.simulated
        first = maker(3)
        assert isinstance(first, SimulatedEnvironment)
        expected = SimulatedEnvironment(maker.problem, 8, 3)
        assert first.state.tobytes() == expected.state.tobytes()
        action = small_action(maker.problem)
        expected.perform(action)
        again = maker(3, resumed=True, performed=[action])
        assert isinstance(again, SimulatedEnvironment)
        assert again.state.tobytes() == expected.state.tobytes()

    def test_one_of_ones_own_is_made_anew_for_each_trial(
        self, loaded: Callable[..., EnvironmentMaker]
    ) -> None:
        maker = loaded("robots:Robot", arguments={"port": 3, "places": [1]}, timeout_ms=20)
        assert not maker.simulated
        assert (maker.name, maker.timeout_ms) == ("robots:Robot", 20.0)
        first: Any = maker(0)
        first.places.append(2)
        second: Any = maker(1, resumed=True, performed=[np.zeros(3)])
        assert sys.modules["robots"].Robot.made == [first, second]
        assert (first.port, first.trial, first.resumed) == (3, 0, False)
        assert (second.port, second.trial, second.resumed) == (3, 1, True)
        assert second.places == [1]
        assert first.problem is second.problem is maker.problem

    def test_a_constructor_gets_only_what_it_names(
        self, loaded: Callable[..., EnvironmentMaker]
    ) -> None:
        assert isinstance(loaded("robots:Plain")(0), Environment)
        environment: Any = loaded("robots:AnyArguments", arguments={"port": 3})(0)
        assert environment.options == {"port": 3}

    def test_methods_may_be_made_by_the_constructor(
        self, loaded: Callable[..., EnvironmentMaker]
    ) -> None:
        assert isinstance(loaded("robots:Late")(0), Environment)

    def test_a_package_may_register_one(
        self, tmp_path: Path, loaded: Callable[..., EnvironmentMaker]
    ) -> None:
        package = tmp_path / "turtle_robots-1.0.dist-info"
        package.mkdir()
        (package / "METADATA").write_text("Metadata-Version: 2.1\nName: turtle-robots\n")
        (package / "entry_points.txt").write_text(
            "[holdfast.environments]\nturtle = robots:Plain\n"
        )
        sys.path.insert(0, str(tmp_path))
        assert type(loaded("turtle")(0)).__name__ == "Plain"

    def test_it_lacks_a_method(self, loaded: Callable[..., EnvironmentMaker]) -> None:
        maker = loaded("robots:Half")
        with pytest.raises(
            EnvironmentFailedError,
            match=r"robots:Half is no environment: it lacks perform_sensing and is_done; it needs",
        ):
            maker(0)

    @pytest.mark.parametrize(
        ("name", "arguments", "expected"),
        [
            ("robots:Robt", {}, r"environment.object: robots:Robt: .* did you mean Robot"),
            ("robots:number", {}, "is not a class but int"),
            ("turtle", {}, r"environment.object: turtle is not a registered name \(registered: "),
            ("robots", {}, "robots is not a registered name; did you mean robots:"),
            ("robots.Plain", {}, r"did you mean robots:Plain\? "),
            ("robots.py", {}, "did you mean robots:"),
            ("lonely_robots:Robot", {}, "cannot be imported .*No module named 'absent_library'"),
            (
                "broken_robots:Robot",
                {},
                r"environment.object: broken_robots:Robot raised TypeError: (.|\n)*1 \+ 'one'",
            ),
            (
                "robots:Robot",
                {"prt": 3},
                "environment.arguments.prt is no argument of robots:Robot; did you mean port.\n"
                "allowed: port, places$",
            ),
            ("robots:Robot", {"trial": 3}, "environment.arguments.trial cannot be set: holdfast"),
            ("robots:Plain", {"port": 3}, "arguments.port is no argument of robots:Plain\nallowed"),
            ("robots:Needy", {}, "environment.arguments do not suit robots:Needy.*'port'"),
        ],
    )
    def test_what_is_refused(
        self,
        name: str,
        arguments: dict[str, object],
        expected: str,
        loaded: Callable[..., EnvironmentMaker],
    ) -> None:
        with pytest.raises(ConfigurationError, match=expected) as caught:
            loaded(name, arguments=arguments)
        assert "run.yaml: environment." in str(caught.value)


def test_a_problem_without_its_state_size_hears_of_that_first() -> None:
    class Sizeless(PegInHole2D):
        state_size = 0

    with pytest.raises(ProblemError, match=r"^state_size of peg_in_hole_2d is 0: must be a whole"):
        SimulatedEnvironment(Sizeless(), 1, 0)
