"""The contract of every wire, over ROS 1; and what only a master and its death can show."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import signal
import struct
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from tests.contracts import test_transport_contract as contract
from tests.contracts.wires import (
    LEASE_MS,
    Inbox,
    Received,
    Start,
    StreamWire,
    answered,
    connected,
    echo,
    service_process,
    until,
)
from tests.ports import free_port
from tests.ros.ros1_processes import HOLDFAST, Ros1, ros1_in, wait_for

from holdfast.errors import TransportError
from holdfast.protocol.events import CallEnded, ReplyReceived, ServiceAppeared, ServiceVanished
from holdfast.transport.ros1 import EXCHANGE
from holdfast.transport.service_end import StreamServiceTransport
from holdfast.transport.tcpros import encode_header

TestEveryWire = contract.TestEveryWire
_OF_PROCESSES = contract.TestProcesses


class RosWire(StreamWire):
    """Every service is where the master says that it is."""

    def endpoint(self, name: str) -> str:
        return f"ros1/{name}"


@pytest.fixture(scope="module")
def around(ros1: Mapping[str, str], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros1]:
    yield from ros1_in(ros1, tmp_path_factory.mktemp("ros1"))


@pytest.fixture
def wire(around: Ros1, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RosWire:
    for name in ("ROS_MASTER_URI", "ROS_HOSTNAME"):
        monkeypatch.setenv(name, around.environment[name])
    return RosWire("ros1", tmp_path)


class TestProcesses:
    """What happens to the service's process."""

    @pytest.fixture
    def start(self, wire: RosWire) -> Start:
        wire.lease_ms = LEASE_MS
        return lambda incarnation: service_process(wire.endpoint("cloud"), incarnation)

    test_kill = _OF_PROCESSES.test_kill_in_mid_call_ends_the_call_and_the_next_process_is_seen
    test_stop = _OF_PROCESSES.test_a_stopped_process_is_lost_after_the_lease_and_found_again
    test_large = _OF_PROCESSES.test_a_large_request_to_a_stopped_process_ends_and_holds_nobody_up
    test_go_on = _OF_PROCESSES.test_a_service_that_goes_on_just_when_it_was_given_up_answers_again


def test_the_tools_of_ros_know_the_service(around: Ros1, wire: RosWire) -> None:
    async def ask() -> None:
        await connected(wire)
        loop = asyncio.get_running_loop()
        assert EXCHANGE.name in await loop.run_in_executor(
            None, around.run, "rosservice", "info", "/cloud/exchange"
        )
        assert "cloud/exchange_node" in await loop.run_in_executor(
            None, around.run, "rosnode", "list"
        )
        await wire.close_on_loop()

    asyncio.run(ask())
    assert around.service_uri("cloud/exchange") is None
    assert around.run("rossrv", "md5", EXCHANGE.name).strip() == EXCHANGE.digest


async def test_links_outlive_the_master_and_come_back_without_one(
    around: Ros1, wire: RosWire
) -> None:
    calls = Received()
    robot, inbox, _ = await connected(wire, calls)
    assert around.master is not None
    around.master.kill()
    around.master.wait()
    try:
        robot.call("cloud", 1, b"question")
        echo(await calls.next())
        assert await inbox.of_call(1) == [ReplyReceived(1, b"question"), CallEnded(1)]
        # A link that breaks is made anew, to where the service was last.
        robot._services["cloud"].current.end("broken by the test", abort=True)  # type: ignore[attr-defined]
        await inbox.wait_for(ServiceVanished("cloud", "b1"))
        await inbox.appeared(times=2)
        robot.call("cloud", 2, b"question")
        echo(await calls.next())
        assert await inbox.of_call(2) == [ReplyReceived(2, b"question"), CallEnded(2)]
    finally:
        around.start_master()
    await until(lambda: around.service_uri("cloud/exchange") is not None)


