"""A problem with a general likelihood: a range finder that now and then shows just anything.

Looking along x or y shows that coordinate, but one reading in five comes from anywhere between the
walls. No Gaussian says so, hence the problem gives ``log_likelihood`` and ``sample_observation``.
"""

from __future__ import annotations

import numpy as np

from holdfast import numerics
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.problem import ProblemBase

OUTLIERS = 0.2
WALLS = (-10.0, 10.0)
VARIANCE = 0.01


class SonarRoom(ProblemBase):
    """A point robot that drives to the origin; states are (x, y) in metres."""

    name = "sonar_room"
    state_size = action_size = 2
    sensing_actions = ("look along x", "look along y")
    state_labels = ("x (m)", "y (m)")
    resolution = 0.05
    motion_variance = np.array([0.0025, 0.0025])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return np.array([3.0, 2.0]) + np.array([1.0, 0.5]) * stream.normal((count, 2))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        return states + actions + 0.05 * stream.normal(states.shape)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        raise AssertionError("a general problem is asked for its likelihood alone")

    observation_variance = observation_mean

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        away = states[:, sensing_action] - observation[0]
        gaussian = numerics.exp(-0.5 * away * away / VARIANCE) / np.sqrt(2.0 * np.pi * VARIANCE)
        return numerics.log((1.0 - OUTLIERS) * gaussian + OUTLIERS / (WALLS[1] - WALLS[0]))

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        reading = state[sensing_action] + np.sqrt(VARIANCE) * stream.normal(1)
        anywhere = WALLS[0] + (WALLS[1] - WALLS[0]) * stream.substream(1).uniform(1)
        return np.where(stream.substream(2).uniform(1) < OUTLIERS, anywhere, reading)

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return -states

    def limit_action(self, actions: FloatArray) -> FloatArray:
        return np.clip(actions, -0.1, 0.1)

    def is_goal(self, states: FloatArray) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        near: np.ndarray[tuple[int, ...], np.dtype[np.bool_]] = np.abs(states) < 0.1
        return near[..., 0] & near[..., 1]
