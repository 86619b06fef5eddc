"""The bring-up package as colcon installs it: node, robot and service as its launch file has them.

Launch itself has no wheel. Its file runs with a stand-in, and the tests start what it starts.
"""

from __future__ import annotations

import json
import os
import platform
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import pytest
from tests.ports import free_port
from tests.ros.conftest import ROOT, Ros2, left_out
from tests.ros.domains import own_domain
from tests.ros.ros2_processes import Process

from holdfast.config.loader import load
from holdfast.planning.planner import Planner
from holdfast.robot.trial import run_trial

PACKAGE = "holdfast_bringup"


class BringUp:
    """What the launch file starts, process by process."""

    def __init__(self, ros2: Ros2, domain: int, directory: Path) -> None:
        prefixes = map(Path, ros2.environment["AMENT_PREFIX_PATH"].split(":"))
        self.prefixes = {prefix.name: prefix for prefix in prefixes}
        if not {PACKAGE, "holdfast_ros"} <= self.prefixes.keys():
            left_out("the packages of ros/ are older than this checkout: make test-ros builds them")
        self.prefix = self.prefixes[PACKAGE]
        self.share = self.prefix / "share" / PACKAGE
        self.configuration = self.share / "config" / "peg_in_hole_2d.yaml"
        self.directory = directory
        self._ros2 = ros2
        self._environment = {**ros2.environment, "ROS_DOMAIN_ID": str(domain)}
        self._started: list[Process] = []
        self.port = free_port()
        self.namespace = ""

    def start(self, command: list[str]) -> Process:
        process = Process(command, self._environment, cwd=self.directory)
        self._started.append(process)
        return process

    def executable(self, package: str, name: str, **more: Any) -> Process:
        command = [
            str(self.prefixes[package] / "lib" / package / name),
            "--ros-args",
            "--params-file",
            str(self.share / "config" / "holdfast.yaml"),
            "-p",
            f"configuration:={self.configuration}",
            *("-r", f"__ns:={self.namespace or '/'}"),
        ]
        for key, value in more.items():
            command += ["-p", f"{key.replace('__', '.')}:={value}"]
        return self.start(command)

    def node(self, **more: Any) -> Process:
        services = json.dumps([f"tcp/127.0.0.1:{self.port}"])
        return self.executable(
            "holdfast_ros",
            "node",
            **{
                "autostart": "true",
                "run_directory": self.directory / "run",
                "offload__services": services,
                "rate_hz": 0.0,
                **more,
            },
        )

    def robot(self, **more: Any) -> Process:
        return self.executable(PACKAGE, "simulated_robot", **more)

    def service(self) -> Process:
        holdfast = self._ros2.python.with_name("holdfast")
        listen = f"tcp/127.0.0.1:{self.port}"
        return self.start([str(holdfast), "serve", "--listen", listen, "--workers", "1"])

    def peer(self) -> Peer:
        script = Path(__file__).with_name("ros2_peer.py")
        peer = Peer(
            [str(self._ros2.python), str(script), f"{self.namespace}/holdfast"], self._environment
        )
        self._started.append(peer)
        assert json.loads(peer.next_line()) == {"ready": True}
        return peer

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


class Made(NamedTuple):
    """What a launch file has made of launch, which has no wheel: the class, and its arguments."""

    kind: str
    given: tuple[Any, ...]
    words: dict[str, Any]

    def perform(self, context: dict[str, str]) -> str:
        return context[self.given[0]]


def launched(bring_up: BringUp, monkeypatch: pytest.MonkeyPatch, **arguments: str) -> list[Made]:
    """Return what the launch file starts, with a stand-in for launch."""
    names = {
        "launch": "LaunchDescription",
        "launch.actions": "DeclareLaunchArgument ExecuteProcess OpaqueFunction",
        "launch.substitutions": "LaunchConfiguration PathJoinSubstitution",
        "launch_ros": "",
        "launch_ros.actions": "Node",
        "launch_ros.substitutions": "FindPackageShare",
    }
    for module, kinds in names.items():
        stand_in = ModuleType(module)
        for kind in kinds.split():

            def make(*given: Any, _kind: str = kind, **words: Any) -> Made:
                return Made(_kind, given, words)

            setattr(stand_in, kind, make)
        monkeypatch.setitem(sys.modules, module, stand_in)
    read = runpy.run_path(str(bring_up.share / "launch" / "holdfast.launch.py"))
    *declared, started = read["generate_launch_description"]().given[0]
    context = {each.given[0]: str(each.words["default_value"]) for each in declared}
    assert arguments.keys() <= context.keys()
    made: list[Made] = started.words["function"](context | arguments)
    return made


