"""A ROS 1 master is killed -9 again and again: how soon is everything there again?

``python benchmarks/ros1_master.py`` starts a guard (``holdfast ros1-guard``) and nodes of others:
stock rospy ones (a publisher, a subscriber, services, a client that calls over one connection all
the time) and stock roscpp ones (``relay``, ``mux``, ``/rosout``). Then the master is killed, and
each time it is measured from outside, in ms from the kill on:

- noticed: the guard says that the master is gone;
- back: a call to the master is answered;
- listed: services, topics, nodes and parameters are all as before, names and addresses;
- command: ``rosservice list``, started at the kill, has printed every service, and ended.

Calls over the standing connection, and messages, go on meanwhile: ``calls`` and ``messages`` count
those from the kill to the next one; ``longest_pause_ms`` is the longest time without an answer to
the client until everything was listed.

``--by stock`` has a stock master instead that the guard has found (``rosmaster``), which is killed
once a guard: the first master is then of others, and only that kill is measured.

ros1_master.csv holds 40 kills of the first kind and 10 of the second, on two cores that others were
using as well (load 3 to 4).
"""

from __future__ import annotations

import argparse
import csv
import datetime as dt
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import itertools

from tests.ros.graph import Graph, Process, unchanged
from tests.ros.ros1_processes import wait_for

TOPIC_TOOLS = Path("/usr/lib/topic_tools")
COLUMNS = (
    *("kill", "master", "services", "nodes", "noticed_ms", "back_ms", "listed_ms", "command_ms"),
    *("calls", "messages", "longest_pause_ms"),
)


class Arrivals:
    """Notes when a process printed something."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self._seen: list[tuple[float, int]] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        while not self._end.wait(0.002):
            now, size = time.monotonic(), self._process.size
            if not self._seen or size > self._seen[-1][1]:
                self._seen.append((now, size))

    def close(self) -> None:
        self._end.set()
        self._thread.join()

    def longest_pause_s(self, begin: float, end: float) -> float:
        times = [begin, *(now for now, _ in self._seen if begin < now < end), end]
        return max(after - before for before, after in itertools.pairwise(times))


def start_nodes(graph: Graph, services: int) -> tuple[Process, Process]:
    """Start nodes of others; return the client and the subscriber."""
    graph.node("talker", "/talker", "/chatter")
    names = [f"/work_{number}" for number in range(services)]
    server = graph.node("server", "/server", "/work", *names)
    graph.start(str(TOPIC_TOOLS / "relay"), "/chatter", "/relayed", "__name:=relay")
    graph.start(str(TOPIC_TOOLS / "mux"), "/muxed", "/chatter", "/relayed", "__name:=mux")
    listener = graph.node("listener", "/listener", "/relayed")
    caller = graph.node("caller", "/caller", "/work")
    for process in (server, listener, caller):
        wait_for(lambda process=process: process.lines, process.account)  # type: ignore[misc]
    for node in ("/mux", "/relay", "/talker", "/rosout"):
        graph.wait_for_node(node)
    graph.run("rosparam", "set", "/robot", "{name: Ada, joints: [1, 2.5, x]}")
    return caller, listener


def epoch(event: dict[str, Any]) -> float:
    return dt.datetime.fromisoformat(event["time"]).timestamp()


def measure(graph: Graph, guard: Process, before: dict[str, Any]) -> dict[str, float]:
    """Kill the master, and return when what was there again, in ms."""
    lost = len(graph.events(guard, "master_lost"))
    pid = graph.master_pid()
    expected = set(before["services"])
    command_ms = []

    def run_command() -> None:
        found = set(graph.run("rosservice", "list").split())
        if found == expected:
            command_ms.append((time.monotonic() - killed_at) * 1e3)

    command = threading.Thread(target=run_command)
    killed, killed_at = time.time(), time.monotonic()
    os.kill(pid, 9)
    command.start()
    wait_for(lambda: graph.master_pid() != pid)
    back_ms = (time.monotonic() - killed_at) * 1e3
    wait_for(lambda: graph.registered() == before)
    listed_ms = (time.monotonic() - killed_at) * 1e3
    command.join()
    (event, *_) = graph.events(guard, "master_lost")[lost:]
    return {
        "noticed_ms": (epoch(event) - killed) * 1e3,
        "back_ms": back_ms,
        "listed_ms": listed_ms,
        "command_ms": command_ms[0] if command_ms else float("nan"),
    }


def trial(
    directory: Path, kills: int, services: int, pause_s: float, *, stock: bool
) -> list[dict[str, object]]:
    """Kill one master after another, and return a row for each."""
    environment = {**os.environ, "ROS_VERSION": "1"}
    rows: list[dict[str, object]] = []
    with Graph(directory, environment) as graph:
        if stock:
            graph.start("rosmaster", "--core", "-p", str(graph.port))
            wait_for(graph.master_pid)
        guard = graph.guard()
        caller, listener = start_nodes(graph, services)
        before = unchanged(graph.registered, 1.0)
        arrivals = Arrivals(caller)
        try:
            for _ in range(1 if stock else kills):
                answered, heard, begun_at = len(caller.lines), len(listener.lines), time.monotonic()
                times = measure(graph, guard, before)
                done_at = time.monotonic()
                time.sleep(pause_s)
                if caller.process.poll() is not None:
                    raise RuntimeError(f"a call has failed: {caller.account()}")
                rows.append(
                    {
                        "master": "stock" if stock else "own",
                        "services": len(before["services"]),
                        "nodes": len(before["nodes"]),
                        **{name: round(value, 1) for name, value in times.items()},
                        "calls": len(caller.lines) - answered,
                        "messages": len(listener.lines) - heard,
                        "longest_pause_ms": round(
                            arrivals.longest_pause_s(begun_at, done_at) * 1e3, 1
                        ),
                    }
                )
        finally:
            arrivals.close()
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Run it; see the top of this file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--services", type=int, default=20, help="of one of the nodes")
    parser.add_argument("--pause-s", type=float, default=1.5, help="between kills")
    parser.add_argument("--by", choices=("own", "stock"), default="own", help="whose master it is")
    parser.add_argument("--output", type=Path, help="a CSV file, one row for each kill")
    options = parser.parse_args(arguments)
    if shutil.which("rosmaster") is None or not TOPIC_TOOLS.exists():
        parser.error("no ROS 1 here: apt-get install ros-core topic-tools")
    rows: list[dict[str, object]] = []
    while len(rows) < options.kills:
        with tempfile.TemporaryDirectory() as directory:
            rows += trial(
                Path(directory),
                options.kills - len(rows),
                options.services,
                options.pause_s,
                stock=options.by == "stock",
            )
    for number, row in enumerate(rows, 1):
        row["kill"] = number
    if options.output is not None:
        with options.output.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
    print(f"{len(rows)} kills; {rows[0]['nodes']} nodes, {rows[0]['services']} services")
    for name in COLUMNS[4:8] + COLUMNS[10:]:
        values = [float(str(row[name])) for row in rows]
        print(f"{name:18} median {statistics.median(values):7.1f}   worst {max(values):7.1f}")


if __name__ == "__main__":
    try:
        main()
    except subprocess.TimeoutExpired as error:
        sys.exit(str(error))
