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
from holdfast.arrays import BoolArray, FloatArray, IntArray
from holdfast.errors import InvalidValueError
from holdfast.geometry import FAR, BoxWorld
from holdfast.problems._fields import (
    Coordinate,
    Length,
    PositiveVariance,
    Step,
    Tolerance,
    Variance,
    validated,
)
from holdfast.problems.problem import Scene
from holdfast.problems.rigid_body import PegProblem, upright_limit

__all__ = ["PegInHole3D", "PegInHole3DModel", "PegInHole3DPlanner"]

Pose = tuple[Coordinate, Coordinate, Coordinate, Coordinate, Coordinate, Coordinate]
PoseVariance = tuple[Variance, Variance, Variance, Variance, Variance, Variance]


class PegInHole3DModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``model``.

    Attributes
    ----------
    peg_dim : tuple of float
        The peg's size along x, y and z when upright, in metres.
    hole_tolerance : float
        Gap between peg and hole on each side and below, and half the goal's size.
    map_dim : tuple of float
        Half the map's size along x, y and z: its walls and its ceiling.
    init_mean, init_cov : tuple of float
        Mean and variances of the initial belief over (x, y, z, yaw, pitch, roll).
    motion_cov : tuple of float
        Variances of the motion noise.
    sensing_cov : float
        Variance of an observation.
    collision_tol : float
        Fraction of an action to which contact is located.
    """

    peg_dim: tuple[Length, Length, Length] = (1.0, 1.0, 2.0)
    hole_tolerance: Length = 0.1
    map_dim: tuple[Length, Length, Length] = (6.0, 6.0, 6.0)
    init_mean: Pose = (2.0, 1.5, 3.0, 0.0, 0.0, 0.0)
    init_cov: PoseVariance = (0.5, 0.5, 0.5, 0.3, 0.1, 0.1)
    motion_cov: PoseVariance = (0.005, 0.005, 0.005, 0.001, 0.001, 0.001)
    sensing_cov: PositiveVariance = 0.004
    collision_tol: Tolerance = 0.001


class PegInHole3DPlanner(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``state_space_planner``.

    Attributes
    ----------
    translation_step_size : float
        Largest size of each component of an action's translation, each on its own.
    rotation_step_size : float
        Largest size of each of its angular components.
    """

    translation_step_size: Step = 0.1
    rotation_step_size: Step = 0.1


class PegInHole3D(PegProblem):
    """Put a box-shaped peg into a rectangular hole in a thick plate.

    The state is (x, y, z, yaw, pitch, roll) of the peg's centre. The plate's top is at z = 0; the
    hole around the z axis is as wide as the peg plus the tolerance on each side, and its floor is
    the tolerance below half the peg's height. The goal is reached when the peg is half-way in:
    x, y and z are below the tolerance in size.

    The policy always moves toward the axis; within half the peg's width of it, it also turns the
    peg upright, and once the norm of the angles is below asin(tolerance / half the peg's height)
    it also lowers it.

    The earlier work left no numbers for this problem, and the first ones tried (motion variances
    0.01 and 0.0025, sensing variance 0.001, turning only within the tolerance of the axis and
    standing still there) made it all but unsolvable: less than one trial in ten ended within 700
    steps. The noise moved the peg faster than one coordinate at a time can be observed, such
    precise observations left a few particles of hundreds in six dimensions, and an action that
    looks at the angles only within the tolerance gives no reason to observe them before. With the
    defaults here, 200 particles and a sensing interval of 4, about 95 % of the trials end within
    700 steps, with an interval of 8 about 90 %; 100 particles are too few.

    The resolution of each coordinate is what the motion noise blurs in a step, 0.071 m and
    0.032 rad: metres and radians are not added as if they were the same.

    Raises
    ------
    InvalidValueError
        If a setting is out of bounds, or the map has no room for the hole.
    """

    Model: ClassVar[type[PegInHole3DModel]] = PegInHole3DModel
    StateSpacePlanner: ClassVar[type[PegInHole3DPlanner]] = PegInHole3DPlanner

    name = "peg_in_hole_3d"
    state_size = 6
    action_size = 6
    sensing_actions: Sequence[str] = ("x", "y", "z", "yaw", "pitch", "roll")
    state_labels: Sequence[str] = (
        "x (m)",
        "y (m)",
        "z (m)",
        "yaw (rad)",
        "pitch (rad)",
        "roll (rad)",
    )
    pose: Sequence[str | None] = ("x", "y", "z", "yaw", "pitch", "roll")

    def __init__(
        self,
        model: PegInHole3DModel | None = None,
        state_space_planner: PegInHole3DPlanner | None = None,
    ) -> None:
        model = validated("model", model or PegInHole3DModel())
        planner = validated("state_space_planner", state_space_planner or PegInHole3DPlanner())
        super().__init__(
            BoxWorld(model.peg_dim, _plate_and_walls(model)),
            init_mean=model.init_mean,
            init_cov=model.init_cov,
            motion_cov=model.motion_cov,
            collision_tol=model.collision_tol,
            sensing_cov=model.sensing_cov,
            step_limits=(
                *[planner.translation_step_size] * 3,
                *[planner.rotation_step_size] * 3,
            ),
        )
        # Where a coordinate moves without noise, the mean of the others has to do.
        self.resolution = np.where(
            self.motion_variance > 0.0, np.sqrt(self.motion_variance), self.resolution
        )
        self.model = model
        self.state_space_planner = planner
        self._tolerance = model.hole_tolerance
        self._half_width = 0.5 * min(model.peg_dim[0], model.peg_dim[1])
        self._upright_limit = upright_limit(model.hole_tolerance, 0.5 * model.peg_dim[2])
        self._path_policy = _kernel.PegPolicy3D(
            self._half_width, self._upright_limit, self._upper_limits.tolist()
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

    def expected_path(
        self, states: FloatArray, stage: int, offsets: Sequence[int], threads: int
    ) -> tuple[FloatArray, IntArray]:
        """Follow the policy without noise; the kernel has it as well."""
        return self.world.follow(
            self._path_policy, states, stage, offsets, self._collision_tolerance, threads
        )

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell where the peg is half-way in the hole."""
        near = np.abs(states[..., 0:3]) < self._tolerance
        return np.asarray(near.all(axis=-1))

    def scene(self) -> Scene:
        """Return the section y = 0: the plate with the hole, and the upright peg.

        The peg is drawn without its angles, of which the section shows only one.
        """
        half_x, half_z = 0.5 * self.model.peg_dim[0], 0.5 * self.model.peg_dim[2]
        obstacles = self.world.obstacles
        cut = obstacles[(obstacles[:, 1] < 0.0) & (obstacles[:, 4] > 0.0)]
        return Scene(
            axes=(0, 2),
            limits=(
                -self.model.map_dim[0],
                -2.0 * half_z,
                self.model.map_dim[0],
                self.model.map_dim[2],
            ),
            obstacles=cut[:, [0, 2, 3, 5]],
            body=[(-half_x, -half_z), (half_x, -half_z), (half_x, half_z), (-half_x, half_z)],
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
