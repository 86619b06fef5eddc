"""Problems by name.

A package registers its problems as entry points of the group ``holdfast.problems``; a single file
needs no registration and is named ``module:Class``. holdfast's own problems are registered as well,
but they are found without a search through everything that is installed: that takes longer than
all else that a service does before it can decide.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from holdfast.errors import UnknownProblemError

__all__ = ["BUILT_IN", "names", "problem_class", "problem_module"]

GROUP = "holdfast.problems"

BUILT_IN = {
    "peg_in_hole_2d": "holdfast.problems.peg_in_hole_2d:PegInHole2D",
    "multitier_peg_in_hole_2d": "holdfast.problems.multitier_peg_in_hole_2d:MultitierPegInHole2D",
    "capsule_robot": "holdfast.problems.capsule_robot:CapsuleRobot",
    "peg_in_hole_3d": "holdfast.problems.peg_in_hole_3d:PegInHole3D",
}
"""holdfast's own problems; the same as their entry points."""


def names() -> list[str]:
    """Return the registered names, sorted."""
    from holdfast.user_code import registered_names

    return registered_names(GROUP)


def problem_class(name: str, search_directory: Path | None = None) -> type[Any]:
    """Find the class of a problem.

    Parameters
    ----------
    name : str
        A registered name, or ``module:Class``.
    search_directory : Path, optional
        Directory in which ``module`` is looked for first. It goes on the import path and stays
        there, as a script's directory does, for the module may import its neighbours later.

    Returns
    -------
    type
        Has the members of :class:`~holdfast.problems.problem.Problem`.

    Raises
    ------
    UnknownProblemError
        If the name is not registered, or the module or its class cannot be imported.
    """
    if name in BUILT_IN:
        module_name, _, class_name = BUILT_IN[name].partition(":")
        built_in: type[Any] = getattr(importlib.import_module(module_name), class_name)
        return built_in
    from holdfast.user_code import find_class

    return find_class(
        name,
        what="problem",
        group=GROUP,
        search_directory=search_directory,
        error_type=UnknownProblemError,
    )


def problem_module(name: str) -> str | None:
    """Return the name of the module in which a problem's class is looked up.

    Parameters
    ----------
    name : str
        A registered name, or ``module:Class``.

    Returns
    -------
    str or None
        None for a name that is not registered.
    """
    place = name if ":" in name else BUILT_IN.get(name)
    if place is None and name:
        import importlib.metadata

        found = importlib.metadata.entry_points(group=GROUP, name=name)
        place = next((entry_point.value for entry_point in found), None)
    return None if place is None else place.partition(":")[0].strip()
