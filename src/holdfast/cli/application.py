"""All commands together, as ``holdfast --help`` lists them.

A command is a module with ``main(arguments)``, which returns the exit code. Only the module of the
command that is run is imported.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from typing import NamedTuple

from holdfast.cli.exit_codes import EXIT_ERROR
from holdfast.errors import OptionError

__all__ = ["COMMANDS", "Command", "run_application"]


class Command(NamedTuple):
    """A command, and the name of its module: nothing outside the laboratory imports that."""

    module: str
    summary: str


COMMANDS = {
    "run": Command("holdfast.cli.run", "Run the trials of a configuration."),
    "serve": Command("holdfast.cli.serve", "Decide for robots, as a service."),
    "doctor": Command("holdfast.cli.doctor", "Check each layer between a robot and a service."),
    "demo": Command(
        "holdfast.lab.demo.command", "See a cloud and a robot killed, and no decision change."
    ),
    "chaos": Command(
        "holdfast.lab.chaos.command", "Inject real faults into real runs, and compare them."
    ),
    "experiment": Command("holdfast.lab.studies.command", "Regenerate the tables and figures."),
    "compare": Command("holdfast.cli.compare", "Compare the decisions of two runs."),
    "export": Command("holdfast.cli.export", "Write a run for RViz, Foxglove, or as tables."),
    "view": Command("holdfast.cli.view", "See a run in Rerun's viewer."),
    "simulate": Command(
        "holdfast.lab.simulation.command", "Search for faults that change a decision."
    ),
    "keys": Command("holdfast.cli.keys", "Make keys for robots and services."),
    "ros1-guard": Command("holdfast.cli.ros1_guard", "Keep a ROS 1 master alive."),
}

_HELP = """\
usage: holdfast [-h] [--version] COMMAND [ARGS]...

Action-entropy active sensing: choose what to sense by how much it decides what
to do, and decide the same, bit for bit, on every machine.

options:
  -h, --help  show this help message and exit
  --version   show the version and exit

commands (holdfast COMMAND --help says more):
{commands}
Start with: holdfast run examples/peg_in_hole_2d.yaml
"""


def run_application(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code.

    Raises
    ------
    HoldfastError
        If the command fails in a way that is no defect.
    SystemExit
        If it ends early.
    """
    first = arguments[0] if arguments else ""
    if first in COMMANDS:
        code: int = importlib.import_module(COMMANDS[first].module).main(arguments[1:])
        return code
    if first in ("", "-h", "--help"):
        lines = [f"  {name:<11} {command.summary}\n" for name, command in COMMANDS.items()]
        (sys.stdout if first else sys.stderr).write(_HELP.format(commands="".join(lines)))
        return 0 if first else EXIT_ERROR
    if first == "--version":
        from holdfast.config.source_digest import core_version
        from holdfast.recording.machine import machines

        sys.stdout.write(f"holdfast {core_version()} ({machines()} state machines)\n")
        return 0
    if first.endswith((".yaml", ".yml")):
        import shlex

        command = shlex.join(["holdfast", "run", *arguments])
        raise OptionError(f"{first} is no command; did you mean: {command}")
    from holdfast.validation import close_match

    what = "option of holdfast" if first.startswith("-") else "command"
    known = [*COMMANDS, "--help", "--version"]
    hint = close_match(first, known) or f"; commands are {', '.join(COMMANDS)}"
    raise OptionError(f"{first!r:.80} is no {what}{hint}")
