"""The transport without a wire: what it does otherwise than the others."""

from __future__ import annotations

import asyncio

import pytest

from holdfast.errors import InvalidValueError, TransportError
from holdfast.protocol.events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.transport.contract import IncomingCall
from holdfast_lab.testbed.in_process import InProcessNetwork


async def turns(number: int = 5) -> None:
    for _ in range(number):
        await asyncio.sleep(0)


async def test_the_service_that_started_last_is_called() -> None:
    network, events = InProcessNetwork(), list[TransportEvent]()
    calls: list[tuple[str, IncomingCall]] = []
    for name in ("i1", "i2"):
        service = network.service("cloud", name)
        await service.start(lambda call, name=name: calls.append((name, call)))  # type: ignore[misc]
    robot = network.robot(["cloud"])
    robot.start(events.append)
    robot.call("cloud", 1, b"request")
    await turns()
    assert events == [ServiceAppeared("cloud", "i1"), ServiceAppeared("cloud", "i2")]
    ((name, call),) = calls
    assert (name, call.payload, call.robot) == ("i2", b"request", None)
    call.reply(b"reply")
    call.end()
    await turns()
    assert events[2:] == [ReplyReceived(1, b"reply"), CallEnded(1)]


async def test_nothing_is_delivered_from_inside_a_method() -> None:
    network, events = InProcessNetwork(), list[TransportEvent]()
    robot = network.robot(["cloud"])
    robot.start(events.append)
    robot.call("cloud", 1, b"to nobody")
    assert events == []
    service = network.service("cloud", "i1", robot="anna")
    calls: list[IncomingCall] = []
    await service.start(calls.append)
    await turns()
    robot.call("cloud", 2, b"request")
    await turns()
    assert calls[0].robot == "anna"
    await service.close()
    assert events == [CallEnded(1), ServiceAppeared("cloud", "i1")]
    await turns()
    assert events[2:] == [ServiceVanished("cloud", "i1"), CallEnded(2)]


async def test_a_dismissed_service_is_seen_by_no_new_robot() -> None:
    network, events = InProcessNetwork(), list[TransportEvent]()
    service = network.service("cloud", "i1")
    await service.start(lambda call: call.end())
    assert service.dismiss().done()
    network.robot(["cloud"]).start(events.append)
    await turns()
    assert events == []


async def test_names_and_starts_are_checked() -> None:
    network = InProcessNetwork()
    with pytest.raises(InvalidValueError, match=r"service 'moon': known are \['cloud'\]"):
        network.robot(["cloud"]).call("moon", 1, b"")
    service = network.service("cloud", "i1")
    await service.start(lambda call: call.end())
    with pytest.raises(TransportError, match="was started before"):
        await service.start(lambda call: call.end())
