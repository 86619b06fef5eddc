"""A disc in a maze."""

from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.problems.capsule_robot import CapsuleRobot, CapsuleRobotModel, CapsuleRobotPlanner


def action(problem: Any, *state: float, stage: int = 0) -> list[float]:
    return [float(value) for value in problem.policy(np.array(state), stage)]


class TestCapsuleRobot:
    problem = CapsuleRobot()

    def test_gains_go_with_the_axis(self) -> None:
        problem = CapsuleRobot(state_space_planner=CapsuleRobotPlanner(gain_0=2.0, gain_1=3.0))
        assert action(problem, 4.0, 2.0, stage=0) == pytest.approx([2 * 0.5, 3 * 0.5])
        assert action(problem, 4.0, 2.0, stage=1) == pytest.approx([3 * 0.5, 2 * -0.5])

    def test_reward_looks_one_action_further(self) -> None:
        states = np.array([[2.0, 2.8], [2.0, 2.8], [2.0, 2.8]])
        actions = np.array([[0.0, 0.06], [0.0, 0.04], [0.1, 0.0]])
        assert self.problem.reward(states, actions).tolist() == [-1.0, 0.0, 0.0]

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
