"""Values of the command line that replace those of the configuration file, by key.

A key can be given twice: by ``--set SECTION.KEY=VALUE``, and by an option of its own. Two different
values are an error. An option that was not given replaces nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from holdfast.errors import InvalidValueError
from holdfast.runtime.files import shown_path

if TYPE_CHECKING:
    from holdfast.runtime.command_line import Options


class Override(NamedTuple):
    """Plain data for a ``section.key`` instead of the file's, and its words on the command line.

    The key may go on below: ``model.holes.0.width`` changes nothing else of ``model.holes``.
    """

    words: str
    key: str
    value: Any

    @property
    def option(self) -> str:
        """The words without the value."""
        return f"--set {self.key}" if self.words.startswith("--set ") else self.words.split()[0]


def parse_assignment(assignment: str) -> Override:
    """Read ``SECTION.KEY=VALUE``, as ``--set`` takes it; the value is YAML.

    Raises InvalidValueError if it is not of that form, or has no value; ConfigurationError if the
    value is not YAML.
    """
    from holdfast.config.yaml_document import read

    name, equals, text = assignment.partition("=")
    key = re.sub(r"\[(\d+)\]", r".\1", name.strip())  # as messages name an item of a list
    if not (equals and all(key.split(".")) and ("." in key or key == "problem_directory")):
        from holdfast.config.source import SETTINGS

        homes = [name for name, kind in SETTINGS.items() if key in kind.__struct_fields__]
        hint = f"; did you mean {homes[0]}.{assignment}?" if homes else ""
        hint = "; that is --problem" if key == "problem" else hint
        raise InvalidValueError(
            f"--set {assignment}: must be SECTION.KEY=VALUE, such as selector.method=random{hint}"
        )
    value = read(text.encode(), f"--set {name}").data
    if value is None and text.strip() not in ("null", "~"):
        raise InvalidValueError(f"--set {assignment}: has no value")
    return Override(f"--set {assignment}", key, value)


def parse_values(assignment: str) -> Override:
    """Read ``SECTION.KEY=A,B,...``, as ``holdfast sweep --set`` takes it; the value is a list.

    Raises what :func:`parse_assignment` raises.
    """
    name, equals, text = assignment.partition("=")
    found = parse_assignment(f"{name}{equals}[{text}]" if text.strip() else assignment)
    return found._replace(words=f"--set {assignment}")


def overrides_of(options: Options, assignments: Iterable[str] = ()) -> list[Override]:
    """Return what ``--set`` assigns, and the options that stand for a key of the file."""
    given = [*map(parse_assignment, assignments)]
    for name, each in options.table().items():
        value = getattr(options, name)
        if each.key is not None and value != each.default:
            plain = list(value) if each.many else value
            if isinstance(value, Path):
                plain = shown_path(value)
            given.append(Override(" ".join(each.words(value)), each.key, plain))
    return given


def combined(overrides: Iterable[Override]) -> dict[str, Any]:
    """Return the values by key; raise InvalidValueError if two of them contradict each other."""
    by_key: dict[str, Override] = {}
    for override in overrides:
        for other in by_key.values():
            outer, inner = sorted((other.key, override.key), key=len)
            # As text, because 1 and true are equal but not the same.
            differ = outer != inner or repr(other.value) != repr(override.value)
            if differ and f"{inner}.".startswith(f"{outer}."):
                raise InvalidValueError(
                    f"{other.words} and {override.words} contradict each other: both say what "
                    f"{inner} is; leave one of them out"
                )
        by_key.setdefault(override.key, override)
    return {key: override.value for key, override in by_key.items()}
