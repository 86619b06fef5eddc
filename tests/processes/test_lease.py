"""Each end says how long it may be silent, and says what it was told to.

A silence is given up after the lease that the silent end has announced when the link was opened.
How long that takes depends on the machine; what is announced does not, so it is read on the way:
between robot and service stands a proxy that overhears what both say.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from tests.ports import free_port

from holdfast.config.loader import load
from holdfast.robot.links import make_links
from holdfast.runtime.events import BoundedEventLog
from holdfast.transport.frames import FrameDecoder, decode_hello
from holdfast_lab.testbed.proxy import Proxy

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "peg_in_hole_2d.yaml"
PATIENCE_S = 60.0
SERVICE_MS = 31_500
ROBOT_MS = 47_250


class Overheard(NamedTuple):
    """What a robot and a service say on the line between them."""

    endpoint: str
    said: dict[str, bytearray]


def announced_ms(said: bytearray) -> float:
    """Return the lease in the first frame of a link."""
    return decode_hello(FrameDecoder(1 << 20).feed(bytes(said))[0].payload).lease_ms


@pytest.fixture
def line() -> Iterator[Overheard]:
    """Return a line to a service that was told its lease."""
    port, entry = free_port(), free_port()
    said = {"to_robot": bytearray(), "to_service": bytearray()}
    command = [sys.executable, "-m", "holdfast", "serve", "--listen", f"tcp/127.0.0.1:{port}"]
    with subprocess.Popen(
        [*command, "--lease-ms", str(SERVICE_MS), "--until-stdin-closes"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as service:
        assert service.stdout is not None
        assert f":{port}" in service.stdout.readline()
        with Proxy(entry, port, "lease", overhear=lambda _, way, piece: said[way].extend(piece)):
            yield Overheard(f"tcp/127.0.0.1:{entry}", said)
        service.kill()


def test_a_run_and_its_service_announce_their_leases(line: Overheard, tmp_path: Path) -> None:
    settings = [f"offload.lease_ms={ROBOT_MS}", "recovery.launch=never", "simulator.max_steps=10"]
    command = [sys.executable, "-m", "holdfast", "run", str(EXAMPLE), "--trials", "1", "--quiet"]
    command += ["--service", line.endpoint, "--out", str(tmp_path / "run")]
    command += [word for setting in settings for word in ("--set", setting)]
    subprocess.run(command, timeout=PATIENCE_S, check=True)
    assert announced_ms(line.said["to_service"]) == ROBOT_MS
    assert announced_ms(line.said["to_robot"]) == SERVICE_MS


def test_the_local_service_is_told_the_robots_lease() -> None:
    """It is the robot's own, so one setting says how long either may be silent."""
    overrides = {"offload.lease_ms": ROBOT_MS, "offload.services": ["tcp/127.0.0.1:1"]}
    links = make_links(load(EXAMPLE, overrides=overrides), None, BoundedEventLog())
    assert links.launcher is not None and links.transport is not None
    command = links.launcher._command
    assert command[command.index("--lease-ms") + 1] == str(ROBOT_MS)
    asyncio.run(links.transport.close())
