"""User code: finding it by name, and showing its errors to its author.

A problem or an environment is a person's own code that holdfast calls. When it fails, the frames
that matter are that person's; those of holdfast and of the libraries between them only hide these.
When no frame is the person's, the defect is ours and nothing may be hidden.

Such code may raise anything: a script that is imported calls ``sys.exit(0)``, which is no
``Exception`` and would end a run as if all were done. So its callers catch everything but
KeyboardInterrupt, which is Ctrl-C, and passes on what has no account here.
"""

from __future__ import annotations

import functools
import importlib
import re
import sysconfig
import traceback
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from holdfast.config.user_modules import find_in
from holdfast.errors import ConfigurationError
from holdfast.printable import did_you_mean

_HOLDFAST = Path(__file__).resolve().parents[1]
_LIBRARIES = tuple(
    Path(path).resolve()
    for name in ("stdlib", "platstdlib", "purelib", "platlib")
    if (path := sysconfig.get_path(name))
)
_MAX_TEXT = 1000
_MAX_LINES = 10
_MAX_FRAMES = 5
"""Bounds on what an account has of a message, and of the frames at either end."""

COPY = "If it changes an array that it was given, take a copy: states = states.copy()."
"""What to do where NumPy says that an array is read-only."""

_PACKAGE_FOLDERS = frozenset({"site-packages", "dist-packages"})


def is_users_file(name: str) -> bool:
    """Return whether a source file belongs neither to holdfast nor to an installed library."""
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

    It has the type and the message, then file, line and source of each frame of the user's, all of
    bounded length. It is None if the user's code had no part in it, or only called what ends a
    command in order (``print``, once the standard output has no reader).
    """
    ours = inner = False
    frames = []
    for frame in traceback.extract_tb(error.__traceback__):
        inner = _place(frame.filename).is_relative_to(_HOLDFAST)
        # Whatever calls holdfast (a script, a notebook) comes first and is not at fault.
        ours = ours or inner
        if ours and is_users_file(frame.filename):
            frames.append(frame)
    if inner and isinstance(error, SystemExit):
        return None
    if isinstance(error, SyntaxError) and error.filename and is_users_file(error.filename):
        # A file that cannot be parsed has no frame; the error itself says where.
        source = (error.text or "").strip()
        where = f'  File "{error.filename}", line {error.lineno}\n    {source:.{_MAX_TEXT}}'
    elif frames:
        where = _frames_listed(frames)
        if isinstance(error, ValueError) and "read-only" in in_words(error):
            where += f"\n{COPY}"
    else:
        return None
    return f"{name} raised {in_words(error)}\n{where}"


def is_of_user(error: BaseException | None) -> bool:
    """Return whether an error, or what has caused it, was raised by the user's code."""
    if error is None:
        return False
    return account_of_user_error(error, "") is not None or is_of_user(error.__cause__)


def in_words(error: BaseException) -> str:
    """Return an error's type and message, cut to a length that a person reads."""
    kind = type(error).__name__
    try:
        text = str(error.msg if isinstance(error, SyntaxError) else error)
    except KeyboardInterrupt:
        raise
    except BaseException:  # noqa: BLE001 - the user may have written it
        return f"{kind}, which cannot be put into words"
    lines = text.splitlines()
    if len(lines) > _MAX_LINES:
        text = "\n".join([*lines[:_MAX_LINES], f"... ({len(lines)} lines in all)"])
    if len(text) > _MAX_TEXT:
        text = f"{text[:_MAX_TEXT]}... ({len(text)} characters in all)"
    return f"{kind}: {text}" if text else kind


def _frames_listed(frames: list[traceback.FrameSummary]) -> str:
    # A recursion has a thousand of them; a few from its beginning and its end are enough.
    left_out = len(frames) - 2 * _MAX_FRAMES
    if left_out <= 0:
        return "".join(traceback.format_list(frames)).rstrip()
    first, last = map(traceback.format_list, (frames[:_MAX_FRAMES], frames[-_MAX_FRAMES:]))
    return "".join([*first, f"  ... {left_out} more\n", *last]).rstrip()


