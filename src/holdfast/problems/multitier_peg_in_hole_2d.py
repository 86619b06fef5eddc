"""A peg that must pass through several plates in turn, each with a hole elsewhere.

The task of :mod:`holdfast.problems.peg_in_hole_2d`, strung together: which hole is next is the
task's stage, and the robot must notice from its estimate alone that it has passed one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, ClassVar

import msgspec
import numpy as np

from holdfast import _kernel
from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.geometry import FAR, KernelObject, RectangleWorld
from holdfast.problems.problem import Scene
from holdfast.problems.rigid_body import (
    Coordinate,
    CoordinatePair,
    Length,
    PegPlanner,
    PegProblem,
    PositiveVariance,
    Seed,
    Tolerance,
    Variance,
    constant,
    rectangle,
    upright_limit,
    validated,
)


class Hole(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A hole and the plate that it is in, of which half lies above the hole's centre."""

    center: CoordinatePair
    tol: Length = 0.1
    depth: Length = 1.0


class MultitierPegInHole2DModel(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True
):
    """The section ``model``; docs/problems.md has the meaning and the unit of each key."""

    peg_dim: tuple[Length, Length] = (1.0, 2.0)
    map_dim: tuple[Coordinate, Coordinate, Coordinate, Coordinate] = (-12.0, -12.0, 12.0, 12.0)
    init_mean: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 9.0, 0.0)
    init_cov: tuple[Variance, Variance, Variance] = (2.0, 1.0, 1.57)
    init_seed: Seed = 0
    motion_cov: tuple[Variance, Variance, Variance] = (0.01, 0.01, 0.01)
    motion_seed: Seed = 0
    sensing_cov: PositiveVariance = 0.001
    sensing_seed: Seed = 0
    collision_tol: Tolerance = 0.001
    holes: Annotated[tuple[Hole, ...], msgspec.Meta(min_length=1, max_length=1000)] = (
        Hole(center=(4.0, 6.0)),
        Hole(center=(-4.0, 0.0)),
        Hole(center=(0.0, -6.0)),
    )


class MultitierPegInHole2D(PegProblem):
    """Bring a peg down through the holes of several plates, in the plane.

    The state is (x, y, θ) of the peg's centre. Each plate reaches across the map and has one hole
    as wide as the peg plus the tolerance on either side. The stage is the index of the hole to
    pass next; it advances when the estimate is a peg's height below the plate. The goal is reached
    when the peg's centre is below the last hole's centre and within its tolerance of its axis.
    The policy turns the peg once its centre is within half its width of the hole's axis.

    Raises
    ------
    InvalidValueError
        If a setting is out of bounds, the map is empty, or a hole does not fit into it.
    """

    Model: ClassVar[type[MultitierPegInHole2DModel]] = MultitierPegInHole2DModel
    model: MultitierPegInHole2DModel

    name = "multitier_peg_in_hole_2d"
    state_size = 3
    action_size = 3
    sensing_actions: Sequence[str] = ("x", "y", "θ")
    state_labels: Sequence[str] = ("x (m)", "y (m)", "θ (rad)")
    pose: Sequence[str | None] = ("x", "y", "yaw")
    up = "y"

    def __init__(
        self,
        model: MultitierPegInHole2DModel | None = None,
        state_space_planner: PegPlanner | None = None,
    ) -> None:
        model = validated("model", model or MultitierPegInHole2DModel())
        planner = validated("state_space_planner", state_space_planner or PegPlanner())
        width, height = model.peg_dim
        world = RectangleWorld(width, height, _walls(model) + _plates(model))
        super().__init__(model, planner, world)
        self.num_stages = len(model.holes)
        self._half_width = 0.5 * width
        self._peg_height = height
        # One element per stage, to be indexed by it.
        self._hole_x = constant([hole.center[0] for hole in model.holes])
        self._passed_below = constant(
            [hole.center[1] - hole.depth - hole.tol for hole in model.holes]
        )
        self._upright_limits = constant(
            [upright_limit(hole.tol, 0.5 * height) for hole in model.holes]
        )
        last = model.holes[-1]
        stages = np.column_stack([self._hole_x, self._upright_limits, self._passed_below])
        self._path_policy = KernelObject(
            _kernel.PegPolicy2D,
            stages.tolist(),
            self._half_width,
            self._peg_height,
            self._upper_limits.tolist(),
            (last.center[0], last.tol, -math.inf, last.center[1]),
        )

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Go to the hole's axis; near it also turn upright; once upright also go down through."""
        x, y, angle = states[..., 0], states[..., 1], states[..., 2]
        to_axis = self._hole_x[stage] - x
        near = np.abs(to_axis) < self._half_width
        upright = near & (np.abs(angle) < self._upright_limits[stage])
        actions = np.empty(states.shape)
        actions[..., 0] = to_axis
        actions[..., 1] = np.where(upright, self._passed_below[stage] - y - self._peg_height, 0.0)
        actions[..., 2] = np.where(near, -angle, 0.0)
        return actions

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        """Advance where the estimate is a peg's height below the plate, unless it is the last."""
        passed = estimates[..., 1] + self._peg_height < self._passed_below[stage]
        following = np.minimum(stage + passed, self.num_stages - 1)
        return int(following) if np.ndim(following) == 0 else following

    expected_path = PegProblem.follow_policy
    _path_actions = PegProblem.command_on_path
    rollout_returns = PegProblem.roll_out_policy

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell where the peg's centre is below that of the last hole, near its axis."""
        last = self.model.holes[-1]
        return np.asarray(
            (np.abs(states[..., 0] - last.center[0]) < last.tol) & (states[..., 1] < last.center[1])
        )

    def scene(self) -> Scene:
        """Return the map with its plates, and the peg."""
        return Scene(
            axes=(0, 1),
            limits=self.model.map_dim,
            obstacles=self.world.obstacles,
            body=rectangle(*self.model.peg_dim),
            angle=2,
            goal=self.model.holes[-1].center,
            points=[hole.center for hole in self.model.holes],
        )


def _walls(model: MultitierPegInHole2DModel) -> list[tuple[float, float, float, float]]:
    x_min, y_min, x_max, y_max = model.map_dim
    if not (x_min < x_max and y_min < y_max):
        raise InvalidValueError(
            f"model.map_dim: {list(model.map_dim)}, must be [x_min, y_min, x_max, y_max] with the "
            "minima below the maxima"
        )
    return [
        (-FAR, -FAR, x_min, FAR),
        (x_max, -FAR, FAR, FAR),
        (-FAR, -FAR, FAR, y_min),
        (-FAR, y_max, FAR, FAR),
    ]


def _plates(model: MultitierPegInHole2DModel) -> list[tuple[float, float, float, float]]:
    x_min, y_min, x_max, y_max = model.map_dim
    plates = []
    for index, hole in enumerate(model.holes):
        half_hole = 0.5 * model.peg_dim[0] + hole.tol
        x, y = hole.center
        bottom, top = y - 0.5 * hole.depth, y + 0.5 * hole.depth
        left, right = x - half_hole, x + half_hole
        if not (x_min < left and right < x_max and y_min < bottom and top < y_max):
            raise InvalidValueError(
                f"model.holes[{index}]: spans x from {left} to {right} and y from {bottom} to "
                f"{top}, must lie inside model.map_dim {list(model.map_dim)}"
            )
        plates += [(x_min, bottom, left, top), (right, bottom, x_max, top)]
    return plates
