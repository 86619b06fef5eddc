"""A rolling restart of three replicas under twenty robots: how late does the latest decision come?

``python benchmarks/rolling.py`` starts three services at three addresses, and robots (``holdfast
run``, each a process of its own) that reach them in one of two ways: by one *name* that stands for
the three addresses, as a headless Service of Kubernetes or a network alias of Docker does, or by a
*list* of three. Then the services are ended by SIGTERM and started again one after another, each
ready before the next one goes. Beside it stands the same without a restart, because on a machine
with few cores twenty robots make each other wait.

The name is one of /etc/hosts, in a mount namespace of each robot's own; so this needs root.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

__all__ = ["HEDGE_MS", "NAME", "Replicas", "Way", "at_hosts", "decisions_of", "start_robots"]

NAME = "replicas.holdfast.test"
HEDGE_MS = 100.0
"""``offload.decision_deadline_ms``: a decision that is later would be asked of a local service."""

Way = Literal["name", "list"]
_PATIENCE_S = 120.0
_HOLDFAST = (sys.executable, "-m", "holdfast")
_CONFIGURATION = """\
problem: peg_in_hole_2d
particle_filter: {{num_particles: 100}}
simulator: {{num_trials: {trials}, max_steps: 200, sensing_intervals: 2, seed: {seed}}}
recovery: {{launch: on_failure}}
offload: {{decision_deadline_ms: {hedge}, detection_timeout_ms: 30000, lease_ms: 30000}}
"""


def at_hosts(hosts: Path, command: Sequence[str]) -> list[str]:
    """Return a command that looks names up in a file instead of /etc/hosts."""
    script = 'mount --bind "$0" /etc/hosts && exec "$@"'
    return ["unshare", "-m", "sh", "-c", script, str(hosts), *command]


def wait_until(condition: Callable[[], bool], what: str) -> None:
    """Wait for another process."""
    deadline = time.monotonic() + _PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(f"{what}: not within {_PATIENCE_S:g} s")
        time.sleep(0.01)


class Replicas:
    """Services at 127.0.1.1, 127.0.1.2, ... and one port, which have a name in common.

    Parameters
    ----------
    directory : Path
        For the file of names, and the services' logs.
    lease_ms : float
        A long one: then what is found is not found by silence.
    """

    def __init__(
        self, directory: Path, port: int, count: int = 3, lease_ms: float = 30_000.0
    ) -> None:
        self._directory = directory
        self._port = port
        self._lease_ms = lease_ms
        self.addresses = [f"127.0.1.{number}" for number in range(1, count + 1)]
        self.hosts = directory / "hosts"
        lines = ["127.0.0.1 localhost", *(f"{each} {NAME}" for each in self.addresses)]
        self.hosts.write_text("\n".join(lines) + "\n")
        self.processes: dict[str, subprocess.Popen[bytes]] = {}

    def services(self, way: Way) -> list[str]:
        """Return the endpoints that a robot is given."""
        hosts = [NAME] if way == "name" else self.addresses
        return [f"tcp/{host}:{self._port}" for host in hosts]

    def start(self, address: str) -> None:
        """Start one; when this returns it is ready, as a probe sees it."""
        with (self._directory / f"{address}.log").open("ab") as log:
            self.processes[address] = subprocess.Popen(
                [
                    *(*_HOLDFAST, "serve", "--listen", f"tcp/{address}:{self._port}"),
                    *("--health", f"{address}:{self._port + 1}", "--drain-s", "60"),
                    *("--lease-ms", str(self._lease_ms), "--log", "json"),
                ],
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
        wait_until(lambda: self._is_ready(address), f"the service at {address} is not ready")

    def end(self, address: str) -> int:
        """End one by SIGTERM; return its exit code."""
        process = self.processes[address]
        process.send_signal(signal.SIGTERM)
        return process.wait(_PATIENCE_S)

    def close(self) -> None:
        """Kill all."""
        for process in self.processes.values():
            process.kill()
            process.wait()

    def told(self, address: str) -> list[dict[str, object]]:
        """Return the events that all services at an address have told."""
        text = (self._directory / f"{address}.log").read_text()
        return [json.loads(line) for line in text.splitlines() if line.startswith("{")]

    def _is_ready(self, address: str) -> bool:
        process = self.processes[address]
        if process.poll() is not None:
            raise RuntimeError(f"the service at {address} has ended with {process.returncode}")
        try:
            with urllib.request.urlopen(f"http://{address}:{self._port + 1}/readyz", timeout=5):
                return True
        except (urllib.error.URLError, OSError):
            return False


def start_robots(
    directory: Path,
    replicas: Replicas,
    way: Way,
    count: int,
    *,
    rate: float,
    trials: int,
    num_seeds: int,
) -> dict[Path, subprocess.Popen[bytes]]:
    """Start robots; return each one's directory and process."""
    robots = {}
    for number in range(count):
        configuration = directory / f"robot-{number}.yaml"
        configuration.write_text(
            _CONFIGURATION.format(seed=number % num_seeds, trials=trials, hedge=HEDGE_MS)
        )
        out = directory / f"out-{number}"
        services = [word for each in replicas.services(way) for word in ("--service", each)]
        command = [*_HOLDFAST, "run", str(configuration), *services]
        command += ["--rate", str(rate), "--out", str(out)]
        with (directory / f"robot-{number}.log").open("wb") as log:
            robots[out] = subprocess.Popen(
                at_hosts(replicas.hosts, command),
                stdout=log,
                stderr=log,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
            )
    return robots


