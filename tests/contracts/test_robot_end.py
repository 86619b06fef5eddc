"""The robot's end: why a service is unreachable, early handshakes, and stalls of the process."""

import asyncio
import contextlib
import functools
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from tests.contracts.wires import (
    PATIENCE_S,
    Inbox,
    StreamWire,
    Visitor,
    answers,
    connected,
    echo,
    joined,
    service_process,
    until,
)
from tests.process_states import stop

from holdfast.protocol.robot_events import CallEnded, ServiceAppeared, ServiceVanished
from holdfast.transport import dialer as dialer_module
from holdfast.transport import links
from holdfast.transport.dialer import Dialer
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.key_ring import make_credentials
from holdfast.transport.service_end import StreamServiceTransport
from holdfast.transport.tls import server_context


class TestUnreachable:
    """A robot reports why it cannot reach a service."""

    @staticmethod
    async def reason(wire: StreamWire) -> str:
        """Return the first reason why a robot does not reach its service."""
        wire.robot("cloud").start(Inbox())
        await until(lambda: bool(wire.refusals))
        service, reason = wire.refusals[0]
        assert service == "cloud"
        return reason

    @staticmethod
    @contextlib.asynccontextmanager
    async def listening(
        wire: StreamWire, answer: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Any]
    ) -> AsyncIterator[None]:
        """Put something there that is no service."""

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await answer(reader, writer)
            writer.close()

        port = int(wire.endpoint("cloud").rpartition(":")[2])
        async with await asyncio.start_server(serve, "127.0.0.1", port):
            yield

    @pytest.mark.parametrize(
        ("protocol", "reason"),
        [
            ("tcp", "connection refused"),
            ("tls", "connection refused"),
            ("udp", "connection refused"),
            ("unix", "no such file or directory"),
        ],
    )
    async def test_nobody_listens_which_is_told_once_in_each_absence(
        self, wire_of: Callable[[str], StreamWire], protocol: str, reason: str
    ) -> None:
        wire = wire_of(protocol)
        robot, inbox = wire.robot("cloud"), Inbox()
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(wire.close_on_loop)
            robot.start(inbox)
            await until(lambda: bool(wire.refusals))
            dialer = robot._services["cloud"]._dialer
            assert dialer is not None
            turn = dialer._next_address
            await until(lambda: dialer._next_address > turn + 3)
            assert wire.refusals == [("cloud", reason)]
            service = wire.service("cloud", "b1")
            await service.start(echo)
            await inbox.wait_for(ServiceAppeared("cloud", "b1"))
            await service.close()
            await until(lambda: len(wire.refusals) == 2)
            assert wire.refusals[1] == ("cloud", reason)

    async def test_a_name_that_nobody_has(self, tcp: StreamWire) -> None:
        # No server need be asked to know that there is no such network interface.
        host = "fe80::1%absent"
        tcp._endpoints["cloud"] = f"tcp/[{host}]:7447"
        assert await self.reason(tcp) == f"host name not found: {host}"

    async def test_of_a_host_one_of_whose_addresses_answers_nothing_is_told(
        self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        port = int(tcp.endpoint("cloud").rpartition(":")[2])
        found = [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", (host, port))
            for host in ("127.0.0.2", "127.0.0.1")
        ]
        await tcp.service("cloud", "b1").start(echo)
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
        monkeypatch.setattr(Dialer, "_rank_of", lambda *_: b"")  # in this order
        tcp._endpoints["cloud"] = f"tcp/robot.example:{port}"
        robot, inbox = tcp.robot("cloud"), Inbox()
        robot.start(inbox)
        await inbox.appeared()
        dialer = robot._services["cloud"]._dialer
        assert dialer is not None
        assert dialer._next_address >= 2
        assert tcp.refusals == []

    async def test_nothing_answers(self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(dialer_module, "_CONNECT_TIMEOUT_S", 0.2)
        place = tcp.endpoint("cloud")
        with contextlib.ExitStack() as stack:
            address = ("127.0.0.1", int(place.rpartition(":")[2]))
            stack.enter_context(socket.create_server(address, backlog=0))
            for _ in range(4):  # they fill its queue
                stack.enter_context(Visitor(place)).socket.connect_ex(address)
            assert await self.reason(tcp) == "nothing answers"

    async def test_it_closes_each_connection(self, tcp: StreamWire) -> None:
        async with self.listening(tcp, lambda *_: asyncio.sleep(0)):
            assert (await self.reason(tcp)).startswith("closes connections without a hello")

    async def test_it_says_nothing(self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(links, "OPENING_TIMEOUT_S", 0.2)
        async with self.listening(tcp, lambda reader, _: reader.read()):
            assert await self.reason(tcp) == "has said no hello within 0.2 s"

    async def test_it_does_not_speak_tls(self, tls: StreamWire) -> None:
        async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b"SSH-2.0-anything\r\n")
            await reader.read()

        async with self.listening(tls, answer):
            assert (await self.reason(tls)).startswith("does not speak TLS 1.3 as expected")

    @pytest.mark.parametrize(
        ("at", "asked", "expected"),
        [
            ("tls", "tcp", "refuses this end, which does not speak TLS; as at that end, write tls"),
            (
                "tcp",
                "tls",
                "closes connections at the first bytes of TLS: it is at tcp/... instead",
            ),
        ],
    )
    async def test_a_service_at_another_kind_of_endpoint(
        self, tcp: StreamWire, tls: StreamWire, at: str, asked: str, expected: str
    ) -> None:
        wires = {"tcp": tcp, "tls": tls}
        await wires[at].service("cloud", "b1").start(echo)
        place = wires[at].endpoint("cloud").partition("/")[2]
        wires[asked]._endpoints["cloud"] = f"{asked}/{place}"
        assert (await self.reason(wires[asked])).startswith(expected)


class TestHandshakeIsEnough:
    """Over TLS a robot that knows the service asks it before that has said hello."""

    @staticmethod
    async def mute_service(
        wire: StreamWire, incarnation: str, heard: list[bytes]
    ) -> asyncio.Server:
        """Serve TLS, take note of what comes, and say nothing."""

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while data := await reader.read(65536):
                heard.append(data)
            writer.close()

        assert wire.service_tls is not None
        host, _, port = wire.endpoint("cloud").removeprefix("tls/").rpartition(":")
        context = server_context(wire.service_tls, incarnation)
        return await asyncio.start_server(serve, host, int(port), ssl=context)

    @pytest.mark.parametrize("incarnation", ["b1", "b2"])
    async def test_the_first_question_does_not_wait_for_the_hello(
        self, tls: StreamWire, incarnation: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(links, "OPENING_TIMEOUT_S", 1.0)
        robot, inbox, service = await connected(tls)
        await service.close()
        await inbox.wait_for(ServiceVanished("cloud", "b1", "said goodbye"))
        heard: list[bytes] = []
        async with await self.mute_service(tls, incarnation, heard):
            reported = await inbox.appeared(times=2)
            # The handshake says whether it is the process that was there before.
            assert (reported == "b1") is (incarnation == "b1")
            robot.call("cloud", 1, b"question")
            await until(lambda: b"question" in b"".join(heard))
            # It never says hello: that is no service, and is not believed again.
            why = "has said no hello within 1 s"
            await inbox.wait_for(ServiceVanished("cloud", reported, why), CallEnded(1))
            heard.clear()
            await until(lambda: len(heard) > 0)
            assert len(inbox.incarnations()) == 2
        await tls.service("cloud", "b3").start(echo)
        assert await inbox.appeared(times=3) == "b3"
        await robot.close()

    async def test_a_process_keeps_the_name_by_which_it_appeared(self, tls: StreamWire) -> None:
        robot, inbox, service = await connected(tls)
        await service.close()
        second = tls.service("cloud", "b2")
        assert isinstance(second, StreamServiceTransport)
        await second.start(echo)
        incarnation = await inbox.appeared(times=2)
        await answers(robot, inbox, 1)
        assert second.end_links(lambda _: "is sent away") == 1
        assert await inbox.appeared(times=3) == incarnation
        assert incarnation != "b1"

    async def test_a_robot_that_is_refused_does_not_see_the_service_come_and_go(
        self, tls: StreamWire, tmp_path: Path
    ) -> None:
        _, inbox, service = await connected(tls)
        await service.close()
        # It has our certificate, but believes another authority: it refuses the robot's.
        assert tls.service_tls is not None
        make_credentials(tmp_path / "foreign")
        ours = tls.service_tls
        tls.service_tls = TlsFiles(
            tmp_path / "foreign" / "service" / "authority.pem", ours.certificate, ours.key
        )
        await tls.service("cloud", "b2").start(echo)
        await until(lambda: len(tls.reasons()) >= 3)
        assert len(inbox.incarnations()) <= 2
        await inbox.wait(lambda events: sum(isinstance(e, ServiceVanished) for e in events) >= 1)


async def test_what_came_while_a_robot_stood_still_is_read_before_anybody_is_given_up(
    tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stands still just when it has looked at its sockets, and before it looks at the time."""
    selector = asyncio.get_running_loop()._selector  # type: ignore[attr-defined]
    look = selector.select
    still_s = [0.0]

    def select(timeout: float | None = None) -> object:
        found = look(timeout)
        if not found:
            time.sleep(still_s[0])
            still_s[0] = 0.0
        return found

    async with service_process(tcp.endpoint("cloud"), "b1", lease_ms=1000.0):
        robot, inbox = await joined(tcp)
        monkeypatch.setattr(selector, "select", select)
        for number in range(2):
            still_s[0] = 1.5
            await until(lambda: still_s[0] == 0.0)
            await answers(robot, inbox, number, b"echo")
        assert not any(isinstance(each, ServiceVanished) for each in inbox.events)


ROBOT_THAT_ENDS = """
import asyncio, sys
from holdfast.protocol.robot_events import ServiceAppeared
from holdfast.transport.robot_end import StreamRobotTransport

async def main():
    robot = StreamRobotTransport({"cloud": sys.argv[1]})
    seen = asyncio.Event()

    def deliver(event):
        if isinstance(event, ServiceAppeared):
            seen.set()

    robot.start(deliver)
    await asyncio.wait_for(seen.wait(), 30)
    for number in range(20):
        robot.call("cloud", number, b"stream")
    robot.call("cloud", 20, bytes(4_000_000))
    print("calling", flush=True)
    await asyncio.sleep(float(sys.argv[3]))
    if sys.argv[2] == "close":
        await robot.close(0.2)

asyncio.run(main())
"""


@pytest.mark.parametrize("manner", ["close", "leave"])
@pytest.mark.parametrize(("stopped", "after_s"), [(False, 0.1), (True, 0.1), (True, 0.7)])
@pytest.mark.slow
async def test_a_process_ends_quietly_whatever_its_links_do(
    tcp: StreamWire, manner: str, stopped: bool, after_s: float
) -> None:
    """With replies coming in, with or without ``close``, with a peer that has stopped."""
    endpoint = tcp.endpoint("cloud")
    loop = asyncio.get_running_loop()
    async with service_process(endpoint, "b1", lease_ms=400.0) as service:
        robot = subprocess.Popen(
            [sys.executable, "-c", ROBOT_THAT_ENDS, endpoint, manner, str(after_s)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            assert robot.stdout is not None
            assert await loop.run_in_executor(None, robot.stdout.readline) == b"calling\n"
            if stopped:
                stop(service.pid)
            communicate = functools.partial(robot.communicate, timeout=PATIENCE_S)
            _, errors = await loop.run_in_executor(None, communicate)
        finally:
            robot.kill()
            robot.communicate()
        assert (robot.returncode, errors) == (0, b"")
