"""A robot that is reached through ROS 2: other processes, which play it well and badly."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
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
) -> Callable[[], Driver]:
    def start() -> Driver:
        made = Driver(ros2.python, surroundings, CONFIGURATION)
        processes.append(made)
        return made

    return start


@pytest.fixture
def driver(start_driver: Callable[[], Driver]) -> Driver:
    return start_driver()


@pytest.fixture
def start(ros2: Ros2, surroundings: dict[str, str], processes: list[Process]) -> Start:
    def start_robot(script: Path, **parameters: Any) -> Process:
        command = [str(ros2.python), str(script), "--ros-args"]
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
    def start_odd(**parameters: Any) -> Process:
        process = start(Path(__file__).with_name("odd_robot.py"), **parameters)
        assert process.next_line() == "ready\n"
        return process

    return start_odd


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
        assert driver.do("make", parameters=parameters, trial=3) == "CountingRos2Environment"
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
        assert "environment.steps.name" in error

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
        # This robot answers while it moves, and counts a task action at its end.
        again.do("make", resumed=True)
        assert again.do("steps_performed") == 1

    def test_failed_is_said(self, driver: Driver, odd: Start) -> None:
        odd(done="failed")
        driver.do("make")
        assert driver.do("is_done") == ["failed", ""]

    def test_the_reason_is_a_field(self, driver: Driver, odd: Start) -> None:
        odd(done="failed")
        driver.do("make", parameters={"environment.done.reason": "message"})
        assert driver.do("is_done") == ["failed", "the arm has hit the table"]


class TestMapped:
    MAPPING: Mapping[str, Any] = {
        "environment.sense.name": "/arm/probe",
        "environment.sense.type": "nav_msgs/srv/GetPlan",
        "environment.sense.index": "tolerance",
        "environment.sense.fields": ["start.pose.position.y"],
        "environment.sense.values": [0.5, 1.5, 2.5],
        "environment.sense.constants": ["start.header.frame_id: probe"],
        "environment.sense.observation": "plan.poses[{index}].pose.position.x",
        "environment.act.name": "/arm/move",
        "environment.act.type": "nav_msgs/srv/GetPlan",
        "environment.act.action": [
            "goal.pose.position.x",
            "goal.pose.position.y",
            "goal.pose.orientation.z",
        ],
        "environment.act.scale": [1000.0, 1000.0, 1.0],
        "environment.act.constants": ["goal.header.frame_id: base_link"],
        "environment.act.reward": "plan.poses[0].pose.position.z",
        "environment.steps.name": "/arm/count",
        "environment.steps.type": "nav_msgs/srv/GetMap",
        "environment.steps.steps": "map.info.width",
        "environment.reset.name": "/arm/home",
        "environment.reset.type": "std_srvs/srv/Trigger",
        "environment.reset.success": "success",
    }

    def test_a_robot_of_ones_own_is_reached_through_its_own_types(
        self, driver: Driver, odd: Start
    ) -> None:
        robot = odd()
        assert driver.do("make", parameters=self.MAPPING) == "CountingRos2Environment"
        assert robot.next_line() == "home\n"
        assert driver.do("is_done") is False
        assert [driver.do("perform_sensing", axis) for axis in range(3)] == [[0.0], [11.0], [22.0]]
        assert driver.do("perform", ACTION) == -2.5
        assert robot.next_line() == "moving base_link -250 125 0.5\n"
        assert driver.do("steps_performed") == 1

    def test_a_move_may_show_more_than_its_reward(self, driver: Driver, odd: Start) -> None:
        odd()
        mapping = {
            **self.MAPPING,
            "environment.act.motion": ["plan.poses[0].pose.position.z"],
            "environment.act.observation": [
                "plan.poses[0].pose.position.x",
                "plan.poses[0].pose.position.z",
            ],
        }
        driver.do("make", parameters=mapping)
        assert driver.do("perform", ACTION) == [-2.5, [-2.5], [0.0, -2.5]]

    def test_numbers_of_each_sensing_action(self, driver: Driver, odd: Start) -> None:
        odd()
        mapping = {
            **self.MAPPING,
            "environment.sense.observation": ["plan.poses[0].pose.position.y"],
        }
        driver.do("make", parameters=mapping)
        assert [driver.do("perform_sensing", axis) for axis in range(3)] == [[0.5], [1.5], [2.5]]

    def test_without_a_count_an_unanswered_action_is_not_sent_again(
        self, driver: Driver, odd: Start
    ) -> None:
        robot = odd(act="silent")
        mapping = {
            key: value
            for key, value in self.MAPPING.items()
            if not key.startswith(("environment.steps", "environment.reset"))
        }
        assert (
            driver.do("make", parameters={**mapping, "environment.act.timeout_ms": 300})
            == "Ros2Environment"
        )
        error = driver.error("perform", ACTION)
        assert "service /arm/move (environment.act.name)" in error
        assert "within 0.3 s (environment.act.timeout_ms)" in error
        assert robot.next_line().startswith("moving")
        assert robot.lines.empty()

    def test_with_a_count_the_robot_says_that_it_was_performed(
        self, driver: Driver, odd: Start
    ) -> None:
        odd(act="silent")
        mapping = {**self.MAPPING, "environment.act.timeout_ms": 300}
        driver.do("make", parameters=mapping)
        driver.error("perform", ACTION)
        driver.do("make", parameters=mapping, resumed=True)
        assert driver.do("steps_performed") == 1

    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"sense.type": "nav_msgs/GetPlan"}, "environment.sense.type is 'nav_msgs/GetPlan'"),
            ({"sense.type": "no_msgs/srv/GetPlan"}, "No module named 'no_msgs'"),
            ({"sense.type": "nav_msgs/srv/GetPlans"}, "environment.sense.type"),
            ({"sense.index": "start.pose.position.w"}, "has no field start.pose.position.w; there"),
            ({"sense.indx": "tolerance"}, "did you mean environment.sense.index"),
            ({"sense.values": [1.0]}, "environment.sense.values has 1 numbers; it must have 3"),
            ({"act.scale": [1.0, 2.0]}, "environment.act.scale has 2 numbers"),
            ({"act.action": ["tolerance", "tolerance"]}, "environment.act.action names 2 fields"),
            ({"act.timeout_ms": -1.0}, "environment.act.timeout_ms is -1.0"),
            ({"act.timeout_ms": 70000.0}, "environment.timeout_ms, 60000"),
            ({"steps.steps": ""}, "environment.steps.steps is empty"),
        ],
    )
    def test_a_mapping_that_cannot_be_used_is_an_error(
        self, driver: Driver, changed: Mapping[str, Any], message: str
    ) -> None:
        own = {f"environment.{key}": value for key, value in changed.items()}
        error = driver.error("make", parameters={**self.MAPPING, **own})
        assert error.startswith("ConfigurationError")
        assert message in error


class TestObservationsAsMessages:
    TOUCH: Mapping[str, Any] = {
        "environment.sense.name": "robot/sense",
        "environment.act.name": "robot/act",
        "environment.observation.topic": "arm/touch",
        "environment.observation.type": "geometry_msgs/msg/PointStamped",
        "environment.observation.fields": ["point.x"],
        "environment.sense.timeout_ms": 2000,
    }

    def test_one_taken_after_sensing_is_the_observation(self, driver: Driver, odd: Start) -> None:
        odd(topic="fresh")
        driver.do("make", parameters=self.TOUCH)
        # The robot shows how often it has sensed: what it showed before is another number.
        assert [driver.do("perform_sensing", 0) for _ in range(5)] == [[1.0 + n] for n in range(5)]

    def test_so_is_one_without_a_stamp_by_when_it_came(self, driver: Driver, odd: Start) -> None:
        odd(topic="unstamped")
        mapping = {
            **self.TOUCH,
            "environment.observation.topic": "arm/force",
            "environment.observation.type": "geometry_msgs/msg/Vector3",
            "environment.observation.fields": "x",
        }
        driver.do("make", parameters=mapping)
        assert [driver.do("perform_sensing", 0) for _ in range(5)] == [[1.0 + n] for n in range(5)]

    def test_one_that_comes_now_and_was_taken_before_is_refused(
        self, driver: Driver, odd: Start
    ) -> None:
        odd(topic="stale")
        driver.do("make", parameters=self.TOUCH)
        error = driver.error("perform_sensing", 0)
        assert "topic arm/touch (environment.observation.topic)" in error
        assert "within 2 s (environment.sense.timeout_ms)" in error
        assert "were older, the last by" in error

    def test_one_taken_while_sensing_counts_if_that_is_said(
        self, driver: Driver, odd: Start
    ) -> None:
        odd(topic="during")
        driver.do("make", parameters=self.TOUCH)
        assert "were older" in driver.error("perform_sensing", 0)
        driver.do("make", parameters={**self.TOUCH, "environment.observation.taken": "during"})
        assert driver.do("perform_sensing", 0) == [2.0]

    def test_a_topic_that_nobody_publishes_is_an_error(self, driver: Driver, odd: Start) -> None:
        odd()
        nothing = {
            "environment.observation.topic": "arm/nothing",
            "environment.discovery_timeout_ms": 1000,
        }
        error = driver.error("make", parameters={**self.TOUCH, **nothing})
        assert "nobody publishes topic arm/nothing (environment.observation.topic)" in error

    def test_so_is_one_of_which_nothing_comes(self, driver: Driver, odd: Start) -> None:
        odd()
        driver.do("make", parameters=self.TOUCH)
        assert "none came, and 1 publish it" in driver.error("perform_sensing", 0)

    def test_nobody_need_be_asked(self, driver: Driver, odd: Start) -> None:
        odd(topic="fresh")
        mapping = {
            key: value
            for key, value in self.TOUCH.items()
            if not key.startswith("environment.sense")
        }
        driver.do("make", parameters=mapping)
        assert driver.do("perform_sensing", 0) == [0.0]


class TestDoneAsAMessage:
    DONE: Mapping[str, Any] = {
        "environment.done.name": "arm/done",
        "environment.done.type": "std_msgs/msg/Bool",
        "environment.done.done": "data",
    }

    @pytest.mark.parametrize("done", ["succeeded", "open"])
    def test_the_last_one_counts(self, driver: Driver, odd: Start, done: str) -> None:
        odd(done=done)
        driver.do("make", parameters=self.DONE, resumed=True)
        assert driver.do("is_done") == (["succeeded", ""] if done == "succeeded" else False)

    def test_that_of_the_trial_before_does_not_end_the_next(
        self, driver: Driver, odd: Start
    ) -> None:
        odd(done="succeeded")
        reset = {
            "environment.reset.name": "arm/home",
            "environment.reset.type": "std_srvs/srv/Trigger",
        }
        driver.do("make", parameters={**self.DONE, **reset})
        assert driver.do("is_done") is False

    def test_one_that_is_not_latched_is_an_error(self, driver: Driver, odd: Start) -> None:
        odd()
        error = driver.error(
            "make", parameters={**self.DONE, "environment.discovery_timeout_ms": 500}
        )
        assert "topic arm/done (environment.done.name) has brought no message" in error
        assert "latched" in error


class TestRobotsThatFail:
    def test_one_that_is_not_there(self, driver: Driver) -> None:
        error = driver.error("make", parameters={"environment.discovery_timeout_ms": 500})
        assert error.startswith("EnvironmentFailedError: nobody offers service robot/sense")
        assert "environment.sense.name" in error
        assert "environment.discovery_timeout_ms" in error

    @pytest.mark.parametrize(
        ("sense", "message"),
        [
            ("refuse", "failed: the probe is not attached"),
            ("size", "showed 2 numbers (environment.sense.observation) for sensing action 1 (y)"),
            ("nothing", "showed 0 numbers"),
            ("not_a_number", "must be finite"),
            ("endless", "must be finite"),
            ("silent", "has not said an answer within 0.5 s (environment.sense.timeout_ms)"),
        ],
    )
    def test_sensing(self, driver: Driver, odd: Start, sense: str, message: str) -> None:
        odd(sense=sense)
        driver.do("make", parameters={"environment.sense.timeout_ms": 500})
        error = driver.error("perform_sensing", 1)
        assert error.startswith("EnvironmentFailedError: service robot/sense")
        assert "environment.sense" in error
        assert message in error

    @pytest.mark.parametrize(
        ("act", "message"),
        [
            ("reject", "rejected the goal"),
            ("abort", "the goal was aborted: the arm has hit the table"),
            ("unsuccessful", "failed: the arm is locked"),
            ("infinite", "the reward inf (environment.act.reward)"),
        ],
    )
    def test_acting(self, driver: Driver, odd: Start, act: str, message: str) -> None:
        odd(act=act)
        driver.do("make")
        error = driver.error("perform", ACTION)
        assert error.startswith("EnvironmentFailedError: action robot/act (environment.act.name)")
        assert message in error

    def test_one_that_takes_too_long_is_cancelled(self, driver: Driver, odd: Start) -> None:
        robot = odd(act="slow")
        driver.do("make", parameters={"environment.act.timeout_ms": 500})
        error = driver.error("perform", ACTION)
        assert "has not said the result within 0.5 s (environment.act.timeout_ms)" in error
        assert "the goal is cancelled" in error
        assert robot.next_line().startswith("moving")
        assert robot.next_line() == "cancelled\n"

    def test_an_action_is_cancelled_from_another_thread(self, driver: Driver, odd: Start) -> None:
        robot = odd(act="slow")
        driver.do("make")
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
        driver.do("make", parameters={f"environment.{what}.timeout_ms": 3000})
        call = ("perform_sensing", 0) if what == "sense" else ("perform", ACTION)
        error = driver.error(*call)
        assert f"robot/{what} (environment.{what}.name)" in error
        assert "environment.discovery_timeout_ms" in error or "timeout_ms" in error
        odd()
        driver.do("make", resumed=True)
        assert driver.do("steps_performed") == 0
