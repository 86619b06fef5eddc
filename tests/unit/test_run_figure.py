"""The figure of trial 0, which is run again where this process did not run it."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.command_line import run_here

PEG = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 40}
active_sensing: {num_observation_samples: 3, num_cores: 1}
simulator: {num_trials: 1, max_steps: 60, seed: 3}
"""


def test_a_figure_of_this_run_and_of_an_earlier_one(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "peg.yaml").write_text(PEG)
    command = ["run", "peg.yaml", "--jobs", "1", "--out", "out"]
    assert run_here(capsys, tmp_path, *command, figures=True).code == 0
    figure = tmp_path / "out" / "trial.png"
    assert figure.read_bytes().startswith(b"\x89PNG\r\n")
    figure.unlink()
    again = run_here(capsys, tmp_path, *command, "--trials", "2", "--resume", figures=True)
    assert (again.code, "figure" in again.stderr) == (0, False)
    assert figure.read_bytes().startswith(b"\x89PNG\r\n")


def test_without_matplotlib_a_note_says_so(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "peg.yaml").write_text(PEG)
    said = run_here(capsys, tmp_path, "run", "peg.yaml", "--out", "out")
    assert said.code == 0
    assert "note: no figure, because matplotlib is not installed" in said.stderr
