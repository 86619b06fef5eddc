"""The contract of a problem: a plain object of NumPy functions.

A problem says how the world moves, what a sensing action would show, what the task planner does in
a known state, and when the task is done. Everything else (the belief, the entropies, the choice)
is holdfast's. Write a class with the members of :class:`Problem`; subclassing is not needed, but
:class:`ProblemBase` gives sensible defaults for the optional ones.

Arrays of states have any leading batch shape and the state's coordinates last: ``(state_size,)`` is
one state, ``(num_particles, state_size)`` a belief, ``(trials, num_particles, state_size)`` many.
A function is called with any of these and returns the same leading shape, as float64. The arrays
that it is given are read-only: make a new one instead of changing them.

Two threads never use one instance at the same time, but a run has several instances, and each may
be called with anything in any order. So what an instance keeps from one call to the next (a cache)
must not change what it returns. It may return the same buffer each time: results are copied.

Observations are Gaussian, by :meth:`Problem.observation_mean` and
:meth:`Problem.observation_variance`, unless the problem has the two methods of
:class:`GeneralObservationProblem`. What an action does without noise follows from
:meth:`Problem.move`, unless the problem has a method of :class:`ExpectedMotionProblem`.

Random numbers come from the :class:`~holdfast.numerics.randomness.Stream` that a function is given.
It has methods of a NumPy ``Generator``, goes on as one does, and begins anew in each call of a
function; with the call it ends, and must not be kept.

To have the same decisions, bit for bit, on every machine, a problem uses only operations that IEEE
754 defines exactly (``+ - * /``, ``np.sqrt``, comparisons, ``np.where``) and takes ``exp``,
``sin``, sums and the like from :mod:`holdfast.numerics`. A problem with other operations works,
too, but then another machine needs the checkpoint of a state and cannot compute the state again.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol, Self, runtime_checkable

import msgspec
import numpy as np
import numpy.typing as npt

from holdfast.conversion import convert
from holdfast.errors import ProblemError
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray, plain, real_numbers
from holdfast.numerics.randomness import Stream
from holdfast.printable import brief
from holdfast.problems.attributes import know_earlier_names


class Scene:
    """The drawing of a problem: the plane of two coordinates, its obstacles and the body.

    Parameters
    ----------
    axes : tuple of int
        Which two coordinates of the state are drawn, horizontal first.
    obstacles : array of shape (m, 4)
        Rectangles as ``x_min, y_min, x_max, y_max`` in that plane.
    limits : tuple of float
        The part of the plane to show, ``x_min, y_min, x_max, y_max``. A figure shows less of it
        where nothing happened, and more where ``goal`` or ``points`` lie outside.
    body : array of shape (p, 2), or float, or None
        Outline of the robot's body about its centre at angle zero, or the radius of a disc.
    angle : int or None
        Index of the coordinate by which the body is turned, counter-clockwise, in radians.
    goal : array of shape (2,) or None
        Centre of the goal.
    points : array of shape (q, 2) or None
        Places of interest (via points, lamps); all of them are shown.
    targets : sequence of (int, int)
        What is somewhere else in the plane as a part of the state (somebody to follow, a landmark
        that is searched for): its two coordinates of the state, horizontal first.
    walls : sequence of ((int or None, int or None), rectangle)
        Obstacles whose place is a part of the state: a rectangle as in ``obstacles``, moved by
        these two coordinates of the state; None does not move it.

    Raises
    ------
    ProblemError
        If an argument has another shape, or is no coordinate of a state where one is needed.

    Examples
    --------
    A door of one metre in the wall at x = 2, whose height is the fourth coordinate of the state:

    >>> import holdfast as hf
    >>> scene = hf.Scene((0, 1), (0, 0, 4, 3), walls=[((None, 3), (1.9, -0.5, 2.1, 0.5))])
    """

    def __init__(
        self,
        axes: tuple[int, int],
        limits: tuple[float, float, float, float],
        obstacles: npt.ArrayLike = (),
        body: npt.ArrayLike | float | None = None,
        angle: int | None = None,
        goal: npt.ArrayLike | None = None,
        points: npt.ArrayLike | None = None,
        targets: Sequence[tuple[int, int]] = (),
        walls: Sequence[tuple[tuple[int | None, int | None], npt.ArrayLike]] = (),
    ) -> None:
        self.axes: tuple[int, int] = _of_state("axes", axes)
        low, high = np.split(_in_scene("limits", limits, (4,)), 2)
        if not (low < high).all() or not np.isfinite(high - low).all():
            raise ProblemError(
                f"limits of a Scene is {brief(limits)}: must be finite x_min, y_min, x_max, y_max, "
                "x_min below x_max and y_min below y_max"
            )
        self.limits = limits
        self.obstacles = _in_scene("obstacles", obstacles, (None, 4))
        if body is not None:
            is_radius = isinstance(body, str | float | int | np.number)
            outline = _in_scene("body", body, () if is_radius else (None, 2))
            if is_radius and not outline > 0.0:
                raise ProblemError(f"body of a Scene is {brief(body)}: a radius must be above 0")
            body = float(outline) if is_radius else outline
        self.body = body
        self.angle: int | None = _of_state("angle", angle)
        self.goal = None if goal is None else _in_scene("goal", goal, (2,))
        self.points = None if points is None else _in_scene("points", points, (None, 2))
        self.targets: list[tuple[int, int]] = _of_state("targets", targets)
        self.walls: list[tuple[tuple[int | None, int | None], FloatArray]] = [
            (pair, _in_scene("walls", wall, (4,))) for pair, wall in _of_state("walls", walls)
        ]


_PAIRS: Any = list[tuple[int, int]]
_MOVED: Any = list[tuple[tuple[int | None, int | None], list[float]]]
_OF_STATE: Mapping[str, tuple[Any, str]] = {
    "axes": (tuple[int, int], "two coordinates of the state, such as (0, 1)"),
    "angle": (int | None, "a coordinate of the state, such as 2, or None"),
    "targets": (_PAIRS, "pairs of coordinates of the state, such as [(2, 3)]"),
    "walls": (_MOVED, "coordinates that move rectangles, such as [((None, 3), (0, 0, 1, 2))]"),
}


def _of_state(name: str, value: object) -> Any:
    kind, needed = _OF_STATE[name]
    try:
        return convert(plain(value), kind)
    except msgspec.ValidationError:
        raise ProblemError(f"{name} of a Scene is {brief(value)}: must be {needed}") from None


def _in_scene(name: str, value: object, shape: tuple[int | None, ...]) -> FloatArray:
    numbers = real_numbers(value)
    sizes = ", ".join("any number" if want is None else str(want) for want in shape)
    need = f"of the shape ({sizes})" if shape else "a single one"
    if numbers is None:
        raise ProblemError(f"{name} of a Scene is {brief(value)}: must be numbers, {need}")
    numbers = np.array(numbers, dtype=np.float64)
    if numbers.shape == (0,) and len(shape) == 2:
        return np.empty((0, shape[1] or 0))
    fits = len(shape) == numbers.ndim and all(
        want in (None, have) for want, have in zip(shape, numbers.shape, strict=True)
    )
    if not fits or np.isnan(numbers).any():
        raise ProblemError(
            f"{name} of a Scene has the shape {numbers.shape}: must be ({sizes}), without NaN"
        )
    return numbers


@runtime_checkable
class Problem(Protocol):
    """The contract between a problem and everything else.

    Attributes
    ----------
    name : str
        The registered name; it is what crosses the wire.
    state_size, action_size : int
        Numbers of coordinates of a state and of a task action.
    sensing_actions : sequence of str
        A label for each sensing action; a sensing action is an index into it.
    num_stages : int
        Stages of the task (holes to pass, via points to reach); 1 where there are none.
    resolution : float or array of shape (action_size,)
        Distance below which two task actions do not differ in practice, in the actions' unit: of
        the order of the motion noise's standard deviation, or of what the task tolerates, if that
        is larger and sensors differ in sharpness. An array gives each coordinate its own, in its
        own unit (0.1 m and 0.05 rad), so distances count in resolutions and the choice of what to
        sense does not depend on units. One number fits where all coordinates have the same.
    motion_variance : array of shape (action_size,)
        Variance of the noise on an executed action, for the Gaussian-mixture entropy.
    state_labels : sequence of str
        Names of the state's coordinates with units, for figures; empty for none.

    Notes
    -----
    Sequences may be lists, tuples or arrays, and numbers Python's or NumPy's.

    A problem may also have ``state_resolution``, a float or an array of shape ``(state_size,)``:
    the resolution of states, for ``state_entropy`` and for nothing else. Without it (or with None)
    states have the actions' resolution, which must then be one number, or an action must have as
    many coordinates as a state.

    It may say which coordinates are angles in radians, so that pi is -pi: ``circular`` of a state,
    ``circular_actions`` of a task action, both as indices (``(2,)``), and ``circular_observations``
    of observations, a sequence of indices for each sensing action (``((), (0,))``: the second one
    shows a bearing). Means, spreads, innovations and entropies then go round the circle the shorter
    way. The functions of the problem may be given any whole number of turns more or less, and take
    ``numerics.wrapped(goal - heading)`` for a difference of angles. Noise on an observed angle is
    that of its shorter way round, so its standard deviation should be below one radian.

    It may say which coordinates of a state are continuous parameters that do not move (a landmark,
    a drift), as indices: ``static_parameters = (2, 3)``. Resampling then draws them anew from a
    kernel about each particle (:func:`holdfast.planning.belief.regularised`); otherwise copies of a
    few values are left. What must keep its values, a bit, is none.

    It may have ``sensing_costs``, the price of each sensing action in units of reward, numbers
    from 0 to 1e150. A trial's reward is less by it at each sensing, and ``expected_return`` weighs
    it against what sensing gains; methods that minimise an entropy do with a rate,
    ``selector.nats_per_cost``. Without this attribute sensing costs nothing. Not to sense is no
    sensing action: ``selector.sensing_is_optional`` makes it a choice, of price 0.
    """

    name: str
    state_size: int
    action_size: int
    sensing_actions: Sequence[str]
    num_stages: int
    motion_variance: FloatArray
    state_labels: Sequence[str]

    @property
    def resolution(self) -> float | FloatArray:
        """Distance below which two task actions do not differ, or one for each coordinate."""
        ...

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        """Draw ``count`` states of the initial belief, shape ``(count, state_size)``."""
        ...

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        """Draw the states after executed ``actions``, which broadcast against ``states``."""
        ...

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the expected observation, shape ``(..., observation_size)``."""
        ...

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        """Return the variance of each coordinate of the observation.

        Shape ``(observation_size,)`` where it is the same for all states, else
        ``(..., observation_size)``.
        """
        ...

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        """Return the commanded task actions, shape ``(..., action_size)``.

        ``stage`` is one integer or an array that broadcasts against the leading shape.
        """
        ...

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        """Return the stage that follows from the state estimate, of the shape of ``stage``."""
        ...

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Limit commanded actions to what one step can do."""
        ...

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return the reward of executed ``actions`` that led to ``states``, leading shape."""
        ...

    def is_goal(self, states: FloatArray) -> BoolArray:
        """Tell which states end the task with success, of the leading shape."""
        ...

    def scene(self) -> Scene | None:
        """Return what can be drawn, or None."""
        ...


