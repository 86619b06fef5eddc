"""Calls of a problem's functions, with their results checked.

A problem is a user's own code, and NumPy forgives much: a mean without its last axis broadcasts to
something, a variance for one coordinate of two to something else, and the decisions are quietly
wrong. So every call of a problem's function passes through here. A result that does not fit is an
error that names the function, what it returned and what was needed. Every array is copied as it
comes: a function may return the same buffer each time. A stream that a function was given ends with
the call. And a user's function runs in the caller's floating-point mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from holdfast import _kernel
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics.arrays import (
    BoolArray,
    FloatArray,
    IntArray,
    floats,
    in_brief,
    is_masked,
    real_numbers,
)
from holdfast.numerics.floating_mode import as_caller
from holdfast.numerics.randomness import Stream
from holdfast.printable import brief
from holdfast.problems.attributes import has_own, name_of

MAX_OBSERVATION_SIZE = 1024

_POSITIVE = (np.nextafter(0.0, 1.0), np.finfo(np.float64).max)


def prediction(
    problem: Any, states: FloatArray, sensing_action: int
) -> tuple[FloatArray, FloatArray]:
    """Return the mean and the variance of the observation in each state.

    The mean has the shape ``(..., observation_size)``, and the variance that or
    ``(observation_size,)``. Whether they are finite is left to the caller.
    """
    mean = _mean(problem, states, sensing_action).copy()
    variance = _variance(problem, states, sensing_action, mean.shape)
    return mean, variance.astype(np.float64, order="C")


def predictions(
    problem: Any, states: FloatArray, sensing_actions: Sequence[int]
) -> tuple[list[int], FloatArray, FloatArray]:
    """Return the predictions for n states under several sensing actions, one below the other.

    They are the sizes of the observations, D in all; their means, shape ``(D, n)``; and their
    variances, shape ``(D, n)``, or ``(D, 1)`` if none depends on the state.
    """
    shown, spread = [], []
    for action in sensing_actions:
        # What comes is copied before the next call, which may return the same buffer.
        mean = _mean(problem, states, action)
        shown.append(mean.T.copy())
        variance = _variance(problem, states, action, mean.shape)
        rows = variance.T if variance.ndim > 1 else variance.reshape(-1, 1)
        spread.append(rows.astype(np.float64, order="C"))
    if any(each.shape[1] > 1 for each in spread):
        spread = [np.repeat(each, len(states) // each.shape[1], axis=1) for each in spread]
    means, variances = np.concatenate(shown), np.concatenate(spread)
    if not _kernel.all_within(variances, *_POSITIVE) or not _kernel.all_finite(means):
        for action in sensing_actions:
            require_usable(problem, action, *prediction(problem, states, action))
    return [len(each) for each in shown], means, variances


def _mean(problem: Any, states: FloatArray, sensing_action: int) -> FloatArray:
    mean: FloatArray = as_caller(problem.observation_mean, states, sensing_action)
    leading = states.shape[:-1]
    if not _is_float_array(mean) or mean.ndim != states.ndim or mean.shape[:-1] != leading:
        what = f"observation_mean of sensing action {sensing_action}"
        raise _misfit(problem, what, mean, (*leading, "observation_size"))
    if not 1 <= mean.shape[-1] <= MAX_OBSERVATION_SIZE:
        raise ProblemError(
            f"observation_mean of {name_of(problem)} has {mean.shape[-1]} coordinates: allowed are "
            f"1 to {MAX_OBSERVATION_SIZE}"
        )
    return mean


def _variance(
    problem: Any, states: FloatArray, sensing_action: int, shape: tuple[int, ...]
) -> FloatArray:
    variance: FloatArray = as_caller(problem.observation_variance, states, sensing_action)
    one = shape[-1:]
    fits = isinstance(variance, np.ndarray) and variance.shape in (one, shape)
    if not fits or variance.dtype.kind not in "biuf" or is_masked(variance):
        need = one if len(shape) == 1 else f"{one} or {shape}"
        what = f"observation_variance of sensing action {sensing_action}"
        raise _misfit(problem, what, variance, need)
    return variance


def require_usable(
    problem: Any, sensing_action: int, mean: FloatArray, variance: FloatArray
) -> None:
    """Raise an error if no observation can have such a prediction."""
    if not _kernel.all_within(variance, *_POSITIVE) or not _kernel.all_finite(mean):
        raise unusable(problem, sensing_action, mean, variance)


def unusable(
    problem: Any, sensing_action: int, mean: FloatArray, variance: FloatArray
) -> ProblemError:
    """Return the error about the first entry of a prediction that no observation can have."""
    function, values, need = "observation_mean", mean, "finite"
    unusable = ~np.isfinite(mean)
    if not unusable.any():
        function, values, need = "observation_variance", variance, "positive and finite"
        unusable = ~((variance > 0.0) & (variance < np.inf))
    index = tuple(map(int, np.argwhere(unusable)[0]))
    return ProblemError(
        f"{function} of {name_of(problem)}, sensing action {sensing_action}, is {values[index]} at "
        f"{_written(index)} of shape {_written(values.shape)}: every entry must be {need}"
    )


def sample_observation(
    problem: Any, state: FloatArray, sensing_action: int, stream: Stream
) -> FloatArray:
    """Return an observation that was drawn in one state, shape ``(observation_size,)``."""
    what = f" of sensing action {sensing_action}"
    return _shown(problem, "sample_observation", state, sensing_action, stream, what=what)


def log_likelihood(
    problem: Any, states: FloatArray, sensing_action: int, observation: FloatArray
) -> FloatArray:
    """Return the log-likelihoods of an observation, shape ``(num_particles,)``."""
    found = _ask(problem, "log_likelihood", states, sensing_action, observation)
    under = f"under sensing action {sensing_action}"
    return _likelihoods(problem, "log_likelihood", found, states, observation, under)


def log_likelihoods(
    problem: Any, states: FloatArray, sensing_action: int, observations: Sequence[FloatArray]
) -> FloatArray:
    """Return those of several observations, shape ``(num_observations, num_particles)``.

    Only for a problem that :func:`~holdfast.problems.attributes.has_batched_likelihoods`.
    """
    function = "log_likelihoods"
    sizes = {each.size for each in observations}
    if len(sizes) > 1:
        raise ProblemError(
            f"sample_observation of {name_of(problem)} drew observations of {min(sizes)} and of "
            f"{max(sizes)} coordinates under sensing action {sensing_action}: {function} needs "
            "them to be of one size"
        )
    together = np.array(observations)
    together.setflags(write=False)
    found = _ask(problem, function, states, sensing_action, together)
    shape = (len(observations), *states.shape[:-1])
    values = _array(problem, function, found, shape)
    under = f"under sensing action {sensing_action}"
    return _require_likelihoods(problem, function, values, together, under)


def move_log_likelihood(
    problem: Any, states: FloatArray, task_action: FloatArray, observation: FloatArray
) -> FloatArray:
    """Return the log-likelihoods of what came with a move, shape ``(num_particles,)``."""
    function = "move_log_likelihood"
    if not hasattr(problem, function):
        raise ProblemError(
            f"a move has shown {in_brief(observation)}, but {name_of(problem)} has no "
            f"{function}(states, action, observation) that could fold it in"
        )
    found = _ask(problem, function, states, task_action, observation)
    return _likelihoods(problem, function, found, states, observation, "after a move")


def _likelihoods(
    problem: Any,
    function: str,
    found: FloatArray,
    states: FloatArray,
    observation: FloatArray,
    where: str,
) -> FloatArray:
    values = _array(problem, function, found, states.shape[:-1])
    return _require_likelihoods(problem, function, values, observation, where)


def _require_likelihoods(
    problem: Any, function: str, values: FloatArray, observation: FloatArray, where: str
) -> FloatArray:
    # A comparison with NaN is false.
    if not (values < np.inf).all():
        if observation.ndim > 1:
            observation = observation[np.argmin((values < np.inf).all(axis=1))]
        raise ProblemError(
            f"{function} of {name_of(problem)}, observation {in_brief(observation)} {where}, "
            "is NaN or plus infinity for a particle"
        )
    return values


def moved_by_measurement(
    problem: Any, states: FloatArray, motion: npt.ArrayLike, stream: Stream
) -> FloatArray:
    """Return states moved by a measured motion, with the noise of the measurement, read-only."""
    measured = floats("motion", motion).reshape(-1).copy()
    if not _kernel.all_finite(measured):
        raise InvalidValueError(f"motion {in_brief(measured)}: every coordinate must be finite")
    function = "move_by_measurement"
    if not hasattr(problem, function):
        raise ProblemError(
            f"a move has the measured motion {in_brief(measured)}, but {name_of(problem)} has no "
            f"{function}(states, motion, stream) that could move the belief by it"
        )
    measured.setflags(write=False)
    return _states(problem, function, states.shape, states, measured, stream)


def measured_motion(
    problem: Any, before: FloatArray, after: FloatArray, stream: Stream
) -> FloatArray:
    """Return the measurement of a true move, shape ``(n,)``."""
    return _shown(problem, "measure_motion", before, after, stream)


def move_observation(
    problem: Any, state: FloatArray, action: FloatArray, stream: Stream
) -> FloatArray:
    """Return what comes with a move into one state, shape ``(n,)``."""
    return _shown(problem, "sample_move_observation", state, action, stream)


def _shown(problem: Any, function: str, *arguments: object, what: str = "") -> FloatArray:
    """Ask a function of the problem for what the world shows, shape ``(n,)``."""
    value, function = _ask(problem, function, *arguments), f"{function}{what}"
    if not isinstance(value, np.ndarray) or real_numbers(value) is None or value.ndim != 1:
        raise _misfit(problem, function, value, "(n,)")
    if not 1 <= value.size <= MAX_OBSERVATION_SIZE or not np.isfinite(value).all():
        raise ProblemError(
            f"{function} of {name_of(problem)} returned {in_brief(value)} of {value.size} "
            f"coordinates: need 1 to {MAX_OBSERVATION_SIZE}, all of them finite"
        )
    return np.array(value)


def policy(problem: Any, states: FloatArray, stage: int | IntArray) -> FloatArray:
    """Return the commanded actions, shape ``(..., action_size)``."""
    shape = (*states.shape[:-1], problem.action_size)
    return _array(problem, "policy", _ask(problem, "policy", states, stage), shape)


def executed_action(problem: Any, commanded: FloatArray) -> FloatArray:
    """Return the executed actions, of the shape of ``commanded``."""
    limited = _ask(problem, "limit_action", commanded)
    return _array(problem, "limit_action", limited, commanded.shape)


def next_stage(problem: Any, estimate: FloatArray, stage: int) -> int:
    """Return the stage that follows."""
    value = _single(problem, "next_stage", _ask(problem, "next_stage", estimate, stage))
    # A comparison with NaN is false.
    if not 0 <= value < problem.num_stages:
        raise ProblemError(
            f"next_stage of {name_of(problem)} is {brief(value)}: allowed are 0 to "
            f"{problem.num_stages - 1}"
        )
    return int(value)


def next_stages(problem: Any, states: FloatArray, stages: IntArray) -> IntArray:
    """Return the stages that follow, one for each state."""
    following = _ask(problem, "next_stage", states, stages)
    return _stages(problem, "next_stage", following, states)


def expected_move(
    problem: Any, states: FloatArray, actions: FloatArray, noise_free: Stream
) -> FloatArray:
    """Return where executed actions lead without noise, of the shape of ``states``, read-only.

    A problem without ``expected_move`` is asked for its ``move`` with the stream ``noise_free``.
    """
    if has_own(problem, "expected_move", ("move",)):
        found = _ask(problem, "expected_move", states, actions)
        moved = _array(problem, "expected_move", found, states.shape)
    else:
        found = _ask(problem, "move", states, actions, noise_free)
        moved = _array(problem, "move", found, states.shape)
    # The caller checks that the actions there are finite, once for many steps.
    moved.setflags(write=False)
    return moved


def expected_path(
    problem: Any, states: FloatArray, stage: int, offsets: Sequence[int], threads: int
) -> tuple[FloatArray, IntArray]:
    """Return the states and stages after each number of steps, the states read-only."""
    found = _ask(problem, "expected_path", states, stage, offsets, threads)
    if not isinstance(found, tuple) or len(found) != 2:
        raise _returned(problem, "expected_path", found, "a tuple of two arrays")
    states_at = _array(problem, "expected_path", found[0], (len(offsets), *states.shape))
    stages_at = _stages(problem, "expected_path", found[1], states_at)
    states_at.setflags(write=False)
    return states_at, stages_at


def path_actions(problem: Any, states: FloatArray, *way: Any) -> FloatArray:
    """Return the actions commanded along each path: a built-in problem's, in the kernel."""
    _, offsets, _ = way
    found = _ask(problem, "_path_actions", states, *way)
    return _array(problem, "_path_actions", found, (len(offsets), len(states), problem.action_size))


