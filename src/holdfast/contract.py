"""Holding problems to their contract, where what they return is used.

A problem is somebody's own code, and NumPy forgives: a mean without its last axis broadcasts to
something, a variance for one coordinate of two to something else, and the decisions are quietly
wrong. So every array that a problem returns passes through here, and one that does not fit is an
error that names the function, what came and what was needed.
"""

from __future__ import annotations

import functools
import inspect
import sys
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from holdfast import _kernel
from holdfast.errors import InvalidValueError, ProblemError

__all__ = [
    "check_problem",
    "check_sizes",
    "executed_action",
    "expected_move",
    "expected_path",
    "first_reward",
    "goals",
    "has_general_observations",
    "has_own",
    "in_brief",
    "known_state_return",
    "log_likelihood",
    "move_each",
    "next_stage",
    "next_stages",
    "observation_mean",
    "observation_variance",
    "policy",
    "resolution_of",
    "rewards",
    "sample_observation",
    "scalar",
    "sensing_costs",
    "states_of",
    "truth",
    "unusable_prediction",
]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]

# The contract itself is holdfast.problems.problem.Problem. Here a problem is anything that may or
# may not fulfil it.
MAX_OBSERVATION_SIZE = 1024

MAX_SENSING_COST = 1e150
"""So that no sum of prices, and no square of one, is too large for a float."""

_EDGE = 4
"""Entries of a long array that a message has, at either end."""

PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "initial_states": ("stream", "count"),
    "move": ("states", "actions", "stream"),
    "expected_move": ("states", "actions"),
    "expected_path": ("states", "stage", "offsets", "threads"),
    "observation_mean": ("states", "sensing_action"),
    "observation_variance": ("states", "sensing_action"),
    "policy": ("states", "stage"),
    "next_stage": ("estimates", "stage"),
    "execute": ("actions",),
    "reward": ("states", "actions"),
    "is_goal": ("states",),
    "scene": (),
    "log_likelihood": ("states", "sensing_action", "observation"),
    "sample_observation": ("state", "sensing_action", "stream"),
    "known_state_return": ("states", "stages"),
    "move_each": ("states", "actions", "streams", "threads"),
}
"""What a problem's functions are called with, by position."""

GAUSSIAN_OBSERVATIONS = ("observation_mean", "observation_variance")
"""What a problem with a likelihood of its own need not have."""


def check_problem(problem: Any) -> None:
    """Check what can be checked without calling anything.

    Raises
    ------
    ProblemError
        If an attribute is missing or out of bounds, a function cannot be called as it will be, or
        only one of ``log_likelihood`` and ``sample_observation`` is there.
    """
    check_sizes(problem)
    name = problem.name
    actions = getattr(problem, "sensing_actions", ())
    if isinstance(actions, str) or not isinstance(actions, Sequence) or not actions:
        raise ProblemError(
            f"sensing_actions of {name} is {actions!r:.80}: must be a sequence of labels, not empty"
        )
    for label in actions:
        if not isinstance(label, str):
            raise ProblemError(f"sensing_actions of {name} has {label!r:.80}: labels must be text")
    sensing_costs(problem)
    labels = getattr(problem, "state_labels", ())
    if labels and len(labels) != problem.state_size:
        raise ProblemError(
            f"state_labels of {name} has {len(labels)} labels: must have {problem.state_size} or "
            "none"
        )
    _check_resolution(problem, "resolution", "an action", problem.action_size)
    if getattr(problem, "state_resolution", None) is not None:
        _check_resolution(problem, "state_resolution", "a state", problem.state_size)
    variance = getattr(problem, "motion_variance", ())
    numbers = _numbers(variance)
    fits = numbers is not None and numbers.shape == (problem.action_size,)
    if numbers is None or not fits or not (numbers >= 0.0).all():
        raise ProblemError(
            f"motion_variance of {name} is {in_brief(variance)}: must be {problem.action_size} "
            "numbers >= 0"
        )
    given = [
        function
        for function in ("log_likelihood", "sample_observation")
        if hasattr(problem, function)
    ]
    if len(given) == 1:
        raise ProblemError(
            f"{name} has {given[0]} alone: log_likelihood and sample_observation go together"
        )
    for function, parameters in PARAMETERS.items():
        if hasattr(problem, function):
            _check_parameters(name, function, getattr(problem, function), parameters)