class GeneralObservationProblem(Protocol):
    """Two more methods, for observations that are not Gaussian. Both or neither.

    With them ``observation_mean`` and ``observation_variance`` are not used and need not be there.
    Sensing costs more: the likelihood is evaluated in Python, once for each hypothetical
    observation, or once for all of a sensing action (:class:`BatchedObservationProblem`).

    A robot is found lost (:mod:`holdfast.planning.lost`) by observations that no particle can have
    made. A likelihood that is zero nowhere has none of these. An attribute ``rank_test = True``
    asks for the test by :func:`holdfast.planning.validation_gate.is_typical` instead: each
    observation is compared with up to 19 drawn ones, which takes as many evaluations of the
    likelihood, 3.5 on average. It is right if what is left out of the likelihood does not depend on
    the observation.
    """

    def log_likelihood(
        self, states: FloatArray, sensing_action: int, observation: FloatArray
    ) -> FloatArray:
        """Return log p(observation | state) for each state, up to one constant.

        ``states`` has the shape ``(num_particles, state_size)``, the result ``(num_particles,)``.
        Minus infinity where a state cannot have made the observation; never NaN or plus infinity.
        """
        ...

    def sample_observation(
        self, state: FloatArray, sensing_action: int, stream: Stream
    ) -> FloatArray:
        """Draw an observation in one state, shape ``(observation_size,)``."""
        ...


