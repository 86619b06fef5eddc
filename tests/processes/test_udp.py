"""Services over UDP: what becomes of datagrams, or of the stream, changes no decision."""

from __future__ import annotations

import contextlib
import select
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.ports import free_port
from tests.processes.faults import (
    References,
    Service,
    Site,
    Story,
    document_of,
    sensing_steps,
)

from holdfast.chaos.proxy import Impairment, Proxy

PEG = "peg_in_hole_2d"


class Relay:
    """Hands datagrams on between one robot and one service, and counts them.

    To the service they come from an address of the relay's own, which can change; each may be
    repeated, and the last ones may come again at any time.
    """

    def __init__(self, port: int, target: int) -> None:
        self._target = target
        self._entry = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._entry.bind(("127.0.0.1", port))
        self._robot: Any = None
        self._kept: list[bytes] = []
        self._lock = threading.Lock()
        self._ending = False
        self._exit = self._new_exit()
        self.carried = {"to_service": 0, "to_robot": 0}
        self.repeat = False
        self.addresses = 1
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _new_exit(self) -> socket.socket:
        made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        made.connect(("127.0.0.1", self._target))
        return made

    def change_address(self) -> None:
        """Send to the service from another port from now on, as after a change of networks."""
        with self._lock:
            old, self._exit = self._exit, self._new_exit()
            old.close()
            self.addresses += 1

    def replay(self) -> None:
        """Send the last datagrams to the service again, from an address that nobody has had."""
        with self._lock, self._new_exit() as stranger:
            for datagram in self._kept:
                stranger.send(datagram)

    def close(self) -> None:
        self._ending = True
        self._thread.join()
        self._entry.close()
        self._exit.close()

    def _run(self) -> None:
        while not self._ending:
            with self._lock:
                sources = [self._entry, self._exit]
            # A socket that was replaced meanwhile is closed, and another one is looked at next.
            with contextlib.suppress(OSError, ValueError):
                for ready in select.select(sources, [], [], 0.01)[0]:
                    self._carry(ready)

    def _carry(self, source: socket.socket) -> None:
        datagram, sender = source.recvfrom(65_536)
        with self._lock:
            for _ in range(1 + self.repeat):
                if source is self._entry:
                    self._robot = sender
                    self._kept = [*self._kept[-49:], datagram]
                    self.carried["to_service"] += 1
                    self._exit.send(datagram)
                else:
                    self.carried["to_robot"] += 1
                    self._entry.sendto(datagram, self._robot)


@contextlib.contextmanager
def relay(port: int, target: int) -> Iterator[Relay]:
    made = Relay(port, target)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture
def cloud(site: Site, keys: Path) -> Service:
    return site.service(
        *("--tls", str(keys / "ours" / "service")), endpoint=f"udp/127.0.0.1:{free_port()}"
    ).start()


@pytest.fixture
def credentials(keys: Path) -> tuple[str, str]:
    return ("--tls", str(keys / "ours" / "robot"))


def port_of(service: Service) -> int:
    return int(service.endpoint.rpartition(":")[2])


def test_losses_and_late_datagrams(
    site: Site, references: References, cloud: Service, credentials: tuple[str, str]
) -> None:
    entry = free_port()
    story = Story(site, references, document_of(PEG))
    with Proxy(entry, port_of(cloud), "losses", datagrams=True) as proxy:
        proxy.impair(Impairment(latency_s=0.005, jitter_s=0.02, loss=0.2))
        robot = story.run(f"udp/127.0.0.1:{entry}", options=credentials)
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared")) == 1
    assert robot.matching("no_datagrams") == []


def test_datagrams_that_come_twice_and_again_later(
    site: Site, references: References, cloud: Service, credentials: tuple[str, str]
) -> None:
    entry = free_port()
    document = document_of(PEG)
    story = Story(site, references, document)
    with Proxy(entry, port_of(cloud), "twice"), relay(entry, port_of(cloud)) as between:
        between.repeat = True
        for step in sensing_steps(document)[2:]:
            story.at("perform", step, between.replay)
        robot = story.run(f"udp/127.0.0.1:{entry}", options=credentials)
        assert between.carried["to_service"] > len(sensing_steps(document))
    assert robot.statuses() == []
    assert len(cloud.process.matching("session_opened")) == 1


def test_a_robot_whose_address_changes(
    site: Site, references: References, cloud: Service, credentials: tuple[str, str]
) -> None:
    """The stream breaks, as one does that is bound to an address, and datagrams go on."""
    entry = free_port()
    document = document_of(PEG)
    steps = sensing_steps(document)
    story = Story(site, references, document)
    with (
        Proxy(entry, port_of(cloud), "address") as stream,
        relay(entry, port_of(cloud)) as datagrams,
    ):
        healed = []

        def move() -> None:
            healed.append(stream.impair(Impairment(cut=True)))
            datagrams.change_address()

        story.at("perform", steps[1] + 1, move)
        before = datagrams.carried
        story.at("perform", steps[3] + 1, lambda: before.update(datagrams.carried))
        story.at("perform", steps[4] + 1, lambda: healed.pop()())
        story.at(
            "perform",
            steps[5] + 1,
            lambda: cloud.process.wait_for("robot_connected", 2),
            move,
        )
        robot = story.run(f"udp/127.0.0.1:{entry}", options=credentials)
        assert datagrams.addresses == 3
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared")) == 1
    assert robot.matching("service_lost") == []
    assert len(cloud.process.matching("session_opened")) == 1


def test_where_no_datagram_gets_through(
    site: Site, references: References, cloud: Service, credentials: tuple[str, str]
) -> None:
    entry = free_port()
    story = Story(site, references, document_of(PEG))
    story.at("perform", 20, lambda: story.running.wait_for("no_datagrams"))
    with Proxy(entry, port_of(cloud), "filtered"):
        robot = story.run(f"udp/127.0.0.1:{entry}", options=credentials)
    assert robot.statuses() == []
    (told,) = robot.matching("no_datagrams")
    assert told["service"] == f"udp/127.0.0.1:{entry}"
