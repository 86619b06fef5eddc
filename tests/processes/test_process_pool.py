"""A pool of processes, as a user of Python makes one, goes on with trials."""

import multiprocessing
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

import holdfast as hf

BEFORE, AFTER = 10, 20


def test_a_problem_of_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its class is found by its name, in the directory of the configuration."""
    monkeypatch.delitem(sys.modules, "pool_peg", raising=False)
    for name, text in {
        "pool_peg.py": (
            "import pool_helper\nfrom holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
            "class Peg(PegInHole2D):\n    resolution = 2.0 * pool_helper.HALF\n"
            "    def __init__(self): super().__init__(); self.resolution = Peg.resolution\n"
            "    @classmethod\n    def from_settings(cls, model, planner): return cls()\n"
        ),
        "pool_helper.py": "HALF = 0.05\n",
        "queue.py": "raise SystemExit\n",
        "peg.yaml": "problem: pool_peg:Peg\nparticle_filter: {num_particles: 30}\n",
    }.items():
        (tmp_path / name).write_text(text)
    configuration = hf.load_configuration(tmp_path / "peg.yaml")
    planner = hf.Planner(configuration.problem, configuration.planning)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(hf.run_trial, planner, 3, max_steps=40).result()
    assert there.digest == hf.run_trial(planner, 3, max_steps=40).digest


def test_in_a_worker_of_a_pool_its_trials_run_there() -> None:
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        there = pool.apply(hf.run_trials, (hf.make_problem("peg_in_hole_2d"), 2), {"max_steps": 20})
    here = hf.run_trials(hf.make_problem("peg_in_hole_2d"), 2, max_steps=20, jobs=1)
    assert [each.digest for each in there] == [each.digest for each in here]


def test_a_script_runs_trials_on_several_cores(tmp_path: Path) -> None:
    """Its class goes to the workers, and they do not run the script: it has no guard."""
    pytest.importorskip("cloudpickle")
    script = tmp_path / "script.py"
    script.write_text(
        "import holdfast as hf\nfrom holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
        "from holdfast.robot import trial_pool\n"
        "trial_pool._WORKER_START_S = 0.0  # they take all trials but the first\n"
        "class Peg(PegInHole2D):\n    resolution = 0.2\n"
        "planner = hf.Planner(Peg(), particles=30)\n"
        "runs = [hf.run_trials(planner, 5, max_steps=40, jobs=jobs) for jobs in (1, 2)]\n"
        "assert [each.digest for each in runs[0]] == [each.digest for each in runs[1]]\n"
        "print(len(runs[1]), sum(each.steps for each in runs[1]))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("5 ")
    assert len(done.stdout.splitlines()) == 1
