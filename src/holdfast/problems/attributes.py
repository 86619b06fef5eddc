"""What a problem declares about itself: its sizes, sensing actions, resolution and prices.

A problem is a user's own code, and NumPy forgives much: an array that does not fit broadcasts, and
the decisions are quietly wrong. So its attributes are checked before the first step, and
:mod:`holdfast.problems.checked` checks what its functions return. Here a problem is any object,
which may or may not have the members of :class:`holdfast.problems.problem.Problem`.

An attribute may be a list, a tuple or an array, of Python's numbers or NumPy's, which differ where
they are compared, repeated or asked whether they are empty. So it is read here alone, and the
functions here return tuples of Python's own numbers and texts, and arrays of float64.
"""

from __future__ import annotations

import functools
import inspect
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from holdfast.earlier_names import EARLIER_NAMES, warn_of_earlier_name
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics.arrays import FloatArray, in_brief, integer, real_numbers
from holdfast.printable import brief

MAX_SENSING_COST = 1e150
"""So that no sum of prices, and no square of one, is too large for a float."""

PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "initial_states": ("stream", "count"),
    "move": ("states", "actions", "stream"),
    "expected_move": ("states", "actions"),
    "expected_path": ("states", "stage", "offsets", "threads"),
    "observation_mean": ("states", "sensing_action"),
    "observation_variance": ("states", "sensing_action"),
    "policy": ("states", "stage"),
    "next_stage": ("estimates", "stage"),
    "limit_action": ("actions",),
    "reward": ("states", "actions"),
    "is_goal": ("states",),
    "is_failure": ("states",),
    "scene": (),
    "log_likelihood": ("states", "sensing_action", "observation"),
    "sample_observation": ("state", "sensing_action", "stream"),
    "log_likelihoods": ("states", "sensing_action", "observations"),
    "known_state_return": ("states", "stages"),
    "move_each": ("states", "actions", "streams", "threads"),
    "move_by_measurement": ("states", "motion", "stream"),
    "measure_motion": ("before", "after", "stream"),
    "move_log_likelihood": ("states", "action", "observation"),
    "sample_move_observation": ("state", "action", "stream"),
    "reinitial_states": ("states", "stream"),
}
"""Arguments of a problem's functions, by position."""

GAUSSIAN_OBSERVATIONS = ("observation_mean", "observation_variance")
"""Functions that a problem with a likelihood of its own need not have."""


_NEARLY = 0.82
"""Likeness (difflib's) from which on a name is taken for another one, as is_failed for is_failure;
observation_size, which a problem may well have, is less like observation_mean."""

NEEDED = ("initial_states", "move", "policy", "is_goal")
"""Functions without which no problem can be used; its observations are needed, too."""

KNOWN_ATTRIBUTES = (
    *("name", "state_size", "action_size", "num_stages", "sensing_actions", "state_labels"),
    *("resolution", "state_resolution", "motion_variance", "sensing_costs", "rank_test"),
    "static_parameters",
    *("circular", "circular_actions", "circular_observations", "pose", "up"),
)


def check_problem(problem: Any) -> None:
    """Check all that can be checked without calling a function of the problem.

    A name that is nearly one that holdfast asks for, which the problem lacks, is warned of.

    Raises
    ------
    ProblemError
        If an attribute is missing or out of bounds, a function cannot be called as it will be, or
        only one of ``log_likelihood`` and ``sample_observation`` is there, or ``log_likelihoods``
        without them.
    """
    check_sizes(problem)
    know_earlier_names(type(problem))
    name = problem.name
    observations = () if has_general_observations(problem) else GAUSSIAN_OBSERVATIONS
    missing = [each for each in (*NEEDED, *observations) if not hasattr(problem, each)]
    if missing:
        raise ProblemError(f"{name} has no {' and no '.join(missing)}{misspelt_in(problem)}")
    if not sensing_labels(problem):
        raise ProblemError(
            f"sensing_actions of {name} is {brief(getattr(problem, 'sensing_actions', ()))}: must "
            "be a sequence of labels, not empty"
        )
    sensing_costs(problem)
    _check_coordinates(problem)
    labels = state_labels(problem)
    if labels and len(labels) != problem.state_size:
        raise ProblemError(
            f"state_labels of {name} has {len(labels)} labels: must have {problem.state_size} or "
            "none"
        )
    _check_resolution(problem, "resolution", "an action", problem.action_size)
    if getattr(problem, "state_resolution", None) is not None:
        _check_resolution(problem, "state_resolution", "a state", problem.state_size)
    variance = getattr(problem, "motion_variance", ())
    numbers = real_numbers(variance)
    fits = numbers is not None and numbers.shape == (problem.action_size,)
    if numbers is None or not fits or not (numbers >= 0.0).all():
        raise ProblemError(
            f"motion_variance of {name} is {in_brief(variance)}: must be {problem.action_size} "
            "numbers >= 0"
        )
    if not isinstance(ranks := getattr(problem, "rank_test", False), bool | np.bool_):
        raise ProblemError(f"rank_test of {name} is {brief(ranks)}: must be True or False")
    both = ("log_likelihood", "sample_observation")
    given = [function for function in both if hasattr(problem, function)]
    if not given and hasattr(problem, "log_likelihoods"):
        given = ["log_likelihoods"]
    if len(given) == 1:
        raise ProblemError(
            f"{name} has {given[0]} alone: log_likelihood and sample_observation go together"
            f"{misspelt_in(problem)}"
        )
    if hint := misspelt_in(problem):
        warnings.warn(f"{name}{hint}", stacklevel=2)
    for function, parameters in PARAMETERS.items():
        if hasattr(problem, function):
            _check_parameters(name, function, getattr(problem, function), parameters)


