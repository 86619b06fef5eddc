"""A corridor with doors that all look the same: the textbook case of a belief with several modes.

The robot knows the map, and may be anywhere in it. It asks a detector whether there is a door on
its left or on its right, and is told wrong one time in ten. It is to stop at one place. Until it
has passed several doors, it may be at any of those that fit.

Source: Thrun, Burgard and Fox, "Probabilistic Robotics", 2005, section 1.3: the corridor. Ours: the
places of the doors, a detector for each side, and the goal.
"""

from __future__ import annotations

import numpy as np

from holdfast import numerics
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.problem import ProblemBase

__all__ = ["Corridor"]

_LENGTH = 20.0
_GOAL = 14.0
_GOAL_SIZE = 0.25
_STEP = 0.25
_MOTION_DEVIATION = 0.05
_WRONG = 0.1
_HALF_DOOR = 0.5
_DOORS = (np.array([2.0, 5.0, 12.5, 17.0]), np.array([4.0, 8.5, 14.5]))


class Corridor(ProblemBase):
    """A robot in a corridor; its state is its place in metres."""

    name = "corridor"
    state_size = action_size = 1
    sensing_actions = ("left", "right")
    state_labels = ("x (m)",)
    resolution = _MOTION_DEVIATION
    motion_variance = np.array([_MOTION_DEVIATION**2])

    def __init__(self) -> None:
        self._log_wrong, self._log_right = numerics.log([_WRONG, 1.0 - _WRONG])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        """Draw places anywhere."""
        return np.asarray(_LENGTH * stream.uniform((count, 1)))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        """Move with noise, up to the ends."""
        moved = states + actions + _MOTION_DEVIATION * stream.normal(states.shape)
        return np.clip(moved, 0.0, _LENGTH)

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        """Return that of the detector's answer: 1 is a door, 0 a wall."""
        right = self._at_door(states, sensing_action) == (observation[0] > 0.5)
        return np.asarray(np.where(right, self._log_right, self._log_wrong))

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        """Draw the detector's answer."""
        mistaken = stream.uniform((1,)) < _WRONG
        said = self._at_door(state, sensing_action) != mistaken
        return np.asarray(said, dtype=np.float64)

    def _at_door(self, states: FloatArray, side: int) -> BoolArray:
        return np.asarray((np.abs(states - _DOORS[side]) < _HALF_DOOR).any(axis=-1))

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Go to the goal."""
        del stage
        return np.asarray(_GOAL - states)

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Limit a step."""
        return np.clip(actions, -_STEP, _STEP)

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell which states are at the goal."""
        return np.asarray(np.abs(states[..., 0] - _GOAL) < _GOAL_SIZE)
