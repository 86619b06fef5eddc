"""A robot and its cloud through OpenVPN or WireGuard: the round trip, and how long outages last.

    .venv/bin/python -m benchmarks.tunnels openvpn

Robot, cloud and the internet between them are network namespaces of this machine (as root), with
the profiles of ``deploy/vpn/make-profiles``. A cable is cut and restored, or the process of one end
of the tunnel is killed and started again. The robot decides locally until the cloud answers once
more; the script prints how long that takes, from the fault and from its repair.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime as dt
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from tests.deploy.test_vpn import CLOUD, INSIDE, KINDS, PORT, End, Internet, Tunnel

HOLDFAST = (sys.executable, "-m", "holdfast")
PATIENCE_S = 120.0


class Run:
    """A service in the cloud, and a robot that asks it ten times a second."""

    def __init__(
        self, internet: Internet, host: str, directory: Path, stack: contextlib.ExitStack
    ) -> None:
        self._events = directory / "run" / "events.jsonl"
        endpoint = f"tls/{host}:{PORT}"
        subprocess.run([*HOLDFAST, "keys", directory / "keys", "--host", host], check=True)
        tls = {role: ("--tls", f"{directory}/keys/{role}") for role in ("service", "robot")}
        robot = (*internet.robot.prefix, *HOLDFAST)
        asks = ("--service", endpoint, *tls["robot"])
        configuration = directory / "robot.yaml"
        configuration.write_text(
            "problem: peg_in_hole_2d\nsimulator: {num_trials: 1000, sensing_intervals: 0}\n"
        )
        out = ("--out", f"{directory}/run", "--rate", "10")
        for command in (
            (*internet.cloud.prefix, *HOLDFAST, "serve", "--listen", endpoint, *tls["service"]),
            (*robot, "run", str(configuration), *asks, *out),
        ):
            process = stack.enter_context(
                subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            )
            stack.callback(process.kill)
        self.wait_for(0.0, "service_appeared")
        found = subprocess.run([*robot, "doctor", *asks, "--json"], stdout=subprocess.PIPE)
        for finding in map(json.loads, found.stdout.decode().splitlines()):
            if finding["layer"] == "round trip":
                print(f"  {finding['seen']}")

    def wait_for(self, since: float, event: str, **fields: str) -> float:
        """Return the time of the first such event that is later."""
        deadline = time.time() + PATIENCE_S
        while time.time() < deadline:
            lines = self._events.read_text().splitlines() if self._events.exists() else []
            for each in map(json.loads, lines):
                at = dt.datetime.fromisoformat(each["time"]).timestamp()
                if at > since and each["event"] == event and fields.items() <= each.items():
                    return at
            time.sleep(0.02)
        raise RuntimeError(f"no event {event} {fields} within {PATIENCE_S:g} s")

    def suffer(self, name: str, fault: Callable[[], None], repair: Callable[[], None]) -> None:
        """Let a fault happen, and print how long the robot did without the cloud."""
        began = time.time()
        fault()
        self.wait_for(began, "status", to="local_recovery")
        heals = time.time()
        repair()
        repaired = time.time()
        back = self.wait_for(heals, "status", to="keep_alive")
        after = f"{back - began:5.1f} s after it, {back - repaired:5.1f} s after the repair"
        print(f"  {name}: the cloud decides {after}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("kind", choices=("none", *KINDS))
    parser.add_argument("--cut-s", type=float, help="cut the cable for so long, instead of kills")
    parser.add_argument("--repetitions", type=int, default=3)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name, contextlib.ExitStack() as stack:
        internet = Internet(stack)
        directory = Path(name)
        ends: dict[str, End] = {}
        if options.kind != "none":
            tunnel = Tunnel(internet, options.kind, directory / "tunnel", stack).up()
            ends = {"the cloud's end": tunnel.cloud, "the robot's end": tunnel.robot}
        print(options.kind)
        run = Run(internet, INSIDE if ends else CLOUD, directory, stack)
        for _ in range(options.repetitions):
            if options.cut_s:
                run.suffer("the cable", cutting(internet, options.cut_s), internet.restore)
                continue
            for which, end in ends.items():
                time.sleep(3.0)
                run.suffer(which, end.kill, starting(end))


def cutting(internet: Internet, seconds: float) -> Callable[[], None]:
    """Return a fault: the cable is cut for so long."""

    def cut() -> None:
        internet.cut()
        time.sleep(seconds)

    return cut


def starting(end: End) -> Callable[[], None]:
    """Return a repair: the end's process is started, and is up."""

    def start() -> None:
        end.start()
        end.wait_until_up()

    return start


if __name__ == "__main__":
    main()
