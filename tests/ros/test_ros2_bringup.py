"""The bring-up package as colcon installs it: node, robot and service as its launch file has them.

Launch itself has no wheel. Its file runs with a stand-in, and the tests start what it starts.
"""

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
from tests.ros.test_ros2_node import Ros, in_process

PACKAGE = "holdfast_bringup"


class BringUp(Ros):
    """What the launch file starts, process by process."""

    def __init__(self, ros2: Ros2, domain: int, directory: Path) -> None:
        super().__init__(ros2, domain, directory)
        prefixes = map(Path, ros2.environment["AMENT_PREFIX_PATH"].split(":"))
        self.prefixes = {prefix.name: prefix for prefix in prefixes}
        if not {PACKAGE, "holdfast_ros"} <= self.prefixes.keys():
            left_out("the packages of ros/ are older than this checkout: make test-ros builds them")
        self.share = self.prefixes[PACKAGE] / "share" / PACKAGE

    def executable(self, package: str, name: str, *words: str) -> None:
        """Start it in the namespace /left, with the parameters of the package."""
        configuration = f"configuration:={self.share / 'config' / 'peg_in_hole_2d.yaml'}"
        common = ("-r", "__ns:=/left", "-p", configuration)
        parameters = str(self.share / "config" / "holdfast.yaml")
        program = str(self.prefixes[package] / "lib" / package / name)
        self.start(program, "--ros-args", "--params-file", parameters, *common, *words)


@pytest.fixture
def bring_up(ros2: Ros2, tmp_path: Path) -> Iterator[BringUp]:
    with own_domain() as domain:
        made = BringUp(ros2, domain, tmp_path)
        yield made
        made.close()


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
    port = free_port()
    bring_up.service(port)
    bring_up.executable(PACKAGE, "simulated_robot")
    given = ("autostart:=true", "rate_hz:=0.0", f"offload.services:=['tcp/127.0.0.1:{port}']")
    words = [word for each in (*given, "run_directory:=run") for word in ("-p", each)]
    bring_up.executable("holdfast_ros", "node", *words)
    peer = bring_up.peer("/left/holdfast")
    assert peer.do("goal")
    result = peer.do("result")
    assert result["code"] == "FINISHED", result["message"]
    assert result["trials"] == in_process(1, 0)
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
    process = bring_up.start(*command, *places, "--return-code-on-test-failure")
    assert process.end() == 0, process.said()
    (report,) = (bring_up.directory / "build" / "holdfast_ros").glob("pytest.xml")
    assert 'tests="5"' in report.read_text()
