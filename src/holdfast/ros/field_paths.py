"""Fields of a ROS message by their path, such as ``pose.position.x`` or ``wrench[2].force.z``.

Robots' services differ in their fields, so parameters name the fields as text, which is parsed
here. Nothing in this module imports ROS: a message is an object that lists its fields with
``get_fields_and_field_types()``, as every generated one does.
"""

from __future__ import annotations

import array
import importlib
import re
from typing import Any, TypeAlias

import numpy as np

from holdfast.errors import ConfigurationError, EnvironmentFailedError

__all__ = ["Path", "check_path", "find_type", "parse_path", "read_field", "read_numbers", "write"]

Path: TypeAlias = tuple[str | int, ...]
"""Names of fields and indices into arrays, from the message inwards."""

_PART = re.compile(r"([A-Za-z][A-Za-z0-9_]*)((?:\[[0-9]{1,4}\])*)")
_TYPE = re.compile(r"([a-z][a-z0-9_]*)/(msg|srv|action)/([A-Z][A-Za-z0-9]*)")
_ELEMENT = re.compile(r"sequence<([^,>]+)(?:, *[0-9]+)?>|(.+)\[[0-9]+\]")


def find_type(name: str, key: str, kinds: tuple[str, ...] = ("srv", "action", "msg")) -> Any:
    """Import a generated type, such as ``std_srvs/srv/Trigger``; ``key`` names it in messages.

    Raises ConfigurationError if it is written in another way, is of another kind, or cannot be
    imported.
    """
    found = _TYPE.fullmatch(name)
    if found is None or found[2] not in kinds:
        forms = " or ".join(f"package/{kind}/Type" for kind in kinds)
        raise ConfigurationError(f"{key} is {name!r}; it must be {forms}")
    package, kind, own = found.groups()
    try:
        return getattr(importlib.import_module(f"{package}.{kind}"), own)
    except (ImportError, AttributeError) as error:
        raise ConfigurationError(
            f"{key} is {name!r}, which cannot be imported ({error}); install ros-DISTRO-"
            f"{package.replace('_', '-')}, or build that package and source its install/setup.bash"
        ) from error


def parse_path(text: str, key: str) -> Path:
    """Read a path.

    Raises ConfigurationError if it is none.
    """
    path: list[str | int] = []
    for part in text.split("."):
        found = _PART.fullmatch(part)
        if found is None:
            raise ConfigurationError(
                f"{key} is {text!r}; it must be names of fields with dots between them, such as "
                "pose.position.x or values[0]"
            )
        path.append(found[1])
        path.extend(int(index) for index in re.findall("[0-9]+", found[2]))
    return tuple(path)


def check_path(message_type: Any, path: Path, key: str) -> None:
    """Check that messages of a type have a field.

    Raises ConfigurationError if not; the message lists the fields that are there.
    """
    try:
        _holder(message_type(), path, grow=True)
    except _NoSuchFieldError as error:
        raise ConfigurationError(f"{key}: {_type_name(message_type)} {error}") from None


def read_field(message: Any, path: Path) -> Any:
    """Return the value of a field.

    Raises EnvironmentFailedError if the message's array is too short for the path.
    """
    try:
        return _part(_holder(message, path), path[-1])
    except _NoSuchFieldError as error:
        raise EnvironmentFailedError(f"{_type_name(type(message))} {error}") from None


def read_numbers(message: Any, path: Path) -> list[float]:
    """Return a field that is a number, or an array of numbers, as a list.

    Raises EnvironmentFailedError if it is neither.
    """
    value = read_field(message, path)
    try:
        numbers = np.atleast_1d(np.asarray(value))
    except (TypeError, ValueError):
        numbers = np.empty(0, dtype=object)
    if numbers.ndim != 1 or (numbers.dtype.kind not in "biuf" and numbers.size):
        raise EnvironmentFailedError(
            f"field {_written(path)} of {_type_name(type(message))} is {value!r:.80}; it must be a "
            "number or an array of numbers"
        )
    return [float(number) for number in numbers]


