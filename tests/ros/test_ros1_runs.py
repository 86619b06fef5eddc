"""Whole runs of ``holdfast run`` over ROS 1: whatever dies, decisions stay those without faults.

The stories are those of every wire's cloud; what only ROS 1 has is its master.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from tests.processes import test_faults
from tests.processes.faults import (
    KEEP_ALIVE,
    LOST,
    PATIENT,
    RESTORED,
    References,
    Service,
    Site,
    Story,
    document_of,
    sensing_steps,
)
from tests.ros.ros1_processes import Ros1, ros1_in, until

PEG = "peg_in_hole_2d"
CLOUD = "cloud_active_sensing"


class RosSite(Site):
    """Services are where a ROS 1 master says that they are."""

    def __init__(self, directory: Path, around: Ros1) -> None:
        super().__init__(directory)
        self.around = around

    def environment(self, variables: Mapping[str, str] | None = None) -> dict[str, str]:
        names = ("ROS_MASTER_URI", "ROS_HOSTNAME")
        ours = {name: self.around.environment[name] for name in names}
        return super().environment({**ours, **(variables or {})})

    def service(
        self, *options: str, endpoint: str | None = None, lease_ms: float = PATIENT["lease_ms"]
    ) -> Service:
        return super().service(*options, endpoint=endpoint or f"ros1/{CLOUD}", lease_ms=lease_ms)


@pytest.fixture
def around(ros1: Mapping[str, str], tmp_path: Path) -> Iterator[Ros1]:
    yield from ros1_in(ros1, tmp_path)


@pytest.fixture
def site(around: Ros1, tmp_path: Path) -> Iterator[Site]:
    with RosSite(tmp_path, around) as site:
        yield site


@pytest.fixture(scope="module")
def references(tmp_path_factory: pytest.TempPathFactory) -> References:
    return References(tmp_path_factory.mktemp("references"))


def test_killed_and_started_again(site: Site, references: References) -> None:
    test_faults.TestCloud().test_killed_and_started_again(PEG, site, references)


def test_stopped_for_longer_than_the_timeout(site: Site, references: References) -> None:
    test_faults.TestCloud().test_stopped_for_longer_than_the_timeout(PEG, site, references)


def test_never_there(site: Site, references: References) -> None:
    test_faults.TestCloud().test_never_there(PEG, site, references)


def test_the_master_is_killed_and_then_the_cloud(site: RosSite, references: References) -> None:
    document = document_of(PEG)
    steps = sensing_steps(document)
    cloud = site.service().start()
    around = site.around
    assert around.master is not None
    first = around.master

    def kill_the_master() -> None:
        first.kill()
        first.wait()

    def start_another() -> None:
        around.start_master()
        until(lambda: around.service_uri(f"{CLOUD}/exchange"), "the cloud is listed")

    story = Story(site, references, document)
    story.at("sense", steps[1], kill_the_master)
    story.at("sense", steps[2], cloud.kill)
    # Without a master it is there, and nobody can find it.
    story.at("perform", steps[3], cloud.start)
    story.at("perform", steps[4], start_another, story.status(KEEP_ALIVE))
    robot = story.run(cloud)
    assert robot.statuses() == [LOST, RESTORED]
