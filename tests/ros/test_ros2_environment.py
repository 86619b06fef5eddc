"""A robot that is reached through ROS 2: other processes, which play it well and badly."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.ros.conftest import ROOT, Ros2
from tests.ros.domains import own_domain
from tests.ros.ros2_processes import Driver, Process

from holdfast.configuration import load
from holdfast.runtime.environment import SimulatedEnvironment

CONFIGURATION = ROOT / "examples" / "peg_in_hole_2d.yaml"
ACTION = [-0.25, 0.125, 0.5]

Start = Callable[..., Process]


@pytest.fixture
def processes(ros2: Ros2) -> Iterator[list[Process]]:
    started: list[Process] = []
    yield started
    for process in started:
        process.kill()


@pytest.fixture
def surroundings(ros2: Ros2) -> Iterator[dict[str, str]]:
    with own_domain() as domain:
        yield {**ros2.environment, "ROS_DOMAIN_ID": str(domain)}


@pytest.fixture
def driver(ros2: Ros2, surroundings: dict[str, str], processes: list[Process]) -> Driver:
    made = Driver(ros2.python, surroundings, CONFIGURATION)
    processes.append(made)
    return made


@pytest.fixture
def start(ros2: Ros2, surroundings: dict[str, str], processes: list[Process]) -> Start:
    def start_robot(script: Path, **parameters: Any) -> Process:
        arguments = [f"-p{key}:={value}" for key, value in parameters.items()]
        parameters_given = [part for argument in arguments for part in ("-p", argument[2:])]
        command = [str(ros2.python), str(script), "--ros-args", *parameters_given]
        process = Process(command, surroundings)
        processes.append(process)
        return process

    return start_robot


@pytest.fixture
def simulated(start: Start) -> Start:
    def start_simulated(**parameters: Any) -> Process:
        script = ROOT / "examples" / "ros2" / "simulated_robot.py"
        return start(script, configuration=CONFIGURATION, **parameters)

    return start_simulated


def world(trial: int = 0) -> SimulatedEnvironment:
    configuration = load(CONFIGURATION)
    return SimulatedEnvironment(configuration.problem, configuration.simulator.seed, trial)


class TestReadyMade:
    @pytest.mark.parametrize("act", ["action", "service"])
    def test_a_robot_without_any_mapping_shows_what_the_world_shows(
        self, driver: Driver, simulated: Start, act: str
    ) -> None:
        simulated(act=act)
        parameters = (
            {"environment.act.type": "holdfast_interfaces/srv/Act"} if act == "service" else {}
        )
        assert driver.do("make", parameters=parameters, trial=3) == "CountingRosEnvironment"
        expected = world(trial=3)
        assert driver.do("is_done") is False
        for step in range(3):
            for sensing_action in range(3):
                assert driver.do("perform_sensing", sensing_action) == list(
                    expected.perform_sensing(sensing_action)
                )
            reward = expected.perform(np.array(ACTION))
            assert driver.do("perform", ACTION) == reward
            assert driver.do("steps_performed") == step + 1
