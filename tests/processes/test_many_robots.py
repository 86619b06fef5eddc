"""Many robots on a service that is too small for them, and neighbours who send it nonsense."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
from tests.processes.faults import (
    PATIENCE_S,
    PATIENT,
    References,
    Service,
    Site,
    assert_identical,
    document_of,
)
from tests.wire import RawClient

from holdfast.protocol.messages import (
    Progress,
    Refused,
)

PEG = "peg_in_hole_2d"


class Client(RawClient):
    """A robot's end of the wire, in the test's own hands."""

    def refused(self, payload: bytes) -> Refused:
        # A sign of life may come before, if it takes its time to find out why.
        (reply,) = (each for each in self.ask(payload) if not isinstance(each, Progress))
        assert isinstance(reply, Refused), reply
        return reply


@pytest.fixture
def cloud(site: Site) -> Service:
    return site.service().start()


@pytest.fixture
def client(cloud: Service) -> Iterator[Client]:
    client = Client(cloud.endpoint)
    yield client
    client.close()


@pytest.mark.slow
class TestTooManyForOne:
    @pytest.mark.parametrize("recovery", ["never", "on_failure"])
    def test_all_runs_stay_right(self, recovery: str, site: Site, references: References) -> None:
        documents = []
        for problem in (PEG, "capsule_robot"):
            # Tens of milliseconds a decision; eight robots that are quick ask for more than that.
            document = document_of(problem, particles=2000, max_steps=40)
            document["active_sensing"]["num_observation_samples"] = 400
            documents += [document] * 4
        small = site.service("--workers", "1").start()
        everybody = threading.Barrier(len(documents), timeout=PATIENCE_S)
        robots, worlds = [], []
        for number, document in enumerate(documents):
            world, file = site.world(
                document,
                f"robot-{number}",
                offload=PATIENT,
                recovery={"launch": recovery},
            )
            world.on("begin", 0, everybody.wait)
            worlds.append(world)
            robots.append(site.run(file, services=[small], out=f"out-{number}"))
        for robot, world, document in zip(robots, worlds, documents, strict=True):
            robot.finish()
            assert_identical(robot.out, references(document))
            world.assert_each_once(references(document))
        turned_away = [event for robot in robots for event in robot.matching("busy")]
        assert turned_away
        assert all(event["retry_after_ms"] > 0 for event in turned_away)
        assert not any(robot.matching("refused") for robot in robots)
