"""A box-shaped peg and a rectangular hole in a thick plate, in space.

The same task as :mod:`holdfast.problems.peg_in_hole_2d` with six coordinates to be uncertain
about, and so six sensing actions to choose from.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import msgspec
import numpy as np

from holdfast import _kernel
from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.geometry import FAR, BoxWorld, KernelObject
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

Pose = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
PoseVariance = tuple[Variance, Variance, Variance, Variance, Variance, Variance]


class PegInHole3DModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``model``; docs/problems.md has the meaning and the unit of each key."""

    peg_dim: tuple[Length, Length, Length] = (1.0, 1.0, 2.0)
    hole_tolerance: Length = 0.1
    map_dim: tuple[Length, Length, Length] = (6.0, 6.0, 6.0)
    init_mean: Pose = (2.0, 1.5, 3.0, 0.0, 0.0, 0.0)
    init_cov: PoseVariance = (0.5, 0.5, 0.5, 0.3, 0.1, 0.1)
    motion_cov: PoseVariance = (0.005, 0.005, 0.005, 0.001, 0.001, 0.001)
    sensing_cov: PositiveVariance = 0.004
    collision_tol: Tolerance = 0.001


class PegInHole3D(PegProblem):
    """Put a box-shaped peg into a rectangular hole in a thick plate.

    The state is (x, y, z, yaw, pitch, roll) of the peg's centre. The plate's top is at z = 0; the
    hole around the z axis is as wide as the peg plus the tolerance on each side, and its floor is
    the tolerance below half the peg's height. The goal is reached when the peg is half-way in:
    x, y and z are below the tolerance in size.

    The policy always moves toward the axis; within half the peg's width of it, it also turns the
    peg upright, and once the norm of the angles is below asin(tolerance / half the peg's height)
    it also lowers it.

    The earlier work left no numbers for this problem. Motion variances of 0.01 and 0.0025, a
    sensing variance of 0.001 and turning only within the tolerance of the axis make it all but
    unsolvable: the noise moves the peg faster than one coordinate at a time can be observed, such
    precise observations leave a few particles of hundreds in six dimensions, and there is no reason
    to observe the angles before they count. With the defaults here, 200 particles and a sensing
    interval of 4, about 95 % of the trials end within 700 steps, with an interval of 8 about 90 %;
    100 particles are too few.

    The resolution of each coordinate is what the motion noise blurs in a step, 0.071 m and
    0.032 rad: metres and radians are not added as if they were the same.

    Raises
    ------
    InvalidValueError
        If a setting is out of bounds, or the map has no room for the hole.
    """

    Model: ClassVar[type[PegInHole3DModel]] = PegInHole3DModel
    model: PegInHole3DModel

    name = "peg_in_hole_3d"
    state_size = 6
    action_size = 6
    sensing_actions: Sequence[str] = ("x", "y", "z", "yaw", "pitch", "roll")
    state_labels: Sequence[str] = (
        *("x (m)", "y (m)", "z (m)"),
        *("yaw (rad)", "pitch (rad)", "roll (rad)"),
    )
    pose: Sequence[str | None] = ("x", "y", "z", "yaw", "pitch", "roll")

    def __init__(
        self, model: PegInHole3DModel | None = None, state_space_planner: PegPlanner | None = None
    ) -> None:
        model = validated("model", model or PegInHole3DModel())
        planner = validated("state_space_planner", state_space_planner or PegPlanner())
        super().__init__(model, planner, BoxWorld(model.peg_dim, _plate_and_walls(model)))
        # Where a coordinate moves without noise, the mean of the others has to do.
        self.resolution = np.where(
            self.motion_variance > 0.0, self._motion_deviation, self.resolution
        )
        self._half_width = 0.5 * min(model.peg_dim[0], model.peg_dim[1])
        self._upright_limit = upright_limit(model.hole_tolerance, 0.5 * model.peg_dim[2])
        self._path_policy = KernelObject(
            _kernel.PegPolicy3D,
            self._half_width,
            self._upright_limit,
            self._upper_limits.tolist(),
            model.hole_tolerance,
        )

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Go to the axis; near it also turn upright; once upright also go down to z = 0."""
        del stage
        x, y = states[..., 0], states[..., 1]
        yaw, pitch, roll = states[..., 3], states[..., 4], states[..., 5]
        near = np.sqrt(x * x + y * y) < self._half_width
        tilt = np.sqrt(yaw * yaw + pitch * pitch + roll * roll)
        lower = near & (tilt < self._upright_limit)
        actions = -states
        actions[..., 2] = np.where(lower, actions[..., 2], 0.0)
        actions[..., 3:6] = np.where(near[..., np.newaxis], actions[..., 3:6], 0.0)
        return actions

    expected_path = PegProblem.follow_policy
    _path_actions = PegProblem.command_on_path
    rollout_returns = PegProblem.roll_out_policy

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell where the peg is half-way in the hole."""
        near = np.abs(states[..., 0:3]) < self.model.hole_tolerance
        return np.asarray(near.all(axis=-1))

    def scene(self) -> Scene:
        """Return the section y = 0: the plate with the hole, and the upright peg.

        The peg is drawn without its angles, of which the section shows only one.
        """
        map_x, _, map_z = self.model.map_dim
        size_x, _, size_z = self.model.peg_dim
        obstacles = self.world.obstacles
        cut = obstacles[(obstacles[:, 1] < 0.0) & (obstacles[:, 4] > 0.0)]
        return Scene(
            axes=(0, 2),
            limits=(-map_x, -size_z, map_x, map_z),
            obstacles=cut[:, [0, 2, 3, 5]],
            body=rectangle(size_x, size_z),
            goal=(0.0, 0.0),
        )


def _plate_and_walls(
    model: PegInHole3DModel,
) -> list[tuple[float, float, float, float, float, float]]:
    hole_x = 0.5 * model.peg_dim[0] + model.hole_tolerance
    hole_y = 0.5 * model.peg_dim[1] + model.hole_tolerance
    floor = -0.5 * model.peg_dim[2] - model.hole_tolerance
    map_x, map_y, map_z = model.map_dim
    if not (hole_x < map_x and hole_y < map_y):
        raise InvalidValueError(
            f"model.map_dim: {list(model.map_dim)}, half the map must be wider than half the hole, "
            f"{[hole_x, hole_y]}"
        )
    return [
        (-FAR, -FAR, -FAR, -hole_x, FAR, 0.0),
        (hole_x, -FAR, -FAR, FAR, FAR, 0.0),
        (-hole_x, -FAR, -FAR, hole_x, -hole_y, 0.0),
        (-hole_x, hole_y, -FAR, hole_x, FAR, 0.0),
        (-hole_x, -hole_y, -FAR, hole_x, hole_y, floor),
        (-FAR, -FAR, -FAR, -map_x, FAR, FAR),
        (map_x, -FAR, -FAR, FAR, FAR, FAR),
        (-FAR, -FAR, -FAR, FAR, -map_y, FAR),
        (-FAR, map_y, -FAR, FAR, FAR, FAR),
        (-FAR, -FAR, map_z, FAR, FAR, FAR),
    ]
