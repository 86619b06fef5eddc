"""A peg, a hole in the ground, and a robot that does not see where the peg is.

The planner brings the peg over the hole, then upright, then lowers it; what it must know changes
on the way, and that is what makes the choice of a sensing action worth a thought. Far from the hole
only x matters to the next action; above it, the angle; when the peg goes in, the height.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import msgspec
import numpy as np

from holdfast import _kernel
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.geometry import FAR, KernelObject, RectangleWorld
from holdfast.problems.problem import Scene
from holdfast.problems.rigid_body import (
    Coordinate,
    Length,
    PegPlanner,
    PegProblem,
    PositiveVariance,
    Tolerance,
    Variance,
    rectangle,
    upright_limit,
    validated,
)


class PegInHole2DModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``model``; docs/problems.md has the meaning and the unit of each key."""

    state_size: Literal[3] = 3
    peg_width: Length = 1.0
    peg_height: Length = 2.0
    hole_tolerance: Length = 0.1
    init_mean: tuple[Coordinate, Coordinate, Coordinate] = (4.0, 2.0, 0.0)
    init_cov: tuple[Variance, Variance, Variance] = (2.0, 1.0, 1.57)
    motion_cov: tuple[Variance, Variance, Variance] = (0.01, 0.01, 0.01)
    sensing_cov: PositiveVariance = 0.001
    collision_tol: Tolerance = 0.001


class PegInHole2D(PegProblem):
    """Put a peg into a hole in the ground, in the plane.

    The state is (x, y, θ) of the peg's centre. The ground is at y = 0; the hole is as wide as the
    peg plus the tolerance on either side, and its floor is the tolerance below half the peg's
    height. The goal is reached when the peg is half-way in: x and y are below the tolerance in
    size. The policy turns the peg once its centre is within half its width of the hole's axis.

    Raises
    ------
    InvalidValueError
        If a setting is out of bounds.
    """

    Model: ClassVar[type[PegInHole2DModel]] = PegInHole2DModel
    model: PegInHole2DModel

    name = "peg_in_hole_2d"
    state_size = 3
    action_size = 3
    sensing_actions: Sequence[str] = ("x", "y", "θ")
    state_labels: Sequence[str] = ("x (m)", "y (m)", "θ (rad)")
    pose: Sequence[str | None] = ("x", "y", "yaw")
    up = "y"

    def __init__(
        self, model: PegInHole2DModel | None = None, state_space_planner: PegPlanner | None = None
    ) -> None:
        model = validated("model", model or PegInHole2DModel())
        planner = validated("state_space_planner", state_space_planner or PegPlanner())
        half_hole = 0.5 * model.peg_width + model.hole_tolerance
        floor = -0.5 * model.peg_height - model.hole_tolerance
        obstacles = [
            (-FAR, -FAR, -half_hole, 0.0),
            (half_hole, -FAR, FAR, 0.0),
            (-half_hole, -FAR, half_hole, floor),
        ]
        world = RectangleWorld(model.peg_width, model.peg_height, obstacles)
        super().__init__(model, planner, world)
        self._half_width = 0.5 * model.peg_width
        self._upright_limit = upright_limit(model.hole_tolerance, 0.5 * model.peg_height)
        self._path_policy = KernelObject(
            _kernel.PegPolicy2D,
            [(0.0, self._upright_limit, 0.0)],
            self._half_width,
            0.0,
            self._upper_limits.tolist(),
            (0.0, model.hole_tolerance, -model.hole_tolerance, model.hole_tolerance),
        )

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Go to x = 0; near it also turn upright; once upright also go down to y = 0."""
        del stage
        near = np.abs(states[..., 0]) < self._half_width
        upright = near & (np.abs(states[..., 2]) < self._upright_limit)
        actions = -states
        actions[..., 1][~upright] = 0.0
        actions[..., 2][~near] = 0.0
        return actions

    expected_path = PegProblem.follow_policy
    _path_actions = PegProblem.command_on_path
    rollout_returns = PegProblem.roll_out_policy

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell where the peg is half-way in the hole."""
        near = np.abs(states[..., 0:2]) < self.model.hole_tolerance
        return np.asarray(near.all(axis=-1))

    def scene(self) -> Scene:
        """Return the ground with the hole, and the peg."""
        reach = 2.0 * self.model.peg_height
        x, y = self.model.init_mean[:2]
        return Scene(
            axes=(0, 1),
            limits=(min(0.0, x) - reach, -reach, max(0.0, x) + reach, max(0.0, y) + reach),
            obstacles=self.world.obstacles,
            body=rectangle(self.model.peg_width, self.model.peg_height),
            angle=2,
            goal=(0.0, 0.0),
        )
