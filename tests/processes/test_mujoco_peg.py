"""The peg in MuJoCo with its cloud killed: motions and forces lead to the same decisions."""

import signal
import subprocess
from pathlib import Path

import pytest
from tests.command_line import done_here
from tests.ports import free_port
from tests.processes.faults import COMMAND, PATIENCE_S, rows_of

pytest.importorskip("mujoco")

EXAMPLE = Path(__file__).parents[2] / "examples" / "mujoco_peg"
PROBLEMS = {"2d": "contact_peg:ContactPeg2D", "3d": "contact_peg:ContactPeg3D"}


@pytest.mark.parametrize("peg", PROBLEMS)
def test_the_cloud_is_killed_and_nothing_is_decided_otherwise(peg: str, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    run = ["run", str(EXAMPLE / f"peg_{peg}.yaml"), "--trials", "2", "--seed", "3"]
    done_here(tmp_path, (*run, "--out", "undisturbed", "-q"))
    cloud = subprocess.Popen(
        [
            *(*COMMAND, "serve", "--listen", endpoint),
            *("--problem", PROBLEMS[peg], "--problem-directory", str(EXAMPLE)),
        ],
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert cloud.stdout is not None
        assert endpoint in cloud.stdout.readline()
        # A hundred steps a second: the run goes on for seconds after its first trial.
        robot = subprocess.Popen(
            [*COMMAND, *run, "--service", endpoint, "--rate", "100", "--out", "disturbed"],
            cwd=tmp_path,
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            text=True,
        )
        assert robot.stderr is not None
        log = []
        for line in robot.stderr:
            log.append(line)
            if "trial 0, outcome" in line:
                cloud.send_signal(signal.SIGKILL)
        assert robot.wait(PATIENCE_S) == 0, "".join(log)
        robot.stderr.close()
    finally:
        cloud.kill()
        cloud.communicate()
    trials = rows_of(tmp_path / "disturbed")
    assert sum(int(trial["recoveries"]) for trial in trials) >= 1
    assert {trial["outcome"] for trial in trials} <= {"succeeded", "failed"}
    done_here(tmp_path, ("compare", "undisturbed", "disturbed"))
