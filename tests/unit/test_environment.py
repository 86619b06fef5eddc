"""The simulated world: a function of its seed, its trial and what is done in it."""

import numpy as np
import pytest
from scipy import stats

from holdfast.config import registry
from holdfast.errors import HoldfastError, InvalidValueError, ProblemError
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.outcome import MoveResult
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import Problem
from holdfast.robot.environment import Environment, SimulatedEnvironment


@pytest.fixture(scope="module", params=registry.names())
def problem(request: pytest.FixtureRequest) -> Problem:
    built = registry.problem_class(request.param).from_settings({}, {})
    assert isinstance(built, Problem)
    return built


def small_action(problem: Problem) -> FloatArray:
    return problem.limit_action(np.full(problem.action_size, -0.05))


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
    for trial in range(150):
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


@pytest.mark.parametrize("sensing_action", [-1, 3])
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


def test_a_problem_without_its_state_size_hears_of_that_first() -> None:
    class Sizeless(PegInHole2D):
        state_size = 0

    with pytest.raises(ProblemError, match=r"^state_size of peg_in_hole_2d is 0: must be a whole"):
        SimulatedEnvironment(Sizeless(), 1, 0)
