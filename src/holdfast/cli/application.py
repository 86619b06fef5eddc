"""All commands together, as ``holdfast --help`` lists them.

A command is a module with ``main(arguments)``, which returns the exit code; that of a service has
``IS_SERVICE = True``, too. Only the module of the command that is run is imported. Other packages
add commands (:mod:`holdfast.cli.added_commands`).
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import NamedTuple

from holdfast.cli.exit_codes import EXIT_ERROR
from holdfast.errors import HoldfastError, OptionError
from holdfast.printable import brief


class Command(NamedTuple):
    """A command, and the name of its module, which is imported when the command is run."""

    module: str
    summary: str


COMMANDS = {
    "run": Command("holdfast.cli.run", "Run the trials of a configuration."),
    "serve": Command("holdfast.service.process", "Decide for robots, as a service."),
    "doctor": Command("holdfast.cli.doctor", "Check each layer between a robot and a service."),
    "check": Command("holdfast.cli.check", "Find what is wrong with a problem of your own."),
    "tune": Command("holdfast.cli.tune", "Find what to sense on your problem, by simulating it."),
    "sweep": Command("holdfast.cli.sweep", "Compare settings: runs of a grid of values."),
    "compare": Command("holdfast.cli.compare", "Compare the decisions of two runs."),
    "export": Command("holdfast.cli.export", "Write a run for RViz, Foxglove, or as tables."),
    "report": Command("holdfast.cli.report", "Write a run as one HTML file to send."),
    "view": Command("holdfast.cli.view", "See a run in Rerun's viewer."),
    "keys": Command("holdfast.cli.keys", "Make keys for robots and services."),
}

_LAB = "holdfast-lab", "./lab"
_ROS = "holdfast-ros", "./ros/ros1_master_guard ./ros/holdfast_ros"
_ELSEWHERE = {"demo": _LAB, "simulate": _LAB, "chaos": _LAB, "ros1-guard": _ROS, "ros1-serve": _ROS}
"""Which package of this project adds a command, and its folders, for whoever lacks it."""

_OVERWRITTEN = (
    "another package, of the distribution holdfast, has overwritten or removed files of this one, "
    "which is holdfast-sensing. Put them back: pip uninstall holdfast; pip install "
    "--force-reinstall --no-deps holdfast-sensing"
)

_HELP = """\
usage: holdfast [-h] [--version] COMMAND [ARGS]...

Action-entropy active sensing: choose what to sense by how much it decides what
to do, and decide the same, bit for bit, on every machine.

options:
  -h, --help  show this help message and exit
  --version   show the version and exit

commands (holdfast COMMAND --help says more):
{commands}{added}
Start with: holdfast run examples/peg_in_hole_2d.yaml
"""


class FoundCommand(NamedTuple):
    """What runs a command with its arguments and returns the exit code, and what it is.

    A service goes on when nobody reads its output: its module has ``IS_SERVICE = True``.
    """

    run: Callable[[Sequence[str]], int]
    is_service: bool = False


def find_command(arguments: Sequence[str]) -> FoundCommand:
    """Find the command that the first word names, and import its module.

    Raises HoldfastError if there is none of that name, or its package is not here; or if another
    package of the name ``holdfast`` lies over this one.
    """
    if "_PLACES" not in vars(sys.modules["holdfast"]):
        raise HoldfastError(_OVERWRITTEN)
    first = arguments[0] if arguments else ""
    if first in COMMANDS:
        return _in_module(importlib.import_module(COMMANDS[first].module))
    if first in ("", "-h", "--help"):
        return FoundCommand(_print_help if first else _explain)
    if first == "--version":
        return FoundCommand(_print_version)
    if first.endswith((".yaml", ".yml")):
        import shlex

        command = shlex.join(["holdfast", "run", *arguments])
        raise OptionError(f"{first} is no command; did you mean: {command}")
    from holdfast.cli.added_commands import added_commands, load_command

    added = added_commands()
    if first in added:
        return _in_module(load_command(added[first]))
    if first in _ELSEWHERE:
        package, folders = _ELSEWHERE[first]
        raise OptionError(
            f"the command {first} is in the package {package}, which is not installed here; in a "
            f"clone of the same version: pip install {folders}"
        )
    from holdfast.validation import close_match

    what = "option of holdfast" if first.startswith("-") else "command"
    names = [*COMMANDS, *added]
    hint = close_match(first, [*names, "--help", "--version"])
    hint = hint or f"; commands are {', '.join(names)}"
    raise OptionError(f"{brief(first)} is no {what}{hint}")


def _in_module(module: ModuleType) -> FoundCommand:
    return FoundCommand(module.main, getattr(module, "IS_SERVICE", False))


def _print_help(_: Sequence[str]) -> int:
    sys.stdout.write(_help())
    return 0


def _explain(_: Sequence[str]) -> int:
    """Print the help where no command was given."""
    sys.stderr.write(_help())
    return EXIT_ERROR


def _print_version(_: Sequence[str]) -> int:
    from holdfast.config.source_digest import core_version, machines

    sys.stdout.write(f"holdfast {core_version()} ({machines()} state machines)\n")
    return 0


def _help() -> str:
    from holdfast.cli.added_commands import added_commands, summary_of

    own = {name: command.summary for name, command in COMMANDS.items()}
    added = {name: summary_of(each) for name, each in added_commands().items() if name not in own}
    lines, more = (
        "".join(f"  {name:<11} {summary}\n" for name, summary in each.items())
        for each in (own, added)
    )
    return _HELP.format(
        commands=lines, added=f"\ncommands of other packages:\n{more}" if more else ""
    )
