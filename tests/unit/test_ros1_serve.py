"""``holdfast ros1-serve`` as a command among the others; test_ros1_process.py has the rest."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.command_line import run_here


def test_it_has_the_options_of_serve(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    said = run_here(capsys, tmp_path, "ros1-serve", "--help")
    assert said.code == 0
    assert "--listen ENDPOINT" in said.stdout
    assert "--ros1-name NAME" in said.stdout
