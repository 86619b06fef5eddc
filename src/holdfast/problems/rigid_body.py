"""What the problems of a rigid body among obstacles have in common.

A body moves by its executed action, stopped at contact, plus Gaussian noise that is drawn again
until the body is free; it starts from a Gaussian, drawn in the same way. A problem of that kind
adds only its obstacles, what it observes, its policy and its goal. Pegs share more: they observe
one coordinate at a time, limit each component of an action on its own, and pay for their way.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, ClassVar, Self

import msgspec
import numpy as np

from holdfast import numerics
from holdfast.arrays import FloatArray
from holdfast.errors import InvalidValueError
from holdfast.geometry import MAX_NOISE_ATTEMPTS, BoxWorld, DiscWorld, RectangleWorld
from holdfast.problems.problem import ProblemBase
from holdfast.randomness import NOISE_FREE, Stream

__all__ = ["PegProblem", "RigidBodyProblem", "constant", "upright_limit"]

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


class RigidBodyProblem(ProblemBase):
    """A body that stops at contact; the state is its pose, the task action a change of pose.

    Parameters
    ----------
    world : DiscWorld, RectangleWorld or BoxWorld
        The body and its obstacles.
    init_mean, init_cov : sequence of float
        Mean and variances of the initial belief.
    motion_cov : sequence of float
        Variances of the motion noise.
    collision_tol : float
        Fraction of an action to which contact is located.

    Attributes
    ----------
    Model, StateSpacePlanner : type
        Of the problem's settings: it is built of one of each.
    resolution : float
        What the motion noise blurs in a step: the geometric mean of its standard deviations. The
        pegs in the plane and the capsule robot have the same deviation in every coordinate unless
        their settings say otherwise, and then one number is right for all. Where deviations differ,
        ``selector.resolution`` takes one for each.
    """

    Model: ClassVar[type[Any]]
    StateSpacePlanner: ClassVar[type[Any]]

    @classmethod
    def from_settings(
        cls, model: Mapping[str, Any], state_space_planner: Mapping[str, Any]
    ) -> Self:
        """Build the problem from plain data; ``msgspec.ValidationError`` if it does not fit."""
        make: Callable[..., Self] = cls
        return make(
            msgspec.convert(model, cls.Model),
            msgspec.convert(state_space_planner, cls.StateSpacePlanner),
        )

    def __init__(
        self,
        world: DiscWorld | RectangleWorld | BoxWorld,
        *,
        init_mean: Sequence[float],
        init_cov: Sequence[float],
        motion_cov: Sequence[float],
        collision_tol: float,
    ) -> None:
        self.world = world
        self.motion_variance = constant(motion_cov)
        self.resolution = _geometric_mean_deviation(self.motion_variance)
        self._init_mean = constant(init_mean)
        self._init_deviation = np.sqrt(constant(init_cov))
        self._motion_deviation = np.sqrt(self.motion_variance)
        self._collision_tolerance = collision_tol

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


class PegProblem(RigidBodyProblem):
    """A peg: one observed coordinate per sensing action, limited actions, reward for short ways.

    Parameters
    ----------
    world, init_mean, init_cov, motion_cov, collision_tol
        As for :class:`RigidBodyProblem`.
    sensing_cov : float
        Variance of every observation.
    step_limits : sequence of float
        Largest size of each component of an executed action.
    """

    sensing_actions: Sequence[str]
    _num_positions: ClassVar[int]

    def __init__(
        self,
        world: RectangleWorld | BoxWorld,
        *,
        init_mean: Sequence[float],
        init_cov: Sequence[float],
        motion_cov: Sequence[float],
        collision_tol: float,
        sensing_cov: float,
        step_limits: Sequence[float],
    ) -> None:
        super().__init__(
            world,
            init_mean=init_mean,
            init_cov=init_cov,
            motion_cov=motion_cov,
            collision_tol=collision_tol,
        )
        self._observation_variance = constant([sensing_cov])
        self._upper_limits = constant(step_limits)
        self._lower_limits = constant([-limit for limit in step_limits])

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return coordinate ``sensing_action`` of the states, shape ``(..., 1)``."""
        self._check_sensing_action(sensing_action)
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the variance of the observation, shape ``(1,)``: the same everywhere."""
        del states
        self._check_sensing_action(sensing_action)
        return self._observation_variance

    def execute(self, actions: FloatArray) -> FloatArray:
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

    def _check_sensing_action(self, sensing_action: int) -> None:
        if not 0 <= sensing_action < self.state_size:
            raise InvalidValueError(
                f"sensing action: {sensing_action}, must be at least 0 and below {self.state_size}"
            )


def _geometric_mean_deviation(variances: FloatArray) -> float:
    """Return the geometric mean of the standard deviations of the coordinates that have noise."""
    noisy = variances[variances > 0.0]
    if noisy.size == 0:
        return SMALLEST_RESOLUTION
    mean_log_variance = numerics.sum(numerics.log(noisy)) / noisy.size
    return numerics.exp(0.5 * mean_log_variance).item()
