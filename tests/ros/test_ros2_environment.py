"""A robot that is reached through ROS 2: other processes, which play it well and badly."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.ros.conftest import ROOT, Ros2
from tests.ros.domains import own_domain
from tests.ros.ros2_processes import Driver, Process

from holdfast.config.loader import load
from holdfast.robot.environment import SimulatedEnvironment

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
def start_driver(
    ros2: Ros2, surroundings: dict[str, str], processes: list[Process]
) -> Callable[..., Driver]:
    def start(*remapped: str) -> Driver:
        made = Driver(ros2.python, surroundings, remapped)
        processes.append(made)
        return made

    return start


@pytest.fixture
def driver(start_driver: Callable[[], Driver]) -> Driver:
    return start_driver()


@pytest.fixture
def start(ros2: Ros2, surroundings: dict[str, str], processes: list[Process]) -> Start:
    def start_robot(script: Path, *remapped: str, **parameters: Any) -> Process:
        command = [str(ros2.python), str(script), "--ros-args"]
        command += [word for rule in remapped for word in ("-r", rule)]
        for key, value in parameters.items():
            command += ["-p", f"{key}:={value}"]
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


@pytest.fixture
def odd(start: Start) -> Start:
    def start_odd(*remapped: str, **parameters: Any) -> Process:
        process = start(Path(__file__).with_name("odd_robot.py"), *remapped, **parameters)
        assert process.next_line() == "ready\n"
        return process

    return start_odd


def world(trial: int = 0) -> SimulatedEnvironment:
    configuration = load(CONFIGURATION)
    return SimulatedEnvironment(configuration.problem, configuration.simulator.seed, trial)


class TestARobot:
    @pytest.mark.parametrize("act", ["action", "service"])
    def test_shows_what_its_world_shows(self, driver: Driver, simulated: Start, act: str) -> None:
        simulated(act=act)
        driver.do("make", act=act, trial=3)
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

    def test_a_trial_begins_anew_unless_it_is_resumed(
        self, driver: Driver, simulated: Start
    ) -> None:
        simulated()
        driver.do("make")
        driver.do("perform", ACTION)
        driver.do("make", resumed=True)
        assert driver.do("steps_performed") == 1
        driver.do("perform", ACTION)
        assert driver.do("steps_performed") == 2
        driver.do("make")
        assert driver.do("steps_performed") == 0

    def test_one_of_another_trial_is_refused_with_the_robots_reason(
        self, driver: Driver, simulated: Start
    ) -> None:
        simulated()
        driver.do("make", trial=0)
        error = driver.error("make", trial=4, resumed=True)
        assert "the robot is in trial 0, not in 4" in error
        assert error.startswith("EnvironmentFailedError: service /robot/trial")

    def test_a_robot_that_was_killed_goes_on_where_it_was(
        self, driver: Driver, simulated: Start, tmp_path: Path
    ) -> None:
        robot = simulated(log=tmp_path / "performed.json")
        driver.do("make")
        driver.do("perform", ACTION)
        robot.kill()
        simulated(log=tmp_path / "performed.json")
        # Who is away for a moment only is waited for.
        expected = world()
        expected.perform(np.array(ACTION))
        assert driver.do("perform_sensing", 1) == list(expected.perform_sensing(1))
        assert driver.do("steps_performed") == 1

    def test_whoever_is_killed_while_the_robot_moves_is_told_the_count_when_it_stands(
        self, driver: Driver, start_driver: Callable[[], Driver], odd: Start
    ) -> None:
        robot = odd(act="long")
        driver.do("make")
        driver.begin("perform", ACTION)
        assert robot.next_line().startswith("moving")
        driver.kill()
        again = start_driver()
        again.do("make", resumed=True)
        assert again.do("steps_performed") == 1

    def test_says_that_and_why_it_has_failed(self, driver: Driver, odd: Start) -> None:
        odd(done="failed")
        driver.do("make")
        assert driver.do("is_done") == ["failed", "the arm has hit the table"]

    def test_may_have_its_names_somewhere_else(
        self, start_driver: Callable[..., Driver], odd: Start
    ) -> None:
        """One rule remaps an action, too."""
        odd("__ns:=/left")
        names = ("sense", "act", "trial")
        driver = start_driver(*(f"robot/{name}:=/left/robot/{name}" for name in names))
        driver.do("make")
        assert driver.do("perform_sensing", 0) == [1.5]
        assert driver.do("perform", ACTION) == -1.0
        assert driver.do("steps_performed") == 1


class TestRobotsThatFail:
    def test_one_that_is_not_there(self, driver: Driver) -> None:
        error = driver.error("make", discovery_timeout_ms=500)
        offered = "service /robot/sense (holdfast_interfaces/srv/Sense)"
        assert error.startswith(f"EnvironmentFailedError: nobody offers {offered}")
        assert "environment.discovery_timeout_ms" in error

    @pytest.mark.parametrize(
        ("sense", "message"),
        [
            ("refuse", "failed: the probe is not attached"),
            ("silent", "has not said an answer within 0.45 s (0.45 times environment.timeout_ms)"),
        ],
    )
    def test_sensing(self, driver: Driver, odd: Start, sense: str, message: str) -> None:
        odd(sense=sense)
        driver.do("make", timeout_ms=1000)
        error = driver.error("perform_sensing", 1)
        assert error.startswith("EnvironmentFailedError: service /robot/sense")
        assert message in error

    @pytest.mark.parametrize(
        ("act", "message"),
        [
            ("reject", "rejected the goal"),
            ("abort", "the goal was aborted: the arm has hit the table"),
            ("unsuccessful", "failed: the arm is locked"),
        ],
    )
    def test_acting(self, driver: Driver, odd: Start, act: str, message: str) -> None:
        odd(act=act)
        driver.do("make")
        error = driver.error("perform", ACTION)
        assert error.startswith("EnvironmentFailedError: action /robot/act (holdfast_")
        assert message in error

    def test_one_that_takes_too_long_is_cancelled(self, driver: Driver, odd: Start) -> None:
        robot = odd(act="slow")
        driver.do("make", timeout_ms=1000)
        error = driver.error("perform", ACTION)
        assert "has not said the result within 0.45 s (0.45 times environment.time" in error
        assert "the goal is cancelled" in error
        assert robot.next_line().startswith("moving")
        assert robot.next_line() == "cancelled\n"

    @pytest.mark.parametrize("before", ["is_done", "cancel_once_accepted"])
    def test_an_action_is_cancelled_from_another_thread(
        self, driver: Driver, odd: Start, before: str
    ) -> None:
        robot = odd(act="slow")
        driver.do("make")
        driver.do(before)
        acting = driver.begin("perform", ACTION)
        assert robot.next_line().startswith("moving")
        driver.do("cancel")
        assert ": cancelled while " in driver.end(acting)["error"]
        assert robot.next_line() == "cancelled\n"
        # What is made afterwards is not concerned.
        driver.do("make", resumed=True)
        assert driver.do("steps_performed") == 0

    def test_a_service_is_not_waited_for_either(self, driver: Driver, odd: Start) -> None:
        robot = odd(sense="silent")
        driver.do("make")
        sensing = driver.begin("perform_sensing", 0)
        assert robot.next_line() == "sensing 0\n"
        driver.do("cancel")
        assert "cancelled while an answer was waited for" in driver.end(sensing)["error"]

    @pytest.mark.parametrize("what", ["sense", "act"])
    def test_one_that_dies_in_the_middle(self, driver: Driver, odd: Start, what: str) -> None:
        odd(**{what: "die"})
        # Nobody tells of a process that was killed; its middleware's lease ends some time after.
        driver.do("make", timeout_ms=7000)
        call = ("perform_sensing", 0) if what == "sense" else ("perform", ACTION)
        error = driver.error(*call)
        assert f" /robot/{what} " in error
        assert "timeout_ms" in error
        again = odd()
        driver.do("make", resumed=True)
        assert driver.do("steps_performed") == 0
        # What was not answered is not sent to the next one.
        assert again.lines.empty()
