"""Modules of the user's, found in the directory of the configuration that names them.

Python knows a module by its name alone. A second configuration whose module has the name of the
first one's would silently run the first one's code, and a file ``queue.py`` in front of the import
path takes the place of Python's own for every library. So a directory goes on the import path
*behind* the standard library, and what a named module imports from beside itself is found there
whatever else has its name. What cannot be told apart is refused, naming both files.
"""

from __future__ import annotations

import importlib
import sys
import sysconfig
from collections.abc import Iterable, Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from types import ModuleType

from holdfast.config.imports import follow_imports
from holdfast.errors import ConfigurationError

_STANDARD = [path for name in ("stdlib", "platstdlib") if (path := sysconfig.get_path(name))]
_STANDARD += [str(Path(path) / "lib-dynload") for path in _STANDARD]

_FOUND: dict[str, tuple[Path, frozenset[str]]] = {}
"""Directory of each module that was asked for, and the names there that it needs."""


class _Finder:
    """Finds what :func:`find_in` was asked for, before anything else on the import path."""

    @staticmethod
    def find_spec(
        name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        del path, target
        for directory, names in _FOUND.values():
            if name in names:
                return PathFinder.find_spec(name, [str(directory)])
        return None


def find_in(directory: Path, module: str) -> None:
    """Have a module imported from a directory, if it is there, with what it imports beside it.

    Raises ConfigurationError if this process, or the standard library, has another module of one of
    these names.
    """
    directory = directory.resolve()
    _put_on_path(str(directory))
    package = module.partition(".")[0]
    spec = PathFinder.find_spec(package, [str(directory)])
    needed = follow_imports(
        [module],
        lambda name: _source(directory, name),
        loaded=lambda name: _require_no_stand_in(name, directory),
    )
    # A folder without __init__.py, of a clone perhaps, is a package only to what has files in it.
    if spec is None or (spec.origin is None and module not in needed):
        return
    names = dict.fromkeys([package, *sorted(name.partition(".")[0] for name in needed)])
    # One that was not imported, or was taken out of sys.modules, stands in nobody's way.
    for root in [root for root in _FOUND if root not in sys.modules]:
        del _FOUND[root]
    for name in names:
        _require_alone(name, directory)
    _FOUND[module] = directory, frozenset(names)
    if _Finder not in sys.meta_path:
        sys.meta_path.insert(0, _Finder)
    importlib.invalidate_caches()


def _put_on_path(directory: str) -> None:
    """Put a directory behind the standard library and those put there before, and leave it there.

    The module may import its neighbours later, and processes that are started from this one need
    it to unpickle what is the module's.
    """
    if directory in sys.path:
        return
    behind = max((sys.path.index(each) + 1 for each in _STANDARD if each in sys.path), default=0)
    libraries = (
        index
        for index, entry in enumerate(sys.path)
        if index >= behind and _is_library(Path(entry))
    )
    sys.path.insert(next(libraries, len(sys.path)), directory)


def _is_library(path: Path) -> bool:
    return not {"site-packages", "dist-packages"}.isdisjoint(path.parts)


def _source(directory: Path, name: str) -> Path | None:
    place = directory.joinpath(*name.split("."))
    choices = (place / "__init__.py", place.with_name(f"{place.name}.py"))
    return next((path for path in choices if path.is_file()), None)


def _require_alone(name: str, directory: Path) -> None:
    """Raise ConfigurationError if a module of a directory has the name of another one."""
    here = _place(PathFinder.find_spec(name, [str(directory)]))
    if name in sys.stdlib_module_names:
        there = PathFinder.find_spec(name, _STANDARD)
        own = "it" if there is None else there.origin
        raise ConfigurationError(
            f"the module {name} is {here}, and Python's standard library has one of that name, "
            f"{own}; rename the first"
        )
    for other in (_place_of_module(sys.modules.get(name)), _place(_Finder.find_spec(name))):
        if here is not None and other not in (None, here):
            raise _clash(name, here, other)


def _require_no_stand_in(name: str, directory: Path) -> None:
    """Raise ConfigurationError if a module would stand for one from a folder below a directory.

    That folder gets onto the import path only while the directory's module is imported. Then the
    name leads to what an earlier directory's module has loaded from a folder of its own.
    """
    there = _place_of_module(sys.modules.get(name))
    others = {other for other, _ in _FOUND.values() if not directory.is_relative_to(other)}
    if there is None or _is_library(there) or not any(map(there.is_relative_to, others)):
        return
    below = f"*/{name.replace('.', '/')}"
    for here in (*directory.glob(f"{below}.py"), *directory.glob(f"{below}/__init__.py")):
        if here != there:
            raise _clash(name, here, there)


def _clash(name: str, here: Path, there: Path | None) -> ConfigurationError:
    return ConfigurationError(
        f"the module {name} is {here}, and this process has another one of that name, "
        f"{there}; rename one of them, or use each in a process of its own"
    )


def _place(spec: ModuleSpec | None) -> Path | None:
    """Return the file of a module, or the folder of a package without a file of its own."""
    return None if spec is None else _first(spec.origin, spec.submodule_search_locations)


def _place_of_module(module: ModuleType | None) -> Path | None:
    """Return the same of a module that is loaded; None for one that was made at run time."""
    return _first(getattr(module, "__file__", None), getattr(module, "__path__", None))


def _first(file: str | None, folders: Iterable[str] | None) -> Path | None:
    place = file if file is not None else next(iter(folders or ()), None)
    return None if place is None else Path(place).resolve()
