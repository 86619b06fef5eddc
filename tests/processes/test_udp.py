"""Services over UDP: what becomes of datagrams, or of the stream, changes no decision."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

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

from holdfast_lab.testbed.bad_line import Impairment
from holdfast_lab.testbed.proxy import Proxy

PEG = "peg_in_hole_2d"


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


def test_a_robot_whose_address_changes(
    site: Site, references: References, cloud: Service, credentials: tuple[str, str]
) -> None:
    """The stream breaks, as one does that is bound to an address, and datagrams go on."""
    entry = free_port()
    document = document_of(PEG)
    steps = sensing_steps(document)
    story = Story(site, references, document)
    carried: Counter[str] = Counter()
    with Proxy(
        entry,
        port_of(cloud),
        "address",
        datagrams=True,
        overhear=lambda carrier, *_: carried.update((carrier,)),
    ) as line:
        healed, moves = [], []

        def move() -> None:
            healed.append(line.impair(Impairment(cut=True, carriers=("streams",))))
            line.change_address()
            moves.append(carried["datagrams"])

        story.at("perform", steps[1] + 1, move)
        story.at("perform", steps[4] + 1, lambda: healed.pop()())
        story.at("perform", steps[5] + 1, lambda: cloud.process.wait_for("robot_connected", 2))
        # Two answers later the robot has the keys of the new link, too.
        story.at("perform", steps[7] + 1, move)
        robot = story.run(f"udp/127.0.0.1:{entry}", options=credentials)
        first, second = moves
        assert first < second < carried["datagrams"]
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared")) == 1
    assert robot.matching("service_lost") == []
    assert len(cloud.process.matching("session_opened")) == 1
