"""Each end says how long it may be silent, and says what it was told to.

A silence is given up after the lease that the silent end has announced when the link was opened.
How long that takes depends on the machine; what is announced does not, so it is read on the way:
between robot and service stands a relay that keeps what both say first.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.ports import free_port

from holdfast.config.loader import load
from holdfast.robot.links import make_links
from holdfast.runtime.events import NullEventLog
from holdfast.transport.frames import FrameDecoder, decode_hello

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "peg_in_hole_2d.yaml"
PATIENCE_S = 60.0
SERVICE_MS = 31_500
ROBOT_MS = 47_250


class Relay:
    """Passes on what a robot and a service say, and keeps all of it, by who said it and where."""

    def __init__(self, port: int) -> None:
        self._port = port
        own_port = free_port()
        self._listener = socket.create_server(("127.0.0.1", own_port))
        self.endpoint = f"tcp/127.0.0.1:{own_port}"
        self.said: dict[str, list[bytearray]] = {"robot": [], "service": []}
        self._sockets: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._threads[0].join()
        for each in self._sockets:
            each.close()
        for thread in self._threads[1:]:
            thread.join()

    def _accept(self) -> None:
        while True:
            try:
                robot, _ = self._listener.accept()
            except OSError:
                return
            service = socket.create_connection(("127.0.0.1", self._port))
            self._sockets += [robot, service]
            for name, source, target in (("robot", robot, service), ("service", service, robot)):
                said = bytearray()
                self.said[name].append(said)
                thread = threading.Thread(target=self._pass_on, args=(said, source, target))
                self._threads.append(thread)
                thread.start()

    def _pass_on(self, said: bytearray, source: socket.socket, target: socket.socket) -> None:
        try:
            while data := source.recv(65_536):
                said += data
                target.sendall(data)
        except OSError:
            return
        finally:
            for each in (source, target):
                with contextlib.suppress(OSError):
                    each.shutdown(socket.SHUT_RDWR)


def announced_ms(said: list[bytearray]) -> float:
    """Return the lease in the first frame of a link."""
    for each in said:
        for frame in FrameDecoder(1 << 20).feed(bytes(each))[:1]:
            return decode_hello(frame.payload).lease_ms
    raise AssertionError("no link was opened")


@pytest.fixture
def relay() -> Iterator[Relay]:
    """Return a relay to a service that was told its lease."""
    port = free_port()
    command = [sys.executable, "-m", "holdfast", "serve", "--listen", f"tcp/127.0.0.1:{port}"]
    with subprocess.Popen(
        [*command, "--lease-ms", str(SERVICE_MS), "--until-stdin-closes"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as service:
        assert service.stdout is not None
        assert f":{port}" in service.stdout.readline()
        relay = Relay(port)
        try:
            yield relay
        finally:
            service.kill()
            relay.close()


def test_a_run_and_its_service_announce_their_leases(relay: Relay, tmp_path: Path) -> None:
    settings = [f"offload.lease_ms={ROBOT_MS}", "recovery.launch=never", "simulator.max_steps=10"]
    command = [sys.executable, "-m", "holdfast", "run", str(EXAMPLE), "--trials", "1", "--quiet"]
    command += ["--service", relay.endpoint, "--out", str(tmp_path / "run")]
    command += [word for setting in settings for word in ("--set", setting)]
    subprocess.run(command, timeout=PATIENCE_S, check=True)
    assert announced_ms(relay.said["robot"]) == ROBOT_MS
    assert announced_ms(relay.said["service"]) == SERVICE_MS


def test_the_local_service_is_told_the_robots_lease() -> None:
    """It is the robot's own, so one setting says how long either may be silent."""
    overrides = {"offload.lease_ms": ROBOT_MS, "offload.services": ["tcp/127.0.0.1:1"]}
    links = make_links(load(EXAMPLE, overrides=overrides), None, NullEventLog())
    try:
        assert links.launcher is not None and links.transport is not None
        command = links.launcher._command
        assert command[command.index("--lease-ms") + 1] == str(ROBOT_MS)
        asyncio.run(links.transport.close())
    finally:
        links.close()
