"""Faults drawn by seed against both machines: whatever happens, the decisions stay the same."""

from __future__ import annotations

import random

import pytest
from tests.robot_world import LOCAL, World
from tests.unit.test_protocol_pair import WholeService

from holdfast.protocol.events import RobotEffect
from holdfast.protocol.messages import Reply


class UnreliableWorld(World):
    """Services are killed, stopped and slow; requests and replies are lost, doubled and late."""

    def __init__(self, seed: int) -> None:
        draw = random.Random(seed)
        services = ("first", "second")[: draw.randint(1, 2)]
        super().__init__(
            services=services,
            launch=draw.choice(["on_failure", "at_start", "never"]),
            deadline_ms=draw.choice([None, 15.0]),
            rate_hz=draw.choice([None, 100.0]),
        )
        self.draw = draw
        self.services = {name: WholeService() for name in (*services, LOCAL)}
        self.services[LOCAL].up = False
        self.loss = draw.choice([0.0, 0.02, 0.2])
        self.doubling = draw.choice([0.0, 0.1])
        self.faults = draw.randint(0, 6)

    def begin_faults(self) -> None:
        for _ in range(self.faults):
            at = self.draw.uniform(0.0, 1.2)
            name = self.draw.choice(list(self.services))
            if name == LOCAL or self.draw.random() < 0.6:
                self.after(at, lambda name=name: self.crash(name))  # type: ignore[misc]
            else:
                self.after(at, lambda name=name: self.stop(name))  # type: ignore[misc]

    def crash(self, name: str) -> list[RobotEffect]:
        service = self.services[name]
        assert isinstance(service, WholeService)
        if service.up:
            self.kill(name, self.draw.uniform(0.001, 0.4))
            service.begin()
            if name != LOCAL:
                self.bring_up(name, self.draw.uniform(0.4, 1.0))
        return []

    def stop(self, name: str) -> list[RobotEffect]:
        service = self.services[name]
        service.stopped = True
        service.latency_s = self.draw.choice([0.001, 0.03])

        def go_on() -> list[RobotEffect]:
            service.stopped = False
            return []

        self.after(self.draw.uniform(0.01, 1.0), go_on)
        return []

    def reply(self, call: int, reply: Reply) -> list[RobotEffect]:
        if self.draw.random() < self.loss:
            return []
        if self.draw.random() < self.doubling:
            self.after(self.draw.uniform(0.0, 0.05), lambda: World.reply(self, call, reply))
        return super().reply(call, reply)


@pytest.mark.parametrize("seed", range(60))
def test_whatever_happens_the_decisions_are_the_same(seed: int) -> None:
    world = UnreliableWorld(seed)
    world.start()
    world.begin_faults()
    world.run(until_s=300.0)
    assert world.stopped is None
    world.assert_same_as_without_faults()
