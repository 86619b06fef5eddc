"""The contract of every wire, over ROS 1; and what only a master and its death can show."""

from __future__ import annotations

import asyncio
import itertools
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest
from tests.contracts import test_transport as contract
from tests.contracts.test_transport import (
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
from tests.ros.ros1_processes import Ros1, ros1_in

from holdfast.errors import TransportError
from holdfast.session.events import Appeared, Ended, Replied, Vanished
from holdfast.transport.ros1 import EXCHANGE
from holdfast.transport.service_end import StreamServiceTransport

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
        return lambda boot: service_process(wire.endpoint("cloud"), boot)

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
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]
        # A link that breaks is made anew, to where the service was last.
        robot._services["cloud"].current.end("broken by the test", abort=True)  # type: ignore[attr-defined]
        await inbox.wait_for(Vanished("cloud", "b1"))
        await inbox.appeared(times=2)
        robot.call("cloud", 2, b"question")
        echo(await calls.next())
        assert await inbox.of_call(2) == [Replied(2, b"question"), Ended(2)]
    finally:
        around.start_master()
    await until(lambda: around.service_uri("cloud/exchange") is not None)


async def test_a_robot_is_told_why_it_finds_nobody(around: Ros1, wire: RosWire) -> None:
    robot, inbox = wire.robot("cloud"), Inbox()
    robot.start(inbox)
    await until(lambda: bool(wire.refusals))
    assert "the ROS master does not say where it is" in wire.refusals[0][1]
    await wire.service("cloud", "b1").start(echo)
    await inbox.wait_for(Appeared("cloud", "b1"))


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
            await inbox.wait_for(Vanished("cloud", f"b{times}"))


@pytest.mark.parametrize("name", ["", "a b", "/", "a//b", "7up", "x" * 201])
def test_names_that_ros_does_not_allow_are_refused(name: str) -> None:
    with pytest.raises(TransportError, match="is no name in ROS 1"):
        StreamServiceTransport("cloud", boot="b", listen=[f"ros1/{name}"])


def test_a_robot_cannot_listen_over_ros_1() -> None:
    with pytest.raises(TransportError, match="it is the service that is offered"):
        StreamServiceTransport("cloud", boot="b", connect=["ros1/robot"])
