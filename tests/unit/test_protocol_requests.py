"""Requests in flight, and replies that are lost, damaged or wrong."""

from __future__ import annotations

import numpy as np
import pytest
from tests.robot_world import (
    World,
    nth,
)

from holdfast.errors import StaleEpochError
from holdfast.protocol.events import (
    Abandon,
    RobotEffect,
)
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    NeedState,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    TaskAnswer,
    encode_floats,
)


def test_a_lost_reply_is_asked_for_again() -> None:
    world = World(launch="never")
    cloud = world.services["cloud"]
    dropped = 0

    def lose_some(request: Request) -> list[Reply] | None:
        nonlocal dropped
        if nth(request) in (2, 3, 7):
            dropped += 1
            return []
        return None

    cloud.rule = lose_some
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert dropped == 3


@pytest.mark.parametrize("damaged", [1, 2, 5])
def test_a_damaged_reply_is_asked_for_again_and_nobody_is_blamed(damaged: int) -> None:
    """The line has flipped a bit: the service is as good as before, and is asked again at once."""
    world = World()
    spoilt: list[tuple[float, int]] = []

    def flip_a_bit(call: int, payload: bytes) -> bytes:
        if len(spoilt) == 0 and len(world.sent) == damaged:
            spoilt.append((world.now, call))
            return payload[:-9] + bytes([payload[-9] ^ 16]) + payload[-8:]
        return payload

    world.on_the_way = flip_a_bit
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    ((at, call),) = spoilt
    (told,) = world.reports("malformed_reply")
    assert told["service"] == "cloud"
    # What else comes in that call is not to be believed, nor is its end news of the service.
    assert (at, Abandon(call)) in world.trace
    asked, again = world.sent[damaged - 1 : damaged + 1]
    assert again.service == "cloud"
    assert (again.request.digest, again.request.step) == (asked.request.digest, asked.request.step)
    assert at < again.at <= at + 0.021
    assert world.reports("service_suspected") == []
    assert world.statuses() == []


def test_swallowed_requests_are_sent_again_after_the_timeout() -> None:
    world = World(launch="never")
    cloud = world.services["cloud"]

    def fault(performed: int) -> None:
        cloud.stopped = performed == 3 and not world.results
        if cloud.stopped:
            world.after(2.0, wake_up)

    def wake_up() -> list[RobotEffect]:
        cloud.stopped = False
        return []

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()


def test_a_service_that_lost_the_session_is_handed_the_state() -> None:
    world = World()
    cloud = world.services["cloud"]

    def fault(performed: int) -> None:
        if performed in (5, 6):
            cloud.states.clear()

    world.on_act = fault
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == []
    assert any(request.checkpoint is not None for request in cloud.requests)


def test_a_stale_epoch_stops_the_robot() -> None:
    world = World()
    world.services["cloud"].rule = lambda r: (
        [Refused(r.number, "stale_epoch", "epoch 1, seen was 2")] if nth(r) == 3 else None
    )
    world.start()
    world.run()
    assert world.stopped is not None
    assert isinstance(world.stopped.error, StaleEpochError)


@pytest.mark.parametrize("number", range(1, 8))
def test_a_reply_to_another_request_is_not_taken(number: int) -> None:
    world = World()
    cloud = world.services["cloud"]

    def confuse(request: Request) -> list[Reply] | None:
        if nth(request) != number:
            return None
        return [TaskAnswer(request.number + 1, 4, bytes(8 * 12), 1)]

    cloud.rule = confuse
    world.start()
    world.run()
    world.assert_same_as_without_faults()


def test_wrong_answers_are_refused() -> None:
    world = World()
    cloud = world.services["cloud"]

    def lie(request: Request) -> list[Reply] | None:
        lies: dict[int, Reply] = {
            2: TaskAnswer(request.number, 3, bytes(8 * 9), 1),
            4: TaskAnswer(request.number, 4, encode_floats([np.nan] * 12), 1),
            6: SensingAnswer(request.number, 8, 17, b"d" * DIGEST_SIZE, 1),
            8: SensingAnswer(request.number, 1, 0, b"d" * DIGEST_SIZE, 1),
        }
        return [lies[nth(request)]] if nth(request) in lies else None

    cloud.rule = lie
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.reports("malformed_reply")


def test_a_service_that_begins_otherwise_is_sent_the_state_and_not_asked_for_ever() -> None:
    world = World(launch="never")
    cloud = world.services["cloud"]

    def begins_otherwise(request: Request) -> list[Reply] | None:
        if request.checkpoint is None:
            return [NeedState(request.number, False)]
        return None

    cloud.rule = begins_otherwise
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    turns = sum(result.sensing_decisions for result in world.results) + len(world.results)
    assert len(world.sent) <= 3 * turns


def test_a_service_that_always_needs_the_state_is_given_up() -> None:
    world = World()
    world.services["cloud"].rule = lambda r: [NeedState(r.number, True)]
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    assert world.statuses() == ["local_recovery"]
    assert len([sent for sent in world.sent if sent.service == "cloud"]) < 20


def test_a_state_that_came_out_otherwise_is_told() -> None:
    world = World()
    told: list[Request] = []

    def rule(request: Request) -> list[Reply] | None:
        if request.checkpoint is None and request.step > 0 and not told:
            told.append(request)
            return [NeedState(request.number, True, diverged=True)]
        return None

    world.services["cloud"].rule = rule
    world.start()
    world.run()
    world.assert_same_as_without_faults()
    (fields,) = world.reports("state_diverged")
    assert (fields["service"], fields["step"]) == ("cloud", told[0].step)
