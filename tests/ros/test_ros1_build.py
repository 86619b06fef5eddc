"""catkin builds our interfaces, and a node in roscpp that is built on them calls our service."""

import os
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from tests.ros.conftest import ROOT, left_out
from tests.ros.ros1_processes import Ros1, ros1_in

from holdfast_ros.active_sensing import DecisionRequest, RequestKind
from holdfast_ros.loop_thread import LoopThread
from holdfast_ros.ros1_client import Ros1Service
from holdfast_ros.ros1_environment import RosEnvironment

EXAMPLE = ROOT / "examples" / "peg_in_hole_2d.yaml"
CLOUD = "cloud_active_sensing"

STOCK = """
#include <cstdio>
#include <ros/ros.h>
#include <holdfast_interfaces/ActiveSensing.h>

using holdfast_interfaces::ActiveSensingRequest;

int main(int argc, char** argv) {
  ros::init(argc, argv, "stock_in_cpp");
  ros::NodeHandle node;
  auto ask = node.serviceClient<holdfast_interfaces::ActiveSensing>(argv[1], argc > 2);
  holdfast_interfaces::ActiveSensing call;
  if (!ask.waitForExistence(ros::Duration(10))) return 2;
  call.request.kind = ActiveSensingRequest::INITIALIZE;
  call.request.seed = 4;
  if (!ask.call(call)) return 3;
  call.request.kind = ActiveSensingRequest::CHOOSE_SENSING_ACTION;
  call.request.state = call.response.state;
  if (!ask.call(call)) return 4;
  std::printf("%u %s %u\\n", call.response.error, call.response.configuration.c_str(),
              call.response.sensing_action);
}
"""


@pytest.fixture
def around(ros1: Mapping[str, str], tmp_path: Path) -> Iterator[Ros1]:
    yield from ros1_in(ros1, tmp_path)


def done(*command: str, environment: Mapping[str, str], directory: Path) -> None:
    made = subprocess.run(
        command,
        env={**environment, "PWD": str(directory)},  # catkin goes by that
        cwd=directory,
        capture_output=True,
        text=True,
        timeout=300.0,
    )
    assert made.returncode == 0, f"{command}: {made.stdout}{made.stderr}"


def test_catkin_builds_it_and_roscpp_calls_it(around: Ros1, tmp_path: Path) -> None:
    if not Path("/usr/include/ros/ros.h").exists() or shutil.which("catkin_make") is None:
        left_out("no roscpp: apt-get install catkin ros-message-generation libroscpp-dev")
    page = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8").splitlines()
    (typed,) = (line for line in page if line.startswith("mkdir -p ~/catkin/src"))
    # As the page has it, with the environment active that it made.
    plain = {**os.environ, "PATH": os.defpath}
    ours = {**plain, "PATH": f"{Path(sys.executable).parent}:{os.defpath}", "HOME": str(tmp_path)}
    done("bash", "-c", typed, environment=ours, directory=ROOT)
    (tmp_path / "stock.cpp").write_text(STOCK)
    libraries = ("roscpp", "rosconsole", "roscpp_serialization", "rostime", "cpp_common")
    done(
        *("g++", "-std=c++17", "-I", "catkin/devel/include", "stock.cpp"),
        *("-o", "stock", *(f"-l{name}" for name in libraries)),
        environment=plain,
        directory=tmp_path,
    )
    around.serve(CLOUD, EXAMPLE)
    thread = LoopThread("test")
    service = Ros1Service(CLOUD, RosEnvironment.of(around.environment), "robot")
    begin = DecisionRequest(RequestKind.INITIALIZE, seed=4)
    state = thread.run(service.ask(begin, 30.0)).state
    choose = DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=state)
    answer = thread.run(service.ask(choose, 30.0))
    thread.call(service.disconnect)
    thread.close(30.0)
    for way in ((), ("persistent",)):
        said = around.run(str(tmp_path / "stock"), CLOUD, *way).split()
        assert said == ["0", answer.configuration, str(answer.sensing_action)]
