"""What is reported while the robot stands still."""

from __future__ import annotations

from tests.robot_world import (
    World,
    answer_third_slowly,
)


def test_a_long_wait_is_told_although_the_service_shows_life() -> None:
    world = World()
    answer_third_slowly(world.services["cloud"], num_signs=20)
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    (told,) = world.reports("waiting")
    assert told["service"] == "cloud"
    assert float(str(told["waited_ms"])) >= 1000.0