def rewards(problem: Any, states: FloatArray, actions: FloatArray) -> FloatArray:
    """Return the rewards of executed actions that led to many states."""
    found = _ask(problem, "reward", states, actions)
    return _finite(problem, "reward", found, states.shape[:-1])


def ends(problem: Any, states: FloatArray) -> tuple[BoolArray, BoolArray | None]:
    """Return which of many states end the task, and which of them in failure.

    The second is None for a problem that has no failures. A state that is a goal, too, is one.
    """
    reached = truths(problem, "is_goal", states)
    if getattr(problem, "is_failure", None) is None:
        return reached, None
    failed = truths(problem, "is_failure", states)
    return reached | failed, failed


def truths(problem: Any, function: str, states: FloatArray) -> BoolArray:
    """Return which states are goals, or failures, of which a problem need not know."""
    shape = states.shape[:-1]
    if getattr(problem, function, None) is None:
        return np.zeros(shape, dtype=bool)
    found = _ask(problem, function, states)
    is_array = isinstance(found, np.ndarray) or not shape  # of one state a truth value will do
    if not is_array or np.shape(found) != shape or np.asarray(found).dtype != np.bool_:
        raise _returned(problem, function, found, f"truth values of shape {_written(shape)}")
    return np.array(found)


def known_state_return(problem: Any, states: FloatArray, stages: IntArray) -> FloatArray | None:
    """Return the problem's own returns of acting in known states; None if it has none."""
    function = "known_state_return"
    if getattr(problem, function, None) is None:
        return None
    rows = np.ascontiguousarray(states).reshape(-1, states.shape[-1])
    rows.setflags(write=False)
    own_stages = np.ascontiguousarray(stages).reshape(-1)
    own_stages.setflags(write=False)
    values = _finite(problem, function, _ask(problem, function, rows, own_stages), rows.shape[:1])
    return values.reshape(stages.shape)


