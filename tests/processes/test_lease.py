"""Each end says how long it may be silent, and says what it was told to.

A silence is given up after the lease that the silent end has announced when the link was opened.
How long that takes depends on the machine; what is announced does not, so it is read on the wire.
"""

import asyncio
import socket
from pathlib import Path

import msgspec
from tests.processes.faults import Site, document_of
from tests.wire import HELLO, RawClient, RawLink

from holdfast.config.loader import load
from holdfast.robot.links import make_links
from holdfast.runtime.events import BoundedEventLog

EXAMPLE = Path(__file__).parents[2] / "examples" / "peg_in_hole_2d.yaml"
SERVICE_MS = 31_500.0
ROBOT_MS = 47_250.0


def test_a_service_announces_its_lease(site: Site) -> None:
    service = site.service(lease_ms=SERVICE_MS).start()
    with RawClient(service.endpoint) as robot:
        assert robot.service["lease_ms"] == SERVICE_MS


def test_a_run_announces_its_lease(site: Site) -> None:
    file = site.configure(document_of("peg_in_hole_2d"), offload={"lease_ms": ROBOT_MS})
    with socket.create_server(("127.0.0.1", 0)) as listener:
        robot = site.run(file, services=[f"tcp/127.0.0.1:{listener.getsockname()[1]}"])
        with RawLink(listener.accept()[0]) as link:
            frame = link.receive()
        robot.kill()
    assert frame is not None and frame.kind == HELLO
    assert msgspec.msgpack.decode(frame.payload)["lease_ms"] == ROBOT_MS


def test_the_local_service_is_told_the_robots_lease() -> None:
    """It is the robot's own, so one setting says how long either may be silent."""
    overrides = {"offload.lease_ms": ROBOT_MS, "offload.services": ["tcp/127.0.0.1:1"]}
    links = make_links(load(EXAMPLE, overrides=overrides), None, BoundedEventLog())
    assert links.launcher is not None and links.transport is not None
    command = links.launcher._command
    assert command[command.index("--lease-ms") + 1] == f"{ROBOT_MS:g}"
    asyncio.run(links.transport.close())
