"""How soon a robot in ROS 1 knows that its service is lost, and who decides then: rospy and ours.

A robot asks the cloud for a sensing action and, if that fails, the recovery service. Three ways of
rospy's: wait for the service for 5 s and then call it, as the first implementation did; call it at
once; call it over a persistent connection. The fourth is ours. Then the cloud is killed (-9) or
stopped (SIGSTOP), or the master is killed while the cloud lives, and the robot asks again.

    tests/ros/set_up_ros1 .ros1
    .venv/bin/python -m benchmarks.ros1_failover

Times are from that question on, medians; in brackets the longest. Who decides nothing within the
limit stands still. "Back" is the time until the cloud decides again once it, or the master, is
there again.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

from tests.ros.conftest import ROOT
from tests.ros.ros1_processes import SYSTEM_PYTHON, Ros1, wait_for

CONFIGURATION = ROOT / "examples" / "peg_in_hole_2d.yaml"
CLOUD, RECOVERY = "cloud_active_sensing", "cloud_active_sensing_recovery"
DEADLINE_S = 0.5
NUM_CALLS = 100

ROSPY = """
import json, sys, time
import rospy
from holdfast_interfaces.srv import ActiveSensing, ActiveSensingRequest

way = sys.argv[1]
rospy.init_node("robot", anonymous=True, disable_rosout=True)
names = ["cloud_active_sensing", "cloud_active_sensing_recovery"]
ask = {n: rospy.ServiceProxy(n, ActiveSensing, persistent=way == "persistent") for n in names}
known = None

def decide(request):
    global known
    began = time.perf_counter()
    known = None
    for name in names:
        try:
            if way == "wait":
                rospy.wait_for_service(name, 5.0)
            ask[name](request)
        except (rospy.ROSException, rospy.ServiceException):
            known = known or time.perf_counter() - began
        else:
            return time.perf_counter() - began, name
    return None, ""

for name in names:
    rospy.wait_for_service(name, 10.0)
    state = ask[name](ActiveSensingRequest(kind=0, seed=4)).state
request = ActiveSensingRequest(kind=1, state=state)
for line in sys.stdin:
    took, by = decide(request)
    print(json.dumps([known, took, by]), flush=True)
"""

OURS = """
import json, sys, time
from holdfast_ros.active_sensing import DecisionRequest, RequestKind
from holdfast_ros.ros1_client import Ros1Client

began, known = 0.0, None

def on_event(name, **fields):
    global known
    if fields.get("status") == "local_recovery" and known is None:
        known = time.perf_counter() - began

with Ros1Client("robot", deadline_s=float(sys.argv[1]), on_event=on_event) as client:
    state = client.decide(DecisionRequest(RequestKind.INITIALIZE, seed=4)).state
    request = DecisionRequest(RequestKind.CHOOSE_SENSING_ACTION, state=state)
    for line in sys.stdin:
        began, known = time.perf_counter(), None
        client.decide(request)
        took = time.perf_counter() - began
        print(json.dumps([known, took, client.decided_by.strip("/")]), flush=True)
