"""A peg and a hole in the plane."""

from functools import partial

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.numerics.randomness import Purpose, stream
from holdfast.problems.peg_in_hole_2d import PegInHole2D, PegInHole2DModel

fresh = partial(stream, 5, 0, 0, Purpose.INITIAL_BELIEF)  # anew at each call


class TestPegInHole2D:
    problem = PegInHole2D()

    @pytest.mark.parametrize("sensing_action", [-1, 3])
    def test_a_sensing_action_that_is_none(self, sensing_action: int) -> None:
        with pytest.raises(InvalidValueError, match=f"sensing action: {sensing_action}"):
            self.problem.observation_mean(np.zeros(3), sensing_action)
        with pytest.raises(InvalidValueError, match=f"sensing action: {sensing_action}"):
            self.problem.observation_variance(np.zeros(3), sensing_action)

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