def misspelt_in(problem: Any) -> str:
    """Return what to ask after names of a problem that are nearly known ones; empty for none."""
    own = frozenset(name for name in getattr(problem, "__dict__", {}) if name[0] != "_")
    kind: type = type(problem)
    return _misspelt(kind, own)


@functools.lru_cache(maxsize=1000)
def _misspelt(kind: type, of_instance: frozenset[str]) -> str:
    theirs = [base for base in kind.__mro__ if not base.__module__.startswith("holdfast.")]
    names = {name for base in theirs for name in vars(base) if name[0] != "_"} | of_instance
    known = {*PARAMETERS, *KNOWN_ATTRIBUTES}
    if names <= known or kind.__module__.startswith("holdfast."):
        return ""
    import difflib

    # One that the problem has was hardly meant by another.
    lacking = sorted(
        known - names - {*(GAUSSIAN_OBSERVATIONS if "log_likelihood" in names else ())}
    )
    found = [
        f"{name}: did you mean {meant[0]}?"
        for name in sorted(names - known)
        if (meant := difflib.get_close_matches(name.lower(), lacking, n=1, cutoff=_NEARLY))
    ]
    return f"; it has {', and '.join(found)}" if found else ""


def check_sizes(problem: Any) -> None:
    """Check the name and the sizes, which every use of a problem needs; raise ProblemError.

    A size of NumPy's is replaced by Python's own: it is read everywhere, and ``[0.0] * size`` is
    something else with NumPy's.
    """
    if isinstance(problem, type):
        called = problem.__name__
        raise ProblemError(f"the problem {called} is a class; make one: {called}()")
    kind = type(problem).__name__
    name = getattr(problem, "name", "")
    if not isinstance(name, str) or not name:
        raise ProblemError(f"name of {kind} is {name!r}: must be a text, not empty")
    for attribute in ("state_size", "action_size", "num_stages"):
        given = getattr(problem, attribute, None)
        size = integer(given)
        if size is None or size < 1:
            raise ProblemError(f"{attribute} of {name} is {given!r}: must be a whole number >= 1")
        if type(given) is not int:
            try:
                setattr(problem, attribute, size)
            except AttributeError:
                raise ProblemError(
                    f"{attribute} of {name} is {given!r} and cannot be set: declare it as "
                    f"int, {size}"
                ) from None


def _check_resolution(problem: Any, attribute: str, of_what: str, size: int) -> None:
    value = getattr(problem, attribute, None)
    numbers = real_numbers(value)
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


def _check_coordinates(problem: Any) -> None:
    name = problem.name
    for attribute, size, what in (
        ("circular", "state_size", _ANGLES),
        ("circular_actions", "action_size", _ANGLES),
        ("static_parameters", "state_size", "do not move"),
    ):
        given = getattr(problem, attribute, ())
        _require_indices(name, attribute, given, getattr(problem, size), what)
    given = getattr(problem, "circular_observations", ())
    own = sequence_of(given)
    if own == ():
        return
    count = len(problem.sensing_actions)
    if has_general_observations(problem):
        raise ProblemError(
            f"circular_observations of {name} is {brief(given)}: it does nothing beside "
            "log_likelihood, which has to know itself what is an angle; leave it out, or give ()"
        )
    if own is None or len(own) != count:
        raise ProblemError(
            f"circular_observations of {name} is {brief(given)}: must be {count} sequences, one of "
            "each sensing action, with the coordinates of its observation that are angles"
        )
    for action, each in enumerate(own):
        _require_indices(name, f"circular_observations[{action}]", each, None)


_ANGLES = "are angles in radians"


