"""A part of a region's robots in one process, with real links: see region.py.

Takes one JSON object as its argument; then a line on standard input ends the run, and what the
robots have seen is printed as one JSON object. Times are of the system's monotonic clock, which all
processes of a machine share.
"""

from __future__ import annotations

import asyncio
import gc
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.region_robots import CLOUD, RegionRobot, Setup
from benchmarks.robots import configuration_for
from holdfast.protocol.robot_events import ServiceAppeared, ServiceVanished, TransportEvent
from holdfast.robot.session_configuration import session_configuration_of
from holdfast.runtime.descriptors import allow_descriptors
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.robot_end import StreamRobotTransport

_LEASE_MS = 30_000.0
"""A robot's default (offload.lease_ms)."""


class _Loop:
    """An event loop as the robots' time."""

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()

    @property
    def now(self) -> float:
        return self._loop.time()

    def after(self, seconds: float, do: Callable[..., None], *arguments: Any) -> None:
        self._loop.call_later(seconds, do, *arguments)


class _Linked:
    """A robot, its links, and when they came and went."""

    def __init__(self, robot: RegionRobot, endpoint: str, tls: TlsFiles | None) -> None:
        self.robot = robot
        self.appeared: list[float] = []
        self.vanished: list[float] = []
        self.events: Counter[str] = Counter()
        self.transport = StreamRobotTransport(
            {CLOUD: endpoint},
            lease_ms=_LEASE_MS,
            tls=tls,
            on_event=lambda name, **fields: self.events.update([str(fields.get("reason", name))]),
        )

    def start(self) -> None:
        self.robot.start(self.transport)
        self.transport.start(self._deliver)

    def _deliver(self, event: TransportEvent) -> None:
        if isinstance(event, ServiceAppeared):
            self.appeared.append(time.monotonic())
        elif isinstance(event, ServiceVanished):
            self.vanished.append(time.monotonic())
        self.robot.hear(event)


async def run(
    endpoint: str,
    keys: str | None,
    first: int,
    num_robots: int,
    act_s: float,
    launch_s: float,
    start_s: float,
) -> dict[str, Any]:
    """Have robots work until a line comes.

    ``start_s``: they begin one after another within this time.
    """
    allow_descriptors(64 + 40 * num_robots)
    loop = asyncio.get_running_loop()
    with tempfile.TemporaryDirectory() as directory:
        configuration = configuration_for(Path(directory), num_trials=1)
    described = session_configuration_of(configuration)
    setup = Setup(configuration.problem, configuration.planning, described)
    files = ("authority.pem", "certificate.pem", "key.pem")

    def tls_of(number: int) -> TlsFiles | None:
        own = None if keys is None else Path(keys) / f"robot-{number}"
        return None if own is None else TlsFiles(*(own / each for each in files))

    scheduler = _Loop()
    robots = [
        _Linked(
            RegionRobot(number, setup, scheduler, act_s=act_s, launch_s=launch_s),
            endpoint,
            tls_of(number),
        )
        for number in range(first, first + num_robots)
    ]
    gc.collect()
    gc.freeze()
    for number, each in enumerate(robots):
        loop.call_later(start_s * number / num_robots, each.start)
    end = asyncio.Event()
    loop.add_reader(sys.stdin, end.set)
    print("begins", flush=True)
    late_s = 0.0
    while not end.is_set():
        before = loop.time()
        await asyncio.sleep(0.01)
        late_s = max(late_s, loop.time() - before - 0.01)
    robots_seen = [
        {
            "standstills": each.robot.standstills,
            "waits_s": max(0.0, loop.time() - each.robot.waits_since()),
            "statuses": each.robot.statuses,
            "status": each.robot.status,
            "launches": each.robot.launches,
            "appeared": each.appeared,
            "vanished": each.vanished,
            "reasons": each.events,
        }
        for each in robots
    ]
    return {"robots": robots_seen, "late_s": late_s, "cpu_s": sum(os.times()[:2])}


if __name__ == "__main__":
    found = asyncio.run(run(**json.loads(sys.argv[1])))
    print(json.dumps(found), flush=True)
    os._exit(0)  # the links end with the process