def decisions_of(run: Path) -> list[dict[str, str]]:
    """Return the rows of a run's timings, but for what the robot decided itself."""
    path = run / "timings.csv"
    if not path.exists():
        return []
    # Read at once: the head may be written while it is read line by line.
    rows = csv.DictReader(path.read_text().splitlines())
    return [row for row in rows if row["service"] != "in_process"]


class _Measured(NamedTuple):
    latest_ms: float
    median_ms: float
    beyond: int
    decisions: int
    locally: int
    recoveries: int


def _measure(way: Way, count: int, rate: float, trials: int, *, restart: bool) -> _Measured:
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        replicas = Replicas(directory, 17447)
        robots: dict[Path, subprocess.Popen[bytes]] = {}
        try:
            for address in replicas.addresses:
                replicas.start(address)
            robots = start_robots(
                directory, replicas, way, count, rate=rate, trials=trials, num_seeds=count
            )
            wait_until(lambda: all(len(decisions_of(out)) > 4 for out in robots), "decisions")
            # Twenty interpreters that start at once make everybody late, restart or not.
            warm = {out: len(decisions_of(out)) for out in robots}
            for address in replicas.addresses if restart else ():
                replicas.end(address)
                replicas.start(address)
            for process in robots.values():
                if process.wait(_PATIENCE_S):
                    raise RuntimeError(f"a robot has ended with {process.returncode}")
            rows = [row for out in robots for row in decisions_of(out)[warm[out] :]]
            events = [
                json.loads(line)
                for out in robots
                for line in (out / "events.jsonl").read_text().splitlines()
            ]
        finally:
            for process in robots.values():
                process.kill()
                process.wait()
            replicas.close()
    waited = [float(row["waited_ms"]) for row in rows]
    return _Measured(
        max(waited),
        statistics.median(waited),
        sum(each > HEDGE_MS for each in waited),
        len(waited),
        sum("recovery" in row["service"] for row in rows),
        sum(event["event"] == "status" for event in events),
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--robots", type=int, default=20)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--trials", type=int, default=2)
    options = parser.parse_args()
    print(
        f"{options.robots} robots at {options.rate:g} actions a second, a hedge is {HEDGE_MS:g} ms"
    )
    print("way   restart  decisions  median ms  latest ms  beyond a hedge  locally  status changes")
    ways: tuple[Way, ...] = ("name", "list")
    for way in ways:
        for restart in (False, True):
            found = _measure(way, options.robots, options.rate, options.trials, restart=restart)
            print(
                f"{way:5} {'yes' if restart else 'no':7} {found.decisions:10}"
                f" {found.median_ms:10.2f} {found.latest_ms:10.1f} {found.beyond:15}"
                f" {found.locally:8} {found.recoveries:15}",
                flush=True,
            )


if __name__ == "__main__":
    main()
