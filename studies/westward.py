"""A robot that drives west, where its heading is pi as much as -pi.

It is here as a problem with an angle that wraps; ``examples/wrapping_heading.py`` is the same for
readers.
"""

from __future__ import annotations

import numpy as np

from holdfast import numerics
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.problem import ProblemBase

__all__ = ["Westward"]

_START = np.array([6.0, 0.0, 3.1])
_START_DEVIATION = np.array([0.5, 0.5, 0.4])
_MOTION_DEVIATION = np.array([0.1, 0.02])
_GOAL_SIZE = 0.25


class Westward(ProblemBase):
    """States are (x, y, heading), actions a turn and a way ahead; the goal is the origin."""

    name = "westward"
    state_size = 3
    action_size = 2
    sensing_actions = ("heading", "x", "y")
    state_labels = ("x (m)", "y (m)", "heading (rad)")
    resolution = 0.1
    motion_variance = _MOTION_DEVIATION**2
    circular = (2,)
    circular_observations = ((0,), (), ())

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        """Draw states around the start."""
        return _wrapped(_START + _START_DEVIATION * stream.normal((count, 3)))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        """Turn, then drive."""
        noise = _MOTION_DEVIATION * stream.normal((*states.shape[:-1], 2))
        turn, ahead = np.moveaxis(actions + noise, -1, 0)
        heading = states[..., 2] + turn
        x = states[..., 0] + ahead * numerics.cos(heading)
        y = states[..., 1] + ahead * numerics.sin(heading)
        return _wrapped(np.stack([x, y, heading], axis=-1))

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the coordinate that is looked at."""
        coordinate = (2, 0, 1)[sensing_action]
        return states[..., coordinate : coordinate + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return that of 0.1 m or rad."""
        del states, sensing_action
        return np.array([0.01])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Turn to the goal, and drive once it is ahead."""
        del stage
        x, y = -states[..., 0], -states[..., 1]
        turn = numerics.wrapped(numerics.arctan2(y, x) - states[..., 2])
        ahead = np.where(np.abs(turn) < 0.5, np.sqrt(x * x + y * y), 0.0)
        return np.stack([turn, ahead], axis=-1)

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Limit turn and way; there is no way back."""
        return np.clip(actions, [-0.3, 0.0], [0.3, 0.2])

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell which states are at the origin."""
        x, y = states[..., 0], states[..., 1]
        return np.asarray(x * x + y * y < _GOAL_SIZE * _GOAL_SIZE)


def _wrapped(states: FloatArray) -> FloatArray:
    states[..., 2] = numerics.wrapped(states[..., 2])
    return states