def check_sizes(problem: Any) -> None:
    """Check what any use of a problem needs first: its name and its numbers of coordinates.

    Raises
    ------
    ProblemError
        If one of them is missing or out of bounds.
    """
    kind = type(problem).__name__
    name = getattr(problem, "name", "")
    if not isinstance(name, str) or not name:
        raise ProblemError(f"name of {kind} is {name!r}: must be a text, not empty")
    for attribute in ("state_size", "action_size", "num_stages"):
        size = getattr(problem, attribute, None)
        if not isinstance(size, int) or size < 1:
            raise ProblemError(f"{attribute} of {name} is {size!r}: must be a whole number >= 1")


def _check_resolution(problem: Any, attribute: str, of_what: str, size: int) -> None:
    value = getattr(problem, attribute, None)
    numbers = _numbers(value)
    # A comparison with NaN is false.
    usable = numbers is not None and ((numbers > 0.0) & (numbers < np.inf)).all()
    if numbers is not None and numbers.ndim == 0 and not usable:
        raise ProblemError(
            f"{attribute} of {problem.name} is {numbers.item()!r}: must be positive and finite"
        )
    if numbers is None or not usable or numbers.shape not in ((), (size,)):
        raise ProblemError(
            f"{attribute} of {problem.name} is {in_brief(value)}: must be one number or {size}, "
            f"one for each coordinate of {of_what}, positive and finite"
        )


def _numbers(value: object) -> npt.NDArray[Any] | None:
    """Return an array, if this is one or more numbers (a truth value is none)."""
    try:
        numbers = np.asarray(value)
    except (TypeError, ValueError):
        return None  # A ragged list.
    return numbers if numbers.dtype.kind in "fiu" else None


def resolution_of(
    problem: Any, given: float | Sequence[float] | None, *, of_states: bool
) -> float | FloatArray:
    """Return the resolution of the points whose entropy counts.

    Parameters
    ----------
    problem : Problem
    given : float or sequence of float, optional
        ``selector.resolution``; None for the problem's own.
    of_states : bool
        Whether the points are states instead of actions.

    Returns
    -------
    float or array
        One number for all coordinates, or one for each.

    Raises
    ------
    InvalidValueError
        If the numbers are not as many as the coordinates.
    """
    of_what, size = ("a state", "state_size") if of_states else ("an action", "action_size")
    if given is not None:
        if isinstance(given, (int, float)):
            return given
        count = getattr(problem, size)
        if len(given) != count:
            raise InvalidValueError(
                f"selector.resolution is {list(given)}, {len(given)} numbers; need one number, or "
                f"{count} for {_name(problem)}, one for each coordinate of {of_what}"
            )
        return np.array(given, dtype=np.float64)
    attribute = "resolution"
    if of_states and getattr(problem, "state_resolution", None) is not None:
        attribute = "state_resolution"
    own = getattr(problem, attribute)
    # A configuration asks before check_problem has.
    numbers = _numbers(own)
    if numbers is None:
        raise ProblemError(f"{attribute} of {_name(problem)} is {own!r:.80}: must be numbers")
    if numbers.ndim == 0:
        return own if isinstance(own, (int, float)) else float(numbers)
    if of_states and attribute == "resolution" and problem.state_size != problem.action_size:
        raise InvalidValueError(
            f"selector.method is state_entropy, but the resolution of {_name(problem)} has "
            f"{numbers.size} numbers, for the coordinates of an action, and a state has "
            f"{problem.state_size}; give the problem a state_resolution, one number or "
            f"{problem.state_size}, or write selector.resolution"
        )
    return numbers.astype(np.float64)


