"""A configuration before it is checked: its sections, and the place of each value in the file.

Every complaint names the file, the line, the key with its section, the value and what is allowed
instead, because a person who reads it has the file open.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Mapping
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from holdfast.config.yaml_document import Document
from holdfast.conversion import convert
from holdfast.errors import ConfigurationError
from holdfast.planning import settings
from holdfast.validation import KeyPath, close_match, dotted, field_names, find_mismatch, shown

SETTINGS: Mapping[str, type[msgspec.Struct]] = {
    "particle_filter": settings.ParticleFilterSettings,
    "active_sensing": settings.ActiveSensingSettings,
    "simulator": settings.SimulatorSettings,
    "selector": settings.SelectorSettings,
    "offload": settings.OffloadSettings,
    "recovery": settings.RecoverySettings,
    "lost": settings.LostSettings,
    "environment": settings.EnvironmentSettings,
}
"""The sections whose keys do not depend on the problem, and their types."""

_FIRST, *_OTHERS = SETTINGS
SECTIONS = ("model", _FIRST, "state_space_planner", *_OTHERS)
"""In the order in which a resolved configuration lists them."""

_MOVED = {"holdfast.lab.studies.": "studies.", "holdfast.lab.": "holdfast_lab."}
"""Packages whose classes runs of earlier releases name, and where they are now."""

_RENAMED = {("selector", "rollout_looks"): "rollout_sensing_steps"}
"""Keys of earlier releases, and what they are called now."""

_ON_TOP = ("problem", "problem_directory")

_StructT = TypeVar("_StructT", bound=msgspec.Struct)


class Source:
    """A configuration before it is checked, which can say where in it something is wrong.

    ``schemas`` has the type of each section that has one (a problem's own are added), ``sections``
    the data of each, that of ``overrides`` (``section.key``) included. ``problem`` and
    ``problem_directory`` stand on top. ``directory`` is that of the file, ``current`` the current
    one when this was made.
    """

    def __init__(self, document: Document, path: Path, overrides: Mapping[str, Any]) -> None:
        self.path = path
        # Now: a problem's module, which is imported later, may change the current directory.
        self.directory = self.current = path.absolute().parent.resolve()
        with contextlib.suppress(OSError):  # it was removed
            self.current = Path.cwd()
        self.schemas = dict(SETTINGS)
        self._document = document
        self._overrides: set[KeyPath] = set()
        data = document.data
        if data is None:
            raise ConfigurationError(
                f"{path}: is empty; a configuration has the sections {', '.join(SECTIONS)}"
            )
        if not isinstance(data, Mapping):
            kind = "a list" if isinstance(data, list) else shown(data)
            raise ConfigurationError(
                f"{path}: is {kind} at the top, where a mapping of the sections"
                f" {', '.join(SECTIONS)} is needed"
            )
        for name in data:
            if name not in (*_ON_TOP, *SECTIONS):
                raise self.unknown((name,), (*_ON_TOP, *SECTIONS))
        data = with_names_of_today(data)
        self.problem: Any = data.get("problem")
        self.problem_directory: Any = data.get("problem_directory")
        self.sections: dict[str, dict[str, Any]] = {}
        for name in SECTIONS:
            section = data.get(name)
            if section is not None and not isinstance(section, Mapping):
                raise self.error((name,), f"is {shown(section)}; expected a mapping of keys")
            self.sections[name] = dict(section or {})
        for given, value in overrides.items():
            self._overrides.add(self._override(given, value))

    def _override(self, given: str, value: Any) -> KeyPath:
        """Let a value stand at a key, whatever the file says there, and return its path."""
        name, _, key = given.partition(".")
        if given == "problem_directory":
            self.problem_directory = value
            return (given,)
        if name not in SECTIONS:
            raise self.unknown((name,), SECTIONS)
        inner, _, below = key.partition(".")
        if below and name in SETTINGS and inner not in field_names(SETTINGS[name]):
            self._overrides.add((name, inner))
            raise self.unknown((name, inner), field_names(SETTINGS[name]))
        own = name_of_today(value) if given == "environment.object" else value
        return put_at(self.sections, f"{name}.{_RENAMED.get((name, key), key)}", own)

    def place(self, path: KeyPath) -> str:
        """Return the file, and the line of the value at ``path`` where there is one."""
        line = self._document.line(path)
        return f"{self.path}" if line is None else f"{self.path}, line {line}"

    def is_overridden(self, path: KeyPath) -> bool:
        """Return whether the value at ``path`` replaces the file's."""
        return any(path[: len(each)] == each for each in self._overrides)

    def directory_of(self, path: KeyPath) -> Path:
        """Return the directory to which a relative path that stands at ``path`` is relative."""
        return self.current if self.is_overridden(path) else self.directory

    def error(self, path: KeyPath, message: str) -> ConfigurationError:
        """Return an error about the value at ``path``."""
        if self.is_overridden(path):
            return ConfigurationError(
                f"{dotted(path)}, given instead of what {self.path} says, {message}"
            )
        return ConfigurationError(f"{self.place(path)}: {dotted(path)} {message}")

    def section(self, name: str, schema: type[_StructT]) -> _StructT:
        """Return a section as its validated struct."""
        data = self.sections[name]
        try:
            return convert(data, schema)
        except msgspec.ValidationError as error:
            found = find_mismatch(data, schema, (name,))
            if found is None:  # only if a struct's own check is inconsistent
                raise ConfigurationError(f"{self.path}: {name}: {error}") from error
        if found.unknown:
            raise self.unknown(found.path, found.allowed)
        raise self.error(found.path, found.in_words())

    def unknown(self, path: KeyPath, allowed: Collection[str]) -> ConfigurationError:
        """Return an error about a section or key that is not one of ``allowed``."""
        what = "section" if len(path) == 1 else "key"
        homes = [
            section
            for section, schema in self.schemas.items()
            if len(path) <= 2 and section != path[0] and path[-1] in field_names(schema)
        ]
        if homes:
            here = f", not of {dotted(path[:-1])}" if len(path) == 2 else ""
            hint = f"is a key of {' and '.join(homes)}{here}"
        else:
            elsewhere = [
                f"{section}.{key}"
                for section, schema in self.schemas.items()
                for key in field_names(schema)
            ]
            key = str(path[-1])
            hint = (
                f"is not a known {what}{close_match(key, allowed) or close_match(key, elsewhere)}"
            )
        text = f"{hint}\nallowed: {', '.join(allowed) or 'no keys'}"
        if path in self._overrides:
            # The key itself was given instead of the file's, which has nothing to do with it.
            return ConfigurationError(f"{dotted(path)} {text}")
        return self.error(path, text)


def put_at(data: dict[str, Any], key: str, value: Any) -> KeyPath:
    """Set the value of ``section.key`` or of what is below (``model.holes.0.width``).

    Mappings and lists on the way are copied, and keep the rest. Returns the path. Raises
    ConfigurationError if there is nothing on the way that could hold the value.
    """
    inner: Any = data
    path: list[str | int] = []
    *way, last = key.split(".")
    for part, below in zip(way, [*way, last][1:], strict=True):
        path.append(int(part) if isinstance(inner, list) else part)
        # What these hold where a file lacks them is known: nothing. What a constructor has by
        # default is not, and would be lost.
        is_empty = len(path) == 1 or path == ["environment", "arguments"]
        is_there = isinstance(inner, list) or part in inner
        held: Any = inner[path[-1]] if is_there else {} if is_empty else None
        is_item = isinstance(held, list) and below.isdecimal() and int(below) < len(held)
        if not is_item and not isinstance(held, Mapping):
            whole = dotted(tuple(path))
            what = "is not in the file" if held is None else f"is {shown(held)}"
            raise ConfigurationError(
                f"{key} cannot be set alone, for {whole} {what}; set all of it: --set '{whole}=...'"
            )
        inner[path[-1]] = list(held) if is_item else dict(held)
        inner = inner[path[-1]]
    path.append(int(last) if isinstance(inner, list) else last)
    inner[path[-1]] = value
    return tuple(path)


def with_names_of_today(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return a configuration's data with what earlier names of classes and keys are now."""
    named = {**data}
    for (section, key), now in _RENAMED.items():
        values = data.get(section)
        if isinstance(values, Mapping) and key in values and now not in values:
            named[section] = {now if each == key else each: values[each] for each in values}
    if "problem" in data:
        named["problem"] = name_of_today(data["problem"])
    environment = data.get("environment")
    if isinstance(environment, Mapping) and "object" in environment:
        named["environment"] = {**environment, "object": name_of_today(environment["object"])}
    return named


def name_of_today(name: Any) -> Any:
    """Return ``module:Class`` with the module where the class is now."""
    for old, new in _MOVED.items():
        if isinstance(name, str) and name.startswith(old):
            return new + name.removeprefix(old)
    return name


def module_directory(source: Source, key: KeyPath, value: str | None, module: str) -> Path | None:
    """Return the directory that holds a user's module, as ``value`` at ``key`` says.

    If it is None, that is the file's own, else the current one, for a resolved configuration stands
    in the directory of its run, far from the module; None if it is in neither.
    """
    package = module.partition(".")[0]
    if value is not None:
        directory = source.directory_of(key) / value
        if not directory.is_dir():
            what = "no directory"
        elif not _holds(directory, package):
            what = f"no module {package}"
        else:
            return directory.resolve()
        raise source.error(
            key,
            f"is {shown(value)}, where there is {what}; say where the module lies on this machine: "
            + ("--problem-directory DIR" if len(key) == 1 else f"--set {dotted(key)}=DIR"),
        )
    places = (source.directory, source.current)
    return next((directory for directory in places if _holds(directory, package)), None)


def _holds(directory: Path, module: str) -> bool:
    return PathFinder.find_spec(module, [str(directory)]) is not None
