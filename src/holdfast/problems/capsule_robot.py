"""A small disc on its way through a walled maze, with two sensors, each good in one direction.

In a corridor along x it matters to know y, so as not to touch the walls; at its end, to know x, so
as not to miss the turn. The robot steers by via points, one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, ClassVar, Literal

import msgspec
import numpy as np

from holdfast import _kernel
from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.geometry import DiscWorld, KernelObject
from holdfast.problems.problem import Scene
from holdfast.problems.rigid_body import (
    Coordinate,
    CoordinatePair,
    Length,
    PositiveVariance,
    RigidBodyProblem,
    Seed,
    Tolerance,
    Variance,
    constant,
    validated,
)

MAX_PARTS = 10_000
"""Bound on the numbers of walls, via points and sensing actions."""


class Wall(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A straight wall along x or y, given by the ends of its middle line, where it stops."""

    end_0: CoordinatePair
    end_1: CoordinatePair
    thickness: Length = 0.1


class Target(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A via point, or the goal: reached when the distance to its centre is below its radius.

    Axis 0: ``gain_0`` acts on x and ``gain_1`` on y; 1: the other way round.
    """

    center: CoordinatePair
    radius: Length = 0.1
    axis: Literal[0, 1] = 0


class CapsuleRobotModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``model``; docs/problems.md has the meaning and the unit of each key."""

    robot_radius: Length = 0.1
    init_mean: CoordinatePair = (0.5, 2.5)
    init_cov: tuple[Variance, Variance] = (0.01, 0.01)
    motion_cov: tuple[Variance, Variance] = (0.001, 0.001)
    sensing_covs: Annotated[
        tuple[tuple[PositiveVariance, PositiveVariance], ...],
        msgspec.Meta(min_length=1, max_length=MAX_PARTS),
    ] = ((1e-4, 1e-3), (1e-3, 1e-4))
    collision_tol: Tolerance = 0.001
    seed: Seed = 0
    num_walls: int | None = None
    walls: Annotated[tuple[Wall, ...], msgspec.Meta(max_length=MAX_PARTS)] = (
        Wall(end_0=(0.0, 0.0), end_1=(0.0, 3.0)),
        Wall(end_0=(0.0, 3.0), end_1=(5.0, 3.0)),
        Wall(end_0=(5.0, 3.0), end_1=(5.0, 0.0)),
        Wall(end_0=(5.0, 0.0), end_1=(0.0, 0.0)),
        Wall(end_0=(0.0, 2.0), end_1=(4.0, 2.0)),
        Wall(end_0=(1.0, 1.0), end_1=(5.0, 1.0)),
    )
    dt: Length = 0.1
    goal: Target = Target(center=(4.5, 0.5), radius=0.2)


class CapsuleRobotPlanner(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``state_space_planner``; docs/problems.md has each key."""

    gain_0: Coordinate = 1.0
    gain_1: Coordinate = 1.0
    num_via_points: int | None = None
    step_size: Length = 0.1
    via_points: Annotated[tuple[Target, ...], msgspec.Meta(max_length=MAX_PARTS)] = (
        Target(center=(4.5, 2.5), axis=0),
        Target(center=(4.5, 1.5), axis=1),
        Target(center=(0.5, 1.5), axis=0),
        Target(center=(0.5, 0.5), axis=1),
    )


class CapsuleRobot(RigidBodyProblem):
    """Bring a disc through a maze without touching its walls.

    The state is the centre (x, y). The stage is the index of the via point to reach next; after
    the last one comes the goal. Every sensing action observes both coordinates, with variances
    of its own.

    Raises
    ------
    InvalidValueError
        If a setting is out of bounds, a wall is not along x or y, or a count does not match.
    """

    Model: ClassVar[type[CapsuleRobotModel]] = CapsuleRobotModel
    StateSpacePlanner: ClassVar[type[CapsuleRobotPlanner]] = CapsuleRobotPlanner
    model: CapsuleRobotModel

    name = "capsule_robot"
    state_size = 2
    action_size = 2
    state_labels: Sequence[str] = ("x (m)", "y (m)")
    pose: Sequence[str | None] = ("x", "y")

    def __init__(
        self,
        model: CapsuleRobotModel | None = None,
        state_space_planner: CapsuleRobotPlanner | None = None,
    ) -> None:
        model = validated("model", model or CapsuleRobotModel())
        planner = validated("state_space_planner", state_space_planner or CapsuleRobotPlanner())
        _check_count("model.num_walls", model.num_walls, "walls", len(model.walls))
        _check_count(
            "state_space_planner.num_via_points",
            planner.num_via_points,
            "via_points",
            len(planner.via_points),
        )
        walls = [_rectangle(index, wall) for index, wall in enumerate(model.walls)]
        super().__init__(model, planner, DiscWorld(model.robot_radius, walls))
        self.sensing_actions: Sequence[str] = tuple(
            f"x, y with variances {x:g}, {y:g}" for x, y in model.sensing_covs
        )
        targets = (*planner.via_points, model.goal)
        self.num_stages = len(targets)
        # One element per stage, to be indexed by it.
        self._centers = constant([target.center for target in targets])
        self._squared_radii = constant([target.radius * target.radius for target in targets])
        gains = (planner.gain_0, planner.gain_1)
        self._gains = constant([gains if target.axis == 0 else gains[::-1] for target in targets])
        self._step_size = planner.step_size
        self._path_policy = KernelObject(
            _kernel.ViaPointPolicy,
            np.column_stack([self._centers, self._gains, self._squared_radii]).tolist(),
            self._step_size,
        )
        self._observation_variances = [constant(variances) for variances in model.sensing_covs]

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the positions: every sensing action observes both coordinates."""
        self._check_sensing_action(sensing_action)
        return states

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the variances of the observed x and y, shape ``(2,)``: the same everywhere."""
        del states
        self._check_sensing_action(sensing_action)
        return self._observation_variances[sensing_action]

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Go toward the target of the stage, in proportion to the distance."""
        return np.asarray(_rows(self._gains, stage) * (_rows(self._centers, stage) - states))

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        """Advance where the estimate has reached the via point; the goal is the last stage."""
        reached = _squared_distance(estimates, self._centers[stage]) < self._squared_radii[stage]
        following = np.minimum(stage + reached, self.num_stages - 1)
        return int(following) if np.ndim(following) == 0 else following

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Limit the norm to the step size and keep the direction."""
        x, y = actions[..., 0:1], actions[..., 1:2]
        norm = np.sqrt(x * x + y * y)
        return actions * (self._step_size / np.maximum(norm, self._step_size))

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return -1 where the action, done again from where it led, would end in a wall, else 0."""
        return np.where(self.world.collides(states + actions), -1.0, 0.0)

    expected_path = RigidBodyProblem.follow_policy
    _path_actions = RigidBodyProblem.command_on_path
    rollout_returns = RigidBodyProblem.roll_out_policy

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell where the centre is within the goal's radius."""
        return np.asarray(_squared_distance(states, self._centers[-1]) < self._squared_radii[-1])

    def scene(self) -> Scene:
        """Return the maze, the disc and the via points."""
        obstacles = self.world.obstacles
        corners = np.array([*obstacles[:, :2], *obstacles[:, 2:], *self._centers])
        margin = 2.0 * self.model.robot_radius
        x_min, y_min = corners.min(axis=0) - margin
        x_max, y_max = corners.max(axis=0) + margin
        return Scene(
            axes=(0, 1),
            limits=(float(x_min), float(y_min), float(x_max), float(y_max)),
            obstacles=obstacles,
            body=self.model.robot_radius,
            goal=self.model.goal.center,
            points=self._centers[:-1],
        )


def _rows(of_stages: FloatArray, stage: int | IntArray) -> FloatArray:
    # Of an array of stages, indexing takes ten times as long.
    return of_stages[stage] if isinstance(stage, int) else of_stages.take(stage, axis=0)


def _squared_distance(states: FloatArray, centers: FloatArray) -> FloatArray:
    difference = states - centers
    x, y = difference[..., 0], difference[..., 1]
    return np.asarray(x * x + y * y)


def _check_count(key: str, count: int | None, list_key: str, length: int) -> None:
    if count is not None and count != length:
        raise InvalidValueError(f"{key}: {count}, but {list_key} has {length} entries")


def _rectangle(index: int, wall: Wall) -> tuple[float, float, float, float]:
    (x_0, y_0), (x_1, y_1) = wall.end_0, wall.end_1
    half = 0.5 * wall.thickness
    if x_0 == x_1 and y_0 != y_1:
        return (x_0 - half, min(y_0, y_1), x_0 + half, max(y_0, y_1))
    if y_0 == y_1 and x_0 != x_1:
        return (min(x_0, x_1), y_0 - half, max(x_0, x_1), y_0 + half)
    raise InvalidValueError(
        f"model.walls[{index}]: from {list(wall.end_0)} to {list(wall.end_1)}, a wall must have a "
        "length and be along x or y"
    )