def _check_parameters(name: str, function: str, own: Any, parameters: tuple[str, ...]) -> None:
    wanted = f"{function}({', '.join(parameters)})"
    if not callable(own):
        raise ProblemError(f"{function} of {name} is {own!r}: must be a function, {wanted}")
    # What a class has is looked at once, and not again for each trial.
    if inspect.ismethod(own):
        takes = _takes(own.__func__, (None, *parameters))
    else:
        takes = _takes.__wrapped__(own, parameters)
    if takes is not None:
        raise ProblemError(f"{function} of {name} takes {takes}: it is called as {wanted}")


@functools.lru_cache(maxsize=1000)
def _takes(function: Any, arguments: tuple[str | None, ...]) -> str | None:
    """Return what a function takes, if it cannot be called with so many arguments."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return None  # Of some compiled functions nobody knows.
    try:
        signature.bind(*arguments)
    except TypeError:
        return str(signature)
    return None


def sensing_costs(problem: Any) -> FloatArray:
    """Return the checked price of each sensing action, shape ``(J,)``; zeros if there is none."""
    count = len(problem.sensing_actions)
    given = getattr(problem, "sensing_costs", None)
    if given is None:
        return np.zeros(count)
    costs = _numbers(given)
    # A comparison with NaN is false.
    if (
        costs is None
        or costs.shape != (count,)
        or not ((costs >= 0.0) & (costs <= MAX_SENSING_COST)).all()
    ):
        raise ProblemError(
            f"sensing_costs of {_name(problem)} is {in_brief(given)}: must be {count} "
            f"numbers from 0 to {MAX_SENSING_COST:g}, one for each sensing action"
        )
    return costs.astype(np.float64)


def first_reward(problem: Any) -> float | None:
    """Return the reward of a trial in which nothing happened yet; None if nothing gives one.

    Looks that have prices are rewards, were they all free; a task action may have none.
    """
    return None if getattr(problem, "sensing_costs", None) is None else 0.0


def has_general_observations(problem: object) -> bool:
    """Tell whether a problem gives a likelihood of its own instead of a Gaussian one."""
    return hasattr(problem, "log_likelihood")


def observation_mean(problem: Any, states: FloatArray, sensing_action: int) -> FloatArray:
    """Return the checked expected observation, shape ``(..., observation_size)``."""
    mean = problem.observation_mean(states, sensing_action)
    if not _is_array(mean, states.ndim) or mean.shape[:-1] != states.shape[:-1]:
        raise _misfit(
            problem,
            f"observation_mean of sensing action {sensing_action}",
            mean,
            (*states.shape[:-1], "observation_size"),
        )
    if not 1 <= mean.shape[-1] <= MAX_OBSERVATION_SIZE:
        raise ProblemError(
            f"observation_mean of {_name(problem)} has {mean.shape[-1]} coordinates: allowed are "
            f"1 to {MAX_OBSERVATION_SIZE}"
        )
    checked: FloatArray = mean
    return checked


def observation_variance(
    problem: Any, states: FloatArray, sensing_action: int, mean: FloatArray
) -> FloatArray:
    """Return the checked variance, shape ``(observation_size,)`` or that of ``mean``."""
    variance = problem.observation_variance(states, sensing_action)
    if not isinstance(variance, np.ndarray) or variance.shape not in (mean.shape[-1:], mean.shape):
        raise _misfit(
            problem,
            f"observation_variance of sensing action {sensing_action}",
            variance,
            mean.shape[-1:] if mean.ndim == 1 else f"{mean.shape[-1:]} or {mean.shape}",
        )
    checked: FloatArray = variance
    return checked


def unusable_prediction(
    problem: Any, sensing_action: int, mean: FloatArray, variance: FloatArray
) -> ProblemError:
    """Return the error about the first entry of a mean or variance that no observation can have.

    Whether there is one the caller has found out, in less time than it takes to find it.
    """
    function, values, need = "observation_mean", mean, "finite"
    unusable = ~np.isfinite(mean)
    if not unusable.any():
        function, values, need = "observation_variance", variance, "positive and finite"
        # A comparison with NaN is false.
        unusable = ~((variance > 0.0) & (variance < np.inf))
    index = tuple(map(int, np.argwhere(unusable)[0]))
    return ProblemError(
        f"{function} of {_name(problem)}, sensing action {sensing_action}, is {values[index]} at "
        f"{_written(index)} of shape {_written(values.shape)}: every entry must be {need}"
    )


def sample_observation(
    problem: Any, state: FloatArray, sensing_action: int, stream: object
) -> FloatArray:
    """Return a checked observation that was drawn in one state, shape ``(observation_size,)``."""
    drawn = problem.sample_observation(state, sensing_action, stream)
    if not isinstance(drawn, np.ndarray) or drawn.dtype.kind not in "fiu" or drawn.ndim != 1:
        raise _misfit(
            problem,
            f"sample_observation of sensing action {sensing_action}",
            drawn,
            "(observation_size,)",
        )
    if not 1 <= drawn.size <= MAX_OBSERVATION_SIZE or not np.isfinite(drawn).all():
        raise ProblemError(
            f"sample_observation of {_name(problem)} returned {in_brief(drawn)} of "
            f"{drawn.size} coordinates: need 1 to {MAX_OBSERVATION_SIZE}, all of them finite"
        )
    checked: FloatArray = drawn
    return checked


def log_likelihood(
    problem: Any, states: FloatArray, sensing_action: int, observation: FloatArray
) -> FloatArray:
    """Return the checked log-likelihoods of an observation, shape ``(num_particles,)``."""
    values = problem.log_likelihood(states, sensing_action, observation)
    if not _is_array(values, 1) or values.shape != states.shape[:-1]:
        raise _misfit(problem, "log_likelihood", values, states.shape[:-1])
    if np.isnan(values).any() or (values == np.inf).any():
        raise ProblemError(
            f"log_likelihood of {_name(problem)}, observation {in_brief(observation)} under "
            f"sensing action {sensing_action}, is NaN or plus infinity for a particle"
        )
    checked: FloatArray = values
    return checked


def policy(problem: Any, states: FloatArray, stage: int | IntArray) -> FloatArray:
    """Return the checked commanded actions, shape ``(..., action_size)``."""
    actions = problem.policy(states, stage)
    shape = (*states.shape[:-1], problem.action_size)
    if not _is_array(actions, states.ndim) or actions.shape != shape:
        raise _misfit(problem, "policy", actions, shape)
    checked: FloatArray = actions
    return checked


def executed_action(problem: Any, commanded: FloatArray) -> FloatArray:
    """Return the checked executed actions, of the shape of ``commanded``."""
    actions = problem.execute(commanded)
    if not _is_array(actions, commanded.ndim) or actions.shape != commanded.shape:
        raise _misfit(problem, "execute", actions, commanded.shape)
    checked: FloatArray = actions
    return checked


def next_stage(problem: Any, estimate: FloatArray, stage: int) -> int:
    """Return the checked stage that follows."""
    value = _single(problem, "next_stage", problem.next_stage(estimate, stage))
    # NaN is not, either.
    if not 0 <= value < problem.num_stages:
        raise ProblemError(
            f"next_stage of {_name(problem)} is {value!r:.40}: allowed are 0 to "
            f"{problem.num_stages - 1}"
        )
    return int(value)


def next_stages(
    problem: Any, states: FloatArray, stages: npt.NDArray[np.int64]
) -> npt.NDArray[np.int64]:
    """Return the checked stages that follow, one for each state."""
    following = problem.next_stage(states, stages)
    _check_stages(problem, "next_stage", following, states)
    checked: npt.NDArray[np.int64] = following
    return checked


def _check_stages(problem: Any, function: str, stages: Any, states: FloatArray) -> None:
    shape = states.shape[:-1]
    if not isinstance(stages, np.ndarray) or stages.dtype.kind not in "iu" or stages.shape != shape:
        raise _misfit(problem, function, stages, shape, "an array of integers")
    if stages.size and (stages.min() < 0 or stages.max() >= problem.num_stages):
        outside = (stages < 0) | (stages >= problem.num_stages)
        bad = np.unravel_index(int(np.argmax(outside)), shape)
        raise ProblemError(
            f"{function} of {_name(problem)} has the stage {stages[bad]} for state "
            f"{in_brief(states[bad])}: allowed are 0 to {problem.num_stages - 1}"
        )


def expected_move(
    problem: Any, states: FloatArray, actions: FloatArray, noise_free: object
) -> FloatArray:
    """Return where executed actions lead without noise, of the shape of ``states``, read-only.

    A problem without ``expected_move`` is asked for its ``move`` with the stream ``noise_free``.
    """
    function = "expected_move"
    if has_own(problem, function, ("move",)):
        moved = problem.expected_move(states, actions)
    else:
        function = "move"
        moved = problem.move(states, actions, noise_free)
    # Whether they are finite is asked of the actions there, once for many steps.
    if not _is_array(moved, states.ndim) or moved.shape != states.shape:
        raise _misfit(problem, function, moved, states.shape)
    checked: FloatArray = moved
    checked.setflags(write=False)
    return checked


def expected_path(
    problem: Any, states: FloatArray, stage: int, offsets: Sequence[int], threads: int
) -> tuple[FloatArray, npt.NDArray[np.int64]]:
    """Return the checked states and stages after each number of steps, the states read-only."""
    found = problem.expected_path(states, stage, offsets, threads)
    shape = (len(offsets), *states.shape)
    if not isinstance(found, tuple) or len(found) != 2:
        raise _returned(problem, "expected_path", found, "a tuple of two arrays")
    states_at, stages_at = found
    if not _is_array(states_at, 3) or states_at.shape != shape:
        raise _misfit(problem, "expected_path", states_at, shape)
    _check_stages(problem, "expected_path", stages_at, states_at)
    states_at.setflags(write=False)
    return states_at, stages_at


def has_own(problem: Any, function: str, spoken_for: tuple[str, ...]) -> bool:
    """Tell whether a problem has a function that speaks for others, and has not replaced those.

    A subclass with a policy of its own inherits a path that is none of that policy.
    """
    if not hasattr(problem, function):
        return False
    own = getattr(problem, "__dict__", {})
    if any(name in own for name in (function, *spoken_for)):
        return function in own
    kind: type = type(problem)
    return _speaks_for(kind, function, spoken_for)


@functools.lru_cache(maxsize=1000)
def _speaks_for(kind: type, function: str, spoken_for: tuple[str, ...]) -> bool:
    for base in kind.__mro__:
        if function in vars(base):
            return True
        if any(name in vars(base) for name in spoken_for):
            return False
    return True


def rewards(problem: Any, states: FloatArray, actions: FloatArray) -> FloatArray:
    """Return the checked rewards of executed actions that led to many states."""
    values = problem.reward(states, actions)
    shape = states.shape[:-1]
    if not _is_array(values, len(shape)) or values.shape != shape:
        raise _misfit(problem, "reward", values, shape)
    if not _kernel.all_finite(np.ascontiguousarray(values)):
        raise ProblemError(
            f"reward of {_name(problem)} returned {in_brief(values)}: all must be finite"
        )
    checked: FloatArray = values
    return checked


def goals(problem: Any, states: FloatArray) -> BoolArray:
    """Return, checked, which of many states are goals."""
    reached = problem.is_goal(states)
    shape = states.shape[:-1]
    if not isinstance(reached, np.ndarray) or reached.dtype != np.bool_ or reached.shape != shape:
        raise ProblemError(
            f"is_goal of {_name(problem)}, asked of {states.shape[0]} states at once, returned "
            f"{reached!r:.80}: need as many truth values"
        )
    return reached


def known_state_return(problem: Any, states: FloatArray, stages: IntArray) -> FloatArray | None:
    """Return the problem's own returns of acting in known states, checked; None if it has none."""
    function = getattr(problem, "known_state_return", None)
    if function is None:
        return None
    rows = np.ascontiguousarray(states).reshape(-1, states.shape[-1])
    rows.setflags(write=False)
    own_stages = np.ascontiguousarray(stages).reshape(-1)
    own_stages.setflags(write=False)
    values = function(rows, own_stages)
    if not _is_array(values, 1) or values.shape != rows.shape[:1]:
        raise _misfit(problem, "known_state_return", values, rows.shape[:1])
    if not _kernel.all_finite(np.ascontiguousarray(values)):
        raise ProblemError(
            f"known_state_return of {_name(problem)} returned {in_brief(values)}: all must be "
            "finite"
        )
    checked: FloatArray = values.reshape(stages.shape)
    return checked


