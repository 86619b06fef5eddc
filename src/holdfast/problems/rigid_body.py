"""What the problems of a rigid body among obstacles have in common.

A body moves by its executed action, stopped at contact, plus Gaussian noise that is drawn again
until the body is free; it starts from a Gaussian, drawn in the same way. A problem of that kind
adds only its obstacles, what it observes, its policy and its goal. Pegs share more: they observe
one coordinate at a time, limit each component of an action on its own, and pay for their way.

The settings of a problem are two structs, for the sections ``model`` and ``state_space_planner`` of
a configuration; docs/problems.md has the meaning and the unit of each key. Every number has finite
bounds, far outside anything sensible: they keep infinities and NaN out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self, TypeVar

import msgspec
import numpy as np

from holdfast.conversion import convert
from holdfast.errors import InvalidValueError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray, IntArray, KeepsReadOnly
from holdfast.numerics.geometry import (
    MAX_NOISE_ATTEMPTS,
    BoxWorld,
    DiscWorld,
    KernelObject,
    RectangleWorld,
    RolloutSettings,
)
from holdfast.numerics.randomness import NOISE_FREE, Stream
from holdfast.problems.problem import ProblemBase

Coordinate = Annotated[float, msgspec.Meta(ge=-1e5, le=1e5)]
CoordinatePair = tuple[Coordinate, Coordinate]
Length = Annotated[float, msgspec.Meta(gt=0.0, le=1e5)]
Variance = Annotated[float, msgspec.Meta(ge=0.0, le=1e10)]
PositiveVariance = Annotated[float, msgspec.Meta(gt=0.0, le=1e10)]
Tolerance = Annotated[float, msgspec.Meta(ge=1e-12, lt=1.0)]
"""Finer ones change nothing that matters, and each halving costs time."""
Seed = Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]

_ROLLOUT_TOLERANCE = 0.25
"""Fraction of an action to which a rollout finds a contact: noise follows that is larger."""

StructT = TypeVar("StructT", bound=msgspec.Struct)

SMALLEST_RESOLUTION = 1e-3
"""The resolution of a problem without motion noise, where the noise cannot set it."""


def constant(values: Sequence[float] | Sequence[Sequence[float]]) -> FloatArray:
    """Return a read-only array, to be handed out again and again."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def upright_limit(tolerance: float, half_height: float) -> float:
    """Return the tilt at which a peg's ends move sideways by the hole's tolerance: asin(t / h)."""
    return numerics.arcsin(min(tolerance / half_height, 1.0))


def rectangle(width: float, height: float) -> list[tuple[float, float]]:
    """Return the corners of a rectangle about its centre, counter-clockwise."""
    x, y = 0.5 * width, 0.5 * height
    return [(-x, -y), (x, -y), (x, y), (-x, y)]


def validated(section: str, settings: StructT) -> StructT:
    """Return settings whose fields have the declared types and bounds, or raise InvalidValueError.

    msgspec checks what it decodes, not what a constructor is given.
    """
    try:
        return convert(msgspec.to_builtins(settings), type(settings))
    except msgspec.ValidationError as error:
        raise InvalidValueError(f"{section}: {error}") from error


