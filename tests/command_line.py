"""The command line in the test's own process: for what is decided before anything is started."""

import csv
import functools
import importlib
import json
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


PEG = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 40}
active_sensing: {num_observation_samples: 3, num_cores: 1}
simulator: {num_trials: 6, max_steps: 80, seed: 3}
"""
"""A small run."""


class Workplace:
    """A directory in which commands are run."""

    def __init__(self, directory: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.directory = directory
        self._capsys = capsys

    def write(self, name: str, text: str) -> None:
        (self.directory / name).write_text(text)

    def names(self) -> set[str]:
        return {path.name for path in self.directory.iterdir()} - {"__pycache__"}

    def run(self, *arguments: str, figures: bool = False) -> Said:
        return run_here(self._capsys, self.directory, *arguments, figures=figures)

    def runs(self, *arguments: str, figures: bool = False) -> Said:
        """Run a command that is to come to its end; return what it says."""
        said = self.run(*arguments, figures=figures)
        assert said.code == 0, said
        return said

    def fails(self, *arguments: str) -> str:
        """Run a command that is to be refused; return what it says."""
        said = self.run(*arguments)
        assert (said.code, said.stdout) == (2, ""), said
        assert said.stderr.startswith("holdfast: error: ")
        assert "Traceback" not in said.stderr
        return said.stderr

    def decided(self, out: str) -> list[tuple[str, ...]]:
        """Return the table of trials, without the times."""
        with (self.directory / out / "trials.csv").open() as file:
            return [
                tuple(value for key, value in row.items() if key != "mean_sensing_ms")
                for row in csv.DictReader(file)
            ]

    def summary(self, out: str) -> dict[str, object]:
        found: dict[str, object] = json.loads((self.directory / out / "summary.json").read_text())
        return found


def done_here(directory: Path, *commands: tuple[str, ...]) -> None:
    """Run commands in a directory, which must succeed, whatever they say. They draw no figure."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, "matplotlib", None)
        patch.chdir(directory)
        for name, *arguments in commands:
            assert find_command([name, *arguments]).run(arguments) == 0


@functools.cache
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