def states_of(
    problem: Any, function: str, states: FloatArray, shape: tuple[int, ...]
) -> FloatArray:
    """Return states that a function of the problem made, checked, and read-only from now on."""
    if not _is_array(states, len(shape)) or states.shape != shape:
        raise _misfit(problem, function, states, shape)
    if not _kernel.all_finite(states):
        rows = states.reshape(-1, shape[-1])
        bad = int(np.argmin(np.isfinite(rows).all(axis=-1)))
        where = in_brief(rows[bad])
        raise ProblemError(f"{function} of {_name(problem)} put particle {bad} at {where}")
    contiguous = np.ascontiguousarray(states)
    contiguous.setflags(write=False)
    return contiguous


def move_each(
    problem: Any,
    states: FloatArray,
    actions: FloatArray,
    streams: Sequence[object],
    threads: int,
) -> FloatArray:
    """Return several beliefs moved, each by its own action, checked, and read-only from now on.

    Parameters
    ----------
    problem : Problem
    states : array of shape (b, n, state_size)
    actions : array of shape (b, action_size)
    streams : sequence of Stream
        One for each belief.
    threads : int
        At most so many, if the problem has a ``move_each``; 0 is all.
    """
    if has_own(problem, "move_each", ("move",)):
        moved = problem.move_each(states, actions, streams, threads)
        return states_of(problem, "move_each", moved, states.shape)
    together = np.empty(states.shape)
    for row, (own, action, stream) in enumerate(zip(states, actions, streams, strict=True)):
        together[row] = states_of(problem, "move", problem.move(own, action, stream), own.shape)
    together.setflags(write=False)
    return together


