"""Links: streams and their frames, slow readers, and the other end's end."""

import asyncio
import contextlib
import functools
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
from tests.contracts.wires import (
    HELLO,
    LEASE_MS,
    MAX_BYTES,
    PATIENCE_S,
    Inbox,
    StreamWire,
    Visitor,
    answers,
    assert_matches,
    connected,
    echo,
    echo_of_size,
    refusal_of,
    saying,
    slow_proxy,
    until,
)

from holdfast.errors import TransportError
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.transport import frames, links, service_end
from holdfast.transport.contract import IncomingCall
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.service_end import StreamServiceTransport


class TestStreams:
    async def test_port_0_becomes_a_port(self) -> None:
        service = StreamServiceTransport("cloud", incarnation="b1", listen=["tcp/127.0.0.1:0"])
        await service.start(echo)
        robot = StreamRobotTransport({"cloud": service.endpoints[0]})
        inbox = Inbox()
        robot.start(inbox)
        await inbox.wait_for(ServiceAppeared("cloud", "b1"))
        assert not service.endpoints[0].endswith(":0")
        await robot.close()
        await service.close()

    async def test_a_host_name_is_looked_up(self, tcp: StreamWire) -> None:
        await tcp.service("cloud", "b1").start(echo)
        endpoint = tcp.endpoint("cloud").replace("127.0.0.1", "localhost")
        robot, inbox = StreamRobotTransport({"cloud": endpoint}), Inbox()
        tcp.ends.append(robot)
        robot.start(inbox)
        await inbox.wait_for(ServiceAppeared("cloud", "b1"))

    async def test_of_two_launched_processes_the_newest_is_called(
        self, socket_directory: Path
    ) -> None:
        wire = StreamWire("unix", socket_directory, launched=True)
        robot, inbox, _ = await connected(wire, saying(b"old"))
        newer = wire.service("cloud", "b2")
        await newer.start(saying(b"new"))
        await inbox.wait_for(ServiceAppeared("cloud", "b2"))
        robot.call("cloud", 1, b"")
        assert await inbox.of_call(1) == [ReplyReceived(1, b"new"), CallEnded(1)]
        await newer.close()
        await inbox.wait(lambda _: inbox.count(ServiceAppeared("cloud", "b1")) == 2)
        robot.call("cloud", 2, b"")
        assert await inbox.of_call(2) == [ReplyReceived(2, b"old"), CallEnded(2)]
        await wire.close_on_loop()

    async def test_a_robot_remembers_the_last_few_reasons(self, socket_directory: Path) -> None:
        """A peer may say another one in each goodbye, for as long as it likes."""
        wire = StreamWire("unix", socket_directory, launched=True)
        robot = wire.robot("cloud")
        robot.start(Inbox())
        texts = ["is 0", "is 0", *(f"is {number}" for number in range(1, 20)), "is 0", "is 0"]
        reported = [text for at, text in enumerate(texts) if at not in (1, len(texts) - 1)]
        for text in texts:
            with wire.connection("cloud") as service:
                service.sendall(frames.MAGIC + frames.encode_goodbye(text))
                await until(lambda: not robot._services["cloud"]._silent)
                await until(lambda: not robot._services["cloud"]._made)
        assert [reason for _, reason in wire.refusals] == [
            f"refuses this end, which {text}" for text in reported
        ]
        await wire.close_on_loop()

    async def test_the_service_refuses_what_is_too_large_for_it(self, tcp: StreamWire) -> None:
        received: list[IncomingCall] = []
        await tcp.service("cloud", "b1").start(received.append)
        robot, inbox = tcp.robot("cloud", max_message_bytes=2 * MAX_BYTES), Inbox()
        robot.start(inbox)
        await inbox.wait_for(ServiceAppeared("cloud", "b1"))
        robot.call("cloud", 1, bytes(MAX_BYTES + 1))
        assert refusal_of(await inbox.of_call(1)).code == "too_large"
        assert received == []

    async def test_the_last_reply_and_the_end_are_one_frame(self, tcp: StreamWire) -> None:
        await tcp.service("cloud", "b1").start(echo)
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(HELLO + frames.encode_frame(frames.CALL, 5, b"question"))
            wanted = frames.encode_frame(frames.LAST, 5, b"question")
            heard = b""
            async with asyncio.timeout(PATIENCE_S):
                while not heard.endswith(wanted):
                    heard += await asyncio.get_running_loop().sock_recv(visitor.socket, 4096)
        hello, last = frames.FrameDecoder(MAX_BYTES).feed(heard)
        assert hello.kind == frames.HELLO
        assert last == (frames.LAST, 5, b"question", 0)

    async def test_nothing_waits_for_more_to_be_sent_with_it(
        self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made: list[links.Link] = []
        begin = links.Link.connection_made

        def connection_made(link: links.Link, transport: asyncio.BaseTransport) -> None:
            begin(link, transport)
            stream = transport.get_extra_info("socket")
            assert stream.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            made.append(link)

        monkeypatch.setattr(links.Link, "connection_made", connection_made)
        await connected(tcp)
        assert len(made) == 2

    async def test_one_bad_endpoint_of_two_is_an_error(self, tcp: StreamWire) -> None:
        taken, free = tcp.endpoint("taken"), tcp.endpoint("free")
        await tcp.service("taken", "b1").start(echo)
        both = StreamServiceTransport("both", incarnation="b1", listen=[free, taken])
        with pytest.raises(TransportError, match="cannot listen on"):
            await both.start(echo)
        await tcp.service("free", "b1").start(echo)  # the first one was given back

    async def test_another_one_s_socket_is_not_removed(self, socket_directory: Path) -> None:
        wire = StreamWire("unix", socket_directory)
        path = Path(wire.endpoint("cloud").removeprefix("unix/"))
        first = wire.service("cloud", "b1")
        await first.start(echo)
        path.unlink()
        await wire.service("cloud", "b2").start(echo)
        await first.close()
        assert path.exists()
        await wire.close_on_loop()

    @pytest.mark.parametrize("bad", ["", "a/b", "a*", "a b", "x" * 101, "$x", "@x"])
    def test_names_that_are_not_allowed_are_refused(self, bad: str) -> None:
        with pytest.raises(TransportError, match="name of a service"):
            StreamServiceTransport(bad, incarnation="b1", listen=["tcp/127.0.0.1:0"])
        with pytest.raises(TransportError, match="incarnation of a service"):
            StreamServiceTransport("cloud", incarnation=bad, listen=["tcp/127.0.0.1:0"])
        with pytest.raises(TransportError, match="incarnation of a robot"):
            StreamRobotTransport({}, incarnation=bad)

    def test_the_right_credentials_or_none(self, robot_tls: TlsFiles, tmp_path: Path) -> None:
        with pytest.raises(TransportError, match=r"tls needs credentials.*--tls"):
            StreamRobotTransport({"cloud": "tls/localhost:7447"})
        with pytest.raises(TransportError, match=r"tcp does not use the credentials"):
            StreamRobotTransport({"cloud": "tcp/localhost:7447"}, tls=robot_tls)
        missing = TlsFiles(robot_tls.authority, tmp_path / "missing.pem", robot_tls.key)
        with pytest.raises(TransportError, match=r"missing\.pem: cannot be read: No such file"):
            StreamRobotTransport({"cloud": "tls/localhost:7447"}, tls=missing)

    def test_a_robot_connects_to_a_port(self) -> None:
        with pytest.raises(TransportError, match="port 0 is for listening"):
            StreamRobotTransport({"cloud": "tcp/127.0.0.1:0"})

    async def test_a_transport_is_started_once(self, tcp: StreamWire) -> None:
        robot, _, service = await connected(tcp)
        with pytest.raises(TransportError, match="was started before"):
            robot.start(Inbox())
        with pytest.raises(TransportError, match="was started before"):
            await service.start(echo)

    async def test_a_large_request_gets_through_a_slow_link(self, tcp: StreamWire) -> None:
        """Although it takes several leases; a link that carries it is no broken one."""
        tcp.lease_ms = 600.0
        await tcp.service("cloud", "b1").start(echo_of_size)
        port = int(tcp.endpoint("cloud").rpartition(":")[2])
        with slow_proxy(port, bytes_per_second=100_000) as slow_port:
            address = f"tcp/127.0.0.1:{slow_port}"
            robot = StreamRobotTransport({"cloud": address}, lease_ms=600.0)
            inbox = Inbox()
            robot.start(inbox)
            await inbox.wait_for(ServiceAppeared("cloud", "b1"))
            robot.call("cloud", 1, bytes(200_000))
            robot.call("cloud", 2, b"small")
            assert await inbox.of_call(1) == [ReplyReceived(1, b"200000"), CallEnded(1)]
            assert await inbox.of_call(2) == [ReplyReceived(2, b"5"), CallEnded(2)]
            assert ServiceVanished("cloud", "b1") not in inbox
            await robot.close()


@pytest.fixture(params=["tcp", "tls", "udp"])
def any_stream(request: pytest.FixtureRequest, wire_of: Callable[[str], StreamWire]) -> StreamWire:
    return wire_of(request.param)


class TestDefects:
    """Whatever a peer sends may lead to any exception: it ends that peer's link alone."""

    async def test_at_the_service(self, any_stream: StreamWire) -> None:
        def answer(call: IncomingCall) -> None:
            if call.payload == b"bad":
                raise RuntimeError("year 10000")
            echo(call)

        other, of_other, _ = await connected(any_stream, answer)
        robot, inbox = any_stream.robot("cloud"), Inbox()
        robot.start(inbox)
        await inbox.appeared()
        robot.call("cloud", 1, b"bad")
        await inbox.wait_for(ServiceVanished("cloud", "b1"))
        assert CallEnded(1) in inbox
        await answers(other, of_other, 1, b"good")
        assert ServiceVanished("cloud", "b1") not in of_other
        # It may come again.
        await inbox.wait(lambda _: inbox.count(ServiceAppeared("cloud", "b1")) == 2)
        await answers(robot, inbox, 2, b"good")
        (defect,) = [fields for name, fields in any_stream.events if name == "defect"]
        assert defect["reason"] == "RuntimeError: year 10000"
        assert "in answer" in str(defect["traceback"])

    async def test_at_the_robot(self, any_stream: StreamWire) -> None:
        told: list[str] = []

        class Fragile(Inbox):
            def __call__(self, event: TransportEvent) -> None:
                if event == ReplyReceived(1, b"bad"):
                    raise RuntimeError("year 10000")
                super().__call__(event)

        await any_stream.service("cloud", "b1").start(echo)
        robot, inbox = any_stream.robot("cloud"), Fragile()
        robot.on_event = lambda name, **fields: told.append(f"{name} {fields.get('reason')}")
        robot.start(inbox)
        await inbox.appeared()
        robot.call("cloud", 1, b"bad")
        await inbox.wait_for(ServiceVanished("cloud", "b1"))
        assert CallEnded(1) in inbox
        await inbox.wait(lambda _: inbox.count(ServiceAppeared("cloud", "b1")) == 2)
        await answers(robot, inbox, 2, b"good")
        assert told[0] == "defect RuntimeError: year 10000"

    async def test_while_nothing_but_time_passes(
        self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        tcp.lease_ms = 300.0
        _, _, service = await connected(tcp)
        assert isinstance(service, StreamServiceTransport)
        (link,) = service._links

        def fail(now: float) -> bool:
            raise RuntimeError("no time")

        monkeypatch.setattr(link, "_owes_ping", fail)
        await until(lambda: link not in service._links)
        assert ("defect", None, "RuntimeError: no time") in tcp.heard()


class TestPeers:
    """Peers that say hello and then break the protocol."""

    async def test_a_hello_of_another_version_is_refused_in_words_at_both_ends(
        self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        await tcp.service("cloud", "b1").start(echo)
        robot, inbox = tcp.robot("cloud"), Inbox()
        hello = robot.settings.hello()
        other = hello.replace(b"\xa7version\x01", b"\xa7version\x02")
        robot.settings.hello = lambda: other
        assert other != hello
        robot.start(inbox)
        await until(lambda: bool(tcp.refusals) and bool(tcp.reasons()))
        text = (
            "is holdfast .* with version 2 of the wire; here is holdfast .* with version 1: install"
        )
        assert_matches(tcp.reasons()[0], text)
        assert tcp.refusals[0][0] == "cloud"
        assert_matches(tcp.refusals[0][1], f"refuses this end, which {text}")
        assert inbox.events == []

    async def test_a_service_of_another_version_is_refused_by_the_robot(
        self, tcp: StreamWire
    ) -> None:
        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            hello = frames.encode_hello("service", "cloud", "b1", 400.0)
            writer.write(hello.replace(b"\xa7version\x01", b"\xa7version\x07"))
            await reader.read()
            writer.close()

        port = int(tcp.endpoint("cloud").rpartition(":")[2])
        async with await asyncio.start_server(serve, "127.0.0.1", port):
            robot, inbox = tcp.robot("cloud"), Inbox()
            robot.start(inbox)
            await until(lambda: bool(tcp.refusals))
            await robot.close()
        assert_matches(tcp.refusals[0][1], "is holdfast .* with version 7 of the wire")
        assert inbox.events == []

    async def test_a_robot_that_does_not_read_loses_its_own_link(
        self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(links, "STALLED_S", 0.5)

        def answer(call: IncomingCall) -> None:
            call.reply(bytes(MAX_BYTES) if call.payload == b"much" else call.payload)
            call.end()

        tcp.lease_ms = LEASE_MS
        robot, inbox, _ = await connected(tcp, answer)
        with (
            await Visitor(tcp.endpoint("cloud")).connect() as first,
            await Visitor(tcp.endpoint("cloud")).connect() as second,
        ):
            for visitor in (first, second):
                await visitor.say(HELLO + frames.encode_frame(frames.CALL, 1, b"much"))
            await until(lambda: tcp.heard().count(("robot_connected", "", None)) == 3)
            for number in range(20):
                await answers(robot, inbox, number)
            lost = ("robot_disconnected", "", "does not read what it is sent")
            await until(lambda: tcp.heard().count(lost) == 2, lambda: tcp.events)
        assert ServiceVanished("cloud", "b1") not in inbox

    async def test_what_waits_for_all_robots_together_has_a_bound(
        self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(service_end, "MAX_UNSENT_BYTES", 2 * MAX_BYTES)

        def answer(call: IncomingCall) -> None:
            call.reply(bytes(MAX_BYTES) if call.payload == b"much" else call.payload)
            call.end()

        def are_connected(number: int) -> bool:
            return tcp.heard().count(("robot_connected", "", None)) == number

        robot, inbox, service = await connected(tcp, answer)
        assert isinstance(service, StreamServiceTransport)
        with contextlib.ExitStack() as visitors:
            for number in range(2, 7):
                visitor = visitors.enter_context(await Visitor(tcp.endpoint("cloud")).connect())
                await visitor.say(HELLO)
                await until(functools.partial(are_connected, number))
                await visitor.say(frames.encode_frame(frames.CALL, 1, b"much"))
                await answers(robot, inbox, number)
            lost = "does not read what it is sent, and others need the memory"
            await until(lambda: ("robot_disconnected", "", lost) in tcp.heard())
            assert sum(link.unsent_bytes for link in service._links) <= 2 * MAX_BYTES
        assert ServiceVanished("cloud", "b1") not in inbox

    async def test_what_waits_for_a_robot_has_a_bound(self, tcp: StreamWire) -> None:
        def answer(call: IncomingCall) -> None:
            for _ in range(5):
                call.reply(bytes(MAX_BYTES))

        await tcp.service("cloud", "b1").start(answer)
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(HELLO + frames.encode_frame(frames.CALL, 1))
            lost = ("robot_disconnected", "", "does not read what it is sent")
            await until(lambda: lost in tcp.heard())

    async def test_the_end_of_a_link_is_told_with_its_reason_and_the_address(
        self, tcp: StreamWire
    ) -> None:
        service = tcp.service("cloud", "b1")
        await service.start(echo)
        goodbye, connected = frames.encode_goodbye(""), ("robot_connected", "", None)
        for last, reason in ((goodbye, "said goodbye"), (b"", "closed the connection without")):
            with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
                host, port = visitor.socket.getsockname()
                await visitor.say(HELLO + last)
                await until(lambda: connected in tcp.heard())
            await until(lambda: len(tcp.events) == 2)
            (_, first), (name, fields) = tcp.events
            assert name == "robot_disconnected"
            assert str(fields["reason"]).startswith(reason)
            assert first["address"] == fields["address"] == f"{host}:{port}"
            tcp.events.clear()
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(HELLO)
            await until(lambda: connected in tcp.heard())
            await service.close()
            await until(lambda: len(tcp.events) == 2)
        assert tcp.heard()[-1] == ("robot_disconnected", "", "this service ends")

    async def test_half_a_message_and_silence_costs_the_link_after_the_lease(
        self, tcp: StreamWire
    ) -> None:
        await tcp.service("cloud", "b1").start(echo)
        hello = frames.encode_hello("robot", "r", "i1", 500.0)
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(hello + frames.encode_frame(frames.CALL, 1, bytes(1000))[:500])
            await visitor.hear()
        await until(lambda: len(tcp.events) == 2)
        assert tcp.heard()[-1] == ("robot_disconnected", "r", "was silent for 500 ms")

    async def test_what_is_sent_at_once_holds_up_nobody_else(self, tcp: StreamWire) -> None:
        number = 20_000  # calls of nine bytes: one look at a socket finds all of them
        came: list[bytes] = []

        def answer(call: IncomingCall) -> None:
            came.append(call.payload)
            if len(came) == 1:
                robot.call("cloud", 1, b"question")
            echo(call)

        robot, inbox, _ = await connected(tcp, answer)
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(HELLO + number * frames.encode_frame(frames.CALL, 1))
            assert await inbox.of_call(1) == [ReplyReceived(1, b"question"), CallEnded(1)]
            assert len(came) < number
            await until(lambda: len(came) == number + 1, lambda: len(came))

    async def test_who_does_not_read_is_not_heard_until_it_does(self, tcp: StreamWire) -> None:
        reply, number = bytes(100_000), 1000  # more than may wait for anybody
        came: list[IncomingCall] = []

        def answer(call: IncomingCall) -> None:
            came.append(call)
            call.reply(reply)
            call.end()

        service = tcp.service("cloud", "b1")
        await service.start(answer)
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(HELLO + number * frames.encode_frame(frames.CALL, 1))
            await until(lambda: bool(came))
            (link,) = service._links
            await until(lambda: link._is_paused)
            assert len(came) < number
            decoder, replies = frames.FrameDecoder(MAX_BYTES), 0
            async with asyncio.timeout(PATIENCE_S):
                while replies < number:
                    data = await asyncio.get_running_loop().sock_recv(visitor.socket, 1 << 20)
                    replies += sum(frame.payload == reply for frame in decoder.feed(data))
        assert len(came) == number

    async def test_whoever_holds_the_most_half_received_messages_loses_one(
        self, tcp: StreamWire
    ) -> None:
        robot, inbox, _ = await connected(tcp)
        with contextlib.ExitStack() as stack:
            small, *large = (stack.enter_context(Visitor(tcp.endpoint("cloud"))) for _ in range(4))
            little = frames.encode_frame(frames.CALL, 1, bytes(100_000))
            much = frames.encode_frame(frames.CALL, 1, bytes(MAX_BYTES))[:-1]
            for visitor, begun in ((small, little[:1000]), *((each, much) for each in large)):
                await visitor.connect()
                await visitor.say(HELLO + begun)
            lost = "has not finished a message, and others need the memory"
            await until(lambda: tcp.events[-1][1].get("reason") == lost)
            await large[0].hear()
            # It began before all the others.
            await small.say(little[1000:] + frames.encode_goodbye("done"))
            decoder = frames.FrameDecoder(MAX_BYTES)
            assert [frame.kind for frame in decoder.feed(await small.hear())][1] == frames.LAST
        await answers(robot, inbox, 1)

    @pytest.mark.parametrize(
        ("frame", "reason"),
        [
            (frames.encode_frame(99, 0), "sends a frame of the unknown kind 99"),
            (frames.encode_frame(frames.REPLY, 1), "is a robot and sends a frame of kind 3"),
            (frames.encode_frame(frames.PING, 0, b"x"), "sends a frame of kind 6 with 1 bytes"),
            (HELLO[8:], "sends a frame of the unknown kind 1"),
        ],
    )
    async def test_a_frame_that_is_not_a_robot_s_ends_the_link_with_the_reason(
        self, tcp: StreamWire, frame: bytes, reason: str
    ) -> None:
        await tcp.service("cloud", "b1").start(echo)
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(HELLO + frame)
            heard = await visitor.hear()
        assert tcp.heard()[-1] == ("robot_disconnected", "", reason)
        last = frames.FrameDecoder(MAX_BYTES).feed(heard)[-1]
        assert (last.kind, frames.read_goodbye(last.payload)) == (frames.GOODBYE, reason)

    async def test_more_robots_than_there_is_room_for_are_told_so(
        self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(service_end, "MAX_LINKS", 1)
        await connected(tcp)
        robot, inbox = tcp.robot("cloud"), Inbox()
        robot.start(inbox)
        await until(lambda: bool(tcp.refusals))
        assert tcp.refusals[0][1].endswith("which is one too many: 1 robots are connected")
        assert inbox.events == []
