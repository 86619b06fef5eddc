"""Replicas are restarted under robots, and nobody decides otherwise or waits for a lease.

Three services at three addresses share a name; benchmarks/rolling.py, which has the figures of the
same, says how. All leases and timeouts here are longer than the test: whatever was found by
somebody's silence would be seen as a run that never ends.
"""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from benchmarks.rolling import Replicas, Way, decisions_of, start_robots, wait_until
from tests.deploy.docker import missing
from tests.ports import free_port
from tests.processes.faults import PATIENCE_S, assert_identical, events_of

ROBOTS, SEEDS, TRIALS = 8, 2, 2
FAILURES = {"launch", "service_suspected", "service_vanished", "status", "hedge", "wrong_answer"}


@pytest.fixture
def replicas(tmp_path: Path) -> Iterator[Replicas]:
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        missing("a name of several addresses needs root and unshare")
    replicas = Replicas(tmp_path, free_port())
    try:
        yield replicas
    finally:
        replicas.close()


@pytest.mark.parametrize("way", ["name", pytest.param("list", marks=pytest.mark.slow)])
def test_rolling_restart(way: Way, replicas: Replicas, tmp_path: Path) -> None:
    for address in replicas.addresses:
        replicas.start(address)
    robots = start_robots(
        tmp_path, replicas, way, ROBOTS, rate=20.0, trials=TRIALS, num_seeds=SEEDS
    )
    try:
        wait_until(lambda: all(decisions_of(out) for out in robots), "decisions of all robots")
        for address in replicas.addresses:
            assert replicas.end(address) == 0
            replicas.start(address)
        assert any(process.poll() is None for process in robots.values()), "they were too quick"
        for out, process in robots.items():
            assert process.wait(PATIENCE_S) == 0, out.with_suffix(".log").read_text()
    finally:
        for process in robots.values():
            process.kill()
            process.wait()
    for number, out in enumerate(robots):
        reference = tmp_path / f"reference-{number % SEEDS}"
        if not reference.exists():
            command = [sys.executable, "-m", "holdfast", "run", f"robot-{number}.yaml"]
            command += ["--out", str(reference)]
            subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
        assert_identical(out, reference)
        # Every answer is a replica's, and no other was ever asked for one.
        assert {row["service"] for row in decisions_of(out)} <= set(replicas.services(way))
        said = {event["event"] for event in events_of(out)}
        assert said & FAILURES <= ({"service_vanished"} if way == "list" else set()), out
    for address in replicas.addresses:
        told = replicas.told(address)
        assert sum(event["event"] == "stopping" for event in told) == 1
        left = [event for event in told if event["event"] == "robot_disconnected"]
        assert left, f"nobody was at {address}"
        assert {event["reason"] for event in left} == {"said goodbye"}