def scalar(problem: Any, function: str, value: object) -> float:
    """Return one number that a function of the problem gave for one state."""
    return float(_single(problem, function, value))


def truth(problem: Any, function: str, value: object) -> bool:
    """Return what a function of the problem says of one state: true or false, or 1 or 0."""
    single = _single(problem, function, value)
    if single not in (0, 1):
        raise ProblemError(f"{function} of {_name(problem)} is {single!r}: must be True or False")
    return bool(single)


def _single(problem: Any, function: str, value: object) -> Any:
    if type(value) in (int, float, bool):
        return value
    if isinstance(value, (list, tuple)):
        raise _misfit(problem, function, value, ())
    number = np.asarray(value)
    if number.ndim != 0 or number.dtype.kind not in "fiub":
        raise _misfit(problem, function, value, ())
    return value


def in_brief(values: object) -> str:
    """Return an array on one line, a long one without its middle.

    Parameters
    ----------
    values : array
    """
    try:
        array = np.asarray(values)
    except (TypeError, ValueError):
        return _in_short(values, 80)  # A ragged list.
    return np.array2string(array, max_line_width=sys.maxsize, threshold=2 * _EDGE, edgeitems=_EDGE)


def _in_short(value: object, length: int) -> str:
    return " ".join(repr(value).split())[:length]


def _is_array(value: object, dimensions: int) -> bool:
    return isinstance(value, np.ndarray) and value.dtype == np.float64 and value.ndim == dimensions


def _name(problem: Any) -> str:
    return getattr(problem, "name", "") or type(problem).__name__


def _misfit(
    problem: Any, function: str, value: object, shape: object, array: str = "a float64 array"
) -> ProblemError:
    need = "one number" if shape == () else f"{array} of shape {_written(shape)}"
    return _returned(problem, function, value, need)


def _returned(problem: Any, function: str, value: object, need: str) -> ProblemError:
    if isinstance(value, np.ndarray):
        came = f"{value.dtype} of shape {value.shape}"
    else:
        came = f"{type(value).__name__} ({_in_short(value, 40)})"
    return ProblemError(f"{function} of {_name(problem)} returned {came}: need {need}")


def _written(shape: object) -> str:
    if isinstance(shape, tuple):
        return f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
    return str(shape)
