"""The bring-up package as colcon installs it: node, robot and service as its launch file has them.

Launch itself is not here: its file is read, and what it starts is started by the test.
"""

from __future__ import annotations

import ast
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.ports import free_port
from tests.ros.conftest import Ros2, left_out
from tests.ros.domains import own_domain
from tests.ros.ros2_processes import WAIT_S, Process

from holdfast.config.loader import load
from holdfast.planning.planner import Planner
from holdfast.robot.trial import run_trial

PACKAGE = "holdfast_bringup"


class BringUp:
    """What the launch file starts, process by process."""

    def __init__(self, ros2: Ros2, domain: int, directory: Path) -> None:
        prefixes = ros2.environment["AMENT_PREFIX_PATH"].split(":")
        found = [Path(prefix) for prefix in prefixes if prefix.endswith(PACKAGE)]
        if not found:
            left_out("the packages of ros/ are older than this checkout: make test-ros builds them")
        self.prefix = found[0]
        self.share = self.prefix / "share" / PACKAGE
        self.configuration = self.share / "config" / "peg_in_hole_2d.yaml"
        self.directory = directory
        self._ros2 = ros2
        self._environment = {**ros2.environment, "ROS_DOMAIN_ID": str(domain)}
        self._started: list[Process] = []
        self.port = free_port()

    def start(self, command: list[str]) -> Process:
        process = Process(command, self._environment, cwd=self.directory)
        self._started.append(process)
        return process

    def executable(self, name: str, **more: Any) -> Process:
        command = [
            str(self.prefix / "lib" / PACKAGE / name),
            "--ros-args",
            "--params-file",
            str(self.share / "config" / "holdfast.yaml"),
            "-p",
            f"configuration:={self.configuration}",
        ]
        for key, value in more.items():
            command += ["-p", f"{key.replace('__', '.')}:={value}"]
        return self.start(command)

    def node(self, **more: Any) -> Process:
        services = json.dumps([f"tcp/127.0.0.1:{self.port}"])
        return self.executable(
            "holdfast_node",
            **{
                "autostart": "true",
                "run_directory": self.directory / "run",
                "offload__services": services,
                "rate_hz": 0.0,
                **more,
            },
        )

    def robot(self, **more: Any) -> Process:
        return self.executable("simulated_robot", log=self.directory / "performed.json", **more)

    def service(self) -> Process:
        holdfast = self._ros2.python.with_name("holdfast")
        listen = f"tcp/127.0.0.1:{self.port}"
        return self.start([str(holdfast), "serve", "--listen", listen, "--workers", "1"])

    def peer(self) -> Peer:
        script = Path(__file__).with_name("ros2_peer.py")
        peer = Peer([str(self._ros2.python), str(script), "/holdfast"], self._environment)
        self._started.append(peer)
        assert json.loads(peer.next_line()) == {"ready": True}
        return peer

    def num_performed(self) -> int:
        log = self.directory / "performed.json"
        return len(json.loads(log.read_text())["performed"]) if log.exists() else 0

    def wait_until_performed(self, number: int) -> None:
        deadline = time.monotonic() + WAIT_S
        while self.num_performed() < number:
            assert time.monotonic() < deadline, f"{self.num_performed()} task actions"
            time.sleep(0.02)

    def kill(self) -> None:
        for process in self._started:
            process.kill()


class Peer(Process):
    """A client of the node; see ros2_peer.py."""

    def do(self, what: str, **arguments: Any) -> Any:
        self.send(json.dumps({"do": what, **arguments}))
        answer = json.loads(self.next_line())
        assert "error" not in answer, answer["error"]
        return answer["answer"]

    def wait_until_active(self) -> None:
        deadline = time.monotonic() + WAIT_S
        while self.do("state") != "active":
            assert time.monotonic() < deadline
            time.sleep(0.1)


@pytest.fixture
def bring_up(ros2: Ros2, tmp_path: Path) -> Iterator[BringUp]:
    with own_domain() as domain:
        made = BringUp(ros2, domain, tmp_path)
        yield made
        made.kill()


def in_process(configuration: Path) -> list[list[Any]]:
    """Return what the trial comes to without ROS."""
    read = load(configuration)
    result = run_trial(
        Planner(read.problem, read.planning),
        read.simulator.seed,
        0,
        max_steps=read.simulator.max_steps,
    )
    return [[result.trial, result.outcome, result.steps, result.digest]]


def test_the_launch_file_names_what_is_installed(bring_up: BringUp) -> None:
    path = bring_up.share / "launch" / "holdfast.launch.py"
    tree = ast.parse(path.read_text())
    compile(tree, str(path), "exec")
    nodes: list[dict[str, str]] = [
        {
            str(word.arg): str(word.value.value)
            for word in call.keywords
            if isinstance(word.value, ast.Constant)
        }
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "Node"
    ]
    ours = {node["executable"] for node in nodes if "package" not in node}
    assert ours == {"holdfast_node", "simulated_robot"}
    for name in ours:
        assert os.access(bring_up.prefix / "lib" / PACKAGE / name, os.X_OK)
    files = [
        [part.value for part in call.args if isinstance(part, ast.Constant)]
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == "share"
    ]
    assert len(files) == 3
    for parts in files:
        assert bring_up.share.joinpath(*map(str, parts)).is_file()


class TestTheExample:
    def test_it_decides_as_in_one_process(self, bring_up: BringUp) -> None:
        bring_up.service()
        bring_up.robot()
        bring_up.node()
        peer = bring_up.peer()
        assert peer.do("goal")
        result = peer.do("result")
        assert result["code"] == "FINISHED", result["message"]
        assert result["trials"] == in_process(bring_up.configuration)

    def test_killed_in_the_middle_of_a_task_action_it_goes_on(self, bring_up: BringUp) -> None:
        bring_up.robot(motion_s=0.1)
        node = bring_up.node()
        peer = bring_up.peer()
        assert peer.do("goal")
        # Nearly all of its time the robot moves. It finishes its motion, and says so when asked.
        bring_up.wait_until_performed(3)
        time.sleep(0.05)
        node.kill()
        bring_up.node()
        peer.wait_until_active()
        assert peer.do("goal")
        # The robot refuses a step that is not due; twice or not at all would be seen.
        assert peer.do("result")["trials"] == in_process(bring_up.configuration)

    def test_deactivated_in_the_middle_of_a_task_action_it_goes_on(self, bring_up: BringUp) -> None:
        bring_up.robot(motion_s=0.1)
        bring_up.node()
        peer = bring_up.peer()
        assert peer.do("goal")
        bring_up.wait_until_performed(3)
        time.sleep(0.05)
        assert peer.do("change", transition="deactivate")
        assert peer.do("result")["code"] == "PAUSED"
        assert peer.do("change", transition="activate")
        assert peer.do("goal")
        assert peer.do("result")["trials"] == in_process(bring_up.configuration)
