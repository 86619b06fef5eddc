"""Problems by name.

A package registers its problems as entry points of the group ``holdfast.problems``; a single file
needs no registration and is named ``module:Class``.
"""

from __future__ import annotations

import difflib
import importlib
import importlib.metadata
import sys
from pathlib import Path
from typing import Any

from holdfast.errors import UnknownProblemError

__all__ = ["names", "problem_class"]

GROUP = "holdfast.problems"


def names() -> list[str]:
    """Return the registered names, sorted."""
    return sorted(
        {entry_point.name for entry_point in importlib.metadata.entry_points(group=GROUP)}
    )


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
    if ":" in name:
        return _imported_class(name, search_directory)
    for entry_point in importlib.metadata.entry_points(group=GROUP, name=name):
        try:
            loaded = entry_point.load()
        except (ImportError, AttributeError) as error:
            raise UnknownProblemError(
                f"problem: {name}, is registered as {entry_point.value}, which cannot be imported: "
                f"{error}"
            ) from error
        return _as_class(name, loaded)
    known = names()
    close = difflib.get_close_matches(name, known, n=3)
    suggestion = f"did you mean {' or '.join(close)}? " if close else ""
    raise UnknownProblemError(
        f"problem: {name}, is not registered; {suggestion}Registered are "
        f"{', '.join(known) or 'none'}; a class of your own is named module:Class"
    )


def _imported_class(name: str, search_directory: Path | None) -> type[Any]:
    module_name, _, class_name = name.partition(":")
    if not all(part.isidentifier() for part in [*module_name.split("."), class_name]):
        raise UnknownProblemError(f"problem: {name}, must be a registered name or module:Class")
    if search_directory is not None:
        directory = str(search_directory.resolve())
        if directory not in sys.path:
            sys.path.insert(0, directory)
            importlib.invalidate_caches()
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        where = "" if search_directory is None else f" (looked in {search_directory} first)"
        raise UnknownProblemError(
            f"problem: {name}, the module {module_name} cannot be imported{where}: {error}"
        ) from error
    if not hasattr(module, class_name):
        classes = [key for key, value in vars(module).items() if isinstance(value, type)]
        close = difflib.get_close_matches(class_name, classes, n=3)
        suggestion = f"; did you mean {' or '.join(close)}?" if close else ""
        raise UnknownProblemError(
            f"problem: {name}, the module {module_name} has no {class_name}{suggestion}"
        )
    return _as_class(name, getattr(module, class_name))


def _as_class(name: str, found: object) -> type[Any]:
    if not isinstance(found, type):
        raise UnknownProblemError(f"problem: {name}, is not a class but {type(found).__name__}")
    return found
