"""The dialer: several addresses of a name, and when it connects again."""

import asyncio
import contextlib
import itertools
import random
import socket
from collections import Counter
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest
from tests.contracts.wires import (
    PATIENCE_S,
    Inbox,
    Received,
    Serve,
    StreamWire,
    answers,
    echo,
    until,
)

from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
)
from holdfast.transport import dialer, frames
from holdfast.transport.dialer import Dialer, RetryPauses
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.service_end import StreamServiceTransport


class Replicas:
    """Several services at one name, each at an address of its own."""

    def __init__(self, wire: StreamWire, count: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wire = wire
        self.port = int(wire.endpoint("cloud").rpartition(":")[2])
        self.hosts = [f"127.0.0.{number}" for number in range(1, count + 1)]
        self.running: dict[str, StreamServiceTransport] = {}
        self._look_up_really = socket.getaddrinfo
        monkeypatch.setattr(socket, "getaddrinfo", self._look_up)
        # The name in the certificates of these tests.
        wire._endpoints["cloud"] = f"{wire.protocol}/localhost:{self.port}"

    def _look_up(self, host: str, *arguments: Any, **others: Any) -> list[tuple[Any, ...]]:
        if host != "localhost":
            return self._look_up_really(host, *arguments, **others)
        return [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (h, self.port)) for h in self.hosts]

    async def start(self, host: str, serve: Serve = echo) -> StreamServiceTransport:
        service = StreamServiceTransport(
            "cloud",
            incarnation=f"at-{host}",
            listen=[f"{self.wire.protocol}/{host}:{self.port}"],
            tls=self.wire.service_tls,
            on_event=lambda event, **fields: self.wire.events.append((event, fields)),
        )
        await service.start(serve)
        self.wire.ends.append(service)
        self.running[f"at-{host}"] = service
        return service


class TestReplicas:
    @pytest.fixture(params=["tcp", "udp"])
    def wire(
        self, request: pytest.FixtureRequest, wire_of: Callable[[str], StreamWire]
    ) -> StreamWire:
        return wire_of(request.param)

    @pytest.fixture
    def replicas(self, wire: StreamWire, monkeypatch: pytest.MonkeyPatch) -> Replicas:
        return Replicas(wire, 3, monkeypatch)

    async def begun(
        self, wire: StreamWire, replicas: Replicas, count: int = 3
    ) -> tuple[Received, Any, Inbox, str]:
        calls = Received()
        for host in replicas.hosts[:count]:
            await replicas.start(host, calls)
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        return calls, robot, inbox, await inbox.appeared()

    async def test_one_that_is_about_to_end_is_left_before_it_is_missed(
        self, wire: StreamWire, replicas: Replicas
    ) -> None:
        calls, robot, inbox, first = await self.begun(wire, replicas)
        robot.call("cloud", 1, b"owed")
        owed = await calls.next()
        gone = replicas.running[first].dismiss()
        connected = [f for e, f in wire.events if e == "robot_connected"]
        await until(
            lambda: len([1 for e, _ in wire.events if e == "robot_connected"]) > len(connected)
        )
        echo(owed)
        assert await inbox.of_call(1) == [ReplyReceived(1, b"owed"), CallEnded(1)]
        second = await inbox.appeared(times=2)
        async with asyncio.timeout(PATIENCE_S):
            await gone
        assert second != first
        robot.call("cloud", 2, b"next")
        echo(await calls.next())
        assert await inbox.of_call(2) == [ReplyReceived(2, b"next"), CallEnded(2)]
        # The robot hears of the next process before the end of the previous one.
        kinds = [type(e) for e in inbox.events if isinstance(e, ServiceAppeared | ServiceVanished)]
        assert kinds[:2] == [ServiceAppeared, ServiceAppeared]
        ends = [reason for event, _, reason in wire.heard() if event == "robot_disconnected"]
        assert ends == ["said goodbye"]
        assert not wire.refusals

    async def test_a_question_asked_while_another_is_owed_goes_to_the_next(
        self, wire: StreamWire, replicas: Replicas
    ) -> None:
        calls, robot, inbox, first = await self.begun(wire, replicas, 2)
        robot.call("cloud", 1, b"given up")
        await calls.next()
        replicas.running[first].dismiss()
        service = robot._services["cloud"]
        await until(lambda: service._successor is not None)
        robot.call("cloud", 2, b"new")
        echo(await calls.next())
        assert await inbox.of_call(2) == [ReplyReceived(2, b"new"), CallEnded(2)]
        assert await inbox.appeared(times=2) != first

    async def test_it_goes_on_being_asked_while_nobody_else_answers(
        self, wire: StreamWire, replicas: Replicas
    ) -> None:
        """At the other addresses connections are accepted and get no reply."""
        await replicas.start(replicas.hosts[0])
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        first = await inbox.appeared()
        with contextlib.ExitStack() as stack:
            for host in replicas.hosts[1:]:
                stack.enter_context(socket.create_server((host, replicas.port)))
            gone = replicas.running[first].dismiss()
            dialer = robot._services["cloud"]._dialer
            assert dialer is not None
            await until(lambda: bool(dialer._links))
            for number in range(3):
                await answers(robot, inbox, number)
            assert not gone.done()
            assert ServiceVanished("cloud", first) not in inbox
            await robot.close()
        await wire.close_on_loop()

    async def test_the_next_one_is_lost_too(self, wire: StreamWire, replicas: Replicas) -> None:
        calls, robot, inbox, first = await self.begun(wire, replicas)
        robot.call("cloud", 1, b"owed")
        owed = await calls.next()
        replicas.running[first].dismiss()
        service = robot._services["cloud"]
        await until(lambda: service._successor is not None)
        assert service._successor is not None
        link, second = service._successor
        await replicas.running[second].close()
        await until(lambda: service._successor is not None and service._successor[0] is not link)
        echo(owed)
        assert await inbox.of_call(1) == [ReplyReceived(1, b"owed"), CallEnded(1)]
        assert await inbox.appeared(times=2) not in (first, second)
        assert service._links

    async def test_one_that_dies_is_replaced_by_another(
        self, wire: StreamWire, replicas: Replicas
    ) -> None:
        for host in replicas.hosts:
            await replicas.start(host)
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        first = await inbox.appeared()
        await replicas.running[first].close(0.0)
        assert await inbox.appeared(times=2) != first