class RigidBodyProblem(KeepsReadOnly, ProblemBase):
    """A body that stops at contact; the state is its pose, the task action a change of pose.

    It is built of validated settings, of the types ``Model`` and ``StateSpacePlanner``. Every model
    has ``init_mean``, ``init_cov``, ``motion_cov`` and ``collision_tol``. The world is the body and
    its obstacles.

    Attributes
    ----------
    resolution : float
        What the motion noise blurs in a step: the geometric mean of its standard deviations. The
        pegs in the plane and the capsule robot have the same deviation in every coordinate unless
        their settings say otherwise, and then one number is right for all. Where deviations differ,
        ``selector.resolution`` takes one for each.
    """

    Model: ClassVar[type[Any]]
    StateSpacePlanner: ClassVar[type[Any]]
    _path_policy: KernelObject
    """The policy, rewards and goal as the kernel has them."""

    @classmethod
    def from_settings(
        cls, model: Mapping[str, Any], state_space_planner: Mapping[str, Any]
    ) -> Self:
        """Build the problem from plain data; ``msgspec.ValidationError`` if it does not fit."""
        make: Callable[..., Self] = cls
        return make(convert(model, cls.Model), convert(state_space_planner, cls.StateSpacePlanner))

    def __init__(
        self, model: Any, state_space_planner: Any, world: DiscWorld | RectangleWorld | BoxWorld
    ) -> None:
        self.model = model
        self.state_space_planner = state_space_planner
        self.world = world
        self.motion_variance = constant(model.motion_cov)
        self.resolution = _geometric_mean_deviation(self.motion_variance)
        self._init_mean = constant(model.init_mean)
        self._init_deviation = np.sqrt(constant(model.init_cov))
        self._motion_deviation = np.sqrt(self.motion_variance)
        self._collision_tolerance = model.collision_tol

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        """Draw states of the initial Gaussian, each again until it is free of collision.

        Raises
        ------
        InvalidValueError
            If some state found no free place: the Gaussian lies too deep in the obstacles.
        """
        states, unplaced = self.world.draw_free(
            self._init_mean, self._init_deviation, count, stream
        )
        if unplaced:
            raise InvalidValueError(
                f"model.init_mean: {self._init_mean.tolist()}, with model.init_cov "
                f"{np.square(self._init_deviation).tolist()}: {unplaced} of {count} initial states "
                f"were in collision at all of {MAX_NOISE_ATTEMPTS} draws"
            )
        return states

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        """Draw the states after executed actions, stopped at contact, with noise."""
        return self.world.move(
            states, actions, self._motion_deviation, self._collision_tolerance, stream
        )

    def expected_move(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return the states after executed actions, stopped at contact, without noise."""
        return self.move(states, actions, NOISE_FREE)

    def move_each(
        self, states: FloatArray, actions: FloatArray, streams: Sequence[Stream], threads: int
    ) -> FloatArray:
        """Move several beliefs as :meth:`move` does one after the other."""
        return self.world.move_each(
            states, actions, self._motion_deviation, self._collision_tolerance, streams, threads
        )

    def follow_policy(
        self, states: FloatArray, stage: int, offsets: Sequence[int], threads: int
    ) -> tuple[FloatArray, IntArray]:
        """Follow the policy without noise, in the kernel.

        A problem makes this its ``expected_path`` beside its own ``policy``: an inherited one
        would not count, for it does not follow a policy that a subclass replaces.
        """
        way = states, stage, offsets, self._collision_tolerance, threads
        return self.world.follow(self._path_policy.own, *way)

    def command_on_path(
        self, states: FloatArray, stage: int, offsets: Sequence[int], threads: int
    ) -> FloatArray:
        """Return what the policy commands at each offset of that way, as ``_path_actions``."""
        way = states, stage, offsets, self._collision_tolerance, threads
        return self.world.follow(self._path_policy.own, *way, commands=True)[0]

    def roll_out_policy(
        self,
        true_states: FloatArray,
        estimates: FloatArray,
        clouds: FloatArray,
        stage: int,
        motion: Stream,
        rollouts: RolloutSettings,
        threads: int,
    ) -> FloatArray:
        """Return the rollouts of ``expected_return``, in the kernel.

        A problem makes this its ``rollout_returns``, as :meth:`follow_policy` its
        ``expected_path``.
        """
        begun = true_states, estimates, clouds, stage
        tolerance = max(self._collision_tolerance, _ROLLOUT_TOLERANCE)
        noise = self._motion_deviation, tolerance, motion
        return self.world.roll_out(self._path_policy.own, *begun, *noise, rollouts, threads)

    def _check_sensing_action(self, sensing_action: int) -> None:
        count = len(self.sensing_actions)
        if not 0 <= sensing_action < count:
            raise InvalidValueError(
                f"sensing action: {sensing_action}, must be at least 0 and below {count}"
            )


class PegPlanner(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The section ``state_space_planner`` of the pegs: the largest size of each component."""

    translation_step_size: Length = 0.1
    rotation_step_size: Length = 0.1


class PegProblem(RigidBodyProblem):
    """A peg: one observed coordinate per sensing action, limited actions, reward for short ways.

    The state's positions come first, then its angles. ``model.sensing_cov`` is the variance of
    every observation.
    """

    StateSpacePlanner: ClassVar[type[PegPlanner]] = PegPlanner

    def __init__(
        self, model: Any, state_space_planner: PegPlanner, world: RectangleWorld | BoxWorld
    ) -> None:
        super().__init__(model, state_space_planner, world)
        positions = world.space_dimension
        angles = self.action_size - positions
        limits = [state_space_planner.translation_step_size] * positions
        limits += [state_space_planner.rotation_step_size] * angles
        self._upper_limits = constant(limits)
        self._lower_limits = -self._upper_limits
        self._observation_variance = constant([model.sensing_cov])

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return coordinate ``sensing_action`` of the states, shape ``(..., 1)``."""
        self._check_sensing_action(sensing_action)
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the variance of the observation, shape ``(1,)``: the same everywhere."""
        del states
        self._check_sensing_action(sensing_action)
        return self._observation_variance

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Limit each component on its own to the step sizes."""
        return np.minimum(np.maximum(actions, self._lower_limits), self._upper_limits)

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return minus the Euclidean norm of the executed actions."""
        squared = actions[..., 0] * actions[..., 0]
        for coordinate in range(1, self.action_size):
            component = actions[..., coordinate]
            squared = squared + component * component
        rewards = -np.sqrt(squared)
        if states.shape == actions.shape:
            return np.asarray(rewards)
        shape = np.broadcast_shapes(states.shape[:-1], actions.shape[:-1])
        return np.broadcast_to(rewards, shape)


def _geometric_mean_deviation(variances: FloatArray) -> float:
    """Return the geometric mean of the standard deviations of the coordinates that have noise."""
    noisy = variances[variances > 0.0]
    if noisy.size == 0:
        return SMALLEST_RESOLUTION
    mean_log_variance = numerics.sum(numerics.log(noisy)) / noisy.size
    return numerics.exp(0.5 * mean_log_variance).item()
