"""A peg and a hole in the plane."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.numerics.randomness import Purpose, stream
from holdfast.problems.peg_in_hole_2d import PegInHole2D, PegInHole2DModel

fresh = partial(stream, 5, 0, 0, Purpose.INITIAL_BELIEF)  # anew at each call


def action(problem: Any, *state: float, stage: int = 0) -> list[float]:
    return [float(value) for value in problem.policy(np.array(state), stage)]


class TestPegInHole2D:
    problem = PegInHole2D()

    def test_policy_uses_more_coordinates_the_nearer_it_is(self) -> None:
        limit = np.arcsin(0.1)
        assert action(self.problem, 0.51, 3.0, 0.05) == [-0.51, 0.0, 0.0]
        assert action(self.problem, -0.49, 3.0, limit + 1e-6) == [0.49, 0.0, -limit - 1e-6]
        assert action(self.problem, 0.49, 3.0, limit - 1e-6) == [-0.49, -3.0, -limit + 1e-6]
        assert action(self.problem, 0.49, 3.0, -limit + 1e-6) == [-0.49, -3.0, limit - 1e-6]
        assert action(self.problem, 0.6, 3.0, 0.01) == [-0.6, 0.0, 0.0]

    def test_each_component_is_limited_on_its_own(self) -> None:
        np.testing.assert_array_equal(
            self.problem.execute(np.array([-3.0, 0.05, 0.2])), [-0.1, 0.05, 0.1]
        )

    def test_reward_is_minus_the_norm(self) -> None:
        reward = self.problem.reward(np.zeros(3), np.array([0.1, -0.1, 0.05]))
        assert reward == pytest.approx(-0.15)

    def test_goal(self) -> None:
        states = np.array([[0.09, -0.09, 0.0], [0.1, 0.0, 0.0], [0.0, -0.1, 0.0], [0.0, 0.11, 0.0]])
        assert self.problem.is_goal(states).tolist() == [True, False, False, False]

    def test_the_hole_fits_the_peg_with_the_tolerance(self) -> None:
        free = np.array([[0.09, -0.09, 0.0], [-0.09, 0.0, 0.0], [4.0, 1.0, 0.0]])
        blocked = np.array([[0.11, 0.0, 0.0], [0.0, -0.11, 0.0], [4.0, 0.99, 0.0]])
        assert not self.problem.world.collides(free).any()
        assert self.problem.world.collides(blocked).all()

    def test_observations(self) -> None:
        state = np.array([1.0, 2.0, 3.0])
        for i in range(3):
            assert self.problem.observation_mean(state, i).tolist() == [i + 1.0]
            assert self.problem.observation_variance(state, i).tolist() == [0.001]

    @pytest.mark.parametrize("sensing_action", [-1, 3])
    def test_a_sensing_action_that_is_none(self, sensing_action: int) -> None:
        with pytest.raises(InvalidValueError, match=f"sensing action: {sensing_action}"):
            self.problem.observation_mean(np.zeros(3), sensing_action)
        with pytest.raises(InvalidValueError, match=f"sensing action: {sensing_action}"):
            self.problem.observation_variance(np.zeros(3), sensing_action)

    def test_initial_spread(self) -> None:
        # x is the one coordinate that the ground hardly cuts off.
        states = self.problem.initial_states(fresh(), 20_000)
        assert states[:, 0].mean() == pytest.approx(4.0, abs=5 * np.sqrt(2.0 / 20_000))
        assert states[:, 0].var() == pytest.approx(2.0, rel=5 * np.sqrt(2.0 / 20_000))

    def test_resolution_is_the_geometric_mean_of_the_deviations(self) -> None:
        assert self.problem.resolution == pytest.approx(0.1)
        model = PegInHole2DModel(motion_cov=(0.01, 0.04, 0.0016))
        assert PegInHole2D(model).resolution == pytest.approx((0.1 * 0.2 * 0.04) ** (1 / 3))
        still = PegInHole2DModel(motion_cov=(0.0, 0.04, 0.0))
        assert PegInHole2D(still).resolution == pytest.approx(0.2)
        assert PegInHole2D(PegInHole2DModel(motion_cov=(0.0, 0.0, 0.0))).resolution > 0.0

    def test_a_start_in_the_ground_is_refused_with_its_keys(self) -> None:
        model = PegInHole2DModel(init_mean=(5.0, -20.0, 0.0), init_cov=(0.1, 0.1, 0.1))
        with pytest.raises(InvalidValueError, match=r"init_mean.*init_cov.*7 of 7"):
            PegInHole2D(model).initial_states(fresh(), 7)
