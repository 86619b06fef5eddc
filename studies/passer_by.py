"""A robot goes to its dock while somebody walks by, about whom it knows less than about itself.

It can look along either axis, or at the passer-by, who does not matter. Of all that it could look
at, that look shows most about the state and nothing about what to do. It also leaves few particles:
they were spread over all places where the passer-by may be, and only those near the right one
survive. Whoever takes few particles for certainty looks there.

It was found by trying out holdfast on a first problem of one's own: with a hundred particles, the
mixture's bound never looks anywhere else.
"""

from __future__ import annotations

import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.problem import ProblemBase, Scene

_START = (3.0, 1.0, 0.0)
_START_DEVIATION = (1.0, 0.5, 4.0)
_MOTION_DEVIATION = (0.05, 0.05, 0.5)
_OBSERVATION_VARIANCE = 0.02
_STEP = 0.1
_DOCK_SIZE = 0.15


class PasserBy(ProblemBase):
    """States are (x, y) of the robot and p of the passer-by, in metres; the dock is the origin.

    What differs in practice is what the noise of a step does not blur: 0.05 m of the robot, and
    0.5 m of the passer-by, who wanders ten times as far.
    """

    name = "passer_by"
    state_size = 3
    action_size = 2
    sensing_actions = ("x", "y", "passer-by")
    state_labels = ("x (m)", "y (m)", "passer-by (m)")
    resolution = _MOTION_DEVIATION[0]
    state_resolution = np.array(_MOTION_DEVIATION)
    motion_variance = np.square(_MOTION_DEVIATION[:2])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        """Draw both around where they are thought to be."""
        spread = np.array(_START_DEVIATION) * stream.normal((count, self.state_size))
        return np.asarray(np.array(_START) + spread)

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        """Move the robot, with noise; the passer-by wanders."""
        moved = states + np.array(_MOTION_DEVIATION) * stream.normal(states.shape)
        moved[..., :2] += actions
        return np.asarray(moved)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the coordinate that is looked at."""
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the same for all looks."""
        del states, sensing_action
        return np.array([_OBSERVATION_VARIANCE])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Go to the dock, whoever passes by."""
        del stage
        return -states[..., :2]

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Limit each coordinate of a step on its own."""
        return np.clip(actions, -_STEP, _STEP)

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return minus the length of the way."""
        del states
        x, y = actions[..., 0], actions[..., 1]
        return np.asarray(-np.sqrt(x * x + y * y))

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell which robots are at the dock."""
        return np.asarray((np.abs(states[..., :2]) < _DOCK_SIZE).all(axis=-1))

    def scene(self) -> Scene:
        """Return the plane with the dock."""
        return Scene((0, 1), (-2.0, -3.0, 7.0, 5.0), goal=(0.0, 0.0))
