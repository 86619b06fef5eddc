"""A plane with light at one end: where a robot sees well and where it has to go are two places.

The robot knows roughly where it is. In the dark its sensors show little; so it goes to the light
first, finds out where it is, and then goes to its goal in the dark. On the way to the light only
one coordinate tells it how far to go; what the other one is matters after that.

Source: Platt, Tedrake, Kaelbling and Lozano-Perez, "Belief space planning assuming maximum
likelihood observations", RSS 2010, section V-A: the place of the light, the variance of an
observation, start and goal. Ours: two sensing actions of a coordinate each, noisy motion, steps of
a limited length, and the policy.
"""

from __future__ import annotations

import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.problem import ProblemBase, Scene

_LIGHT_X = 5.0
_START = (2.0, 2.0)
_START_VARIANCE = 5.0
_MOTION_DEVIATION = 0.03
_LEAST_VARIANCE = 1e-3
_STEP = 0.1
_AT_THE_LIGHT = 0.2
_GOAL_SIZE = 0.15


class LightDark(ProblemBase):
    """A point robot in the plane; states are (x, y) in metres, the goal is the origin.

    The resolution is what the noise of a step blurs, the same in both coordinates.
    """

    name = "light_dark"
    state_size = 2
    action_size = 2
    sensing_actions = ("x", "y")
    state_labels = ("x (m)", "y (m)")
    num_stages = 2  # to the light, then to the goal
    resolution = _MOTION_DEVIATION
    motion_variance = np.full(2, _MOTION_DEVIATION**2)

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        """Draw states around the start."""
        spread = np.sqrt(_START_VARIANCE) * stream.normal((count, 2))
        return np.asarray(np.array(_START) + spread)

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        """Move freely, with noise."""
        return np.asarray(states + actions + _MOTION_DEVIATION * stream.normal(states.shape))

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the coordinate that is looked at."""
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return half the squared distance from the light, and a little."""
        del sensing_action
        away = states[..., 0:1] - _LIGHT_X
        return np.asarray(0.5 * away * away + _LEAST_VARIANCE)

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Go to the light, whatever y is; then to the goal."""
        lit = np.expand_dims(np.asarray(stage) > 0, -1)
        to_light = np.stack([_LIGHT_X - states[..., 0], np.zeros_like(states[..., 1])], axis=-1)
        return np.where(lit, -states, to_light)

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        """Advance when the estimate is at the light."""
        there = np.abs(estimates[..., 0] - _LIGHT_X) < _AT_THE_LIGHT
        following = np.where(there, 1, stage)
        return following if following.ndim else int(following)

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Limit each coordinate of a step on its own."""
        return np.clip(actions, -_STEP, _STEP)

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return minus the length of the way."""
        del states
        x, y = actions[..., 0], actions[..., 1]
        return np.asarray(-np.sqrt(x * x + y * y))

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell which states are at the origin."""
        return np.asarray((np.abs(states) < _GOAL_SIZE).all(axis=-1))

    def scene(self) -> Scene:
        """Return the plane with the goal and the light."""
        return Scene((0, 1), (-4.0, -4.0, 8.0, 8.0), goal=(0.0, 0.0), points=[(_LIGHT_X, 0.0)])
