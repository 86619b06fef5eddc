"""A peg and the holes of several plates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.problems.multitier_peg_in_hole_2d import (
    Hole,
    MultitierPegInHole2D,
    MultitierPegInHole2DModel,
)


def action(problem: Any, *state: float, stage: int = 0) -> list[float]:
    return [float(value) for value in problem.policy(np.array(state), stage)]


class TestMultitierPegInHole2D:
    problem = MultitierPegInHole2D()

    def test_policy_of_each_stage(self) -> None:
        assert action(self.problem, 0.0, 9.0, 0.02) == [4.0, 0.0, 0.0]
        assert action(self.problem, 3.6, 9.0, 0.3) == pytest.approx([0.4, 0.0, -0.3])
        # Down to y = 6 - 1 - 0.1 - 2.
        assert action(self.problem, 3.6, 9.0, 0.02) == pytest.approx([0.4, 2.9 - 9.0, -0.02])
        assert action(self.problem, 0.0, 3.0, 0.02, stage=1) == [-4.0, 0.0, 0.0]
        assert action(self.problem, 0.1, -4.0, 0.0, stage=2) == pytest.approx([-0.1, -5.1, 0.0])

    def test_the_stage_advances_below_the_plate(self) -> None:
        above, below = np.array([4.0, 2.91, 0.0]), np.array([4.0, 2.89, 0.0])
        assert self.problem.next_stage(above, 0) == 0
        assert self.problem.next_stage(below, 0) == 1
        assert self.problem.next_stage(below, 1) == 1  # the current stage's hole decides
        assert self.problem.next_stage(np.array([0.0, -11.0, 0.0]), 2) == 2  # the last one
        stages = np.array([0, 1, 2])
        states = np.tile([0.0, -3.2, 0.0], (3, 1))
        np.testing.assert_array_equal(self.problem.next_stage(states, stages), [1, 2, 2])

    def test_plates_holes_and_walls(self) -> None:
        holes = np.array([[4.05, 6.0, 0.0], [-4.05, 0.0, 0.0], [0.05, -6.0, 0.0]])
        assert not self.problem.world.collides(holes).any()
        aside = np.array([[4.15, 6.0, 0.0], [-4.15, 0.0, 0.0], [0.15, -6.0, 0.0]])
        assert self.problem.world.collides(aside).all()
        # The first plate is 1 thick, the peg 2 high.
        clear_of_it = np.array([[-9.0, 7.51, 0.0], [-9.0, 4.49, 0.0]])
        assert not self.problem.world.collides(clear_of_it).any()
        into_it = np.array([[-9.0, 7.49, 0.0], [-9.0, 4.51, 0.0]])
        assert self.problem.world.collides(into_it).all()
        walls = np.array([[11.51, 9.0, 0.0], [-11.51, 9.0, 0.0], [0.0, 11.01, 0.0], [0, -11.01, 0]])
        assert self.problem.world.collides(walls).all()
        assert not self.problem.world.collides(walls * [0.99, 0.99, 1.0]).any()

    def test_goal_is_below_the_last_hole(self) -> None:
        states = np.array([[0.05, -6.01, 0.0], [0.05, -5.99, 0.0], [0.11, -6.01, 0.0]])
        assert self.problem.is_goal(states).tolist() == [True, False, False]

    def test_a_hole_outside_of_the_map_is_refused(self) -> None:
        model = MultitierPegInHole2DModel(holes=(Hole(center=(0, 0)), Hole(center=(11.8, 6))))
        with pytest.raises(InvalidValueError, match=r"model\.holes\[1\].*map_dim"):
            MultitierPegInHole2D(model)

    def test_an_empty_map_is_refused(self) -> None:
        model = MultitierPegInHole2DModel(map_dim=(12, -12, -12, 12))
        with pytest.raises(InvalidValueError, match=r"model\.map_dim"):
            MultitierPegInHole2D(model)
