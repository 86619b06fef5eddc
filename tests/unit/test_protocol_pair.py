"""The robot's machine and the service's, joined under a virtual clock."""

from __future__ import annotations

import pytest
from tests.questions import received
from tests.robot_world import LOCAL, PROBLEM, SmallService, World

from holdfast.protocol.messages import Reply, SessionConfiguration, decode_reply
from holdfast.protocol.service import Service
from holdfast.protocol.service_jobs import SendReply, StartJob


class WholeService(SmallService):
    """The real machine in the place of the small one; jobs take no time."""

    def __init__(self) -> None:
        super().__init__()
        self.begin()

    def begin(self) -> None:
        def make(session_configuration: SessionConfiguration) -> object:
            assert session_configuration.problem == "peg_in_hole_2d"
            return PROBLEM

        self.machine = Service(make, workers=2)  # type: ignore[arg-type]
        self.calls = 0

    def answer(self, payload: bytes) -> list[Reply]:
        self.calls += 1
        effects = self.machine.receive(self.calls, *received(payload), 0.0)
        replies = []
        while effects:
            effect = effects.pop(0)
            if isinstance(effect, StartJob):
                effects += self.machine.finished(effect.job, effect.job.run(), 0.0)
            elif isinstance(effect, SendReply):
                replies.append(decode_reply(effect.payload))
        return replies


def whole_world(launch: str = "on_failure", services: tuple[str, ...] = ("cloud",)) -> World:
    world = World(launch=launch, services=services)
    world.services = {name: WholeService() for name in world.services}
    world.services[LOCAL].up = False
    return world


def test_without_faults() -> None:
    world = whole_world()
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    cloud = world.services["cloud"]
    assert isinstance(cloud, WholeService)
    statistics = cloud.machine.statistics
    assert statistics.state_requests == 0
    assert statistics.restores == 0
    decisions = sum(result.sensing_decisions for result in world.results)
    assert decisions <= statistics.sensing_parts <= decisions + len(world.results)


@pytest.mark.parametrize("step", range(12))
@pytest.mark.parametrize("launch", ["on_failure", "at_start", "never"])
def test_killed_at_any_step_and_back_again(step: int, launch: str) -> None:
    world = whole_world(launch)

    def fault(performed: int) -> None:
        cloud = world.services["cloud"]
        assert isinstance(cloud, WholeService)
        if performed == step and not world.results and cloud.boot == 1:
            world.kill("cloud")
            cloud.begin()
            world.bring_up("cloud", 0.3)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    expected = [] if launch == "never" else ["local_recovery", "keep_alive"]
    assert world.statuses() == expected


def test_replicas_in_turn() -> None:
    world = whole_world(services=("first", "second"))

    def fault(performed: int) -> None:
        name = "first" if performed % 8 < 4 else "second"
        service = world.services[name]
        assert isinstance(service, WholeService)
        if performed % 4 == 2 and service.up:
            world.kill(name)
            service.begin()
            world.bring_up(name, 0.035)

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
