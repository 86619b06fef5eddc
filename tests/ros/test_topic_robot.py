"""The example of a robot on topics, a Python class with rclpy, drives its arm in a real ROS."""

import csv
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.ros.conftest import ROOT, Ros2
from tests.ros.domains import own_domain
from tests.ros.ros2_processes import ObservedProcess
from tests.ros.test_ros2_node import Ros

from holdfast.config.loader import load
from holdfast.planning.outcome import TrialResult
from holdfast.robot.trials import run_trials

CONFIGURATION = ROOT / "examples" / "peg_in_hole_2d.yaml"
DIRECTORY = ROOT / "examples" / "ros2"
TRIALS = 2


class Arm:
    """The arm in a domain of its own, and runs that drive it."""

    def __init__(self, ros2: Ros2, domain: int, directory: Path) -> None:
        self._python = str(ros2.python)
        self._environment = {**ros2.environment, "ROS_DOMAIN_ID": str(domain)}
        self._directory = directory
        self._started: list[ObservedProcess] = []
        script, configuration = DIRECTORY / "topic_arm.py", f"configuration:={CONFIGURATION}"
        level = ("--log-level", "topic_arm:=debug")
        self.process = self._start(str(script), "--ros-args", "-p", configuration, *level)

    def run(self, *options: str) -> ObservedProcess:
        named = ("--environment", "topic_robot:TopicRobot")
        found = ("--set", f"environment.directory={DIRECTORY}")
        words = (str(CONFIGURATION), *named, *found, "--trials", str(TRIALS))
        return self._start("-m", "holdfast", "run", *words, "--out", "run", *options)

    def digests(self) -> list[str]:
        with (self._directory / "run" / "trials.csv").open() as table:
            return [row["digest"] for row in csv.DictReader(table)]

    def close(self) -> None:
        for process in self._started:
            if process.process.poll() is None:
                process.kill()

    def _start(self, *words: str) -> ObservedProcess:
        process = ObservedProcess([self._python, *words], self._environment, self._directory)
        self._started.append(process)
        return process


@pytest.fixture
def domain() -> Iterator[int]:
    with own_domain() as number:
        yield number


@pytest.fixture
def arm(ros2: Ros2, domain: int, tmp_path: Path) -> Iterator[Arm]:
    made = Arm(ros2, domain, tmp_path)
    yield made
    made.close()


def in_process() -> list[str]:
    """Return what is decided without ROS."""
    results: list[TrialResult] = []
    configuration = load(CONFIGURATION, overrides={"simulator.num_trials": TRIALS})
    run_trials(configuration, 1, (), results.append)
    return [result.digest for result in results]


def test_a_run_decides_as_without_ros(arm: Arm) -> None:
    run = arm.run()
    assert run.end() == 0, run.said()
    assert arm.digests() == in_process()


def test_a_run_that_is_killed_goes_on_where_the_arm_is(arm: Arm) -> None:
    run = arm.run("--rate", "50")
    arm.process.wait_for("trial 0, move 20")
    run.kill()
    run = arm.run("--resume")
    assert run.end() == 0, run.said()
    assert arm.digests() == in_process()


def test_a_timeout_names_the_topic_that_is_silent(arm: Arm) -> None:
    run = arm.run("--rate", "50", "--set", "environment.arguments={timeout_s: 3.0}")
    arm.process.wait_for("trial 0, move 20")
    arm.process.kill()
    assert run.end() != 0
    assert re.search(
        r"no (touch|end of move \d+) on /arm/(touch|state) \(\d publishers\) within 3 s", run.said()
    )


@pytest.mark.usefixtures("arm")
def test_the_node_drives_it_too(ros2: Ros2, domain: int, tmp_path: Path) -> None:
    ros = Ros(ros2, domain, tmp_path)
    try:
        ros.node(
            simulator__seed=0,
            environment__object="topic_robot:TopicRobot",
            environment__directory=DIRECTORY,
            environment__arguments__timeout_s=30.0,
        )
        peer = ros.peer()
        assert peer.do("goal")
        result = peer.do("result")
        assert result["code"] == "FINISHED", result["message"]
        assert [trial[3] for trial in result["trials"]] == in_process()
    finally:
        ros.close()
