"""The node of ROS 2, with another process of ROS 2 as its client, its robot and its audience."""

import json
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from statistics import median
from time import monotonic
from typing import Any

import numpy as np
import pytest
from tests.ports import free_port
from tests.ros.conftest import Ros2
from tests.ros.domains import own_domain
from tests.ros.ros2_processes import ObservedProcess

from holdfast.config.loader import load
from holdfast.planning.planner import Planner
from holdfast.reports.poses import pose_layout
from holdfast.robot.trial import run_trial

ROOT = Path(__file__).parents[2]
CONFIGURATION = ROOT / "examples" / "peg_in_hole_2d.yaml"
PATIENCE_S = 120.0
"""Only a hang takes so long."""

SEED = 5
TRIALS = 2


def in_process(trials: int = TRIALS, seed: int = SEED) -> list[list[Any]]:
    """Return what the trials come to without any process but this one."""
    configuration = load(CONFIGURATION, seed=seed)
    results = [
        run_trial(
            Planner(configuration.problem, configuration.planning),
            configuration.simulator.seed,
            trial,
            max_steps=configuration.simulator.max_steps,
        )
        for trial in range(trials)
    ]
    return [[result.trial, result.outcome, result.steps, result.digest] for result in results]


class Peer(ObservedProcess):
    """Another process of ROS."""

    def read(self) -> Any:
        return json.loads(self.output.get(timeout=2 * PATIENCE_S))

    def ask(self, name: str, **arguments: Any) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"do": name, **arguments}) + "\n")
        self.process.stdin.flush()

    def do(self, name: str, **arguments: Any) -> Any:
        self.ask(name, **arguments)
        return self.answer()

    def answer(self) -> Any:
        answer = self.read()
        assert "error" not in answer, f"{answer['error']}\n{self.said()}"
        return answer["answer"]

    def drive(self, answers: int | None = None, seed: int = SEED) -> Any:
        """Be the robot until so many decisions are performed, or all."""
        limit = {} if answers is None else {"answers": answers}
        return self.do("drive", configuration=str(CONFIGURATION), seed=seed, **limit)

    def wait_seen(self, is_there: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Gather what is published until it is enough."""
        deadline = monotonic() + PATIENCE_S
        seen: dict[str, Any] = {}
        while True:
            for key, values in self.do("seen").items():
                seen.setdefault(key, []).extend(values)
            if is_there(seen):
                return seen
            assert monotonic() < deadline, seen
            threading.Event().wait(0.05)


class Ros:
    """One domain of ROS 2, and the processes in it."""

    def __init__(self, ros2: Ros2, domain: int, directory: Path) -> None:
        self._python = str(ros2.python)
        self.directory = directory
        self.environment = {**ros2.environment, "ROS_DOMAIN_ID": str(domain)}
        self.started: list[ObservedProcess] = []

    def start(self, *command: str) -> ObservedProcess:
        self.started.append(ObservedProcess([*command], self.environment, self.directory))
        return self.started[-1]

    def node(self, *, wait: bool = True, **parameters: Any) -> ObservedProcess:
        """Start the node; ``a__b`` stands for ``a.b``."""
        values = {
            "configuration": str(CONFIGURATION),
            "run_directory": str(self.directory / "run"),
            "simulator.seed": SEED,
            "simulator.num_trials": TRIALS,
            "autostart": "true",
            **{key.replace("__", "."): value for key, value in parameters.items()},
        }
        words = [word for key, value in values.items() for word in ("-p", f"{key}:={value}")]
        node = self.start(self._python, "-m", "holdfast_ros.ros2", "--ros-args", *words)
        if wait:
            node.wait_for("]: active" if values["autostart"] == "true" else "]: unconfigured")
        return node

    def peer(self, name: str = "/holdfast") -> Peer:
        command = [self._python, str(ROOT / "tests" / "ros" / "ros2_peer.py"), name]
        peer = Peer(command, self.environment, self.directory)
        self.started.append(peer)
        assert peer.read() == {"ready": True}
        return peer

    def robot(self, motion_s: float) -> ObservedProcess:
        """Start a robot that is another process of ROS."""
        script = ROOT / "examples" / "ros2" / "simulated_robot.py"
        configuration = self.directory / "robot.yaml"
        configuration.write_text(load(CONFIGURATION, seed=SEED).to_yaml())
        values = {"configuration": configuration, "motion_s": motion_s}
        words = [word for key, value in values.items() for word in ("-p", f"{key}:={value}")]
        return self.start(self._python, str(script), "--ros-args", *words)

    def service(self, port: int) -> ObservedProcess:
        endpoint = f"tcp/127.0.0.1:{port}"
        service = self.start(self._python, "-m", "holdfast", "serve", "--listen", endpoint)
        assert "listening" in service.output.get(timeout=PATIENCE_S)
        return service

    def close(self) -> None:
        for process in self.started:
            if process.process.poll() is None:
                process.kill()


@pytest.fixture
def ros(ros2: Ros2, tmp_path: Path) -> Iterator[Ros]:
    with own_domain() as domain:
        made = Ros(ros2, domain, tmp_path)
        yield made
        made.close()


def trials(result: dict[str, Any]) -> list[list[Any]]:
    found: list[list[Any]] = result["trials"]
    return found


class TestARun:
    def test_decides_as_in_process_and_shows_it(self, ros: Ros) -> None:
        node = ros.node(belief_rate_hz=1000.0, rate_hz=100.0)
        peer = ros.peer()
        assert peer.do("goal")
        result = peer.do("result")
        assert (result["code"], result["status"]) == ("FINISHED", 4)
        assert trials(result) == in_process()

        steps = sum(trial[2] for trial in result["trials"])
        seen = peer.wait_seen(
            lambda seen: (
                sum(order[2] for order in seen["decisions"]) == steps
                and seen["statuses"][-1] == "finished"
            )
        )
        finished = [item[2] for item in seen["diagnostics"] if item[1] == "finished"]
        assert {(facts["status"], facts["finished_trials"]) for facts in finished} == {
            ("standard", str(TRIALS))
        }
        sensing = [order for order in seen["decisions"] if order[2] == 0]
        acting = [order for order in seen["decisions"] if order[2] == 1]
        assert [order[1] for order in acting] == [
            step for trial in result["trials"] for step in range(trial[2])
        ]
        # On a busy machine some come too late to be computed.
        computed = [order for order in sensing if order[4]]
        assert computed
        for order in computed:
            assert int(np.argmin(order[4])) == order[3]
        assert {order[6] for order in acting} == {"standard"}
        assert all(len(order[5]) == 3 for order in acting)
        assert seen["feedback"][0] in seen["decisions"]
        assert {tuple(cloud) for cloud in seen["clouds"]} == {("task", 500)}

        belief = peer.do("belief")
        table = np.reshape(belief["data"], (belief["rows"], -1))
        states, weights = table[:, :-1], table[:, -1]
        assert belief["columns"] == "x (m); y (m); θ (rad); weight"
        layout = pose_layout(load(CONFIGURATION).problem)
        assert layout is not None
        np.testing.assert_array_equal(peer.do("cloud"), layout.poses(states))
        assert sum(weights) == pytest.approx(1.0)
        assert node.interrupt() == 0
        # Before its end a bond is ended, which a lifecycle manager would take for a death.
        bonds = peer.wait_seen(lambda seen: seen["bonds"] and not seen["bonds"][-1][2])["bonds"]
        assert {(name, instance) for name, instance, *_ in bonds} == {("holdfast", bonds[0][1])}
        assert [active for *_, active, _ in bonds[:-1]] == [True] * (len(bonds) - 1)

    def test_a_goal_is_cancelled_and_a_new_one_goes_on(self, ros: Ros) -> None:
        ros.node(rate_hz=100.0)
        peer = ros.peer()
        assert peer.do("goal")
        peer.wait_seen(lambda seen: len(seen["feedback"]) >= 20)
        second = peer.do("second_goal")
        assert second["code"] == "REFUSED"
        assert second["message"] == "another goal is running; cancel it, or wait for its result"
        assert peer.do("cancel") == 1
        result = peer.do("result")
        assert (result["code"], result["status"]) == ("PAUSED", 5)
        assert result["message"] == "the goal was cancelled"
        assert peer.do("goal")
        result = peer.do("result")
        assert result["code"] == "FINISHED"
        assert trials(result) == in_process()

    def test_a_goal_after_the_end_gets_the_result_again(self, ros: Ros) -> None:
        ros.node()
        peer = ros.peer()
        results = []
        for _ in range(2):
            assert peer.do("goal")
            results.append(peer.do("result"))
        assert results[0]["code"] == "FINISHED"
        assert results[0] == results[1]


class TestAnExecutive:
    def test_drives_the_robot_as_in_process(self, ros: Ros) -> None:
        ros.node(environment__kind="executive")
        peer = ros.peer()
        driven = peer.drive()
        assert peer.do("decide")["code"] == "FINISHED"
        assert peer.do("goal")
        result = peer.do("result")
        assert trials(result) == in_process()
        times = sorted(driven["times"])
        print(
            f"~/decide: {len(times)} calls, median {1e3 * median(times):.2f} ms, 99 % "
            f"{1e3 * times[int(0.99 * len(times))]:.2f} ms"
        )

    def test_a_call_is_repeated_and_a_bad_one_is_explained(self, ros: Ros) -> None:
        ros.node(environment__kind="executive")
        peer = ros.peer()
        first = peer.do("decide")
        assert (first["code"], first["number"], first["kind"]) == ("OK", 1, 0)
        assert peer.do("decide") == first
        bad = peer.do("decide", number=1, observation=[0.0, 1.0])
        assert bad["code"] == "BAD_REQUEST"
        assert "observation of 2 values" in bad["message"]
        assert bad["number"] == 1
        wrong = peer.do("decide", number=9)
        assert wrong["code"] == "BAD_REQUEST"
        assert "trial 0, number 9: trial 0, number 1 is to be answered" in wrong["message"]
        done = peer.do("decide", number=1, observation=[0.0], done=7)
        assert done["message"] == "done 7: allowed are 0 to 2"
        assert (done["code"], done["number"]) == ("BAD_REQUEST", 1)
        early = peer.do("decide", number=1, observation=[0.0], done=1)
        assert (early["code"], early["number"]) == ("BAD_REQUEST", 1)
        assert "number 1 is a sensing action" in early["message"]
        second = peer.do("decide", number=1, observation=[4.0])
        assert (second["code"], second["number"], second["kind"]) == ("OK", 2, 1)
        again = peer.do("decide", number=1, observation=[4.0])
        assert again == second

    def test_needs_its_parameter(self, ros: Ros) -> None:
        ros.node()
        answer = ros.peer().do("decide")
        assert answer["code"] == "INACTIVE"
        assert "environment.kind is configuration" in answer["message"]

    def test_may_go_on_with_a_goal_beside_it(self, ros: Ros) -> None:
        ros.node(environment__kind="executive")
        peer = ros.peer()
        peer.drive(30)
        assert peer.do("goal")
        peer.drive()
        result = peer.do("result")
        assert result["code"] == "FINISHED"
        assert trials(result) == in_process()


class TestARobot:
    """Another process of ROS plays the robot; the node calls its services and actions."""

    def test_is_driven_as_in_process(self, ros: Ros) -> None:
        ros.robot(motion_s=0.0)
        ros.node(environment__kind="ros")
        peer = ros.peer()
        assert peer.do("goal")
        result = peer.do("result")
        assert result["code"] == "FINISHED", result["message"]
        assert trials(result) == in_process()

    def test_may_be_held_and_the_node_killed_while_it_moves(self, ros: Ros) -> None:
        ros.robot(motion_s=0.01)
        node = ros.node(environment__kind="ros")
        peer = ros.peer()
        assert peer.do("goal")
        peer.wait_seen(lambda seen: len(seen["feedback"]) >= 10)
        assert peer.do("change", transition="deactivate")
        assert peer.do("result")["code"] == "PAUSED"
        assert peer.do("change", transition="activate")
        assert peer.do("goal")
        peer.wait_seen(lambda seen: len(seen["feedback"]) >= 10)
        node.kill()
        ros.node(environment__kind="ros")
        assert peer.do("goal")
        result = peer.do("result")
        assert result["code"] == "FINISHED", result["message"]
        assert trials(result) == in_process()

    def test_that_is_not_there_holds_the_run(self, ros: Ros) -> None:
        ros.node(environment__kind="ros", environment__discovery_timeout_ms=300.0)
        peer = ros.peer()
        assert peer.do("goal")
        result = peer.do("result")
        assert (result["code"], result["status"]) == ("HELD", 6)
        assert "nobody offers" in result["message"]
        ros.robot(motion_s=0.0)
        while peer.do("goal") and (result := peer.do("result"))["code"] == "HELD":
            assert "nobody offers" in result["message"]
        assert trials(result) == in_process()
        peer.wait_seen(lambda seen: "finished" in seen["statuses"])

    def test_has_parameters_that_are_checked_at_once(self, ros: Ros) -> None:
        node = ros.node(wait=False, environment__kind="ros", environment__act="topic")
        node.wait_for("not configured: ")
        assert "environment.act" in node.said()


def statuses(seen: dict[str, Any]) -> list[str]:
    """Return the statuses of the diagnostics, without repetitions."""
    found: list[str] = []
    for _, _, values, *_ in seen["diagnostics"]:
        status = values["status"]
        if status and (not found or found[-1] != status):
            found.append(status)
    return found


class TestFaults:
    def test_a_cloud_that_is_killed_and_comes_back(self, ros: Ros) -> None:
        port = free_port()
        service = ros.service(port)
        services = f"['tcp/127.0.0.1:{port}']"
        node = ros.node(environment__kind="executive", offload__services=services)
        peer = ros.peer()
        peer.drive(40)
        decided_by = f"tcp/127.0.0.1:{port}"
        peer.wait_seen(
            lambda seen: any(
                (item[2]["status"], item[2]["decided_by"]) == ("standard", decided_by)
                for item in seen["diagnostics"]
            )
        )
        service.kill()
        peer.drive(20)
        seen = peer.wait_seen(lambda seen: "local_recovery" in statuses(seen))
        recovering = [item for item in seen["diagnostics"] if item[2]["status"] == "local_recovery"]
        # Also while it holds still until the local service has started.
        assert {item[0] for item in recovering} == {1}
        assert all(item[2]["decided_by"] != decided_by for item in recovering)
        ros.service(port)
        while "keep_alive" not in node.said():
            peer.drive(10)
        peer.wait_seen(lambda seen: "keep_alive" in statuses(seen))
        peer.drive()
        assert peer.do("goal")
        assert trials(peer.do("result")) == in_process()

    def test_nobody_decides(self, ros: Ros) -> None:
        port = free_port()
        node = ros.node(
            environment__kind="executive",
            offload__services=f"['tcp/127.0.0.1:{port}']",
            recovery__launch="never",
            decide_timeout_s=0.2,
        )
        peer = ros.peer()
        assert peer.do("decide")["code"] == "HOLDING"
        seen = peer.wait_seen(
            lambda seen: any(item[2]["holding"] == "true" for item in seen["diagnostics"])
        )
        assert seen["diagnostics"][-1][:2] == [2, "holding still"]
        (said,) = (line for line in node.errors if "]: holding: " in line)
        assert said.startswith("[WARN]")
        ros.service(port)
        peer.drive()
        assert peer.do("goal")
        assert trials(peer.do("result")) == in_process()

    @pytest.mark.parametrize("performed", [1, 2, 47])
    def test_the_node_is_killed_and_started_again(self, ros: Ros, performed: int) -> None:
        node = ros.node(environment__kind="executive")
        peer = ros.peer()
        peer.drive(performed)
        node.kill()
        # Its answer to what was performed last is still to be given, again and again.
        peer.ask("drive", configuration=str(CONFIGURATION), seed=SEED)
        ros.node(environment__kind="executive")
        peer.answer()
        assert peer.do("goal")
        assert trials(peer.do("result")) == in_process()

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_signal_holds_the_run(self, ros: Ros, number: signal.Signals) -> None:
        node = ros.node(environment__kind="executive")
        peer = ros.peer()
        assert peer.do("goal")
        peer.drive(25)
        assert node.interrupt(number) == 0
        result = peer.do("result")
        assert (result["code"], result["message"]) == ("PAUSED", "the node was shut down")
        ros.node(environment__kind="executive")
        peer.drive()
        assert peer.do("goal")
        assert trials(peer.do("result")) == in_process()


class TestLifecycle:
    def test_every_order(self, ros: Ros, ros2: Ros2) -> None:
        node = ros.node(autostart="false", environment__kind="executive")
        node.wait_for("ros2 lifecycle set /holdfast configure, then ros2 lifecycle set /holdfast a")
        peer = ros.peer()
        states: dict[str, dict[str, str]] = {
            "unconfigured": {"configure": "inactive"},
            "inactive": {"activate": "active", "cleanup": "unconfigured"},
            "active": {"deactivate": "inactive"},
        }
        words = [
            "configure cleanup configure activate deactivate cleanup",
            "configure activate deactivate activate deactivate activate deactivate cleanup",
            "configure configure activate activate cleanup deactivate deactivate cleanup cleanup",
            "activate deactivate cleanup",
        ]
        state = "unconfigured"
        for transition in " ".join(words).split():
            following = states[state].get(transition)
            if following is None and ros2.distribution == "jazzy":
                continue  # its rclpy does not answer what is impossible
            assert peer.do("change", transition=transition) is (following is not None)
            state = following or state
            assert peer.do("state") == state
        assert node.interrupt() == 0

    @pytest.mark.parametrize("state", ["unconfigured", "inactive", "active", "running"])
    def test_shut_down_from_every_state(self, ros: Ros, state: str) -> None:
        node = ros.node(autostart="false", environment__kind="executive")
        peer = ros.peer()
        for transition in {
            "unconfigured": [],
            "inactive": ["configure"],
            "active": ["configure", "activate"],
            "running": ["configure", "activate"],
        }[state]:
            assert peer.do("change", transition=transition)
        if state == "running":
            assert peer.do("goal")
            peer.drive(5)
        where = "active" if state == "running" else state
        assert peer.do("change", transition=f"{where}_shutdown")
        assert peer.do("state") == "finalized"
        if state == "running":
            assert peer.do("result")["message"] == "the node was shut down"
        assert node.interrupt() == 0

    def test_nothing_is_published_while_inactive(self, ros: Ros) -> None:
        node = ros.node(environment__kind="executive")
        peer = ros.peer()
        assert peer.do("set", speed=3) == [[False, "speed is no parameter of this node"]]
        (frame,) = peer.wait_seen(lambda seen: seen["frames"])["frames"]
        assert frame[:2] == ["map", "task"]
        layout = pose_layout(load(CONFIGURATION).problem)
        assert layout is not None
        assert frame[2:] == pytest.approx(layout.upright)
        peer.drive(20)
        peer.wait_seen(lambda seen: len(seen["decisions"]) >= 20)
        assert peer.do("change", transition="deactivate")
        peer.do("state")
        peer.do("seen")
        assert peer.do("decide")["code"] == "INACTIVE"
        assert peer.do("goal") is False
        node.wait_for("takes goals while it is active: ros2 lifecycle set /holdfast activate")
        # More than two periods of the diagnostics.
        threading.Event().wait(2.5)
        assert all(not values for values in peer.do("seen").values())
        assert peer.do("change", transition="activate")
        peer.drive()
        peer.wait_seen(lambda seen: bool(seen["diagnostics"] and seen["clouds"]))
        assert peer.do("goal")
        assert trials(peer.do("result")) == in_process()

    @pytest.mark.parametrize("kind", ["configuration", "executive"])
    def test_deactivated_in_the_middle_of_a_run(self, ros: Ros, kind: str) -> None:
        ros.node(environment__kind=kind, rate_hz=100.0 if kind == "configuration" else 0.0)
        peer = ros.peer()
        for count in (10, 20, 30):
            assert peer.do("goal")
            if kind == "executive":
                peer.drive(count)
            peer.wait_seen(lambda seen: len(seen["feedback"]) >= 10)
            assert peer.do("change", transition="deactivate")
            result = peer.do("result")
            assert (result["code"], result["status"]) == ("PAUSED", 6)
            assert result["message"] == "the node was deactivated"
            assert peer.do("change", transition="activate")
        assert peer.do("goal")
        if kind == "executive":
            peer.drive()
        assert trials(peer.do("result")) == in_process()

    def test_configured_again_with_other_parameters(self, ros: Ros) -> None:
        ros.node()
        peer = ros.peer()
        assert peer.do("goal")
        assert trials(peer.do("result")) == in_process()
        names = ["simulator.seed", "rate_hz", "offload.tls", "model.peg_width", "frame_id"]
        assert peer.do("get", names=names) == [SEED, 0.0, "", 1.0, "task"]
        (refused,) = peer.do("set", **{"simulator.seed": 6})
        assert refused == [
            False,
            "simulator.seed is read-only once the node is configured: clean it up first",
        ]
        for transition in ("deactivate", "cleanup"):
            assert peer.do("change", transition=transition)
        values = {"simulator.seed": 6, "run_directory": str(ros.directory / "other")}
        assert peer.do("set", **values) == [[True, ""]] * 2
        for transition in ("configure", "activate"):
            assert peer.do("change", transition=transition)
        assert peer.do("goal")
        assert trials(peer.do("result")) == in_process(seed=6)
        assert peer.do("get", names=names) == [6, 0.0, "", 1.0, "task"]


class TestParameters:
    @pytest.mark.parametrize(
        ("name", "value", "message"),
        [
            ("configuration", "''", "configuration is empty; it must name the configuration file"),
            ("configuration", "none.yaml", "none.yaml: there is no such file"),
            ("particle_filter.num_particles", "0", "num_particles, given instead of what"),
            ("particle_filter.num_particles", "2.5", "is 2.5; expected a whole number >= 1"),
            ("particle_filter.num_particle", "5", "did you mean particle_filter.num_particles?"),
            ("selector.method", "entropy", "expected one of action_covariance, action_entropy"),
            ("model.peg_widht", "1.0", "did you mean peg_width?"),
            ("rate_hz", "-1.0", "rate_hz is -1.0; expected a number >= 0 and <= 10000"),
            ("rate_hz", "fast", 'rate_hz is "fast"; expected a number >= 0'),
            ("environment.kind", "real", "expected one of configuration, executive, ros"),
            ("offload.services", "['tcp/nowhere']", "offload.services[0]: "),
            ("assignments", "['offload=1']", "assignments[0] is 'offload=1'; expected SECTION.KEY"),
            ("run_directory", "/proc/none", "/proc/none: cannot be made"),
            ("speed", "3", "speed is no parameter of this node"),
        ],
    )
    def test_a_bad_one_is_named_and_can_be_mended(
        self, ros: Ros, name: str, value: str, message: str
    ) -> None:
        parameters = {name: value}
        node = ros.node(wait=False, **parameters)
        node.wait_for("not configured: ")
        assert message in node.said()
        assert node.said().count("not configured: ") == 1
        if name in ("particle_filter.num_particles", "rate_hz"):
            peer = ros.peer()
            assert peer.do("state") == "unconfigured"
            assert peer.do("set", **{name: 100}) == [[True, ""]]
            assert peer.do("change", transition="configure")
        assert node.interrupt() == 0

    def test_what_ros_cannot_read_is_said(self, ros: Ros) -> None:
        node = ros.node(wait=False, offload__services="[tcp/127.0.0.1:7447]")
        assert node.end() == 2
        assert "holdfast: error: " in node.said()
        assert "Traceback" not in node.said()

    def test_what_no_parameter_can_hold_is_assigned(self, ros: Ros) -> None:
        node = ros.node(
            assignments="['selector.resolution=null','model.init_mean=[4, 2, 0]']",
            particle_filter__num_particles=500,
        )
        peer = ros.peer()
        assert peer.do("goal")
        assert trials(peer.do("result")) == in_process()
        assert node.interrupt() == 0

    def test_a_run_of_another_configuration_is_not_gone_on_with(self, ros: Ros) -> None:
        node = ros.node()
        peer = ros.peer()
        assert peer.do("goal")
        peer.do("result")
        assert node.interrupt() == 0
        other = ros.node(wait=False, particle_filter__num_particles=50)
        other.wait_for("not configured: ")
        assert "particle_filter.num_particles is 500 there and 50 here" in other.said()
        assert "another directory (run_directory)" in other.said()

    def test_another_process_has_the_run(self, ros: Ros) -> None:
        ros.node(environment__kind="executive")
        ros.peer().drive(3)
        other = ros.node(wait=False, environment__kind="executive")
        other.wait_for("not configured: ")
        assert "another process is using this run" in other.said()
