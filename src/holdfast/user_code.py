"""Code that is not ours: how it is found by name, and what its author needs to see of its errors.

A problem or an environment is a person's own code that holdfast calls. When it fails, the frames
that matter are that person's; those of holdfast and of the libraries between them only hide these.
When no frame is the person's, the defect is ours and nothing may be hidden.
"""

from __future__ import annotations

import difflib
import importlib
import re
import sys
import sysconfig
import traceback
from pathlib import Path
from typing import Any

from holdfast.errors import ConfigurationError

__all__ = [
    "account_of_user_error",
    "describe_problem_error",
    "find_class",
    "is_users_file",
    "registered_names",
]

_HOLDFAST = Path(__file__).resolve().parent
_LIBRARIES = tuple(
    Path(path).resolve()
    for name in ("stdlib", "platstdlib", "purelib", "platlib")
    if (path := sysconfig.get_path(name))
)
_PACKAGE_FOLDERS = frozenset({"site-packages", "dist-packages"})


def is_users_file(name: str) -> bool:
    """Tell whether a source file belongs neither to holdfast nor to an installed library.

    Parameters
    ----------
    name : str
        Path of the file, or what Python says where there is none (``<string>``).
    """
    if name.startswith("<"):
        return False
    path = _place(name)
    return _PACKAGE_FOLDERS.isdisjoint(path.parts) and not any(
        path.is_relative_to(folder) for folder in (_HOLDFAST, *_LIBRARIES)
    )


def _place(name: str) -> Path:
    # Compiled modules give their sources' names as they lie in the package, wherever that is.
    installed = _HOLDFAST.parent / name
    if installed.is_relative_to(_HOLDFAST) and installed.is_file():
        return installed
    return Path(name).resolve()


def account_of_user_error(error: BaseException, name: str) -> str | None:
    """Say what the user's code raised and where, without the frames of anybody else.

    Parameters
    ----------
    error : BaseException
        What was raised, caught in holdfast.
    name : str
        What to call the code, usually the problem's name.

    Returns
    -------
    str or None
        One line with the type and the message, then file, line and source of each frame of the
        user's; None if the user's code had no part in it.
    """
    ours = False
    frames = []
    for frame in traceback.extract_tb(error.__traceback__):
        # Whatever calls holdfast (a script, a notebook) comes first and is not at fault.
        ours = ours or _place(frame.filename).is_relative_to(_HOLDFAST)
        if ours and is_users_file(frame.filename):
            frames.append(frame)
    if isinstance(error, SyntaxError) and error.filename and is_users_file(error.filename):
        # A file that cannot be parsed has no frame; the error itself says where.
        where = f'  File "{error.filename}", line {error.lineno}\n    {(error.text or "").strip()}'
    elif frames:
        where = "".join(traceback.format_list(frames)).rstrip()
    else:
        return None
    text = error.msg if isinstance(error, SyntaxError) else str(error)
    kind = type(error).__name__
    return f"{name} raised {kind}{': ' if text else ''}{text}\n{where}"


def describe_problem_error(name: str, error: BaseException) -> str:
    """Put what a problem raised into words, wherever it came from.

    Parameters
    ----------
    name : str
        Of the problem.
    error : BaseException
    """
    return account_of_user_error(error, name) or f"{type(error).__name__}: {error}"


def registered_names(group: str) -> list[str]:
    """Return the names of a group of entry points, sorted.

    Parameters
    ----------
    group : str
        Such as ``holdfast.problems``.
    """
    import importlib.metadata

    return sorted(
        {entry_point.name for entry_point in importlib.metadata.entry_points(group=group)}
    )


