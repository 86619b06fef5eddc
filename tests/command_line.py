"""The command line in the test's own process: for what is decided before anything is started."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from holdfast.cli import main
from holdfast.cli.added_commands import added_commands
from holdfast.cli.application import COMMANDS, find_command
from holdfast.runtime.command_line import Options


class Said(NamedTuple):
    """How a command ended, and what it said."""

    code: int
    stdout: str
    stderr: str


def run_here(
    capsys: pytest.CaptureFixture[str], directory: Path, *arguments: str, figures: bool = False
) -> Said:
    """Run a command in a directory, as if matplotlib were not installed unless figures are wanted.

    Modules that it imports from there are forgotten again.
    """
    modules, path, here = set(sys.modules), sys.path.copy(), Path.cwd()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["holdfast", *arguments])
        patch.setattr(sys, "excepthook", sys.excepthook)
        if not figures:
            patch.setitem(sys.modules, "matplotlib", None)
            patch.delitem(sys.modules, "holdfast.reports.figure", raising=False)
        os.chdir(directory)
        try:
            with pytest.raises(SystemExit) as ended:
                main()
        finally:
            os.chdir(here)
            sys.path[:] = path
            for name in set(sys.modules) - modules:
                if str(directory) in str(getattr(sys.modules[name], "__file__", None)):
                    del sys.modules[name]
    said = capsys.readouterr()
    code = ended.value.code or 0
    assert isinstance(code, int), code
    return Said(code, said.out, said.err)


def done_here(directory: Path, *commands: tuple[str, ...]) -> None:
    """Run commands in a directory, which must succeed, whatever they say."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(directory)
        for name, *arguments in commands:
            assert find_command([name, *arguments]).run(arguments) == 0


def commands() -> dict[str, str]:
    """Return the modules of all commands by name, those of the laboratory as well.

    The commands of ROS have parsers of their own.
    """
    own = {name: command.module for name, command in COMMANDS.items()}
    added = {name: each.value for name, each in added_commands().items()}
    return {**{name: place for name, place in added.items() if "holdfast_lab" in place}, **own}


def options_of(command: str) -> type[Options]:
    """Return the class of a command's options."""
    found = vars(importlib.import_module(commands()[command])).values()
    (options,) = (
        each
        for each in found
        if isinstance(each, type) and issubclass(each, Options) and each is not Options
    )
    return options
