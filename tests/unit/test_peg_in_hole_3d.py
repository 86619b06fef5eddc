"""A peg and a hole in space."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.problems.peg_in_hole_3d import PegInHole3D, PegInHole3DModel


def action(problem: Any, *state: float, stage: int = 0) -> list[float]:
    return [float(value) for value in problem.policy(np.array(state), stage)]


class TestPegInHole3D:
    problem = PegInHole3D()

    def test_policy(self) -> None:
        assert action(self.problem, 2.0, -1.0, 3.0, 0.01, 0, 0) == [-2.0, 1.0, 0, 0, 0, 0]
        assert action(self.problem, 0.4, 0.4, 3.0, 0.01, 0, 0) == [-0.4, -0.4, 0, 0, 0, 0]
        tilted = action(self.problem, 0.3, 0.3, 3.0, 0.1, -0.05, 0.02)
        assert tilted == [-0.3, -0.3, 0.0, -0.1, 0.05, -0.02]
        upright = action(self.problem, 0.3, 0.3, 3.0, 0.05, -0.05, 0.02)
        assert upright == [-0.3, -0.3, -3.0, -0.05, 0.05, -0.02]

    def test_the_hole_fits_the_peg_with_the_tolerance(self) -> None:
        free = np.zeros((4, 6))
        free[1, 0] = free[2, 1] = 0.09
        free[3, 2] = -0.09
        assert not self.problem.world.collides(free).any()
        blocked = np.zeros((6, 6))
        blocked[0, 0] = blocked[1, 1] = 0.11
        blocked[2, 2] = -0.11
        blocked[3, 3] = blocked[4, 4] = blocked[5, 5] = 0.25
        assert self.problem.world.collides(blocked).all()

    def test_map(self) -> None:
        inside = np.zeros((4, 6))
        inside[:, 2] = 3.0
        inside[0, 0] = 5.49
        inside[1, 1] = -5.49
        inside[2, 2] = 4.99
        inside[3, :3] = [3.0, 3.0, 1.01]
        outside = inside.copy()
        outside[:3, :3] += [[0.02, 0, 0], [0, -0.02, 0], [0, 0, 0.02]]
        outside[3, 2] -= 0.02
        assert not self.problem.world.collides(inside).any()
        assert self.problem.world.collides(outside).all()

    def test_goal(self) -> None:
        states = np.zeros((4, 6))
        states[1, 0] = states[2, 1] = states[3, 2] = 0.11
        states[:, 3:] = 0.5
        assert self.problem.is_goal(states).tolist() == [True, False, False, False]

    def test_a_map_without_room_for_the_hole_is_refused(self) -> None:
        with pytest.raises(InvalidValueError, match=r"model\.map_dim"):
            PegInHole3D(PegInHole3DModel(map_dim=(0.5, 6.0, 6.0)))