"""

WAYS = {
    "wait": "rospy: wait_for_service(5), call",
    "call": "rospy: call",
    "persistent": "rospy: persistent call",
    "ours": f"ours, deadline {DEADLINE_S:g} s",
}
WHO = {CLOUD: "the cloud", RECOVERY: "recovery", "": "nobody"}
FAULTS = {"killed": "cloud killed -9", "stopped": "cloud stopped", "master": "master killed -9"}


class Seen(NamedTuple):
    """What a robot did about a fault; infinite where it did nothing in time."""

    known_s: float
    decided_s: float
    by: str
    back_s: float = math.nan


class Robot:
    def __init__(self, around: Ros1, way: str, limit_s: float) -> None:
        self._limit_s = limit_s
        command = (
            [sys.executable, "-c", OURS, str(DEADLINE_S)]
            if way == "ours"
            else [SYSTEM_PYTHON, "-c", ROSPY, way]
        )
        self.process = around.start(
            *command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def ask(self) -> Seen:
        process = self.process
        assert process.stdin is not None and process.stdout is not None
        timer = threading.Timer(self._limit_s, process.kill)
        timer.start()
        process.stdin.write("\n")
        process.stdin.flush()
        line = process.stdout.readline()
        timer.cancel()
        if not line:
            process.wait()
            return Seen(math.inf, math.inf, "")
        known, decided, by = json.loads(line)
        return Seen(
            math.inf if known is None else known, math.inf if decided is None else decided, by
        )

    def back_s(self, limit_s: float) -> float:
        """Return how long it takes until the cloud, which is back, decides again."""
        began = time.monotonic()
        while self.process.poll() is None and time.monotonic() < began + limit_s:
            if self.ask().by == CLOUD:
                return time.monotonic() - began
            time.sleep(0.02)
        return math.inf

    def close(self) -> None:
        with contextlib.suppress(ProcessLookupError):
            self.process.kill()
        self.process.communicate()


class Scene:
    """A master, the cloud and the recovery service."""

    def __init__(self, directory: Path) -> None:
        environment = {
            **os.environ,
            "ROS_VERSION": "1",
            "ROS_PACKAGE_PATH": f"{ROOT / 'ros'}:/usr/share",
            "ROS_HOSTNAME": "127.0.0.1",
        }
        self.ros = Ros1(environment, directory)
        self.ros.start_master()
        self.cloud = self.ros.serve(CLOUD, CONFIGURATION)
        self.ros.serve(RECOVERY, CONFIGURATION)

    def measure(self, way: str, fault: str, limit_s: float) -> tuple[float, Seen]:
        """Return the median time of a call before a fault, and what was done after it."""
        robot = Robot(self.ros, way, limit_s)
        calls = [robot.ask().decided_s for _ in range(NUM_CALLS)]
        self._strike(fault)
        seen = robot.ask()
        self._mend(fault)
        if seen.by != CLOUD:
            seen = seen._replace(back_s=robot.back_s(limit_s))
        robot.close()
        return statistics.median(calls), seen

    def _strike(self, fault: str) -> None:
        if fault == "stopped":
            self.cloud.send_signal(signal.SIGSTOP)
            return
        victim = self.cloud if fault == "killed" else self.ros.master
        assert victim is not None
        victim.kill()
        victim.wait()

    def _mend(self, fault: str) -> None:
        if fault == "stopped":
            self.cloud.send_signal(signal.SIGCONT)
        elif fault == "killed":
            self.cloud = self.ros.serve(CLOUD, CONFIGURATION)
        else:
            self.ros.start_master()
            wait_for(lambda: self.ros.service_uri(CLOUD), CLOUD)
            wait_for(lambda: self.ros.service_uri(RECOVERY), RECOVERY)


def written(times: list[float], limit_s: float) -> str:
    """Write a median and the longest."""
    middle, longest = statistics.median(times), max(times)
    if math.isinf(middle):
        return f"not in {limit_s:g} s"
    return f"{middle:.3f} s ({longest:.3f})"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repetitions", type=int, default=10)
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--limit-s", type=float, default=12.0)
    parser.add_argument("--json", type=Path, help="every single time")
    options = parser.parse_args()
    results: dict[str, Any] = {}
    rows = []
    with tempfile.TemporaryDirectory() as directory, contextlib.ExitStack() as stack:
        scene = Scene(Path(directory))
        stack.callback(scene.ros.close)
        for fault in options.faults:
            words = FAULTS[fault]
            for way, its_words in WAYS.items():
                each = [
                    scene.measure(way, fault, options.limit_s) for _ in range(options.repetitions)
                ]
                results[f"{fault} {way}"] = each
                call_ms = 1e3 * statistics.median(call for call, _ in each)
                seen = [seen for _, seen in each]
                by = {WHO[one.by] for one in seen}
                known = written([one.known_s for one in seen], options.limit_s)
                if by == {"the cloud"}:
                    known = "not lost"
                decided = written([one.decided_s for one in seen], options.limit_s)
                back = "-"
                if by != {"the cloud"}:
                    back = written([one.back_s for one in seen], options.limit_s)
                    if not seen[0].by and fault == "stopped":
                        back = "hangs"
                rows.append(
                    f"| {words} | {its_words} | {known} | {decided} | {' or '.join(sorted(by))} "
                    f"| {back} | {call_ms:.2f} ms |"
                )
                print(rows[-1], file=sys.stderr, flush=True)
    print("| fault | robot | knows it after | next decision after | by | back after | a call |")
    print("|---|---|---|---|---|---|---|")
    print("\n".join(rows))
    if options.json:
        options.json.write_text(json.dumps(results))


if __name__ == "__main__":
    main()