def _require_indices(
    name: str, attribute: str, given: Any, size: int | None, what: str = _ANGLES
) -> None:
    numbers = real_numbers(given)
    usable = numbers is not None and numbers.ndim == 1
    if numbers is not None and usable and numbers.size:
        usable = (
            numbers.dtype.kind in "iu"
            and numbers.min() >= 0
            and (size is None or numbers.max() < size)
            and np.unique(numbers).size == numbers.size
        )
    if not usable:
        limit = "" if size is None else f" to {size - 1}"
        raise ProblemError(
            f"{attribute} of {name} is {brief(given)}: must be different indices of coordinates "
            f"that {what}, from 0{limit}, such as (0,)"
        )


def sequence_of(given: object) -> tuple[Any, ...] | None:
    """Return a declared list, tuple or array as a tuple; None for anything else, a text too."""
    if isinstance(given, np.ndarray):
        given = given.tolist()
    return tuple(given) if isinstance(given, Sequence) and not isinstance(given, str) else None


def _indices(given: Any) -> tuple[int, ...]:
    """Return indices that :func:`check_problem` has let pass."""
    return tuple(map(int, given))


def sensing_labels(problem: Any) -> tuple[str, ...]:
    """Return a label for each sensing action; ProblemError if one is no text."""
    labels = sequence_of(getattr(problem, "sensing_actions", ())) or ()
    for label in labels:
        if not isinstance(label, str):
            raise ProblemError(
                f"sensing_actions of {name_of(problem)} has {brief(label)}: labels must be text"
            )
    return tuple(map(str, labels))


def sensing_action_of(problem: Any, given: object, *, optional: bool = False) -> int:
    """Return the index of a sensing action, or with ``optional`` that of not to sense.

    Raises InvalidValueError if the problem has no such one.
    """
    count = len(problem.sensing_actions)
    chosen = integer(given)
    if chosen is None or not 0 <= chosen < count + optional:
        raise InvalidValueError(
            f"sensing action {brief(given)}: {problem.name} has 0 to {count - 1}"
        )
    return chosen


def state_labels(problem: Any) -> tuple[str, ...]:
    """Return a label for each coordinate of a state; empty if the problem has none.

    ProblemError if they are no sequence of labels: a text is one label.
    """
    given = getattr(problem, "state_labels", None)
    labels = () if given is None else sequence_of(given)
    if labels is None:
        raise ProblemError(
            f"state_labels of {name_of(problem)} is {brief(given)}: must be a sequence of labels, "
            "one for each coordinate of a state, or empty"
        )
    return tuple(map(str, labels))


def coordinate_name(problem: Any, number: int) -> str:
    """Return what messages call a coordinate of a state."""
    labels = state_labels(problem)
    return labels[number] if labels else f"coordinate {number} of a state"


def circular_states(problem: Any) -> Sequence[int]:
    """Return which coordinates of a state are angles."""
    return _indices(getattr(problem, "circular", ()))


def static_parameters(problem: Any) -> Sequence[int]:
    """Return which coordinates of a state are parameters that do not move."""
    return _indices(getattr(problem, "static_parameters", ()))


def circular_actions(problem: Any) -> Sequence[int]:
    """Return which coordinates of a task action are angles."""
    return _indices(getattr(problem, "circular_actions", ()))


def has_circular_observations(problem: Any) -> bool:
    """Tell whether a problem says which coordinates of an observation are angles."""
    return len(getattr(problem, "circular_observations", ())) > 0


def circular_observation(problem: Any, sensing_action: int, size: int) -> Sequence[int]:
    """Return which of the ``size`` coordinates that a sensing action shows are angles.

    Raises ProblemError if there is no such coordinate.
    """
    if not has_circular_observations(problem):
        return ()
    own = _indices(problem.circular_observations[sensing_action])
    if any(coordinate >= size for coordinate in own):
        raise ProblemError(
            f"circular_observations[{sensing_action}] of {name_of(problem)} is {brief(own)}: "
            f"sensing action {sensing_action} shows {size} coordinates, 0 to {size - 1}"
        )
    return own


