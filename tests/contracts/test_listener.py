"""The listener: visitors who are no peers, and many connections from one address."""

import asyncio
import contextlib
import socket
from collections.abc import Callable

import pytest
from tests.contracts.wires import (
    HELLO,
    PATIENCE_S,
    StreamWire,
    Visitor,
    answers,
    echo,
    joined,
    until,
)

from holdfast.transport import frames, links, listener, service_end
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.tls import TlsStream, client_context


@pytest.mark.parametrize("protocol", ["tcp", "tls", "udp", "unix"])
class TestVisitors:
    """What connects to a service and is no robot of ours costs the robots nothing."""

    @pytest.fixture
    def wire(self, protocol: str, wire_of: Callable[[str], StreamWire]) -> StreamWire:
        return wire_of(protocol)

    @pytest.mark.parametrize(
        ("first_bytes", "plain", "over_tls"),
        [
            (b"GET / HTTP/1.1\r\nHost: x\r\n\r\n", "speaks HTTP", "does not speak TLS, and"),
            (bytes.fromhex("16030100f8010000f40303"), "speaks TLS, and this endpoint", None),
            (b"\x16\x03\x01\x00\x05hello", "speaks TLS", "does not speak TLS 1.3"),
            (b"\0" * 64, "begins with b", "does not speak TLS, and"),
            (frames.MAGIC + b"\xff" * 9, "begins with a frame of kind 255", "does not speak TLS"),
            (
                HELLO.replace(b"robot", b"human"),
                "sends a malformed hello",
                "does not speak TLS, and",
            ),
            (
                HELLO[:8] + frames.encode_frame(frames.HELLO, 0, bytes(4097)),
                "frame of kind 1 with 4097 bytes",
                "does not speak TLS",
            ),
            (
                frames.encode_hello("service", "cloud", "x", 400.0),
                "is a service, and a robot was expected",
                "does not speak TLS, and",
            ),
        ],
    )
    async def test_a_wrong_greeting_is_refused_with_the_reason(
        self, wire: StreamWire, first_bytes: bytes, plain: str, over_tls: str | None
    ) -> None:
        await wire.service("cloud", "b1").start(echo)
        wanted = over_tls if wire.protocol in ("tls", "udp") else plain
        if wanted is None:
            pytest.skip("it is the beginning of a greeting")
        with await Visitor(wire.endpoint("cloud")).connect() as visitor:
            await visitor.say(first_bytes)
            heard = await visitor.hear()
        assert b"incarnation" not in heard
        await until(lambda: bool(wire.reasons()))
        assert wanted in wire.reasons()[0]

    async def test_connections_that_say_nothing_keep_no_robot_out(self, wire: StreamWire) -> None:
        service = wire.service("cloud", "b1")
        await service.start(echo)
        begun = b"\x16\x03\x01" if wire.protocol in ("tls", "udp") else frames.MAGIC[:3]
        with contextlib.ExitStack() as stack:
            for first in (b"", begun):
                # All of them before the service looks.
                for _ in range(400):
                    visitor = stack.enter_context(Visitor(wire.endpoint("cloud")))
                    visitor.socket.setblocking(True)
                    visitor.socket.connect(visitor.address)
                    visitor.socket.sendall(first)
                (place,) = service._listeners
                for _ in range(100):
                    await asyncio.sleep(0)
                    assert len(place._silent) <= listener.MAX_SILENT
                    assert len(service._without_hello) <= service_end._MAX_WITHOUT_HELLO
            robot, inbox = await joined(wire)
            await answers(robot, inbox, 1)
        assert "has said no hello, and others wait" in wire.reasons()

    async def test_connections_that_say_nothing_are_closed_after_a_while(
        self, wire: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(listener, "OPENING_TIMEOUT_S", 0.2)
        monkeypatch.setattr(links, "OPENING_TIMEOUT_S", 0.2)
        await wire.service("cloud", "b1").start(echo)
        begun = b"\x16\x03\x01" if wire.protocol in ("tls", "udp") else frames.MAGIC[:3]
        with Visitor(wire.endpoint("cloud")) as mute, Visitor(wire.endpoint("cloud")) as slow:
            await mute.connect()
            await slow.connect()
            await slow.say(begun)
            assert await mute.hear() == await slow.hear() == b""
        await until(lambda: bool(wire.reasons()))
        assert wire.reasons() == ["has said no hello within 0.2 s"]

    async def test_many_that_close_at_once_keep_no_robot_out(self, wire: StreamWire) -> None:
        await wire.service("cloud", "b1").start(echo)
        for _ in range(2000):
            with (
                Visitor(wire.endpoint("cloud")) as visitor,
                contextlib.suppress(BlockingIOError),  # unix: the queue is full
            ):
                await visitor.connect()
        await joined(wire)


class TestManyFromOneAddress:
    """Whoever opens more connections than there is room for loses its own, and nobody else."""

    MANY = 600

    @classmethod
    def flood(cls, stack: contextlib.ExitStack, endpoint: str, said: bytes) -> list[socket.socket]:
        visitors = [stack.enter_context(Visitor(endpoint)) for _ in range(cls.MANY)]
        for visitor in visitors:
            visitor.socket.bind(("127.0.0.2", 0))
            visitor.socket.setblocking(True)
            visitor.socket.connect(visitor.address)
            visitor.socket.sendall(said)
            visitor.socket.setblocking(False)
        return [visitor.socket for visitor in visitors]

    @staticmethod
    def is_open(stream: socket.socket) -> bool:
        """Whether nothing but bytes has come; those are lost."""
        try:
            while stream.recv(65536):
                pass
        except BlockingIOError:
            return True
        except ConnectionError:
            pass
        return False

    @classmethod
    async def until_closed(cls, streams: list[socket.socket], least: int) -> None:
        await until(lambda: sum(not cls.is_open(each) for each in streams) >= least)

    @pytest.mark.parametrize("begun", [0, 3], ids=["silent", "in_the_handshake"])
    async def test_a_robot_that_is_slow_is_let_in(
        self, tls: StreamWire, robot_tls: TlsFiles, begun: int, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(listener, "OPENING_TIMEOUT_S", PATIENCE_S)  # this machine may be slow
        monkeypatch.setattr(links, "OPENING_TIMEOUT_S", PATIENCE_S)
        await tls.service("cloud", "b1").start(echo)
        stream = TlsStream(client_context(robot_tls), "127.0.0.1")
        stream.begin()
        opening = stream.take()
        with contextlib.ExitStack() as stack:
            robot = stack.enter_context(Visitor(tls.endpoint("cloud")))
            await robot.connect()
            await robot.say(opening[:begun])
            others = self.flood(stack, tls.endpoint("cloud"), opening[:begun])
            await self.until_closed(others, self.MANY - listener.MAX_SILENT)
            assert self.is_open(robot.socket)
            await robot.say(opening[begun:])
            loop, heard = asyncio.get_running_loop(), b""
            async with asyncio.timeout(PATIENCE_S):
                while not heard:
                    came = await loop.sock_recv(robot.socket, 65536)
                    assert came, "the service has hung up"
                    was_established = stream.established
                    heard = stream.receive(came)
                    if stream.established and not was_established:
                        stream.send(HELLO)
                        await robot.say(stream.take())
        assert heard.startswith(frames.MAGIC)

    async def test_handshakes_wait_in_turns_by_address_and_cost_nothing_once_given_up(
        self, tls: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Beside a storm from one address, a robot from another is next."""
        monkeypatch.setattr(listener, "MAX_WAITING", 500)
        service = tls.service("cloud", "b1")
        begun: list[bytes] = []
        may_begin = False

        def accepted(_: object, connection: socket.socket, network: bytes) -> None:
            connection.close()
            begun.append(network)

        monkeypatch.setattr(service, "_may_shake_hands", lambda: may_begin)
        monkeypatch.setattr(service, "_accepted", accepted)
        await service.start(echo)
        (place,) = service._listeners
        with contextlib.ExitStack() as stack:
            others = self.flood(stack, tls.endpoint("cloud"), b"\x16\x03\x01")
            # The newest are closed: the others have waited for longer.
            await self.until_closed(others, self.MANY - 500)
            assert all(map(self.is_open, others[:400]))
            for other in others[:100]:
                other.close()
            with await Visitor(tls.endpoint("cloud")).connect() as robot:
                await robot.say(b"\x16\x03\x01")
                await until(lambda: len(place._waiting) == 2)
                may_begin = True
                await until(lambda: not place._waiting)
        assert begun.index(listener._network_of(socket.AF_INET, ("127.0.0.1", 1))) <= 1
        assert len(begun) == 400

    async def test_of_many_addresses_those_that_came_first_stay(
        self, tls: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(listener, "MAX_WAITING", 300)
        monkeypatch.setattr(listener, "_network_of", lambda _, address: str(address).encode())
        service = tls.service("cloud", "b1")
        monkeypatch.setattr(service, "_may_shake_hands", lambda: False)
        await service.start(echo)
        with contextlib.ExitStack() as stack:
            others = self.flood(stack, tls.endpoint("cloud"), b"\x16\x03\x01")
            await self.until_closed(others, self.MANY - 300)
            assert all(map(self.is_open, others[:200]))

    def test_an_owner_of_many_addresses_of_ipv6_is_one(self) -> None:
        def network(address: str) -> bytes:
            return listener._network_of(socket.AF_INET6, (address, 1, 0, 0))

        assert network("2001:db8::1") == network("2001:db8::ffff:2")
        assert network("2001:db8::1") != network("2001:db8:0:1::1")
        assert network("fe80::1%lo") == network("fe80::2")
        assert network("::ffff:10.0.0.1") == listener._network_of(socket.AF_INET, ("10.0.0.1", 1))
        assert network("::ffff:10.0.0.1") != network("::ffff:10.0.0.2")