def write(message: Any, path: Path, value: Any) -> None:
    """Set a field, converted to its type; arrays become as long as the path needs.

    Raises EnvironmentFailedError if it does not fit: a fraction into an integer, three numbers into
    an array of two.
    """
    try:
        holder, part = _holder(message, path, grow=True), path[-1]
        fitting = _fitting(_part(holder, part), value)
        if isinstance(part, str):
            setattr(holder, part, fitting)
        else:
            holder[part] = fitting
    except _NoSuchFieldError as error:
        raise EnvironmentFailedError(f"{_type_name(type(message))} {error}") from None
    except (TypeError, ValueError, OverflowError, AssertionError) as error:
        raise EnvironmentFailedError(
            f"{value!r:.80} cannot be put into field {_written(path)} of "
            f"{_type_name(type(message))}: {error}"
        ) from None


class _NoSuchFieldError(Exception):
    """A path leads nowhere."""


def _holder(message: Any, path: Path, *, grow: bool = False) -> Any:
    """Return what holds the field that a path names: the last part of the path is in it."""
    holder, declared = message, None
    for depth, part in enumerate(path):
        if isinstance(part, str):
            fields = _fields(holder)
            if part not in fields:
                there = ", ".join(fields) or "none"
                raise _NoSuchFieldError(
                    f"has no field {_written(path[: depth + 1])}; there: {there}"
                )
            declared = fields[part]
        else:
            if not hasattr(holder, "__len__") or isinstance(holder, str | bytes):
                raise _NoSuchFieldError(f"has no array {_written(path[:depth])}")
            size = len(holder)
            if part >= size and not (grow and _grow(holder, part + 1, declared)):
                raise _NoSuchFieldError(
                    f"has {size} elements in {_written(path[:depth])}, and "
                    f"{_written(path[: depth + 1])} is meant"
                )
            declared = _element(declared)
        if depth < len(path) - 1:
            holder = _part(holder, part)
    return holder


def _part(holder: Any, part: str | int) -> Any:
    return getattr(holder, part) if isinstance(part, str) else holder[part]


def _fitting(old: Any, value: Any) -> Any:
    """Return a value as the type of the one that stands there."""
    if isinstance(old, bool):
        if value not in (0, 1):
            raise ValueError("a truth value is needed")
        return bool(value)
    if isinstance(old, int):
        return _whole(value)
    if isinstance(old, float):
        return float(value)
    if isinstance(old, str):
        return str(value)
    if isinstance(old, np.ndarray):
        values = np.array(value, dtype=np.float64)
        if values.shape != old.shape:
            raise ValueError(f"{old.size} numbers are needed")
        return np.array(values if old.dtype.kind == "f" else list(map(_whole, values)), old.dtype)
    if isinstance(old, array.array):
        several = value if isinstance(value, list | tuple) else [value]
        return array.array(old.typecode, map(float if old.typecode in "fd" else _whole, several))
    if isinstance(old, list):
        return list(value) if isinstance(value, list | tuple) else [value]
    raise ValueError(f"a {type(old).__name__} stands there; name one of its fields")


def _whole(value: Any) -> int:
    if float(value) != int(value):
        raise ValueError("a whole number is needed")
    return int(value)


def _fields(holder: Any) -> dict[str, str]:
    tell = getattr(holder, "get_fields_and_field_types", None)
    return dict(tell()) if callable(tell) else {}


def _element(declared: str | None) -> str | None:
    """Return the type of an array's elements."""
    found = None if declared is None else _ELEMENT.fullmatch(declared)
    return None if found is None else found[1] or found[2]


def _grow(holder: Any, size: int, declared: str | None) -> bool:
    """Extend an array to a size; return whether that is possible."""
    element = _element(declared)
    if isinstance(holder, np.ndarray) or element is None or "[" in (declared or ""):
        return False
    if isinstance(holder, array.array):
        make: Any = int
    elif "/" in element:
        package, name = element.split("/")
        make = getattr(importlib.import_module(f"{package}.msg"), name)
    else:
        make = {"boolean": bool, "string": str, "wstring": str}.get(element, float)
    while len(holder) < size:
        holder.append(make())
    return True


def _type_name(message_type: Any) -> str:
    module = message_type.__module__.split(".")
    return (
        "/".join([*module[:2], message_type.__name__])
        if len(module) > 2
        else str(message_type.__name__)
    )


def _written(path: Path) -> str:
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
    return text
