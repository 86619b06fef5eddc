"""The problem of a configuration: its name, its class, and the object built from its sections.

A problem declares its keys as structs (``Model``, ``StateSpacePlanner``), or has a constructor
whose keyword arguments are the keys. The defaults that it fills in are written down with the rest,
so that a resolved configuration has all values in use.
"""

from __future__ import annotations

import functools
import inspect
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from holdfast.config import registry
from holdfast.config.source import Source, module_directory
from holdfast.config.user_code import account_of_user_error, in_words
from holdfast.config.yaml_document import Document
from holdfast.errors import ConfigurationError, HoldfastError, UnknownProblemError
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.problems.attributes import (
    GAUSSIAN_OBSERVATIONS,
    has_general_observations,
    misspelt_in,
)
from holdfast.problems.problem import Problem, ProblemBase
from holdfast.validation import shown


def schemas_of(problem_class: type) -> dict[str, type[msgspec.Struct]]:
    """Return the types of a problem's own sections, as far as it declares them."""
    schemas: dict[str, type[msgspec.Struct]] = {}
    for section, attribute in (("model", "Model"), ("state_space_planner", "StateSpacePlanner")):
        schema = getattr(problem_class, attribute, None)
        if isinstance(schema, type) and issubclass(schema, msgspec.Struct):
            schemas[section] = schema
    return schemas


def find_problem(source: Source, name: str | None) -> tuple[str, type, Path | None]:
    """Return the problem's name, its class and the directory where its module was looked up.

    The name is given, written in the file, or inferred from its keys; the directory is None if the
    problem is installed.
    """
    given = name is not None
    if name is None:
        if source.problem is None:
            name = _infer_problem(source)
        elif isinstance(source.problem, str):
            name = source.problem
        else:
            raise source.error(
                ("problem",),
                f"is {shown(source.problem)}; expected one of {', '.join(registry.names())},"
                " or module:Class",
            )
    value, key = source.problem_directory, ("problem_directory",)
    if value is not None and not isinstance(value, str):
        raise source.error(key, f"is {shown(value)}; expected the path of a directory")
    module, colon, _ = name.partition(":")
    if value is not None and not colon and not given:
        raise source.error(
            key, f"is {shown(value)}; only a problem that is named module:Class has one"
        )
    directory = module_directory(source, key, value, module) if colon else None
    try:
        problem_class = registry.problem_class(name, search_directory=directory or source.directory)
    except UnknownProblemError as error:
        if given or source.problem is None:
            raise
        raise UnknownProblemError(f"{source.place(('problem',))}: {error}") from error
    return name, problem_class, directory


def _infer_problem(source: Source) -> str:
    """Return the one problem whose signature keys ``model`` has."""
    keys = set(source.sections["model"])
    found = sorted(name for name, own in registry.BUILT_IN.items() if own.signature_keys <= keys)
    if len(found) == 1:
        return found[0]
    why = (
        f"the keys of its model belong to {' and '.join(found)}"
        if found
        else "the keys of its model belong to none"
    )
    raise ConfigurationError(
        f"{source.path}: names no problem, and {why}; put 'problem: NAME' on top\n"
        f"problems: {', '.join(registry.names())}"
    )


def build_problem(
    name: str, problem_class: type, model: Mapping[str, Any], state_space_planner: Mapping[str, Any]
) -> Problem:
    """Build a problem from plain data that did not come from a file.

    Raises ConfigurationError if the data does not fit the problem.
    """
    sections = {"model": model, "state_space_planner": state_space_planner}
    source = Source(Document(sections, {}), Path(name), {})
    source.schemas |= schemas_of(problem_class)
    return build_from(source, name, problem_class).problem


class BuiltProblem(NamedTuple):
    """A problem and what it was built from."""

    problem: Problem
    # The problem's two sections with their defaults, as plain data.
    model: dict[str, Any]
    state_space_planner: dict[str, Any]
    unlisted: tuple[str, ...]  # arguments whose defaults plain data cannot hold


