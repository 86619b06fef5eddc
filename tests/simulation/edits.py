"""Changes of the production code for a while, written as the lines that are replaced."""

from __future__ import annotations
import __future__

import inspect
import textwrap
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple, TypeAlias
from unittest import mock


class Edit(NamedTuple):
    """Lines of a function that are replaced."""

    owner: Any
    function: str
    before: str
    after: str


class Replacement(NamedTuple):
    """A name that stands for something else."""

    owner: Any
    name: str
    by: object


Change: TypeAlias = Edit | Replacement


class Defect(NamedTuple):
    """Something wrong."""

    name: str
    story: str
    changes: tuple[Change, ...]


@contextmanager
def applied(defect: Defect) -> Iterator[None]:
    """Let the production code have a defect for a while."""
    sources: dict[tuple[Any, str], str] = {}
    with ExitStack() as stack:
        for change in defect.changes:
            if isinstance(change, Replacement):
                stack.enter_context(mock.patch.object(change.owner, change.name, change.by))
                continue
            key = change.owner, change.function
            if key not in sources:
                function = inspect.getattr_static(*key)
                sources[key] = textwrap.dedent(inspect.getsource(function))
            try:
                sources[key] = _edited(sources[key], change.before, change.after)
            except ValueError as error:
                raise ValueError(f"{defect.name}: {change.function} {error}") from None
        for (owner, name), source in sources.items():
            stack.enter_context(mock.patch.object(owner, name, _compiled(owner, name, source)))
        yield


def _edited(source: str, before: str, after: str) -> str:
    first = before.splitlines()[0]
    at = source.find(first)
    line = source[source.rfind("\n", 0, at) + 1 :]
    indentation = line[: len(line) - len(line.lstrip())]
    before, after = (text.replace("\n", f"\n{indentation}") for text in (before, after))
    if source.count(before) != 1:
        raise ValueError(f"has {source.count(before)} times, not once: {before!r}")
    return source.replace(before, after)


def _compiled(owner: object, name: str, source: str) -> object:
    flags = __future__.annotations.compiler_flag
    code = compile(source, f"<defect in {name}>", "exec", flags)
    defined: dict[str, object] = {}
    exec(code, inspect.getattr_static(owner, name).__globals__, defined)
    return defined[name]