def rollout_returns(
    problem: Any, true_states: FloatArray, estimates: FloatArray, *further: Any
) -> FloatArray:
    """Return the problem's own rollouts, shape (J, M): a built-in problem's, in the kernel."""
    found = _ask(problem, "rollout_returns", true_states, estimates, *further)
    return _array(problem, "rollout_returns", found, estimates.shape[:2])


def initial_states(problem: Any, stream: Stream, count: int) -> FloatArray:
    """Return states drawn from the initial belief, shape ``(count, state_size)``, read-only."""
    return _states(problem, "initial_states", (count, problem.state_size), stream, count)


def reinitial_states(problem: Any, states: FloatArray, stream: Stream) -> FloatArray:
    """Return the states of a belief that is begun anew, of the shape of ``states``, read-only."""
    function = "reinitial_states"
    if getattr(problem, function, None) is None:
        return initial_states(problem, stream, states.shape[0])
    return _states(problem, function, states.shape, states, stream)


def move(problem: Any, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
    """Return the states after executed actions, of the shape of ``states``, read-only."""
    return _states(problem, "move", states.shape, states, actions, stream)


def _states(problem: Any, function: str, shape: tuple[int, ...], *arguments: object) -> FloatArray:
    """Ask a function of the problem for states."""
    states = _array(problem, function, _ask(problem, function, *arguments), shape)
    if not _kernel.all_finite(states):
        rows = states.reshape(-1, shape[-1])
        bad = int(np.argmin(np.isfinite(rows).all(axis=-1)))
        where = f"{in_brief(rows[bad])}: every coordinate must be finite"
        raise ProblemError(f"{function} of {name_of(problem)} put particle {bad} at {where}")
    states.setflags(write=False)
    return states


def move_each(
    problem: Any, states: FloatArray, actions: FloatArray, streams: Sequence[Stream], threads: int
) -> FloatArray:
    """Return b beliefs moved, each by its own action and with its own stream, read-only.

    ``states`` has the shape ``(b, n, state_size)``, ``actions`` ``(b, action_size)``; ``threads``
    counts if the problem has a ``move_each``.
    """
    if has_own(problem, "move_each", ("move",)):
        lent = [stream.lent() for stream in streams]
        moved = _states(problem, "move_each", states.shape, states, actions, lent, threads)
        for stream in lent:
            stream.end()
        return moved
    together = np.empty(states.shape)
    for row, (own, action, stream) in enumerate(zip(states, actions, streams, strict=True)):
        together[row] = move(problem, own, action, stream)
    together.setflags(write=False)
    return together


def reward(problem: Any, state: FloatArray, action: FloatArray) -> float:
    """Return the reward of one executed action that led to one state."""
    return float(_single(problem, "reward", _ask(problem, "reward", state, action)))


def scene(problem: Any) -> Any:
    """Return the problem's drawing, a ``Scene`` or None; its coordinates are those of a state."""
    drawn = _ask(problem, "scene")
    if drawn is None:
        return None
    if not hasattr(drawn, "walls"):
        raise ProblemError(f"scene of {name_of(problem)} gives {in_brief(drawn)}: need a Scene")
    moved = [axes for axes, _ in drawn.walls]
    known = range(problem.state_size)
    if (
        len(drawn.axes) != 2
        or not all(index in known for each in (drawn.axes, *drawn.targets) for index in each)
        or not all(index is None or index in known for index in (drawn.angle, *sum(moved, ())))
    ):
        raise ProblemError(
            f"scene of {name_of(problem)} has axes {drawn.axes}, angle {drawn.angle}, targets "
            f"{drawn.targets} and walls moved by {moved}: need two coordinates each (of angle one "
            f"or None, of a wall each may be None), from 0 to {problem.state_size - 1}"
        )
    return drawn


def is_goal(problem: Any, state: FloatArray) -> bool:
    """Tell whether one state is a goal: true or false, or 1 or 0."""
    return _truth(problem, "is_goal", state)


def is_failure(problem: Any, state: FloatArray) -> bool:
    """Tell whether one state ends the task in failure; none does if the problem does not say."""
    if getattr(problem, "is_failure", None) is None:
        return False
    return _truth(problem, "is_failure", state)


def _truth(problem: Any, function: str, state: FloatArray) -> bool:
    single = _single(problem, function, _ask(problem, function, state))
    if single not in (0, 1):
        raise ProblemError(f"{function} of {name_of(problem)} is {single!r}: must be True or False")
    return bool(single)


def _ask(problem: Any, function: str, *arguments: object) -> Any:
    """Call a function of the problem; streams among the arguments are lent to it for the call."""
    lent = [each.lent() if isinstance(each, Stream) else each for each in arguments]
    found = as_caller(getattr(problem, function), *lent)
    for each in lent:
        if isinstance(each, Stream):
            each.end()
    return found


def _array(problem: Any, function: str, value: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    if not _is_float_array(value) or value.shape != shape:
        raise _misfit(problem, function, value, shape)
    return np.array(value, order="C")  # of no other class, such as a masked array


def _finite(problem: Any, function: str, value: Any, shape: tuple[int, ...]) -> FloatArray:
    values = _array(problem, function, value, shape)
    if not _kernel.all_finite(values):
        raise ProblemError(
            f"{function} of {name_of(problem)} returned {in_brief(values)}: all must be finite"
        )
    return values


def _stages(problem: Any, function: str, stages: Any, states: FloatArray) -> IntArray:
    shape = states.shape[:-1]
    if not isinstance(stages, np.ndarray) or stages.dtype.kind not in "iu" or stages.shape != shape:
        raise _misfit(problem, function, stages, shape, "an array of integers")
    found: IntArray = stages.astype(np.int64)
    if not _kernel.all_integers_within(found, 0, problem.num_stages - 1):
        outside = (stages < 0) | (stages >= problem.num_stages)
        bad = np.unravel_index(int(np.argmax(outside)), shape)
        raise ProblemError(
            f"{function} of {name_of(problem)} has the stage {stages[bad]} for state "
            f"{in_brief(states[bad])}: allowed are 0 to {problem.num_stages - 1}"
        )
    return found


def _single(problem: Any, function: str, value: object) -> Any:
    if type(value) in (int, float, bool):
        return value
    number = None if isinstance(value, (list, tuple)) else np.asarray(value)
    if number is None or number.ndim or number.dtype.kind not in "fiub" or is_masked(value):
        raise _misfit(problem, function, value, ())
    return value


def _is_float_array(value: object) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.float64 and not is_masked(value)


def _misfit(
    problem: Any, function: str, value: object, shape: object, array: str = "a float64 array"
) -> ProblemError:
    need = "one number" if shape == () else f"{array} of shape {_written(shape)}"
    return _returned(problem, function, value, need)


def _returned(problem: Any, function: str, value: object, need: str) -> ProblemError:
    if isinstance(value, np.ndarray):
        masked = ", masked in part," if is_masked(value) else ""
        came = f"{value.dtype}{masked} of shape {value.shape}"
    else:
        came = f"{type(value).__name__} ({brief(value)})"
    return ProblemError(f"{function} of {name_of(problem)} returned {came}: need {need}")


def _written(shape: object) -> str:
    if isinstance(shape, tuple):
        return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
    return str(shape)