@in_own_mode
def build_from(source: Source, name: str, problem_class: type) -> BuiltProblem:
    """Build the problem of a configuration from its two sections."""
    resolved: dict[str, dict[str, Any]] = {}
    unlisted: tuple[str, ...] = ()
    for section in ("model", "state_space_planner"):
        resolved[section] = source.sections[section]
        if (schema := source.schemas.get(section)) is not None:
            resolved[section] = msgspec.to_builtins(source.section(section, schema))
    arguments = resolved
    if "model" not in source.schemas and "state_space_planner" not in source.schemas:
        defaults = _keyword_arguments(source, problem_class)
        arguments = {
            section: {key: _in_the_form_of(defaults.get(key), value) for key, value in keys.items()}
            for section, keys in resolved.items()
        }
        given = {*resolved["model"], *resolved["state_space_planner"]}
        left = {key: default for key, default in defaults.items() if key not in given}
        unlisted = tuple(key for key, default in left.items() if not _is_plain(default))
        resolved["model"] |= {
            key: json.loads(json.dumps(default))  # which makes lists of tuples
            for key, default in left.items()
            if key not in unlisted
        }
    # A class that only has the members of the protocol is built as ProblemBase builds.
    build = getattr(problem_class, "from_settings", None) or functools.partial(
        ProblemBase.from_settings.__func__,  # type: ignore[attr-defined]
        problem_class,
    )
    try:
        problem = build(arguments["model"], arguments["state_space_planner"])
        missing = [member for member in _needed_members(problem) if not hasattr(problem, member)]
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        complaint = _cannot_be_built(source, name, resolved, error)
        if complaint is None:
            raise
        raise complaint from error
    if missing:
        raise ConfigurationError(
            f"{source.path}: {name} is no problem: it lacks {', '.join(missing)}"
            f"{misspelt_in(problem)}"
        )
    return BuiltProblem(problem, resolved["model"], resolved["state_space_planner"], unlisted)


def _keyword_arguments(source: Source, problem_class: type) -> dict[str, Any]:
    """Check keys that are arguments of the constructor, and return those arguments' defaults."""
    build = getattr(problem_class, "from_settings", None)
    if getattr(build, "__func__", None) not in (None, ProblemBase.from_settings.__func__):  # type: ignore[attr-defined]
        return {}
    try:
        parameters = inspect.signature(problem_class).parameters.values()
    except (TypeError, ValueError):
        return {}  # compiled code may have no signature; then its constructor complains
    named = {
        parameter.name: parameter.default
        for parameter in parameters
        if parameter.kind in (parameter.POSITIONAL_OR_KEYWORD, parameter.KEYWORD_ONLY)
    }
    if not any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters):
        for section in ("model", "state_space_planner"):
            for key in source.sections[section]:
                if key not in named:
                    raise source.unknown((section, key), list(named))
    return {
        key: default for key, default in named.items() if default is not inspect.Parameter.empty
    }


def _is_plain(value: Any) -> bool:
    """Return whether a file can hold a value, a tuple as a list."""
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(item) for key, item in value.items())
    # Exactly these types: a subclass (an enumeration, a NumPy number) would come back as another.
    if type(value) is int:
        return -(2**63) <= value < 2**63
    if type(value) is float:
        return abs(value) < float("inf")
    return value is None or type(value) in (bool, str)


def _in_the_form_of(default: Any, value: Any) -> Any:
    """Return ``value`` with a tuple for each list that stands where the default has a tuple.

    So a constructor gets the same from a file in which its defaults are written down.
    """
    if not isinstance(value, list) or not isinstance(default, list | tuple):
        return value
    # A longer list continues like the default's last item.
    forms = [*default[: len(value)], *default[-1:] * (len(value) - len(default))]
    items = [_in_the_form_of(form, item) for form, item in zip(forms, value, strict=False)]
    items += value[len(items) :]
    return tuple(items) if isinstance(default, tuple) else items


def _cannot_be_built(
    source: Source, name: str, sections: Mapping[str, Mapping[str, Any]], error: BaseException
) -> ConfigurationError | None:
    """Return the problem's own complaint, with the line of the first of its keys named there.

    A complaint about no key is a defect of the problem and comes with its frames; None means that
    the problem is ours, and so is the defect.
    """
    text = str(error) if isinstance(error, HoldfastError | ValueError) else in_words(error)
    text = text or type(error).__name__
    mentioned = [
        (at.start(), (section, key))
        for section, keys in sections.items()
        for key in keys
        if (at := re.search(rf"(?<!\w){re.escape(key)}(?!\w)", text))
    ]
    # ProblemBase wraps the TypeError of a call that does not fit; the constructor may raise one.
    cause = error.__cause__ if isinstance(error.__cause__, TypeError) else error
    refused = isinstance(error, HoldfastError | msgspec.ValidationError | ValueError)
    account = account_of_user_error(cause, name)
    if account is not None and not (refused and mentioned and cause is error):
        return ConfigurationError(f"{source.path}: {account}")
    if name in registry.BUILT_IN and not refused and not isinstance(error, TypeError):
        return None
    if mentioned:
        return ConfigurationError(f"{source.place(min(mentioned)[1])}: {text}")
    return ConfigurationError(f"{source.path}: {name} cannot be built: {text}")


def _needed_members(problem: Any) -> list[str]:
    """Return the names of the attributes and methods that a problem has to have."""
    names = [name for name in (*Problem.__annotations__, *vars(Problem)) if name[0] != "_"]
    if has_general_observations(problem):
        # Its own likelihood is in their place.
        return [name for name in names if name not in GAUSSIAN_OBSERVATIONS]
    return names
