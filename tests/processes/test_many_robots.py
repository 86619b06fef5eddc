"""Many robots on a service that is too small for them, and neighbours who send it nonsense."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.processes.faults import (
    PATIENCE_S,
    PATIENT,
    PROBLEMS,
    References,
    Service,
    Site,
    Story,
    assert_identical,
    document_of,
    events_of,
    in_order,
)
from tests.processes.world import World
from tests.questions import request_of
from tests.wire import RawClient

from holdfast.config.loader import Configuration, load
from holdfast.planning.planner import Planner
from holdfast.protocol.messages import (
    PROTOCOL_VERSION,
    Progress,
    Refused,
    Request,
    SensingAnswer,
    encode,
    with_checksum,
)
from holdfast.robot.session_configuration import session_configuration_of
from holdfast.transport.contract import DEFAULT_MAX_MESSAGE_BYTES

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


def first_request(configuration: Configuration, **changes: Any) -> Request:
    """Return the first question of a run."""
    state = Planner(configuration.problem, configuration.planning).init(
        configuration.simulator.seed, 0
    )
    request = request_of(
        state, bytes(range(16)), 1, session_configuration=session_configuration_of(configuration)
    )
    return msgspec.structs.replace(request, **changes)


class TestNeighbours:
    def test_nonsense_is_refused_and_nobody_else_notices(
        self, cloud: Service, client: Client, site: Site, references: References
    ) -> None:
        story = Story(site, references, document_of(PEG))
        configuration = load(story.file)
        good = first_request(configuration)
        assert good.session_configuration is not None
        random = np.random.default_rng(11)

        def another_problem(name: str) -> bytes:
            assert good.session_configuration is not None
            return encode(
                msgspec.structs.replace(
                    good,
                    session=random.bytes(16),
                    session_configuration=msgspec.structs.replace(
                        good.session_configuration, problem=name
                    ),
                )
            )

        def send_nonsense() -> None:
            unknown = client.refused(another_problem("no_such_problem"))
            assert unknown.code == "unknown_problem"
            assert "no_such_problem" in unknown.text
            # Code that a robot names is not run.
            assert client.refused(another_problem("os:system")).code == "unknown_problem"
            other = msgspec.structs.replace(good, version=PROTOCOL_VERSION + 1)
            assert client.refused(encode(other)).code == "version"
            wrong = msgspec.structs.replace(good, session=random.bytes(16), checkpoint=b"wrong")
            assert client.refused(encode(wrong)).code in ("malformed", "invalid")
            whole = encode(good)
            for size in range(0, len(whole), 37):
                assert client.refused(whole[:size]).code == "damaged"
            for _ in range(50):
                nonsense = with_checksum(random.bytes(200))
                assert client.refused(nonsense).code in ("malformed", "version")
            large = bytes(DEFAULT_MAX_MESSAGE_BYTES + 1)
            assert client.refused(large).code == "too_large"

        def be_answered() -> None:
            # The one that sent all this is still served.
            assert any(isinstance(reply, SensingAnswer) for reply in client.ask(encode(good)))

        for step in (5, 30, 60):
            story.at("perform", step, send_nonsense)
        story.at("perform", 61, be_answered)
        robot = story.run(cloud)
        assert robot.statuses() == []
        assert not robot.matching("refused")
        assert not robot.matching("service_suspected")
        assert cloud.process.matching("refused", code="unknown_problem")

    def test_flipped_bits_of_a_good_request(
        self, cloud: Service, client: Client, site: Site, references: References
    ) -> None:
        """Whatever comes of them, it is a typed reply, and the robot beside it goes on."""
        story = Story(site, references, document_of(PEG))
        whole = encode(first_request(load(story.file)))
        random = np.random.default_rng(12)

        def send_spoilt() -> None:
            for _ in range(60):
                spoilt = bytearray(whole)
                spoilt[random.integers(len(spoilt))] ^= 1 << int(random.integers(8))
                assert client.ask(bytes(spoilt))

        story.at("perform", 25, send_spoilt)
        story.at("sense", 45, send_spoilt)
        robot = story.run(cloud)
        assert robot.statuses() == []

    def test_a_problem_that_the_service_does_not_know(
        self, site: Site, cloud: Service, references: References
    ) -> None:
        """The robot's own: the cloud refuses it by name, and the local service has it."""
        from tests.processes.test_faults import GATED

        story = Story(site, references, GATED)
        robot = story.run(cloud)
        assert ("standard", "local_recovery") in robot.statuses()
        refused = robot.matching("refused")[0]
        assert refused["code"] == "unknown_problem"
        assert "--problem" in refused["reason"]


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

    def test_killed_under_them(self, site: Site, references: References) -> None:
        """Their service dies and comes back; they all go on, each in its own way."""
        documents = [document_of(problem) for problem in PROBLEMS]
        cloud = site.service("--workers", "1").start()
        worlds: list[World] = []
        robots = []
        for number, document in enumerate(documents):
            world, file = site.world(
                document, f"robot-{number}", offload=PATIENT, recovery={"launch": "never"}
            )
            worlds.append(world)
            if number == 0:
                world.on("perform", 30, in_order(cloud.kill, cloud.start))
                world.on("sense", 54, in_order(cloud.kill, cloud.start))
            robots.append(site.run(file, services=[cloud], out=f"out-{number}"))
        for robot, world, document in zip(robots, worlds, documents, strict=True):
            robot.finish()
            world.check()
            assert_identical(robot.out, references(document))
            world.assert_each_once(references(document))
            assert not [each for each in events_of(robot.out) if each["event"] == "launch"]