def describe_problem_error(name: str, error: BaseException) -> str:
    """Put what a problem raised into words, wherever it came from."""
    return account_of_user_error(error, name) or in_words(error)


def registered_names(group: str) -> list[str]:
    """Return the names of a group of entry points, sorted."""
    import importlib.metadata

    return sorted({each.name for each in importlib.metadata.entry_points(group=group)})


def find_class(
    name: str,
    *,
    what: str,
    group: str,
    search_directory: Path | None,
    built_in: Iterable[str] = (),
    error_type: type[ConfigurationError],
) -> type[Any]:
    """Find a class by its name.

    That is the name of an entry point of the ``group``, or ``module:Class``, and the module is
    looked for in ``search_directory`` first (:mod:`holdfast.config.user_modules`). Messages begin
    with ``what`` it is for, usually the key of the configuration, and suggest ``built_in``, too.
    Raises ``error_type`` if the name is not registered, or the module or its class cannot be
    imported, whatever its import raises.
    """
    try:
        if ":" in name:
            found = _imported(name, search_directory)
        else:
            found = _registered(name, group, built_in, search_directory)
    except ConfigurationError as error:
        raise error_type(f"{what}: {error}") from error.__cause__
    if not isinstance(found, type):
        raise error_type(f"{what}: {name} is not a class but {type(found).__name__}")
    return found


def _registered(
    name: str, group: str, built_in: Iterable[str], search_directory: Path | None
) -> object:
    import importlib.metadata

    for entry_point in importlib.metadata.entry_points(group=group, name=name):
        value = entry_point.value
        refused = f"{name} is registered as {value}, which cannot be imported"
        return _loaded(entry_point.load, name, value, refused, (ImportError, AttributeError))
    known = sorted({*built_in, *registered_names(group)})
    hint = did_you_mean(name, known, 3, sure=_classes_beside(name, search_directory))
    raise ConfigurationError(
        f"{name} is not a registered name{hint} "
        f"(registered: {', '.join(known) or 'none'}; a class of your own is named module:Class)"
    )


def _loaded(
    load: Callable[[], object],
    name: str,
    module: str,
    refused: str,
    refusals: tuple[type[Exception], ...],
) -> object:
    """Import something of the user's; ``refused`` introduces the errors that need no frames."""
    try:
        return load()
    except refusals as error:
        raise ConfigurationError(f"{refused}: {error}") from error
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        # The module is there, but does not come through its own import.
        account = account_of_user_error(error, name)
        raise ConfigurationError(
            account or f"{name}: the module {module} raised {in_words(error)}"
        ) from error


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


def _imported(name: str, search_directory: Path | None) -> object:
    module_name, _, class_name = name.partition(":")
    if not all(part.isidentifier() for part in [*module_name.split("."), class_name]):
        raise ConfigurationError(f"{name} is neither a registered name nor module:Class")
    where = ""
    if search_directory is not None:
        if not search_directory.is_dir():
            raise ConfigurationError(
                f"{name} is looked for in {search_directory}, which is no directory"
            )
        where = f" (looked in {search_directory} first)"
        try:
            find_in(search_directory, module_name)
        except ConfigurationError as error:
            raise ConfigurationError(f"{name}: {error}") from None
    if module_name.startswith("holdfast.ros."):
        where += " (holdfast.ros is the package holdfast_ros now)"
    module = _loaded(
        functools.partial(importlib.import_module, module_name),
        name,
        module_name,
        f"{name}: the module {module_name} cannot be imported{where}",
        (ImportError,),
    )
    if not hasattr(module, class_name):
        classes = [key for key, value in vars(module).items() if isinstance(value, type)]
        hint = did_you_mean(class_name, classes, 3)
        raise ConfigurationError(f"{name}: the module {module_name} has no {class_name}{hint}")
    return getattr(module, class_name)
