"""Requests in flight, and replies that are lost, damaged or wrong."""

import numpy as np
from tests.robot_world import World, nth

from holdfast.errors import StaleEpochError
from holdfast.planning.inputs import encode_floats
from holdfast.protocol.messages import (
    DIGEST_SIZE,
    NeedState,
    Refused,
    Reply,
    Request,
    SensingAnswer,
    TaskAnswer,
)


def test_a_stale_epoch_stops_the_robot() -> None:
    world = World()
    world.services["cloud"].rule = lambda r: (
        [Refused(r.number, "stale_epoch", "epoch 1, seen was 2")] if nth(r) == 3 else None
    )
    world.start_and_run()
    assert world.stopped is not None
    assert isinstance(world.stopped.error, StaleEpochError)


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
    world.complete()
    assert world.reports("malformed_reply")


def test_a_service_that_begins_otherwise_is_sent_the_state_and_not_asked_for_ever() -> None:
    world = World(launch="never")
    cloud = world.services["cloud"]

    def begins_otherwise(request: Request) -> list[Reply] | None:
        if request.checkpoint is None:
            return [NeedState(request.number, False)]
        return None

    cloud.rule = begins_otherwise
    world.complete()
    turns = sum(result.sensing_decisions for result in world.results) + len(world.results)
    assert len(world.sent) <= 3 * turns


def test_a_service_that_always_needs_the_state_is_given_up() -> None:
    world = World()
    world.services["cloud"].rule = lambda r: [NeedState(r.number, True)]
    world.complete()
    assert world.statuses() == ["local_recovery"]
    assert len([sent for sent in world.sent if sent.service == "cloud"]) < 20


def test_a_service_that_is_silent_for_ever_has_few_open_calls() -> None:
    world = World()
    most = 0

    def fault(performed: int) -> None:
        nonlocal most
        world.services["cloud"].stopped = bool(world.results) or performed >= 4
        most = max(most, list(world.calls.values()).count("cloud"))

    world.on_act = fault
    world.complete()
    assert most == 4


def test_a_state_that_came_out_otherwise_is_told() -> None:
    world = World()
    told: list[Request] = []

    def rule(request: Request) -> list[Reply] | None:
        if request.checkpoint is None and request.step > 0 and not told:
            told.append(request)
            return [NeedState(request.number, True, diverged=True)]
        return None

    world.services["cloud"].rule = rule
    world.complete()
    (fields,) = world.reports("state_diverged")
    assert (fields["service"], fields["step"]) == ("cloud", told[0].step)
