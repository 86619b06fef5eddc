"""The peg, with what a real robot also has: encoders, and a switch that feels the ground.

So its moves show something, by which the belief is moved and weighted, and each decision has to
wait for it.
"""

from __future__ import annotations

import numpy as np

from holdfast import numerics
from holdfast.numerics.arrays import BoolArray, FloatArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.peg_in_hole_2d import PegInHole2D

_DEVIATION = 0.02
"""Standard deviation of a measured coordinate, in its unit."""

_IS_RIGHT = 0.9
"""How often the switch is."""

_CLOSE = 0.2
"""Height of the peg's lower end at which the switch closes, in metres."""


class PegWithEncoders(PegInHole2D):
    """Peg in hole in the plane, whose moves are measured."""

    name = "peg_with_encoders"

    def move_by_measurement(
        self, states: FloatArray, motion: FloatArray, stream: Stream
    ) -> FloatArray:
        """Draw the states after a measured motion."""
        moved: FloatArray = states + motion + _DEVIATION * stream.normal(states.shape)
        return moved

    def measure_motion(self, before: FloatArray, after: FloatArray, stream: Stream) -> FloatArray:
        """Measure a true move."""
        measured: FloatArray = after - before + _DEVIATION * stream.normal(before.shape)
        return measured

    def move_log_likelihood(
        self, states: FloatArray, action: FloatArray, observation: FloatArray
    ) -> FloatArray:
        """Return the log-likelihood of what the switch says."""
        del action
        agrees = self._closes(states) == (observation[0] > 0.5)
        return numerics.log(np.where(agrees, _IS_RIGHT, 1.0 - _IS_RIGHT))

    def sample_move_observation(
        self, state: FloatArray, action: FloatArray, stream: Stream
    ) -> FloatArray:
        """Draw what the switch says after a move: 1 where it is closed."""
        del action
        is_right = float(stream.uniform(1)[0]) < _IS_RIGHT
        return np.array([1.0 if bool(self._closes(state)) == is_right else 0.0])

    def _closes(self, states: FloatArray) -> BoolArray:
        height = states[..., 1] - 0.5 * self.model.peg_height
        return np.asarray(height < _CLOSE)