def find_class(
    name: str,
    *,
    what: str,
    group: str,
    search_directory: Path | None,
    error_type: type[ConfigurationError],
) -> type[Any]:
    """Find a class by its name.

    Parameters
    ----------
    name : str
        Of an entry point, or ``module:Class``.
    what : str
        What it is for, usually the key of the configuration; messages begin with it.
    group : str
        Of the entry points.
    search_directory : Path or None
        Directory in which ``module`` is looked for first. It goes on the import path and stays
        there, as a script's directory does, for the module may import its neighbours later.
    error_type : type
        What is raised.

    Returns
    -------
    type

    Raises
    ------
    error_type
        If the name is not registered, or the module or its class cannot be imported.
    """
    if ":" in name:
        return _imported_class(name, what, search_directory, error_type)
    import importlib.metadata

    for entry_point in importlib.metadata.entry_points(group=group, name=name):
        try:
            loaded = entry_point.load()
        except (ImportError, AttributeError) as error:
            raise error_type(
                f"{what}: {name} is registered as {entry_point.value}, which cannot be imported: "
                f"{error}"
            ) from error
        return _as_class(name, what, loaded, error_type)
    known = registered_names(group)
    likely = _classes_beside(name, search_directory) or difflib.get_close_matches(name, known, n=3)
    suggestion = f"; did you mean {' or '.join(likely)}?" if likely else ""
    raise error_type(
        f"{what}: {name} is not a registered name{suggestion} "
        f"(registered: {', '.join(known) or 'none'}; a class of your own is named module:Class)"
    )


def _classes_beside(name: str, directory: Path | None) -> list[str]:
    """Return the classes, as ``module:Class``, that may be meant if a file of that name is there.

    The file is read, not run: it may be no module at all.
    """
    import ast

    stem, _, inner = name.removesuffix(".py").partition(".")
    # A class MyRobot usually stands in my_robot.py.
    snake = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", stem).lower()
    for module in dict.fromkeys((stem, snake)):
        for folder in dict.fromkeys((directory or Path(), Path())):
            if not module.isidentifier() or not (folder / f"{module}.py").is_file():
                continue
            try:
                text = (folder / f"{module}.py").read_text(encoding="utf-8")
                statements = ast.parse(text).body
            except (OSError, ValueError, SyntaxError):
                continue
            classes = [each.name for each in statements if isinstance(each, ast.ClassDef)]
            public = [each for each in classes if not each.startswith("_")]
            wanted = [each for each in public if each in (inner, stem)]
            return [f"{module}:{each}" for each in (wanted or public)[:3]]
    return []


def _imported_class(
    name: str, what: str, search_directory: Path | None, error_type: type[ConfigurationError]
) -> type[Any]:
    module_name, _, class_name = name.partition(":")
    if not all(part.isidentifier() for part in [*module_name.split("."), class_name]):
        raise error_type(f"{what}: {name} is neither a registered name nor module:Class")
    if search_directory is not None:
        if not search_directory.is_dir():
            raise error_type(
                f"{what}: {name} is looked for in {search_directory}, which is no directory"
            )
        directory = str(search_directory.resolve())
        if directory not in sys.path:
            sys.path.insert(0, directory)
            importlib.invalidate_caches()
    try:
        module = importlib.import_module(module_name)
    except ImportError as error:
        where = "" if search_directory is None else f" (looked in {search_directory} first)"
        raise error_type(
            f"{what}: {name}: the module {module_name} cannot be imported{where}: {error}"
        ) from error
    if not hasattr(module, class_name):
        classes = [key for key, value in vars(module).items() if isinstance(value, type)]
        close = difflib.get_close_matches(class_name, classes, n=3)
        suggestion = f"; did you mean {' or '.join(close)}?" if close else ""
        raise error_type(
            f"{what}: {name}: the module {module_name} has no {class_name}{suggestion}"
        )
    return _as_class(name, what, getattr(module, class_name), error_type)


def _as_class(
    name: str, what: str, found: object, error_type: type[ConfigurationError]
) -> type[Any]:
    if not isinstance(found, type):
        raise error_type(f"{what}: {name} is not a class but {type(found).__name__}")
    return found
