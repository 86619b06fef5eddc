"""A robot's body among obstacles: collisions, and motion that stops at contact.

A *world* is one body and the obstacles that it must not enter. It answers three questions. Which
states collide? Where does an action lead, if motion stops at contact and the noise added after it
never ends inside an obstacle? Which states drawn from a Gaussian are free? The kernel computes the
answers with separating axes, and with the same bits on every machine.

A state that touches an obstacle without overlapping it is free. Obstacles are finite; give an
unbounded one, such as the ground, a large extent (:data:`FAR`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt

from holdfast import _kernel
from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    KeepsReadOnly,
    floats,
    real_number,
)
from holdfast.numerics.randomness import NoiseFreeStream

if TYPE_CHECKING:
    from holdfast.numerics.randomness import Stream


FAR = 1.0e6
"""Extent of an unbounded obstacle, in metres."""

MAX_NOISE_ATTEMPTS = 1000
"""Draws of noise, the first included, after which a state gets no noise."""


class KernelObject:
    """An object of the kernel, ``own``, that can be pickled and copied: it is made again."""

    def __init__(self, kind: type[Any], *arguments: Any) -> None:
        self.own = kind(*arguments)
        self._made_of = (kind, *arguments)

    def __reduce__(self) -> tuple[type[KernelObject], tuple[Any, ...]]:
        return KernelObject, self._made_of


class RolloutSettings(NamedTuple):
    """What the rollouts of the method ``expected_return`` have in common.

    Attributes
    ----------
    interval : int
        Steps from one sensing step to the next.
    looks : int
        Later sensing steps at which the state may become known.
    steps : int
        Length of a rollout.
    discount, price : float
        Of a step's reward; of a later sensing action, in units of reward.
    counts_steps : bool
        Whether each step counts -1 instead of its reward.
    """

    interval: int
    looks: int
    steps: int
    discount: float
    price: float
    counts_steps: bool


class _World(KeepsReadOnly):
    """Base of the worlds: the checks and the calls into the kernel.

    ``dimension`` is the number of a state's coordinates, ``space_dimension`` that of a point's.
    States and actions have their coordinates last.

    All methods raise InvalidValueError if shapes do not fit, or a value is not finite or out of
    bounds. Results do not depend on ``threads``, of which 0 means all cores.
    """

    dimension: int
    space_dimension: int
    _kernel: KernelObject  # one of the kernel's three worlds, which have the same methods
    obstacles: FloatArray

    def _check_obstacles(self, obstacles: npt.ArrayLike) -> FloatArray:
        half = self.space_dimension
        limits = floats("obstacles", obstacles).copy()
        if limits.size == 0:
            limits = limits.reshape(0, 2 * half)
        if limits.ndim != 2 or limits.shape[1] != 2 * half:
            raise InvalidValueError(f"obstacles: shape {limits.shape}, must be (m, {2 * half})")
        if not np.isfinite(limits).all():
            raise InvalidValueError(f"obstacles: a limit is not finite; use {FAR:g} for far away")
        empty = (limits[:, :half] >= limits[:, half:]).any(axis=1)
        if empty.any():
            index = int(np.argmax(empty))
            raise InvalidValueError(
                f"obstacles[{index}]: {limits[index].tolist()}, the minima must be below the maxima"
            )
        limits.setflags(write=False)
        return limits

    def collides(self, states: FloatArray) -> BoolArray:
        """Tell which states overlap an obstacle; the result has their leading shape."""
        states = self._rows("states", states)
        result = np.empty(states.shape[:-1], dtype=np.bool_)
        if not self._kernel.own.collides(states.reshape(-1, self.dimension), result.reshape(-1)):
            _raise_not_finite("states", states)
        return result

    def move(
        self,
        states: FloatArray,
        actions: FloatArray,
        standard_deviation: FloatArray,
        tolerance: float,
        stream: Stream,
    ) -> FloatArray:
        """Move each state by its action, stopped at contact, and add noise that keeps it free.

        The full action is tried first. If it ends in collision, its fraction is bisected until the
        bounds are ``tolerance`` apart, and the largest free fraction found is used. Then noise is
        drawn, and drawn again if it ends in collision, up to :data:`MAX_NOISE_ATTEMPTS` times; if
        all fail, no noise is added. States are independent: state n of the flattened batch uses the
        same random numbers whatever else is in the batch.

        Parameters
        ----------
        states : array of shape (..., d)
            Free states. A colliding state may stay where it is.
        actions : array of shape (..., d)
            Executed actions; they broadcast against ``states``.
        standard_deviation : array of shape (d,)
            Of the noise, per coordinate; zero is allowed.
        tolerance : float
            Fraction of the action, above 0 and below 1.
        stream : Stream
            Source of the noise; a :class:`~holdfast.numerics.randomness.NoiseFreeStream` adds none.
        """
        dimension = self.dimension
        states, actions = self._rows("states", states), self._rows("actions", actions)
        if actions.size != dimension and actions.shape != states.shape:
            states, actions = _broadcast(states, actions)
        one_action = actions.shape == (dimension,)
        shape = states.shape if one_action else np.broadcast_shapes(states.shape, actions.shape)
        if isinstance(stream, NoiseFreeStream):
            standard_deviation = np.zeros(dimension)
        next_states = np.empty(shape)
        moved = self._kernel.own.move(
            states.reshape(-1, dimension),
            actions.reshape(-1, dimension),
            np.ascontiguousarray(standard_deviation, dtype=np.float64),
            tolerance,
            stream.for_motion(),
            next_states.reshape(-1, dimension),
        )
        if not moved:
            self._explain_move(states, actions, standard_deviation, tolerance)
        return next_states

    def follow(
        self,
        policy: Any,
        states: FloatArray,
        stage: int,
        offsets: Sequence[int],
        tolerance: float,
        threads: int,
        *,
        commands: bool = False,
    ) -> tuple[FloatArray, IntArray]:
        """Follow a policy of the kernel without noise, from each of n states independently.

        All begin in one stage. The result, the states (K, n, d), or with ``commands`` what the
        policy commands in them, and stages (K, n) after K numbers of steps (``offsets``,
        ascending), equals repeated calls of the problem's policy, limits, motion without noise and
        next stage, bit for bit but for the signs of commands of 0; this is much faster. A tolerance
        of 0 is motion without obstacles.
        """
        states = self._rows("states", states)
        if states.ndim != 2:
            raise InvalidValueError(f"states: shape {states.shape}, must be (n, {self.dimension})")
        rows_at = np.empty((len(offsets), *states.shape))
        stages_at = np.empty(rows_at.shape[:2], dtype=np.int64)
        if not self._kernel.own.follow(
            policy, states, stage, offsets, tolerance, threads, commands, rows_at, stages_at
        ):
            _raise_not_finite("states", states)
        return rows_at, stages_at

    def roll_out(
        self,
        policy: Any,
        true_states: FloatArray,
        estimates: FloatArray,
        clouds: FloatArray,
        stage: int,
        standard_deviation: FloatArray,
        tolerance: float,
        stream: Stream,
        rollouts: RolloutSettings,
        threads: int,
    ) -> FloatArray:
        """Return the rollouts of a policy of the kernel, shape (J, M).

        They are those of :func:`holdfast.planning.expected_return.rollout_returns`;
        cpp/src/rollouts.hpp has the noise.
        """
        returns = np.empty(estimates.shape[:2])
        given = ("true states", true_states), ("estimates", estimates), ("clouds", clouds)
        begun = *(self._rows(*each) for each in given), stage
        noise = standard_deviation, tolerance, stream.for_motion()
        if not self._kernel.own.roll_out(policy, *begun, *noise, rollouts, threads, returns):
            _raise_not_finite("clouds", clouds)
        return returns

    def move_each(
        self,
        states: FloatArray,
        actions: FloatArray,
        standard_deviation: FloatArray,
        tolerance: float,
        streams: Sequence[Stream],
        threads: int,
    ) -> FloatArray:
        """Move b beliefs of shape (n, d), each by its own action and with its own stream.

        ``states`` has the shape (b, n, d), ``actions`` (b, d). The result equals, bit for bit, that
        of :meth:`move` for each belief in turn.
        """
        states, actions = self._rows("states", states), self._rows("actions", actions)
        count = len(streams)
        if states.ndim != 3 or states.shape[0] != count or actions.shape[:-1] != (count,):
            raise InvalidValueError(
                f"states: shape {states.shape}, actions: shape {actions.shape}; for {count} "
                f"streams they must be ({count}, n, {self.dimension}) and "
                f"({count}, {self.dimension})"
            )
        next_states = np.empty(states.shape)
        moved = self._kernel.own.move_each(
            states,
            actions,
            np.ascontiguousarray(standard_deviation, dtype=np.float64),
            tolerance,
            [stream.for_motion() for stream in streams],
            threads,
            next_states,
        )
        if not moved:
            self._explain_move(states, actions, standard_deviation, tolerance)
        return next_states

    def draw_free(
        self, mean: FloatArray, standard_deviation: FloatArray, count: int, stream: Stream
    ) -> tuple[FloatArray, int]:
        """Draw ``count`` states of a Gaussian, each until it is free of collision.

        State n uses the same random numbers whatever ``count`` is.

        Returns
        -------
        states : array of shape (count, d)
        num_unplaced : int
            Number of states that collided in all :data:`MAX_NOISE_ATTEMPTS` draws. These are set to
            the mean, which may collide.
        """
        if count < 0:
            raise InvalidValueError(f"count: {count}, must be at least 0")
        self._check_vector("mean", mean)
        self._check_deviation(standard_deviation)
        states = np.empty((count, self.dimension))
        num_unplaced = self._kernel.own.draw_free(
            np.ascontiguousarray(mean, dtype=np.float64),
            np.ascontiguousarray(standard_deviation, dtype=np.float64),
            stream.for_motion(),
            states,
        )
        return states, int(num_unplaced)

    def _rows(self, name: str, values: FloatArray) -> FloatArray:
        """Return states or actions as the kernel takes them."""
        array = np.ascontiguousarray(values, dtype=np.float64)
        if array.shape[-1] != self.dimension:
            raise InvalidValueError(f"{name}: shape {array.shape}, must be (..., {self.dimension})")
        return array

    def _check_vector(self, name: str, values: FloatArray) -> None:
        if values.shape != (self.dimension,):
            raise InvalidValueError(f"{name}: shape {values.shape}, must be ({self.dimension},)")
        if not np.isfinite(values).all():
            _raise_not_finite(name, values)

    def _check_deviation(self, deviation: FloatArray) -> None:
        self._check_vector("standard_deviation", deviation)
        if (deviation < 0.0).any():
            raise InvalidValueError(
                f"standard_deviation: {deviation.tolist()}, must not be negative"
            )

    def _explain_move(
        self,
        states: FloatArray,
        actions: FloatArray,
        standard_deviation: FloatArray,
        tolerance: float,
    ) -> NoReturn:
        """Raise the error for arguments that the kernel refused."""
        for name, values in (("states", states), ("actions", actions)):
            if not np.isfinite(values).all():
                _raise_not_finite(name, values)
        self._check_deviation(standard_deviation)
        raise InvalidValueError(f"tolerance: {tolerance}, must be above 0 and below 1")


class DiscWorld(_World):
    """A disc among axis-aligned rectangles; a state is the centre (x, y).

    Parameters
    ----------
    radius : float
        Of the disc, above 0.
    obstacles : array of shape (m, 4)
        Rectangles as ``x_min, y_min, x_max, y_max``.
    """

    dimension = 2
    space_dimension = 2

    def __init__(self, radius: float, obstacles: npt.ArrayLike) -> None:
        self.radius = _check_length("radius", radius)
        self.obstacles = self._check_obstacles(obstacles)
        self._kernel = KernelObject(_kernel.DiscWorld, self.radius, self.obstacles)


class RectangleWorld(_World):
    """A rectangle among axis-aligned rectangles; a state is its centre and angle (x, y, θ).

    Parameters
    ----------
    width, height : float
        Of the rectangle along x and y at angle zero, above 0. The angle is counter-clockwise.
    obstacles : array of shape (m, 4)
        Rectangles as ``x_min, y_min, x_max, y_max``.
    """

    dimension = 3
    space_dimension = 2

    def __init__(self, width: float, height: float, obstacles: npt.ArrayLike) -> None:
        self.width = _check_length("width", width)
        self.height = _check_length("height", height)
        self.obstacles = self._check_obstacles(obstacles)
        self._kernel = KernelObject(_kernel.RectangleWorld, self.width, self.height, self.obstacles)


class BoxWorld(_World):
    """A box among axis-aligned boxes; a state is (x, y, z, yaw, pitch, roll) of its centre.

    The box is turned by Rz(yaw) Ry(pitch) Rx(roll).

    Parameters
    ----------
    size : tuple of float
        Of the box along x, y and z at angles zero, above 0.
    obstacles : array of shape (m, 6)
        Boxes as ``x_min, y_min, z_min, x_max, y_max, z_max``.
    """

    dimension = 6
    space_dimension = 3

    def __init__(self, size: tuple[float, float, float], obstacles: npt.ArrayLike) -> None:
        x, y, z = (_check_length(f"size[{i}]", length) for i, length in enumerate(size))
        self.size = (x, y, z)
        self.obstacles = self._check_obstacles(obstacles)
        self._kernel = KernelObject(_kernel.BoxWorld, x, y, z, self.obstacles)


def _check_length(name: str, value: float) -> float:
    length = real_number(value)
    if length is None or not 0.0 < length <= FAR:  # false for NaN too
        raise InvalidValueError(f"{name}: {value}, must be above 0 and at most {FAR:g}")
    return length


def _broadcast(states: FloatArray, actions: FloatArray) -> tuple[FloatArray, FloatArray]:
    try:
        shape = np.broadcast_shapes(states.shape, actions.shape)
    except ValueError as error:
        raise InvalidValueError(
            f"actions: shape {actions.shape}, does not broadcast against states {states.shape}"
        ) from error
    return (
        np.ascontiguousarray(np.broadcast_to(states, shape)),
        np.ascontiguousarray(np.broadcast_to(actions, shape)),
    )


def _raise_not_finite(name: str, values: FloatArray) -> NoReturn:
    index = np.unravel_index(int(np.argmin(np.isfinite(values))), values.shape)
    position = ", ".join(str(int(i)) for i in index)
    raise InvalidValueError(f"{name}[{position}]: {values[index]}, must be finite")
