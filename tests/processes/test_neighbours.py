"""What else comes to a service's port disturbs no robot that is there, and locks none out.

How long robots wait meanwhile is measured by ``python benchmarks/run.py --only neighbours``.
"""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from tests.processes.faults import Process, References, Site, Story, document_of, wait_until
from tests.processes.test_tls import secure

DOCUMENT = document_of("peg_in_hole_2d")
ROOT = Path(__file__).parents[2]


def neighbour(site: Site, kind: str, endpoint: str, *options: str) -> Process:
    return site.process(
        sys.executable,
        *("-m", "tests.fuzz.neighbours", kind, endpoint, *options),
        variables={"PYTHONPATH": str(ROOT)},
    )


def done_by(process: Process) -> int:
    """Return how often a neighbour did what it does, once it has come to its end."""
    assert process.wait() == 0, process.account()
    return int(process.output.splitlines()[-1])


SLOWLY = [pytest.param(kind, marks=pytest.mark.slow) for kind in ("slow", "scanner", "silent")]


@pytest.mark.parametrize("kind", ["deaf", "greetings", *SLOWLY])
def test_a_robot_at_work_notices_nothing(kind: str, site: Site, references: References) -> None:
    cloud = site.service().start()
    story = Story(site, references, DOCUMENT)
    neighbours: list[Process] = []
    story.at(
        "perform",
        10,
        lambda: neighbours.append(neighbour(site, kind, cloud.endpoint, "--seconds", "1")),
    )
    # The robot goes on beside it; and is not through before it.
    story.at("perform", 78, lambda: neighbours[0].wait())
    robot = story.run(cloud)
    assert done_by(neighbours[0]) > 0
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared", service=cloud.endpoint)) == 1
    assert not robot.matching("service_vanished")
    assert "Traceback" not in cloud.process.output


def test_a_robot_over_udp_is_answered_in_a_flood_of_datagrams(
    keys: Path, site: Site, references: References
) -> None:
    """Most of its own are dropped by the system; it is answered over the stream."""
    cloud = secure(site, keys, "udp").start()
    story = Story(site, references, DOCUMENT)
    floods: list[Process] = []
    story.at(
        "perform",
        10,
        lambda: floods.append(neighbour(site, "flood", cloud.endpoint, "--seconds", "1")),
    )
    story.at("perform", 78, lambda: floods[0].wait())
    robot = story.run(cloud, options=("--tls", str(keys / "ours" / "robot")))
    assert done_by(floods[0]) > 0
    assert robot.statuses() == []
    assert len(robot.matching("service_appeared", service=cloud.endpoint)) == 1
    assert not robot.matching("service_vanished")


@pytest.mark.parametrize(
    "kind",
    ["hasty", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("trickle", "silent"))],
)
def test_a_new_robot_is_let_in(kind: str, keys: Path, site: Site, references: References) -> None:
    """However many connections to a service with TLS never come to their handshakes."""
    cloud = secure(site, keys, "tls").start()
    story = Story(site, references, DOCUMENT)
    stranger = neighbour(site, kind, cloud.endpoint, "--seconds", "600")
    if kind == "hasty":
        assert done_by(stranger) == 2000
    else:
        wait_until(lambda: stranger.output != "", "it to begin")
    robot = story.run(cloud, options=("--tls", str(keys / "ours" / "robot")))
    assert robot.statuses() == []
    assert robot.matching("service_appeared", service=cloud.endpoint)
    assert cloud.process.matching("session_opened")
    stranger.process.terminate()
    assert done_by(stranger) > 0
