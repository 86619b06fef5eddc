"""The images of deploy/: their size, how soon a container decides, and how much memory it takes.

    .venv/bin/python -m benchmarks.containers

Robot and cloud are containers on one network of a Docker Engine on this machine, hardened as the
Compose files have them. It prints the rows of a table.
"""

from __future__ import annotations

import csv
import statistics
import tempfile
from datetime import UTC, datetime
from pathlib import Path

from tests.deploy.docker import (
    ROOT,
    USER,
    Engine,
    build,
    give_to,
    holdfast,
    running_engine,
    wait_until,
)

REPETITIONS = 5
NAME = "holdfast-benchmark"
CLOUD, ROBOT = f"{NAME}-cloud", f"{NAME}-robot"
HARDENED = (
    "--read-only",
    "--tmpfs",
    "/tmp",
    "--cap-drop",
    "ALL",
    "--security-opt",
    "no-new-privileges",
)


def main() -> None:
    with running_engine() as engine, tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        directory.chmod(0o755)
        try:
            engine.docker("network", "create", NAME)
            measure(engine, directory)
        finally:
            for container in (CLOUD, ROBOT):
                engine.run("docker", "rm", "--force", "--volumes", container)
            engine.run("docker", "network", "rm", NAME)


def measure(engine: Engine, directory: Path) -> None:
    images = build(engine)
    base = engine.inspect("debian:bookworm-slim")["Size"]
    size = engine.inspect(images.robot)["Size"]
    holdfast("keys", "keys", "--host", "cloud", cwd=directory)
    give_to(USER, directory / "keys")
    engine.docker(
        *("run", "-d", "--name", CLOUD, "--network", NAME, "--network-alias", "cloud", *HARDENED),
        *("-v", f"{directory}/keys/service:/keys:ro", images.cloud),
    )
    wait_until(lambda: "is listening" in engine.docker("logs", CLOUD), "the service to listen")
    first, memory = [], []
    for number in range(REPETITIONS):
        began = datetime.now(UTC)
        engine.docker(
            *("run", "-d", "--name", ROBOT, "--network", NAME, *HARDENED),
            *("-v", f"{ROOT}/examples/peg_in_hole_2d.yaml:/config/robot.yaml:ro"),
            *("-v", f"{directory}/keys/robot:/keys:ro", images.robot),
            *("run", "robot.yaml", "--out", "/runs/run", "--trials", 1, "--rate", 20),
            *("--service", "tls/cloud:7447", "--tls", "/keys", "--recovery", "at_start"),
        )
        wait_until(lambda: "launched" in engine.run("docker", "logs", ROBOT).stderr, "recovery")
        memory.append([memory_of(engine, container) for container in (CLOUD, ROBOT)])
        engine.docker("wait", ROBOT)
        engine.docker("cp", f"{ROBOT}:/runs/run/timings.csv", directory / f"{number}.csv")
        with (directory / f"{number}.csv").open() as table:
            row = next(csv.DictReader(table))
        assert row["service"] == "tls/cloud:7447", row
        first.append((datetime.fromisoformat(row["time"]) - began).total_seconds())
        engine.docker("rm", "--volumes", ROBOT)
    print(
        f"| image of either role | {size / 1e6:.0f} MB, {(size - base) / 1e6:.0f} above its base |"
    )
    print(f"| `docker run` of a robot to its first decision | {statistics.median(first):.2f} s |")
    for role, used in zip(
        ("the cloud", "a robot with its local service"), zip(*memory, strict=True), strict=True
    ):
        print(f"| memory of {role} | {statistics.median(used) / 2**20:.0f} MiB |")


def memory_of(engine: Engine, container: str) -> float:
    used = engine.docker("stats", "--no-stream", "--format", "{{.MemUsage}}", container).split("/")[
        0
    ]
    return float(used.strip().removesuffix("MiB")) * 2**20


if __name__ == "__main__":
    main()