def test_the_launch_file_starts_what_is_installed(
    bring_up: BringUp, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, robot, service = launched(bring_up, monkeypatch, parameters="p", configuration="c")
    for each in (node, robot):
        place = bring_up.prefixes[each.words["package"]] / "lib" / each.words["package"]
        assert os.access(place / each.words["executable"], os.X_OK)
        assert each.words["parameters"][:2] == ["p", {"configuration": "c", "use_sim_time": False}]
    assert node.words["parameters"][2:] == [
        {"autostart": True},
        {"offload.services": ["tcp/127.0.0.1:7447"]},
    ]
    assert service.words["cmd"] == ["holdfast", "serve", "--listen", "tcp/127.0.0.1:7447"]


def test_the_launch_files_arguments_reach_the_nodes(
    bring_up: BringUp, monkeypatch: pytest.MonkeyPatch
) -> None:
    more = {"namespace": "left", "use_sim_time": "true", "log_level": "debug", "respawn": "true"}
    node, robot, manager, service, rviz = launched(
        bring_up,
        monkeypatch,
        listen="tcp/127.0.0.1:9",
        lifecycle_manager="true",
        rviz="true",
        **more,
    )
    for each in (node, robot, manager):
        assert each.words["namespace"] == "left"
        assert each.words["arguments"] == ["--ros-args", "--log-level", "debug"]
    assert node.words["respawn"] is True
    assert node.words["parameters"][1]["use_sim_time"] is True
    assert node.words["parameters"][2:] == [
        {"autostart": False},
        {"offload.services": ["tcp/127.0.0.1:9"]},
    ]
    assert service.words["cmd"][-1] == "tcp/127.0.0.1:9"
    (managed,) = manager.words["parameters"]
    assert (managed["node_names"], managed["autostart"]) == (["holdfast"], True)
    assert managed["bond_timeout"] == 4.0
    files = [each.given[0][1:] for each in rviz.words["arguments"][1:]]
    assert all(bring_up.share.joinpath(*parts).is_file() for parts in files)
    elsewhere = launched(bring_up, monkeypatch, service="false", robot="false")
    assert [each.words["parameters"][2:] for each in elsewhere] == [[{"autostart": True}]]


def test_the_example_decides_as_in_one_process_in_a_namespace_too(bring_up: BringUp) -> None:
    bring_up.namespace = "/left"
    bring_up.service()
    bring_up.robot()
    bring_up.node()
    peer = bring_up.peer()
    assert peer.do("goal")
    result = peer.do("result")
    assert result["code"] == "FINISHED", result["message"]
    assert result["trials"] == in_process(bring_up.configuration)
    assert peer.do("get", names=["rate_hz", "environment.kind"]) == [0.0, "ros"]
    diagnostics = peer.do("seen")["diagnostics"]
    assert {name for *_, name, _ in diagnostics} == {"left/holdfast: active sensing"}
    assert {hardware for *_, hardware in diagnostics} == {platform.node()}


def test_colcon_tests_the_package(bring_up: BringUp) -> None:
    """What a user's workspace would run, over what was built."""
    command = ["colcon", "--log-base", "log", "test", "--packages-select", "holdfast_ros"]
    places = [
        *("--base-paths", str(ROOT / "ros"), "--build-base", "build"),
        *("--install-base", str(bring_up.prefixes["holdfast_ros"].parent)),
    ]
    process = bring_up.start([*command, *places, "--return-code-on-test-failure"])
    assert process.wait() == 0
    (report,) = (bring_up.directory / "build" / "holdfast_ros").glob("pytest.xml")
    assert 'tests="5"' in report.read_text()
