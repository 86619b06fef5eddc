"""A problem with a likelihood of its own decides the same in a batch, as a robot and by a service.

The example has ``log_likelihood`` and ``sample_observation`` alone, as a user's problem may.
"""

import contextlib
import importlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.ports import free_port
from tests.processes.faults import COMMAND, holdfast, summary_of

EXAMPLES = Path(__file__).parents[2] / "examples"
PROBLEM = "corridor_doors:CorridorDoors"


@contextlib.contextmanager
def service(*options: str) -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    process = subprocess.Popen(
        [*COMMAND, "serve", "--listen", endpoint, *options], stdout=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert endpoint in process.stdout.readline()
        yield endpoint
    finally:
        process.terminate()
        process.communicate(timeout=120)


def test_the_example_has_nothing_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    members = dir(importlib.import_module("corridor_doors").CorridorDoors)
    assert {"log_likelihood", "sample_observation"} <= set(members)
    assert not {"observation_mean", "observation_variance"} & set(members)


def test_it_runs_everywhere_and_decides_the_same(tmp_path: Path) -> None:
    command = ["run", str(EXAMPLES / "corridor_doors.yaml"), "--trials", "3", "--seed", "7"]
    with service("--problem", PROBLEM, "--problem-directory", str(EXAMPLES)) as endpoint:
        for name, options in (
            ("batch", []),
            ("robot", ["--rate", "10000"]),
            ("offloaded", ["--service", endpoint, "--recovery", "never"]),
        ):
            done = holdfast(tmp_path, *command, *options, "--out", name)
            assert done.returncode == 0, f"{name}: {done.stderr}"
    found = {name: summary_of(tmp_path / name) for name in ("batch", "robot", "offloaded")}
    assert found["batch"]["successes"] == 3
    assert found["batch"]["digest"] == found["robot"]["digest"] == found["offloaded"]["digest"]
    for name in ("robot", "offloaded"):
        done = holdfast(tmp_path, "compare", "batch", name)
        assert done.returncode == 0, done.stdout + done.stderr
    assert sum(found["offloaded"]["sensing_decisions_by_service"].values()) > 0