async def test_a_robot_is_told_why_it_finds_nobody(around: Ros1, wire: RosWire) -> None:
    robot, inbox = wire.robot("cloud"), Inbox()
    robot.start(inbox)
    await until(lambda: bool(wire.refusals))
    assert "the ROS master does not say where it is" in wire.refusals[0][1]
    await wire.service("cloud", "b1").start(echo)
    await inbox.wait_for(ServiceAppeared("cloud", "b1"))


async def test_a_service_that_is_started_again_is_found_at_its_new_port(
    around: Ros1, wire: RosWire
) -> None:
    robot, inbox = wire.robot("cloud"), Inbox()
    robot.start(inbox)
    numbers = itertools.count()
    for times in (1, 2, 3):
        async with service_process(wire.endpoint("cloud"), f"b{times}") as process:
            await inbox.appeared(times=times)
            assert await answered(robot, inbox, numbers)
            process.send_signal(signal.SIGKILL)
            await inbox.wait_for(ServiceVanished("cloud", f"b{times}"))


async def opened(around: Ros1, wire: RosWire) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Return a connection to the service that is open, as a robot's is before its first frame."""
    await wire.service("cloud", "b1").start(echo)
    uri = around.service_uri("cloud/exchange")
    assert uri is not None
    host, _, port = uri.removeprefix("rosrpc://").rpartition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(encode_header({"service": "/cloud/exchange", "md5sum": EXCHANGE.digest}))
    await reader.readexactly(int.from_bytes(await reader.readexactly(4), "little"))
    return reader, writer


async def test_requests_without_bytes_and_without_end_are_refused(
    around: Ros1, wire: RosWire
) -> None:
    reader, writer = await opened(around, wire)
    writer.write(struct.pack("<II", 4, 0) * 100_000)
    with contextlib.suppress(ConnectionError):
        assert await reader.read() == b""  # none of them was answered
    writer.close()
    assert "sends requests without bytes while 2 wait" in wire.reasons()


class TestTwoOfOneName:
    def serve(self, around: Ros1) -> subprocess.Popen[str]:
        before = around.service_uri("two/exchange")
        process = around.start(
            *(HOLDFAST, "serve", "--insecure", "--listen", "ros1/two"),
            stderr=subprocess.PIPE,
            text=True,
        )
        wait_for(
            lambda: around.service_uri("two/exchange") not in (None, before), "it is registered"
        )
        return process

    def test_rosnode_kill_ends_it(self, around: Ros1) -> None:
        process = self.serve(around)
        around.run("rosnode", "kill", "/two/exchange_node")
        _, log = process.communicate(timeout=60.0)
        assert process.returncode == 0
        assert "asked to by ROS (user request)" in log
        assert around.service_uri("two/exchange") is None

    def test_the_later_one_has_the_name_and_the_earlier_one_ends(self, around: Ros1) -> None:
        first, second = (self.serve(around) for _ in range(2))
        assert first.wait(60.0) == 0
        uri = around.service_uri("two/exchange")
        assert uri is not None
        assert second.poll() is None
        second.terminate()
        assert second.wait(60.0) == 0


async def test_a_name_that_a_dead_process_has_taken_is_taken_back(
    around: Ros1, wire: RosWire
) -> None:
    await wire.service("cloud", "b1").start(echo)
    own = around.service_uri("cloud/exchange")
    dead = f"rosrpc://127.0.0.1:{free_port()}"
    node = f"http://127.0.0.1:{free_port()}/"
    around.ask("registerService", "/cloud/exchange", dead, node, caller="/other")
    assert around.service_uri("cloud/exchange") == dead
    await until(lambda: around.service_uri("cloud/exchange") == own)


@pytest.mark.parametrize("name", ["", "a b", "/", "a//b", "7up", "x" * 201])
def test_names_that_ros_does_not_allow_are_refused(name: str) -> None:
    with pytest.raises(TransportError, match="is no name in ROS 1"):
        StreamServiceTransport("cloud", incarnation="b", listen=[f"ros1/{name}"])


def test_a_robot_cannot_listen_over_ros_1() -> None:
    with pytest.raises(TransportError, match="it is the service that is offered"):
        StreamServiceTransport("cloud", incarnation="b", connect=["ros1/robot"])
