"""Services over UDP: what becomes of datagrams, or of the stream, changes no decision."""

from collections import Counter
from pathlib import Path

import pytest
from tests.ports import free_port
from tests.processes.faults import References, Service, Site, Story, document_of, sensing_steps

from holdfast_lab.testbed.bad_line import Carrier, Direction, Impairment
from holdfast_lab.testbed.proxy import Proxy

PEG = "peg_in_hole_2d"


@pytest.fixture
def cloud(site: Site, keys: Path) -> Service:
    return site.service(
        *("--tls", str(keys / "ours" / "service")), endpoint=f"udp/127.0.0.1:{free_port()}"
    ).start()


_PROBE = 34
"""Bytes of a datagram with a probe, the shortest one to a robot that is no answer."""


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
    document = document_of(PEG, max_steps=120)
    steps = sensing_steps(document)
    story = Story(site, references, document)
    carried: Counter[str] = Counter()
    answering: set[bytes] = set()

    def overhear(carrier: Carrier, way: Direction, piece: bytes) -> None:
        carried[carrier] += 1
        if carrier == "datagrams" and way == "to_robot" and len(piece) > _PROBE:
            answering.add(piece[:4])  # the link's association (docs/datagrams.md)

    with Proxy(entry, port_of(cloud), "address", datagrams=True, overhear=overhear) as line:
        healed, moves = [], []

        def move() -> None:
            healed.append(line.impair(Impairment(cut=True, carriers=("streams",))))
            line.change_address()
            moves.append(carried["datagrams"])

        def move_again() -> None:
            if len(answering) > 1 and len(moves) == 1:  # the new link has datagrams, too
                move()

        story.at("perform", steps[1] + 1, move)
        story.at("perform", steps[4] + 1, lambda: healed.pop()())
        story.at("perform", steps[5] + 1, lambda: cloud.process.wait_for("robot_connected", 2))
        for step in range(steps[6], steps[-2]):
            story.at("perform", step, move_again)
        robot = story.run(f"udp/127.0.0.1:{entry}", options=credentials)
        first, second = moves
        assert first < second < carried["datagrams"]
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared")) == 1
    assert robot.matching("service_lost") == []
    assert len(cloud.process.matching("session_opened")) == 1
