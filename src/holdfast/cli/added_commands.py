"""Commands that other installed packages add to ``holdfast``, as entry points.

A package adds a command with an entry point of the group ``holdfast.commands``. Its name is the
command's, and its value a module, without an attribute::

    [project.entry-points."holdfast.commands"]
    demo = "holdfast_lab.demo.command"

The module has

- ``main(arguments: Sequence[str]) -> int``: runs the command with the words behind its name and
  returns the exit code. An error of :mod:`holdfast.errors` ends it with one message.
- ``SUMMARY: str``: its line in ``holdfast --help``.
- ``IS_SERVICE = True``, if it is a service: it goes on when nobody reads its standard output.

Both importing it and reading ``SUMMARY`` should be quick: libraries that are slow to load belong
into ``main``. A command of holdfast itself goes before one of the same name in another package.

The search reads the metadata of everything installed, some ten milliseconds, so only ``--help`` and
a name that is none of holdfast's own commands begin it.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from types import ModuleType
from typing import cast

from holdfast.errors import HoldfastError
from holdfast.printable import printable

GROUP = "holdfast.commands"


def added_commands() -> dict[str, EntryPoint]:
    """Return the commands of other packages by name, sorted; of two with one name the first."""
    found: dict[str, EntryPoint] = {}
    for entry_point in entry_points(group=GROUP):
        found.setdefault(entry_point.name, entry_point)
    return dict(sorted(found.items()))


def load_command(entry_point: EntryPoint) -> ModuleType:
    """Import the module of a command.

    Raises HoldfastError if it cannot be imported, or has no ``main``.
    """
    try:
        module = cast(ModuleType, entry_point.load())
    except Exception as error:  # whatever another package's code raises
        raise HoldfastError(_complaint(entry_point, f"{type(error).__name__}: {error}")) from error
    if not callable(getattr(module, "main", None)):
        raise HoldfastError(_complaint(entry_point, f"{entry_point.value} has no function main"))
    return module


def summary_of(entry_point: EntryPoint) -> str:
    """Return the line of a command in the help; of one that cannot be loaded, why."""
    try:
        return str(getattr(load_command(entry_point), "SUMMARY", ""))
    except HoldfastError as error:
        return f"({error})"


def _complaint(entry_point: EntryPoint, reason: str) -> str:
    package = f" of {entry_point.dist.name}" if entry_point.dist is not None else ""
    return printable(f"the command {entry_point.name}{package} cannot be loaded: {reason}")
