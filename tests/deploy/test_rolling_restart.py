"""Replicas are restarted under robots, and nobody decides otherwise or waits for a lease.

Three services at three addresses share a name; benchmarks/rolling.py, which has the figures of the
same, says how. All leases and timeouts here are longer than the test: whatever was found by
somebody's silence would be seen as a run that never ends.
"""

from __future__ import annotations

import itertools
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from benchmarks.rolling import Replicas, Way, decisions_of, start_robots, wait_until
from tests.deploy.docker import missing
from tests.ports import free_port
from tests.processes.faults import PATIENCE_S, References, Site, Story, assert_identical, events_of
from tests.processes.test_faults import GATED, SERVES_GATED

ROBOTS, SEEDS, TRIALS = 8, 2, 2
FAILURES = {"launch", "service_suspected", "service_vanished", "status", "hedge", "wrong_answer"}


def test_what_is_computed_when_the_signal_comes_is_delivered(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    references = References(tmp_path_factory.mktemp("references"))
    with Site(tmp_path) as site:
        gate = site.gate(4)
        first, second = (site.service(*SERVES_GATED, "--drain-s", "3600") for _ in range(2))
        first.variables["HOLDFAST_TEST_GATE"] = str(gate.port)
        first.start()
        second.start()
        story = Story(site, references, GATED, recovery={"launch": "on_failure"})
        # However fast it is, it does not come to its end before it has heard the goodbye.
        story.at("perform", 30, lambda: story.running.wait_for("service_vanished"))
        robot = site.run(story.file, services=[first, second])
        gate.wait()
        answered = len(decisions_of(robot.out))
        first.process.signal(signal.SIGTERM)
        first.process.wait_for("stopping")
        gate.open()
        story.finish(robot)
        assert first.process.wait() == 0
    deciders = [row["service"] for row in decisions_of(robot.out)]
    # What it owed it has given, and the other one decided all that was asked after that.
    assert deciders[answered] == first.endpoint
    # (Before that either may have: the one that connects first is asked first.)
    owed = deciders[answered:]
    assert sum(after != before for before, after in itertools.pairwise(owed)) == 1
    assert deciders[-1] == second.endpoint
    said = {event["event"] for event in events_of(robot.out)}
    assert said & FAILURES == {"service_vanished"}
    (left,) = first.process.matching("robot_disconnected")
    assert left["reason"] == "said goodbye"


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
