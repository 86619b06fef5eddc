"""Problems by name: holdfast's own, those of installed packages, and single files.

The table below is the only place that names holdfast's own problems. They are found without a
search through everything installed, which takes longer than all else that a service does before it
can decide. Another package registers its problems as entry points of the group
``holdfast.problems``. A single file needs no registration: its problem is ``module:Class``.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from holdfast.errors import InvalidValueError, UnknownProblemError
from holdfast.numerics.arrays import plain
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.printable import brief
from holdfast.problems.problem import Problem

GROUP = "holdfast.problems"


class BuiltIn(NamedTuple):
    """One of holdfast's own problems.

    ``place`` is its module and class. Only this problem has all ``signature_keys`` in the section
    ``model``: the thesis's files do not name their problem, these keys tell it.
    """

    place: str
    signature_keys: frozenset[str]


BUILT_IN = {
    "peg_in_hole_2d": BuiltIn(
        "holdfast.problems.peg_in_hole_2d:PegInHole2D", frozenset({"peg_width"})
    ),
    "multitier_peg_in_hole_2d": BuiltIn(
        "holdfast.problems.multitier_peg_in_hole_2d:MultitierPegInHole2D", frozenset({"holes"})
    ),
    "capsule_robot": BuiltIn(
        "holdfast.problems.capsule_robot:CapsuleRobot", frozenset({"robot_radius"})
    ),
    "peg_in_hole_3d": BuiltIn(
        "holdfast.problems.peg_in_hole_3d:PegInHole3D", frozenset({"peg_dim", "hole_tolerance"})
    ),
}
"""holdfast's own problems by name."""


def names() -> list[str]:
    """Return all names, built in and registered, sorted."""
    from holdfast.config.user_code import registered_names

    return sorted({*BUILT_IN, *registered_names(GROUP)})


@in_own_mode
def make_problem(name: str, **settings: Any) -> Problem:
    """Build a problem by its registered name, or ``module:Class``.

    The settings are keys of the sections ``model`` and ``state_space_planner`` of a configuration
    (docs/problems.md); those left out have their defaults.

    Raises
    ------
    UnknownProblemError
        If there is no such problem.
    InvalidValueError, ProblemError
        If the problem does not take these settings.
    """
    if not isinstance(name, str):
        raise InvalidValueError(
            f"name is {brief(name)}; expected a text: one of {', '.join(names())}, or module:Class"
        )
    kind = problem_class(name)
    planner_keys = getattr(getattr(kind, "StateSpacePlanner", None), "__struct_fields__", ())
    planner = {key: settings.pop(key) for key in planner_keys if key in settings}
    model_keys = getattr(getattr(kind, "Model", None), "__struct_fields__", None)
    if model_keys is not None:
        settings, planner = plain(settings), plain(planner)
        allowed = [*model_keys, *planner_keys]
        for key in settings:
            if key not in model_keys:
                from holdfast.validation import close_match

                raise InvalidValueError(
                    f"{name} has no setting {key!r}{close_match(key, allowed)}; allowed: "
                    f"{', '.join(allowed)}"
                )
    try:
        problem: Problem = kind.from_settings(settings, planner)
    except msgspec.ValidationError as error:
        from holdfast.validation import dotted, find_mismatch

        for schema, data in (("Model", settings), ("StateSpacePlanner", planner)):
            found = find_mismatch(data, getattr(kind, schema, dict))
            if found is not None and found.path:
                raise InvalidValueError(
                    f"{name}: {dotted(found.path)} {found.in_words()}"
                ) from error
        raise InvalidValueError(f"{name}: {error}") from error
    return problem


def problem_class(name: str, search_directory: Path | None = None) -> type[Any]:
    """Find the class of a problem by its registered name, or ``module:Class``.

    The search directory is that in which ``module`` is looked for first
    (:mod:`holdfast.config.user_modules`). Raises UnknownProblemError if the name is not registered,
    or the module or its class cannot be imported.
    """
    if name in BUILT_IN:
        module_name, _, class_name = BUILT_IN[name].place.partition(":")
        built_in: type[Any] = getattr(importlib.import_module(module_name), class_name)
        return built_in
    from holdfast.config.user_code import find_class

    return find_class(
        name,
        what="problem",
        group=GROUP,
        built_in=BUILT_IN,
        search_directory=search_directory,
        error_type=UnknownProblemError,
    )


def problem_module(name: str) -> str | None:
    """Return the module of a problem's class; None for a name that is not registered."""
    place = name if ":" in name else None
    if name in BUILT_IN:
        place = BUILT_IN[name].place
    elif place is None and name:
        import importlib.metadata

        found = importlib.metadata.entry_points(group=GROUP, name=name)
        place = next((entry_point.value for entry_point in found), None)
    return None if place is None else place.partition(":")[0].strip()