def resolution_of(
    problem: Any, given: float | Sequence[float] | None, *, of_states: bool
) -> float | FloatArray:
    """Return the resolution of the points whose entropy counts: actions, or states.

    It is one number for all coordinates, or one for each: ``given`` (``selector.resolution``), or
    the problem's own. Raises InvalidValueError if they are not as many as the coordinates.
    """
    of_what, size = ("a state", "state_size") if of_states else ("an action", "action_size")
    if given is not None:
        if isinstance(given, (int, float)):
            return given
        count = getattr(problem, size)
        if len(given) != count:
            raise InvalidValueError(
                f"selector.resolution is {list(given)}, {len(given)} numbers; need one number, or "
                f"{count} for {name_of(problem)}, one for each coordinate of {of_what}"
            )
        return np.array(given, dtype=np.float64)
    attribute = "resolution"
    if of_states and getattr(problem, "state_resolution", None) is not None:
        attribute = "state_resolution"
    own = getattr(problem, attribute)
    if type(own) is float:
        return own
    # A configuration asks before check_problem has.
    numbers = real_numbers(own)
    if numbers is None:
        raise ProblemError(f"{attribute} of {name_of(problem)} is {brief(own)}: must be numbers")
    if numbers.ndim == 0:
        return own if isinstance(own, (int, float)) else float(numbers)
    if of_states and attribute == "resolution" and problem.state_size != problem.action_size:
        raise InvalidValueError(
            f"selector.method is state_entropy, but the resolution of {name_of(problem)} has "
            f"{numbers.size} numbers, for the coordinates of an action, and a state has "
            f"{problem.state_size}; give the problem a state_resolution, one number or "
            f"{problem.state_size}, or write selector.resolution"
        )
    return numbers.astype(np.float64)


def _check_parameters(name: str, function: str, own: Any, parameters: tuple[str, ...]) -> None:
    wanted = f"{function}({', '.join(parameters)})"
    if not callable(own):
        raise ProblemError(f"{function} of {name} is {own!r}: must be a function, {wanted}")
    # The result for a class is kept: each trial checks its problem.
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
        return None  # Some compiled functions have no signature.
    try:
        signature.bind(*arguments)
    except TypeError:
        return str(signature)
    return None


def sensing_costs(problem: Any, *, otherwise: float = 0.0, optional: bool = False) -> FloatArray:
    """Return the checked price of each sensing action, shape ``(J,)``.

    ``otherwise`` is that of each where the problem has no prices. With ``optional`` a last entry of
    zero stands for not sensing.
    """
    costs = _costs_of_actions(problem, otherwise)
    return np.append(costs, 0.0) if optional else costs


def _costs_of_actions(problem: Any, otherwise: float) -> FloatArray:
    count = len(problem.sensing_actions)
    given = getattr(problem, "sensing_costs", None)
    if given is None:
        return np.full(count, otherwise)
    costs = real_numbers(given)
    # A comparison with NaN is false.
    if (
        costs is None
        or costs.shape != (count,)
        or not ((costs >= 0.0) & (costs <= MAX_SENSING_COST)).all()
    ):
        raise ProblemError(
            f"sensing_costs of {name_of(problem)} is {in_brief(given)}: must be {count} "
            f"numbers from 0 to {MAX_SENSING_COST:g}, one for each sensing action"
        )
    return costs.astype(np.float64)


def has_general_observations(problem: object) -> bool:
    """Tell whether a problem gives a likelihood of its own instead of a Gaussian one."""
    return hasattr(problem, "log_likelihood")


def has_batched_likelihoods(problem: object) -> bool:
    """Tell whether a problem evaluates the likelihoods of several observations at once."""
    return has_own(problem, "log_likelihoods", ("log_likelihood",))


def choice_labels(problem: Any) -> list[str]:
    """Return a label for each choice: the sensing actions, and not to sense."""
    return [*sensing_labels(problem), "no sensing"]


def moves_give_observations(problem: object) -> bool:
    """Tell whether a problem can fold in what a move shows: a measured motion, an observation."""
    return hasattr(problem, "move_by_measurement") or hasattr(problem, "move_log_likelihood")


def know_earlier_names(kind: type) -> None:
    """Give the classes of a problem ``limit_action`` and ``execute``, its earlier name."""
    for base in kind.__mro__:
        for name, other in (("limit_action", "execute"), ("execute", "limit_action")):
            if name in vars(base) and other not in vars(base):
                if name in EARLIER_NAMES:
                    warn_of_earlier_name(name)
                setattr(base, other, vars(base)[name])


def has_own(problem: Any, function: str, stands_for: tuple[str, ...]) -> bool:
    """Tell whether a problem's function agrees with those that it stands for.

    It does not if a subclass or instance replaces one of ``stands_for`` and inherits ``function``:
    an inherited ``expected_path`` does not follow a new ``policy``.
    """
    if not hasattr(problem, function):
        return False
    own = getattr(problem, "__dict__", {})
    if any(name in own for name in (function, *stands_for)):
        return function in own
    kind: type = type(problem)
    return _agrees(kind, function, stands_for)


@functools.lru_cache(maxsize=1000)
def _agrees(kind: type, function: str, stands_for: tuple[str, ...]) -> bool:
    for base in kind.__mro__:
        if function in vars(base):
            return True
        if any(name in vars(base) for name in stands_for):
            return False
    return True


def name_of(problem: Any) -> str:
    """Return what messages call a problem, even one without a name."""
    return getattr(problem, "name", "") or type(problem).__name__
