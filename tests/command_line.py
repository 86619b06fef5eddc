"""The command line in the test's own process: for what is decided before anything is started."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

from holdfast.cli import main
from holdfast.cli.application import COMMANDS
from holdfast.runtime.command_line import Options

__all__ = ["Said", "options_of", "run_here"]


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
            patch.delitem(sys.modules, "holdfast.recording.figure", raising=False)
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


def options_of(command: str) -> type[Options]:
    """Return the class of a command's options."""
    found = vars(importlib.import_module(COMMANDS[command].module)).values()
    (options,) = (
        each
        for each in found
        if isinstance(each, type) and issubclass(each, Options) and each is not Options
    )
    return options
