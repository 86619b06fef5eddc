"""Links over ROS 1: frames as requests and answers, over a pair of sockets, without a master."""

from __future__ import annotations

import asyncio
import socket
from functools import partial

import pytest

from holdfast.transport.endpoints import Endpoint, Role
from holdfast.transport.frames import CALL, LAST, Frame, Hello, encode_hello
from holdfast.transport.link_settings import LinkSettings
from holdfast.transport.links import Link, LinkOwner
from holdfast.transport.ros1 import RosScheme, exchange_name

HERE = Endpoint("ros1", "cloud", 0)


class End(LinkOwner):
    """One end: a link, and what was heard on it."""

    def __init__(self, role: Role, endpoint: Endpoint = HERE) -> None:
        settings = LinkSettings(
            partial(encode_hello, role, "name", "i1", 30_000.0),
            30_000.0,
            1_000_000,
            pauses_for_readers=role == "service",
        )
        self.frames: asyncio.Queue[Frame] = asyncio.Queue()
        self.hello: asyncio.Future[Hello] = asyncio.get_running_loop().create_future()
        self.ended: asyncio.Future[str] = asyncio.get_running_loop().create_future()
        self.link = RosScheme().make_link(self, settings, endpoint, None, role=role, dialled=True)

    def refusal(self, link: Link, hello: Hello) -> str | None:
        return None

    def on_hello(self, link: Link, hello: Hello) -> None:
        self.hello.set_result(hello)

    def on_frame(self, link: Link, frame: Frame) -> None:
        self.frames.put_nowait(frame)

    def on_ended(self, link: Link) -> None:
        self.ended.set_result(link.reason)


async def joined(robot: End, service: End) -> None:
    ours, theirs = socket.socketpair()
    for end, stream in ((robot, ours), (service, theirs)):
        stream.setblocking(False)
        await end.link.connect(stream)


@pytest.fixture(autouse=True)
def environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_HOSTNAME", "127.0.0.1")
    monkeypatch.delenv("ROS_NAMESPACE", raising=False)


async def test_requests_and_replies_of_any_size_and_both_ends_part() -> None:
    robot, service = End("robot"), End("service")
    await joined(robot, service)
    assert (await robot.hello).role == "service"
    assert (await service.hello).role == "robot"
    for call, size in enumerate((0, 1, 300_000)):
        robot.link.send_message(CALL, call, bytes(size))
        assert await service.frames.get() == Frame(CALL, call, bytes(size))
        service.link.send_message(LAST, call, bytes(2 * size))
        assert await robot.frames.get() == Frame(LAST, call, bytes(2 * size))
    service.link.end("", goodbye="ends")
    assert "ends" in await robot.ended
    await service.ended


async def test_another_service_is_refused_by_name() -> None:
    robot, service = End("robot", Endpoint("ros1", "moon", 0)), End("service")
    await joined(robot, service)
    assert "only the service /cloud/exchange is here" in await robot.ended
    assert "only the service /cloud/exchange is here" in await service.ended


def test_names_are_resolved_as_ros_does(monkeypatch: pytest.MonkeyPatch) -> None:
    assert exchange_name(HERE) == "/cloud/exchange"
    monkeypatch.setenv("ROS_NAMESPACE", "lab")
    assert exchange_name(HERE) == "/lab/cloud/exchange"


def test_a_service_listens_where_ros_says_and_keeps_its_name() -> None:
    scheme = RosScheme()
    listening = scheme.listening_endpoint(HERE)
    assert listening == Endpoint("tcp", "127.0.0.1", 0)
    assert scheme.bound_endpoint(HERE, listening._replace(port=7)) == HERE