async def test_robots_spread_over_the_addresses_of_a_name(
    tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
) -> None:
    replicas = Replicas(tcp, 3, monkeypatch)
    for host in replicas.hosts:
        await replicas.start(host)
    chosen: list[str] = []
    for number in range(30):
        for _ in range(2):  # one that comes again goes where it was
            robot, inbox = tcp.robot("cloud", name=f"robot-{number}"), Inbox()
            robot.start(inbox)
            chosen.append(await inbox.appeared())
            await robot.close()
    assert chosen[::2] == chosen[1::2]
    counts = [chosen.count(incarnation) // 2 for incarnation in replicas.running]
    # Which ports the test gets decides: fewer than 2 of 30 are there once in 4,000 times.
    assert min(counts) >= 2, counts
    # So do those that have lost theirs.
    await replicas.running.popitem()[1].close()
    replicas.hosts.pop()
    moved = []
    for number, before in enumerate(chosen[::2]):
        robot, inbox = tcp.robot("cloud", name=f"robot-{number}"), Inbox()
        robot.start(inbox)
        after = await inbox.appeared()
        await robot.close()
        if before in replicas.running:
            assert after == before
        else:
            moved.append(after)
    assert set(moved) == set(replicas.running)


async def test_a_name_is_looked_up_again_once_nobody_is_left(
    tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dialer, "_LOOKUP_INTERVAL_S", 0.01)
    replicas = Replicas(tcp, 2, monkeypatch)
    replicas.hosts = ["127.0.0.1"]
    service = await replicas.start("127.0.0.1")
    robot, inbox = tcp.robot("cloud"), Inbox()
    robot.start(inbox)
    await inbox.appeared()
    replicas.hosts = ["127.0.0.2"]
    await replicas.start("127.0.0.2")
    service.dismiss()
    assert await inbox.appeared(times=2) == "at-127.0.0.2"


def let_time_fly(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the loop's time pass at once whenever nothing is left to do."""
    loop: Any = asyncio.get_running_loop()
    look = loop._selector.select
    now = [loop.time()]

    def select(timeout: float | None = None) -> object:
        if timeout is None:
            return look(None)
        found = look(min(timeout, 0.002))  # what was just sent may still be on its way
        if not found:
            now[0] += timeout
        return found

    monkeypatch.setattr(loop, "time", lambda: now[0])
    monkeypatch.setattr(loop._selector, "select", select)


def test_robots_that_have_lost_one_service_do_not_stay_in_step() -> None:
    """After an outage of T seconds they come within 0.02 T: as evenly as if each had its own clock.

    Of 1,000 robots a tenth of that time has 100; no more than 160 in any (false alarms: 1e-8).
    """
    chance = random.Random(7).random
    for outage_s in (5.0, 60.0, 600.0):
        came = []
        for _ in range(1000):
            pauses, now = RetryPauses(chance), 0.0
            pauses.begin(now)
            while now < outage_s:
                now += pauses.next_attempt_s(now)
            came.append(now - outage_s)
        window_s = min(0.02 * outage_s, 10.0)
        assert max(came) < 1.26 * window_s
        tenths = Counter(int(10.0 * each / window_s) for each in came)
        assert max(tenths.values()) < 160


class TestRedialling:
    @pytest.fixture
    def dialled(self, monkeypatch: pytest.MonkeyPatch) -> list[float]:
        """When a connection was tried, by the loop's clock."""
        times: list[float] = []
        connect = Dialer._connect

        async def note(self: Dialer, *arguments: Any) -> None:
            times.append(asyncio.get_running_loop().time())
            await connect(self, *arguments)

        monkeypatch.setattr(Dialer, "_connect", note)
        return times

    @staticmethod
    @contextlib.asynccontextmanager
    async def coming_and_going(wire: StreamWire, *lasts_s: float) -> AsyncIterator[None]:
        """Serve links that end by themselves: so long after the hello, and then at once."""
        lasting = iter(lasts_s)
        serving: list[asyncio.Task[None] | None] = []

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            incarnation = f"b{len(serving)}"
            serving.append(asyncio.current_task())
            with contextlib.suppress(ConnectionError):
                writer.write(frames.encode_hello("service", "cloud", incarnation, 30_000.0))
                await asyncio.sleep(next(lasting, 0.0))
                await reader.read(1)
                writer.close()
                await writer.wait_closed()

        port = int(wire.endpoint("cloud").rpartition(":")[2])
        async with await asyncio.start_server(serve, "127.0.0.1", port):
            yield
            await asyncio.wait([task for task in serving if task is not None])

    async def test_a_service_that_comes_and_goes_is_dialled_ever_less_often(
        self, tcp: StreamWire, dialled: list[float], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        let_time_fly(monkeypatch)
        async with self.coming_and_going(tcp):
            robot, inbox = tcp.robot("cloud"), Inbox()
            robot.start(inbox)
            await asyncio.sleep(60.0)
            await robot.close()
        # Soon at first, in the end every fifth of a second.
        assert 250 < len(dialled) < 310
        pauses = [after - before for before, after in itertools.pairwise(dialled)]
        assert 0.019 < pauses[0] < 0.1
        assert min(pauses[-40:]) > 0.19
        assert len(inbox.incarnations()) == len(dialled)

    async def test_after_a_link_that_has_lasted_it_is_dialled_soon_again(
        self, tcp: StreamWire, dialled: list[float], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        let_time_fly(monkeypatch)
        async with self.coming_and_going(tcp, *([0.0] * 12), 30.0):
            robot, inbox = tcp.robot("cloud"), Inbox()
            robot.start(inbox)
            await asyncio.sleep(60.0)
            await robot.close()
        pauses = [after - before for before, after in itertools.pairwise(dialled)]
        assert pauses[11] > 0.19
        assert 29.999 < pauses[12] < 30.1  # the clock's last bits are rounded
        assert pauses[13] < 0.1

    async def test_a_service_that_answers_and_dies_is_dialled_soon_each_time(
        self, tcp: StreamWire, dialled: list[float], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        let_time_fly(monkeypatch)
        robot, inbox = tcp.robot("cloud"), Inbox()
        robot.start(inbox)
        for number in range(8):
            service = tcp.service("cloud", f"b{number}")
            await service.start(echo)
            await inbox.appeared(times=number + 1)
            before = len(dialled)
            robot.call("cloud", number, b"hello")
            await inbox.wait_for(CallEnded(number))
            await service.close()
            await asyncio.sleep(1.0)
            # Every few hundredths of a second, as often as after the first one.
            assert len(dialled) - before > 30
        await robot.close()

    # A refusal, which costs both ends a handshake, is followed by ever longer pauses.
    @pytest.mark.parametrize(
        ("robots", "services", "least", "most"), [("tcp", "tls", 20, 40), ("tls", "tcp", 55, 310)]
    )
    async def test_an_end_that_speaks_no_tls_is_not_dialled_all_the_time(
        self,
        tls: StreamWire,
        dialled: list[float],
        monkeypatch: pytest.MonkeyPatch,
        robots: str,
        services: str,
        least: int,
        most: int,
    ) -> None:
        place = tls.endpoint("cloud").partition("/")[2]
        let_time_fly(monkeypatch)
        service = StreamServiceTransport(
            "cloud",
            incarnation="b1",
            listen=[f"{services}/{place}"],
            tls=tls.service_tls if services == "tls" else None,
        )
        robot = StreamRobotTransport(
            {"cloud": f"{robots}/{place}"}, tls=tls.robot_tls if robots == "tls" else None
        )
        inbox = Inbox()
        await service.start(echo)
        robot.start(inbox)
        await asyncio.sleep(60.0)
        await robot.close()
        await service.close()
        assert least < len(dialled) < most
        assert inbox.events == []
