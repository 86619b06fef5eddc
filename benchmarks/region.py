"""A region dies and comes back: two thousand robots with real links; and what each robot costs."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import Context
from benchmarks.processes import ServiceProcess, usage_of
from benchmarks.report import Bar, Result, Table, paragraph
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.key_ring import make_credentials
from holdfast.transport.tls import TlsStream, client_context, server_context

__all__ = ["costs", "region"]

# What was asked for: nobody stands still for longer than a launch, and all are in again within
# three times what their handshakes take, computed one after another on all cores.
LAUNCH_S = 0.15
IN_BAR = 3.0
WAIT_BAR_MS = 200.0

_CLIENTS = 4
_PROCESSES = 2
_LEASE_MS = "2000"
_CLIENT = Path(__file__).with_name("region_client.py")
_LOAD = Path(__file__).with_name("load.py")


class _Robots:
    """A process with some of the robots; yields to the services where both want the processor."""

    def __init__(self, request: dict[str, Any], niceness: int) -> None:
        self.process = subprocess.Popen(
            ["nice", "-n", str(niceness), sys.executable, str(_CLIENT), json.dumps(request)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def wait_begun(self) -> None:
        assert self.process.stdout is not None
        if self.process.stdout.readline() != "begins\n":
            raise RuntimeError("a process of robots did not begin")

    def end(self) -> dict[str, Any]:
        """Return what its robots have seen."""
        output, _ = self.process.communicate("\n")
        found: dict[str, Any] = json.loads(output)
        return found

    def kill(self) -> None:
        self.process.kill()
        self.process.communicate()


def _credentials(directory: Path, robots: int) -> None:
    """Make credentials of a service, and of each robot."""
    make_credentials(directory, services=["service"])
    for first in range(0, robots, 500):
        names = [f"robot-{number}" for number in range(first, min(robots, first + 500))]
        make_credentials(directory, robots=names)


def _served(keys: Path) -> ServiceProcess:
    options = ("--tls", str(keys / "service"), "--lease-ms", _LEASE_MS, "--max-sessions", "4000")
    return ServiceProcess(*options, "--processes", str(_PROCESSES), protocol="tls")


def region(context: Context) -> Result:
    """Kill all services of many robots, and start them again."""
    robots, down_s, after_s = (400, 5.0, 8.0) if context.quick else (2000, 20.0, 14.0)
    watchers = 8
    act_s = 1.0
    clients: list[_Robots] = []
    with tempfile.TemporaryDirectory() as name:
        keys = Path(name)
        _credentials(keys, robots + watchers)
        server_s, client_s = handshake_s(keys)
        context.progress(0.2)
        service = _served(keys)
        with service:
            common = {"endpoint": service.endpoint, "keys": str(keys), "launch_s": LAUNCH_S}
            share = robots // _CLIENTS
            for number in range(_CLIENTS):
                request = {"first": number * share, "num_robots": share, "act_s": act_s}
                clients.append(_Robots(common | request | {"start_s": 6.0}, 8))
            request = {"first": robots, "num_robots": watchers, "act_s": 0.1}
            clients.append(_Robots(common | request | {"start_s": 1.0}, 0))
            try:
                for client in clients:
                    client.wait_begun()
                time.sleep(6.0 + 9.0 * act_s)
                killed_at = time.monotonic()
                for process_id in reversed(service.process_ids):
                    os.kill(process_id, signal.SIGKILL)
                service.close()
                time.sleep(down_s)
                context.progress(0.6)
                service.start()
                service.wait_ready()
                back_at = time.monotonic()
                time.sleep(after_s)
                cpu_s = sum(usage_of(each).cpu_s for each in service.process_ids)
                found = [client.end() for client in clients]
            finally:
                for client in clients:
                    client.kill()
    context.progress(1.0)
    everybody = [robot for client in found[:-1] for robot in client["robots"]]
    watched = found[-1]["robots"]
    still = [_standstill(robot, killed_at) for robot in everybody + watched]
    came = [max(robot["appeared"], default=np.inf) - back_at for robot in everybody]
    busiest = max(np.histogram(came, bins=np.arange(0.0, after_s + 1.0))[0])
    lost = sum(each >= back_at for robot in everybody for each in robot["vanished"])
    trips = [
        trip
        for robot in watched
        for at, _, by, trip in robot["standstills"]
        if by == "cloud" and at - trip > max(back_at, min(robot["appeared"]))
    ]
    in_turn_s = robots * (server_s + client_s) / len(os.sched_getaffinity(0))
    rows = [
        ["longest standstill, s", f"{max(still):.3f}"],
        ["99 % of the standstills, s", f"{np.percentile(still, 99):.3f}"],
        ["all are in again after, s", f"{max(came):.1f}"],
        ["half of them after, s", f"{np.median(came):.1f}"],
        ["links in the busiest second", f"{busiest}"],
        ["links lost again", f"{lost}"],
        ["longest wait for an answer, of those in, s", f"{max(trips, default=np.nan):.3f}"],
        ["99 % of them, s", f"{np.percentile(trips, 99):.3f}" if trips else ""],
        ["processor time of the services since, s", f"{cpu_s:.1f}"],
        ["a handshake, the service's part, ms", f"{1e3 * server_s:.2f}"],
        ["the robot's part, ms", f"{1e3 * client_s:.2f}"],
        ["longest stall of the robots' own processes, s", f"{max(e['late_s'] for e in found):.2f}"],
    ]
    return Result(
        [
            paragraph(
                f"""{robots:,} robots with mutual TLS, each with its own certificate, and
                {_PROCESSES} processes of a service on the same
                {len(os.sched_getaffinity(0))} cores: the robots' part of all handshakes and of all
                attempts to connect is computed here, too. All processes are killed, and
                {down_s:g} s later there are new ones. Meanwhile local services decide, which are
                simulated: one is there {LAUNCH_S:g} s after its launch. {watchers} of the robots
                ask 1.1 times a second, the others 0.11 times. Times are from the new processes'
                ready line."""
            ),
            Table(("", ""), rows),
        ],
        [
            Bar(
                f"{robots:,} robots lose all services: longest standstill",
                1e3 * max(still),
                1e3 * LAUNCH_S,
                "ms",
            ),
            Bar(
                "all are in again, in their handshakes one after another",
                max(came) / in_turn_s,
                IN_BAR,
                "times",
            ),
            Bar(
                "meanwhile, longest wait of those that are in",
                1e3 * max(trips, default=np.nan),
                WAIT_BAR_MS,
                "ms",
            ),
        ],
    )


def _standstill(robot: dict[str, Any], since: float) -> float:
    waits = [float(waited) for at, waited, *_ in robot["standstills"] if at >= since]
    return max([float(robot["waits_s"]), *waits])


def handshake_s(keys: Path, number: int = 200) -> tuple[float, float]:
    """Return the processor time of a handshake: of the service's part, and of the robot's."""
    files = ("authority.pem", "certificate.pem", "key.pem")
    server = server_context(TlsFiles(*(keys / "service" / each for each in files)), "measured")
    client = client_context(TlsFiles(*(keys / "robot-0" / each for each in files)))
    server_s, client_s = [], []
    for _ in range(number):
        began = time.thread_time()
        robot = TlsStream(client, "127.0.0.1")
        robot.begin()
        hello = robot.take()
        at_robot = time.thread_time() - began
        began = time.thread_time()
        service = TlsStream(server)
        service.receive(hello)
        said = service.take()
        at_service = time.thread_time() - began
        began = time.thread_time()
        robot.receive(said)
        said = robot.take()
        client_s.append(at_robot + time.thread_time() - began)
        began = time.thread_time()
        service.receive(said)
        service.peer()
        server_s.append(at_service + time.thread_time() - began)
    return float(np.median(server_s)), float(np.median(client_s))


# -- what a robot costs ------------------------------------------------------------------------


def costs(context: Context) -> Result:
    """Measure what docs/scale.md reckons with."""
    robots, seconds = (100, 4.0) if context.quick else (1000, 10.0)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        keys = Path(name)
        _credentials(keys, robots)
        server_s, client_s = handshake_s(keys)
        rows.append(["handshake, the service's part, ms of a core", f"{1e3 * server_s:.2f}"])
        rows.append(["handshake, the robot's part, ms of a core", f"{1e3 * client_s:.2f}"])
        for lease_ms in ("400", "2000"):
            options = ("--tls", str(keys / "service"), "--lease-ms", lease_ms)
            with ServiceProcess(*options, protocol="tls") as service:
                before = usage_of(service.process.pid)
                request = {
                    "endpoint": service.endpoint,
                    "keys": str(keys),
                    "first": 0,
                    "num_robots": robots,
                    "act_s": 1000.0,
                    "launch_s": LAUNCH_S,
                    "start_s": 5.0,
                }
                client = _Robots(request, 8)
                try:
                    client.wait_begun()
                    time.sleep(10.0 if context.quick else 15.0)
                    linked = usage_of(service.process.pid)
                    time.sleep(seconds)
                    after = usage_of(service.process.pid)
                    client.end()
                finally:
                    client.kill()
            idle = (after.cpu_s - linked.cpu_s) / seconds / robots
            came = (linked.cpu_s - before.cpu_s) / robots
            size = (after.resident_bytes - before.resident_bytes) / robots
            rows += [
                [f"a silent link, lease {lease_ms} ms: ms of a core a second", f"{1e3 * idle:.3f}"],
                [f"to come in and ask once, lease {lease_ms} ms: ms", f"{1e3 * came:.2f}"],
                [f"its memory with its session, lease {lease_ms} ms: kB", f"{1e-3 * size:.0f}"],
            ]
            context.progress(0.5 if lease_ms == "400" else 0.8)
    rows += _turns(seconds)
    context.progress(1.0)
    return Result(
        [
            paragraph(
                f"""What a robot takes of one process of a service: {robots:,} robots over mutual
                TLS that ask nothing after their first question, then 100 over tcp that ask 1.11
                turns a second (9 task actions and a sensing action, 100 particles). docs/scale.md
                reckons with these."""
            ),
            Table(("", ""), rows),
        ]
    )


def _turns(seconds: float) -> Sequence[list[str]]:
    with ServiceProcess() as service:
        request = {
            "endpoint": service.endpoint,
            "process_ids": service.process_ids,
            "num_robots": 100,
            "num_links": 100,
            "rate_hz": 10.0 / 9.0,
            "sensing_interval": 8,
            "warm_up_s": 3.0,
            "seconds": seconds,
        }
        done = subprocess.run(
            [sys.executable, str(_LOAD), json.dumps(request)],
            check=True,
            capture_output=True,
            text=True,
        )
    found = json.loads(done.stdout)
    rate = found["complete"] / found["wall_s"]
    return [["a turn, ms of a core", f"{1e3 * found['service_cores'] / rate:.2f}"]]
