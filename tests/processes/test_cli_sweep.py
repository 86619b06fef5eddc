"""``holdfast sweep``, as a person types it."""

import re
import shlex
from pathlib import Path

import pytest
from tests.command_line import run_here
from tests.processes.faults import holdfast

PROBLEM = """\
import os
import pathlib
import signal
from holdfast.problems.peg_in_hole_2d import PegInHole2D

class Peg(PegInHole2D):
    begun = 0

    def initial_states(self, stream, count):
        Peg.begun += 1
        if pathlib.Path("die").exists() and Peg.begun == 6:
            os._exit(9)
        if pathlib.Path("stop").exists() and Peg.begun == 6:
            os.kill(os.getppid(), signal.SIGINT)
            signal.pause()
        return super().initial_states(stream, count)
"""
CONFIGURATION = """\
problem: swept_peg:Peg
particle_filter: {num_particles: 30}
simulator: {num_trials: 3, max_steps: 40, seed: 3}
"""
SET = ("--set", "selector.method=random,path_entropy")


def test_a_process_that_ends_ctrl_c_and_resume(tmp_path: Path) -> None:
    (tmp_path / "swept_peg.py").write_text(PROBLEM)
    (tmp_path / "peg.yaml").write_text(CONFIGURATION)
    (tmp_path / "die").touch()
    words = ("sweep", "peg.yaml", *SET, "--jobs", "1", "--out", "out")
    died = holdfast(tmp_path, *words)
    assert died.returncode == 4
    how = r"a worker process ended with exit code 9 while it ran trial \d of method=\w+; finished"
    assert re.search(how, died.stderr)
    (tmp_path / "die").rename(tmp_path / "stop")
    command = died.stderr.splitlines()[-1].removeprefix("Go on with: ")
    stopped = holdfast(tmp_path, *shlex.split(command)[1:])
    assert stopped.returncode == 130
    assert "trials are finished and kept in out" in stopped.stderr
    (tmp_path / "stop").unlink()
    command = stopped.stderr.splitlines()[-1].removeprefix("Go on with: ")
    assert shlex.split(command)[0] == "holdfast"
    done = holdfast(tmp_path, *shlex.split(command)[1:], "--baseline", "selector.method=random")
    assert done.returncode == 0, done.stderr
    assert " finished before; results in out" in done.stderr
    head, first, second, *_ = done.stdout.splitlines()
    assert head.split()[:2] == ["success", "(%)"]
    assert first.startswith("method=random (baseline)  ")
    assert second.startswith("method=path_entropy")
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        *("method=random", "method=path_entropy"),
        *("table.md", "table.tex", "table.csv", "trials.csv", "sweep.json"),
    }


def test_refusals(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """None of them leaves anything behind."""
    (tmp_path / "peg.yaml").write_text(CONFIGURATION.replace("swept_peg:Peg", "peg_in_hole_2d"))
    for words, message in {
        (): "--set is missing",
        ("--set", "selector.method=random"): "makes one combination",
        ("--set", "selector.method=rnd,random"): 'is "rnd"; expected one of',
        (*SET, "--baseline", "selector.method=fixed"): "no combination has that; they are",
        (*SET, "--resume"): "--resume needs --out",
        (*SET, "--seed", "1", "--set", "simulator.seed=2"): "both say what simulator.seed is",
    }.items():
        refused = run_here(capsys, tmp_path, "sweep", "peg.yaml", *words)
        assert refused.code == 2
        assert message in refused.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["peg.yaml"]