class BatchedObservationProblem(Protocol):
    """One more method, for speed, beside those of :class:`GeneralObservationProblem`."""

    def log_likelihoods(
        self, states: FloatArray, sensing_action: int, observations: FloatArray
    ) -> FloatArray:
        """Return :meth:`GeneralObservationProblem.log_likelihood` of several observations.

        ``observations`` has the shape ``(num_observations, observation_size)``, the result
        ``(num_observations, num_particles)``: what is the same for all of them is computed once.
        The result has the bits of one after the other. A method that a class inherits is not used
        if the class itself replaces ``log_likelihood``.
        """
        ...


class ExpectedMotionProblem(Protocol):
    """Two more methods, for the selector ``path_entropy``, which follows particles without noise.

    Either, both or none. One that a class inherits is not used if the class itself replaces what it
    speaks for: ``move``, and for the path ``policy``, ``limit_action`` and ``next_stage`` as well.
    """

    def expected_move(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return the states after executed ``actions`` if nothing is random, as ``states``.

        A problem that does not have this is asked for its ``move`` with the stream
        :data:`~holdfast.numerics.randomness.NOISE_FREE`, whose numbers are all at the middle. A
        problem needs the method if it draws otherwise (from ``stream.words``, or again and again
        until something fits). It may have it to be faster.
        """
        ...

    def expected_path(
        self, states: FloatArray, stage: int, offsets: Sequence[int], threads: int
    ) -> tuple[FloatArray, IntArray]:
        """Follow the policy from each state, in one stage, without noise.

        Return the states after each number of steps of ``offsets`` (ascending), shape
        ``(len(offsets), n, state_size)``, and the stages there, shape ``(len(offsets), n)``. A step
        is the policy's action for the state and its stage, limited by ``limit_action``, the motion
        without noise, and ``next_stage`` of where that leads. ``threads`` may be used, or all cores
        if it is 0. What the path is without this method
        it must be with it: it is there to be faster.
        """
        ...


class BatchedMotionProblem(Protocol):
    """One more method, for ``active_sensing.horizon`` above 1 on all cores; no problem needs it."""

    def move_each(
        self, states: FloatArray, actions: FloatArray, streams: Sequence[Stream], threads: int
    ) -> FloatArray:
        """Move several beliefs, each by an action and with a stream of its own.

        The shapes are ``(b, n, state_size)``, ``(b, action_size)`` and ``(b,)``. The result has the
        bits of ``move`` of one belief after the other, for any number of ``threads`` (0: all). One
        that a class inherits is not used if the class itself replaces ``move``.
        """
        ...


class ShownMovesProblem(Protocol):
    """Methods for moves that show something: a measured motion, an observation. Any of them.

    The robot's environment returns what a move has shown
    (:class:`~holdfast.planning.outcome.MoveResult`); these say what it means. With the first or the
    third the next decision waits for what the move shows, so a service is asked at each step.
    """

    def move_by_measurement(
        self, states: FloatArray, motion: FloatArray, stream: Stream
    ) -> FloatArray:
        """Draw the states after a move whose motion was measured, as ``states``.

        It takes the place of ``move`` in the belief: the noise is that of the measurement.
        ``motion`` is what the environment returned, shape ``(n,)``.
        """
        ...

    def measure_motion(self, before: FloatArray, after: FloatArray, stream: Stream) -> FloatArray:
        """Draw the measurement of a true move from state to state, shape ``(n,)``; to simulate."""
        ...

    def move_log_likelihood(
        self, states: FloatArray, action: FloatArray, observation: FloatArray
    ) -> FloatArray:
        """Return log p(observation | state after the move), up to one constant, for each state.

        ``states`` has the shape ``(num_particles, state_size)``, the executed ``action``
        ``(action_size,)`` and the result ``(num_particles,)``. Minus infinity where a state cannot
        have shown that; never NaN or plus infinity.
        """
        ...

    def sample_move_observation(
        self, state: FloatArray, action: FloatArray, stream: Stream
    ) -> FloatArray:
        """Draw what comes with a move into one state, shape ``(n,)``; to simulate."""
        ...


class ReinitialisedProblem(Protocol):
    """One more method, for a robot that is lost; without it its belief is the initial one again."""

    def reinitial_states(self, states: FloatArray, stream: Stream) -> FloatArray:
        """Draw a new belief after the particles ``states``, of the same shape."""
        ...


class FailingProblem(Protocol):
    """One more method, for a task that can fail; without it a trial succeeds or runs out of steps.

    A simulated trial ends there as ``"failed"``, and so does a rollout of ``expected_return``. By
    rewards, a rollout has no further ones then: give the failure one of its own (in ``reward``,
    which is asked of the state that was reached), or to fail soon is cheap. Counted in steps, it
    costs all that are left of ``selector.rollout_steps``. A real robot's environment says itself
    how a trial ends.
    """

    def is_failure(self, states: FloatArray) -> BoolArray:
        """Tell which states end the task in failure, of the leading shape, also if at a goal."""
        ...


class KnownStateReturnProblem(Protocol):
    """One more method, for ``selector.method: expected_return``; no problem needs it."""

    def known_state_return(self, states: FloatArray, stages: IntArray) -> FloatArray:
        """Return the expected discounted return of acting in known states from now on.

        ``states`` has the shape ``(n, state_size)``, ``stages`` and the result ``(n,)``; the
        discount is ``active_sensing.discount``, and the unit is that of the reward. It takes the
        place of simulating the policy up to the goal, and may be better than the policy.
        """
        ...


def _meant(kind: type, given: list[str]) -> str:
    """Return what to ask after a setting that a constructor does not take; empty for nothing."""
    import inspect

    from holdfast.validation import close_match

    try:
        takes = list(inspect.signature(kind).parameters)
    except (TypeError, ValueError):
        return ""
    return "".join(close_match(key, takes) for key in given if key not in takes)


class ProblemBase:
    """Defaults for the optional members of :class:`Problem`.

    A subclass sets ``name``, ``state_size``, ``action_size``, ``sensing_actions``, ``resolution``
    and ``motion_variance`` and writes ``initial_states``, ``move``, ``policy``, ``is_goal`` and
    either ``observation_mean`` and ``observation_variance`` or ``log_likelihood`` and
    ``sample_observation`` (:class:`GeneralObservationProblem`).
    """

    name: str = ""
    state_size: int = 0
    action_size: int = 0
    sensing_actions: Sequence[str] = ()
    num_stages: int = 1
    resolution: float | FloatArray = 0.1
    state_resolution: float | FloatArray | None = None
    circular: Sequence[int] = ()
    static_parameters: Sequence[int] = ()
    circular_actions: Sequence[int] = ()
    circular_observations: Sequence[Sequence[int]] = ()
    motion_variance: FloatArray = np.array([0.01])
    state_labels: Sequence[str] = ()
    pose: Sequence[str | None] = ()
    """Which coordinates of the state are a pose, for ROS: see :mod:`holdfast.reports.poses`."""
    up: str = "z"
    """Which axis of that pose points up: z, or y for a problem in a vertical plane."""

    def __init_subclass__(cls, **keywords: Any) -> None:
        """Let a class define ``limit_action`` under its earlier name, ``execute``."""
        super().__init_subclass__(**keywords)
        know_earlier_names(cls)

    @classmethod
    def from_settings(
        cls, model: Mapping[str, Any], state_space_planner: Mapping[str, Any]
    ) -> Self:
        """Build the problem from the sections ``model`` and ``state_space_planner``.

        The default passes the keys of both to the constructor as keyword arguments.

        Raises
        ------
        ProblemError
            If a key is in both sections or the constructor does not take it.
        """
        both = sorted(set(model) & set(state_space_planner))
        if both:
            raise ProblemError(
                f"{', '.join(both)}: given in both model and state_space_planner; keep one"
            )
        try:
            return cls(**model, **state_space_planner)
        except TypeError as error:
            raise ProblemError(
                f"{cls.__name__} cannot be built from its settings (the keys of model): {error}"
                f"{_meant(cls, [*model, *state_space_planner])}"
            ) from error

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        """Stay in the stage: the task has one."""
        del estimates
        return stage

    def limit_action(self, actions: FloatArray) -> FloatArray:
        """Do as commanded: actions have no limits."""
        return actions

    execute = limit_action

    def reward(self, states: FloatArray, actions: FloatArray) -> FloatArray:
        """Return zero: the task is judged by success alone.

        A problem that does not override this has no reward, and its trials have none either.
        """
        return np.zeros(np.broadcast_shapes(states.shape[:-1], actions.shape[:-1]))

    def scene(self) -> Scene | None:
        """Return None: nothing to draw."""
        return None
