"""The peg in MuJoCo with its cloud killed again and again: are the decisions the undisturbed ones?

A real service is killed (SIGKILL) during every tenth trial, and started again five trials later;
meanwhile the robot's own local service decides. ::

    python -m benchmarks.mujoco_peg_cloud --out runs/mujoco_peg_cloud

runs 200 trials of each peg twice, in some minutes, and ends with 1 if a decision differs.
"""

from __future__ import annotations

import argparse
import csv
import re
import socket
import subprocess
import sys
from pathlib import Path

from benchmarks.mujoco_peg import EXAMPLES

COMMAND = (sys.executable, "-c", "from holdfast.cli import main; main()")
KILLED_EVERY, AWAY_FOR = 10, 5
PROBLEMS = {"2d": "contact_peg:ContactPeg2D", "3d": "contact_peg:ContactPeg3D"}
_ENDED = re.compile(r" trial (\d+), outcome ")


class Cloud:
    """A service that can be killed and started again at the same address."""

    def __init__(self, problem: str) -> None:
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.endpoint = f"tcp/127.0.0.1:{free.getsockname()[1]}"
        self._problem = problem
        self.kills = 0
        self.start()

    def start(self) -> None:
        self._process = subprocess.Popen(
            [
                *(*COMMAND, "serve", "--listen", self.endpoint),
                *("--problem", self._problem, "--problem-directory", str(EXAMPLES)),
            ],
            stdout=subprocess.PIPE,
        )
        assert self._process.stdout is not None
        self._process.stdout.readline()  # it listens

    def kill(self) -> None:
        self._process.kill()
        self._process.communicate()
        self.kills += 1


def compared(peg: str, trials: int, seed: int, directory: Path) -> bool:
    """Run a peg without a cloud and with one that is killed; tell whether they decided the same."""
    undisturbed, disturbed = directory / f"{peg}_undisturbed", directory / f"{peg}_disturbed"
    run = [*COMMAND, "run", str(EXAMPLES / f"peg_{peg}.yaml"), "-q"]
    run += ["--trials", str(trials), "--seed", str(seed), "--out"]
    subprocess.run([*run, str(undisturbed)], check=True, stderr=subprocess.DEVNULL)
    cloud = Cloud(PROBLEMS[peg])
    # Without -q: the log says when a trial has ended.
    run.remove("-q")
    robot = subprocess.Popen(
        [*run, str(disturbed), "--service", cloud.endpoint],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert robot.stderr is not None
    away = False
    for line in robot.stderr:
        ended = _ENDED.search(line)
        if ended is None:
            continue
        if int(ended[1]) % KILLED_EVERY == AWAY_FOR - 1 and not away:
            cloud.kill()
        elif int(ended[1]) % KILLED_EVERY == KILLED_EVERY - 1:
            cloud.start()
        else:
            continue
        away = not away
    failed = robot.wait()
    if not away:
        cloud.kill()
        cloud.kills -= 1
    same = subprocess.run([*COMMAND, "compare", str(undisturbed), str(disturbed)], check=False)
    with (disturbed / "trials.csv").open(newline="") as rows:
        recoveries = [int(row["recoveries"]) for row in csv.DictReader(rows)]
    print(
        f"{peg}: {len(recoveries)} trials, cloud killed {cloud.kills} times, "
        f"{sum(recoveries)} recoveries, "
        f"decisions {'identical' if same.returncode == 0 else 'DIFFERENT'}"
    )
    return failed == 0 and same.returncode == 0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("runs/mujoco_peg_cloud"))
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--seed", type=int, default=2026)
    options = parser.parse_args()
    same = [compared(peg, options.trials, options.seed, options.out) for peg in PROBLEMS]
    raise SystemExit(0 if all(same) else 1)


if __name__ == "__main__":
    main()
