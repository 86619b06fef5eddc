"""Problems in which a look costs as much as some steps, to compare when robots look.

The dock is the robot of ``examples/priced_looks.py``, which looks along one of two axes. The boat
has a sharp range finder for x and a weak GPS for y: what it can learn most about in one look is not
what it lacks. It was found by a new user, whose robot failed more often with the default than with
random sensing. The peg is the built-in one, with a price.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.problems.peg_in_hole_2d import PegInHole2D, PegInHole2DModel
from holdfast.problems.problem import ProblemBase


class _Point(ProblemBase):
    """A point robot on its way to the origin; states are (x, y) in metres, a step costs 1."""

    state_size = 2
    action_size = 2
    state_labels: Sequence[str] = ("x (m)", "y (m)")
    start: ClassVar[tuple[float, float]]
    start_deviation: ClassVar[float]
    motion_deviation: ClassVar[float]
    sensing_deviations: ClassVar[tuple[float, float]]
    step: ClassVar[float]
    goal_size: ClassVar[float]
    """Half the width of the goal."""

    def __init__(self, price: float = 0.0, resolution: float | None = None) -> None:
        self.sensing_costs = (price, price)
        self.resolution = self.motion_deviation if resolution is None else resolution
        self.motion_variance = np.full(2, self.motion_deviation**2)

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return np.asarray(self.start + self.start_deviation * stream.normal((count, 2)))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        return np.asarray(states + actions + self.motion_deviation * stream.normal(states.shape))

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        del states
        return np.array([self.sensing_deviations[sensing_action] ** 2])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        del stage
        return -states

    def limit_action(self, actions: FloatArray) -> FloatArray:
        return np.clip(actions, -self.step, self.step)

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        return np.full(np.broadcast_shapes(states.shape[:-1], actions.shape[:-1]), -1.0)

    def is_goal(self, states: FloatArray) -> BoolArray:
        return np.asarray((np.abs(states) < self.goal_size).all(axis=-1))


class Dock(_Point):
    """Both axes show equally well."""

    name = "dock"
    sensing_actions: Sequence[str] = ("x", "y")
    start = (2.0, 1.0)
    start_deviation = 0.7
    motion_deviation = 0.03
    sensing_deviations = (0.05, 0.05)
    step = 0.1
    goal_size = 0.1


class Boat(_Point):
    """A range finder shows x to 0.02 m, a GPS shows y to 1 m; the harbour is 0.6 m wide."""

    name = "boat"
    sensing_actions: Sequence[str] = ("range", "GPS")
    start = (6.0, 3.0)
    start_deviation = 1.0
    motion_deviation = 0.05
    sensing_deviations = (0.02, 1.0)
    step = 0.2
    goal_size = 0.3


class PricedPegModel(PegInHole2DModel, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The peg's section ``model``, with the price of a look in steps."""

    price: float = 0.0


class PricedPeg(PegInHole2D):
    """The peg in the plane, where a look has a price."""

    Model = PricedPegModel
    model: PricedPegModel

    @property
    def sensing_costs(self) -> Sequence[float]:
        """The price, the same of all three."""
        return (self.model.price,) * 3
