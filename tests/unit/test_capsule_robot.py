"""A disc in a maze."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.problems.capsule_robot import CapsuleRobot, CapsuleRobotModel, CapsuleRobotPlanner


def action(problem: Any, *state: float, stage: int = 0) -> list[float]:
    return [float(value) for value in problem.policy(np.array(state), stage)]


class TestCapsuleRobot:
    problem = CapsuleRobot()

    def test_policy_heads_for_the_target_of_the_stage(self) -> None:
        targets = [(4.5, 2.5), (4.5, 1.5), (0.5, 1.5), (0.5, 0.5), (4.5, 0.5)]
        for stage, (x, y) in enumerate(targets):
            assert action(self.problem, 1.0, 2.0, stage=stage) == pytest.approx([x - 1, y - 2])

    def test_gains_go_with_the_axis(self) -> None:
        problem = CapsuleRobot(state_space_planner=CapsuleRobotPlanner(gain_0=2.0, gain_1=3.0))
        assert action(problem, 4.0, 2.0, stage=0) == pytest.approx([2 * 0.5, 3 * 0.5])
        assert action(problem, 4.0, 2.0, stage=1) == pytest.approx([3 * 0.5, 2 * -0.5])

    def test_the_stage_advances_within_the_radius(self) -> None:
        assert self.problem.next_stage(np.array([4.41, 2.5]), 0) == 1
        assert self.problem.next_stage(np.array([4.39, 2.5]), 0) == 0
        assert self.problem.next_stage(np.array([4.43, 2.57]), 0) == 1
        assert self.problem.next_stage(np.array([4.42, 2.58]), 0) == 0
        assert self.problem.next_stage(np.array([4.5, 0.5]), 4) == 4

    def test_the_norm_is_limited(self) -> None:
        executed = self.problem.execute(np.array([[3.0, -4.0], [0.03, 0.04], [0.0, 0.0]]))
        np.testing.assert_allclose(executed, [[0.06, -0.08], [0.03, 0.04], [0.0, 0.0]], rtol=1e-15)

    def test_reward_looks_one_action_further(self) -> None:
        states = np.array([[2.0, 2.8], [2.0, 2.8], [2.0, 2.8]])
        actions = np.array([[0.0, 0.06], [0.0, 0.04], [0.1, 0.0]])
        assert self.problem.reward(states, actions).tolist() == [-1.0, 0.0, 0.0]

    def test_walls(self) -> None:
        beside = np.array([[0.16, 1.5], [2.0, 2.16], [2.0, 1.84], [4.16, 2.0], [0.84, 1.0]])
        assert not self.problem.world.collides(beside).any()
        into = np.array([[-0.02, 0], [0, -0.02], [0, 0.02], [-0.07, 0], [0.07, 0]])
        assert self.problem.world.collides(beside + into).all()

    def test_observations(self) -> None:
        state = np.array([1.0, 2.0])
        assert self.problem.observation_mean(state, 1).tolist() == [1.0, 2.0]
        assert self.problem.observation_variance(state, 0).tolist() == [1e-4, 1e-3]
        assert self.problem.observation_variance(state, 1).tolist() == [1e-3, 1e-4]
        with pytest.raises(InvalidValueError, match="sensing action: 2"):
            self.problem.observation_mean(state, 2)

    def test_goal(self) -> None:
        states = np.array([[4.5, 0.69], [4.5, 0.71], [4.35, 0.6]])
        assert self.problem.is_goal(states).tolist() == [True, False, True]

    def test_counts_must_match(self) -> None:
        with pytest.raises(InvalidValueError, match=r"model\.num_walls: 5.*walls has 6"):
            CapsuleRobot(CapsuleRobotModel(num_walls=5))
        with pytest.raises(InvalidValueError, match=r"num_via_points: 3.*via_points has 4"):
            CapsuleRobot(state_space_planner=CapsuleRobotPlanner(num_via_points=3))

    @pytest.mark.parametrize("end_1", [[1.0, 1.0], [0.0, 0.0]])
    def test_a_wall_must_be_along_an_axis(self, end_1: list[float]) -> None:
        walls = [{"end_0": [0.0, 0.0], "end_1": end_1}]
        with pytest.raises(InvalidValueError, match=r"model\.walls\[0\]"):
            CapsuleRobot.from_settings({"walls": walls}, {})
