"""A small problem that keeps its contract, for tests of what happens when one does not."""

from typing import Any

import numpy as np

from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.problems.problem import ProblemBase

SETTINGS = PlanningSettings(particle_filter=ParticleFilterSettings(num_particles=30))


class Line(ProblemBase):
    """A point on a line with two coordinates, of which each sensing action shows one."""

    name = "line"
    state_size = 2
    action_size = 1
    sensing_actions: Any = ("first", "second")
    motion_variance = np.array([0.01])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return stream.normal((count, 2))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        return states + actions + 0.1 * stream.normal(states.shape)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.array([0.01])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return -states[..., :1]

    def is_goal(self, states: FloatArray) -> Any:
        return np.abs(states[..., 0]) < 0.1


class Beacon(Line):
    """A robot on a line that looks for a beacon, which does not move."""

    state_labels: Any = ("robot (m)", "beacon (m)")
    noise = np.array([0.1, 0.0])

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        moved = states + self.noise * stream.normal(states.shape)
        moved[..., :1] += actions
        return moved

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return np.clip(states[..., 1:] - states[..., :1], -0.1, 0.1)

    def is_goal(self, states: FloatArray) -> Any:
        return np.zeros(states.shape[:-1], dtype=bool)
