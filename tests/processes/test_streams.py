"""A standard output that nobody reads any more, or that is full: ``holdfast simulate | head``."""

import os
import subprocess
from pathlib import Path

import pytest
from tests.processes.faults import COMMAND
from tests.programs import completed

CONFIGURATION = """
problem: capsule_robot
particle_filter: {num_particles: 20}
active_sensing: {num_observation_samples: 2, num_cores: 1}
simulator: {num_trials: 2, max_steps: 20, seed: 3}
"""


def unread(directory: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run a command whose reader has ended before it began."""
    reading, writing = os.pipe()
    os.close(reading)
    try:
        return subprocess.run(
            [*COMMAND, *arguments],
            cwd=directory,
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
        )
    finally:
        os.close(writing)


@pytest.mark.parametrize(
    "arguments",
    [
        ("simulate", "--story", "--seeds", "0:1000"),  # which takes minutes if it goes on
        ("simulate", "--seeds", "0:2", "--jobs", "1"),
        pytest.param(("chaos", "--list"), marks=pytest.mark.slow),
        pytest.param(("chaos", "--help"), marks=pytest.mark.slow),
        ("--version",),
    ],
    ids=" ".join,
)
def test_it_ends_as_other_tools_do(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    """And not with 1, which says of these commands that they have found something."""
    done = unread(tmp_path, *arguments)
    assert done.returncode == 141
    if "--jobs" not in arguments:  # whose progress is told
        assert done.stderr == ""
    assert "Traceback" not in done.stderr
    assert "Exception" not in done.stderr


def test_a_run_keeps_what_it_has_done(tmp_path: Path) -> None:
    path = tmp_path / "capsule.yaml"
    path.write_text(CONFIGURATION, encoding="utf-8")
    done = unread(tmp_path, "run", path.name, "--out", "out")
    assert done.returncode == 141
    assert "Traceback" not in done.stderr
    assert (tmp_path / "out" / "summary.json").exists()
    assert (tmp_path / "out" / "trials.csv").exists()
    assert unread(tmp_path, "compare", "out", "out").returncode == 141


def test_a_full_one_is_an_error(tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [*COMMAND, "chaos", "--list"],
            cwd=tmp_path,
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            timeout=120,
            check=False,
        )
    assert done.returncode == 2
    assert done.stderr == (
        "holdfast: error: the standard output cannot be written: No space left on device\n"
    )


def test_a_path_that_the_encoding_of_the_streams_lacks(tmp_path: Path) -> None:
    """A unit or cron job in the C locale."""
    (tmp_path / "größe.yaml").write_text(CONFIGURATION)
    for arguments, code in (
        (("run", "größe.yaml", "--jobs", "1", "--out", "größe"), 0),
        (("run", "größe.yaml", "--jobs", "1", "--out", "größe"), 2),
    ):
        done = completed(
            [*COMMAND, *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONIOENCODING": "ascii:strict"},
            timeout=120,
        )
        assert (done.returncode, "Traceback" in done.stderr) == (code, False), done.stderr
        assert "gr\\xf6\\xdfe" in done.stderr
    assert (tmp_path / "größe" / "summary.json").is_file()
