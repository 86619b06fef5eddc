"""Links with datagrams beside the stream: who gets in, what goes which way, how an end is found."""

import asyncio
import contextlib
import select
import socket
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.contracts.wires import LEASE_MS, Inbox, Received, StreamWire, answers, echo, until
from tests.ports import free_port

from holdfast.errors import TransportError
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
)
from holdfast.transport import datagram_cipher
from holdfast.transport import datagram_links as datagram_links
from holdfast.transport.contract import IncomingCall
from holdfast.transport.datagram_cipher import AssociationKeys, DatagramCipher
from holdfast.transport.datagram_links import RobotDatagramLink, ServiceDatagramLink
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.exchanges import MAX_PAYLOAD_BYTES
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.service_end import StreamServiceTransport
from holdfast_lab.testbed.bad_line import Carrier, Direction, Impairment
from holdfast_lab.testbed.proxy import Proxy


async def connected(
    wire: StreamWire, serve: Callable[[IncomingCall], None] = echo
) -> tuple[StreamRobotTransport, Inbox, StreamServiceTransport]:
    service = wire.service("cloud", "b1")
    await service.start(serve)
    robot, inbox = wire.robot("cloud"), Inbox()
    robot.start(inbox)
    await inbox.appeared()
    await until(lambda: robot.sends_datagrams("cloud"))
    return robot, inbox, service


def noting(payloads: list[bytes]) -> Callable[[IncomingCall], None]:
    """Return what answers a call with what it asks, and notes that."""

    def serve(call: IncomingCall) -> None:
        payloads.append(call.payload)
        echo(call)

    return serve


def link_of(robot: StreamRobotTransport) -> RobotDatagramLink:
    link = robot._services["cloud"].current
    assert isinstance(link, RobotDatagramLink)
    return link


async def at_rest(link: RobotDatagramLink) -> None:
    """Wait until a link has no datagram to send for a while, unless it is asked."""
    loop = asyncio.get_running_loop()
    await until(lambda: link._exchange.due > loop.time() + 1.0)


def link_at(service: StreamServiceTransport, number: int = 0) -> ServiceDatagramLink:
    link = list(service._links)[number]
    assert isinstance(link, ServiceDatagramLink)
    return link


def place_of(wire: StreamWire) -> tuple[str, int]:
    return "127.0.0.1", int(wire.endpoint("cloud").rpartition(":")[2])


@contextlib.contextmanager
def stranger(to: tuple[str, int]) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.connect(to)
        made.setblocking(False)
        yield made


class TestWhatGoesWhichWay:
    async def test_short_questions_and_answers_are_not_on_the_stream(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot, inbox, service = await connected(udp)
        link, other = link_of(robot), link_at(service)
        on_stream: list[bytes] = []
        for each in (link, other):
            monkeypatch.setattr(each, "send", on_stream.append)
        for call in range(20):
            robot.call("cloud", call, bytes(MAX_PAYLOAD_BYTES))
            assert len(await inbox.of_call(call)) == 2
        assert [sent for sent in on_stream if len(sent) > 9] == []
        monkeypatch.undo()

    async def test_what_is_longer_is(self, udp: StreamWire) -> None:
        robot, inbox, _ = await connected(udp)
        link = link_of(robot)
        await at_rest(link)
        before = link._cipher, 0 if link._cipher is None else link._cipher._counter
        for size in (MAX_PAYLOAD_BYTES + 1, 100_000):
            await answers(robot, inbox, size, bytes(size))
        assert link._cipher is before[0]
        assert before[0] is not None and before[0]._counter - before[1] <= 2  # probes

    async def test_a_service_at_all_addresses_answers_from_the_one_that_was_called(
        self, robot_tls: TlsFiles, service_tls: TlsFiles
    ) -> None:
        port = free_port("0.0.0.0")
        service = StreamServiceTransport(
            "cloud", incarnation="b1", listen=[f"udp/0.0.0.0:{port}"], tls=service_tls
        )
        await service.start(echo)
        robot = StreamRobotTransport({"cloud": f"udp/127.0.0.1:{port}"}, tls=robot_tls)
        robot.start(Inbox())
        await until(lambda: robot.sends_datagrams("cloud"))
        await robot.close()
        await service.close()

    async def test_where_somebody_has_the_port_the_service_takes_another(
        self, udp: StreamWire
    ) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
            other.bind(place_of(udp))
            robot, inbox, _ = await connected(udp)
            await answers(robot, inbox, 1)


class TestStrangers:
    async def test_what_is_forged_reaches_nobody_and_is_not_answered(self, udp: StreamWire) -> None:
        received: list[bytes] = []
        robot, inbox, service = await connected(udp, noting(received))
        link = link_at(service)
        assert link._cipher is not None
        number = link._cipher.association
        forger = DatagramCipher(AssociationKeys.draw(number), service=False)
        question = b"\1\0" + (7).to_bytes(4, "big") * 2 + b"\0\0" + b"forged"
        reply = b"\2\0" + (1).to_bytes(4, "big") + b"\x80\0" + b"forged"
        service_forger = DatagramCipher(AssociationKeys.draw(number), service=True)
        with stranger(place_of(udp)) as to_service:
            for k in range(50):
                to_service.send(forger.encrypt(question))
                to_service.send(bytes(k))
                to_service.send(number.to_bytes(4, "big") + bytes(60 + k))
                link._put(service_forger.encrypt(reply))  # as if from the service's address
                await answers(robot, inbox, k)
            with pytest.raises(BlockingIOError):
                to_service.recv(1)
        assert received == [b"question"] * 50
        assert ServiceVanished("cloud", "b1") not in inbox

    async def test_associations_cannot_be_guessed(self, udp: StreamWire) -> None:
        """Whoever does not see a robot's datagrams makes none that have to be deciphered."""
        _, _, service = await connected(udp)
        other = udp.robot("cloud")
        other.start(Inbox())
        await until(lambda: other.sends_datagrams("cloud"))
        sealings = [link_at(service, number)._cipher for number in range(2)]
        first, second = (each.association for each in sealings if each is not None)
        assert abs(first - second) > 1  # unless two draws of 32 bits are as near as that

    async def test_a_robot_cannot_use_the_keys_of_another(self, udp: StreamWire) -> None:
        calls = Received()
        robot, inbox, service = await connected(udp, calls)
        other, other_inbox = udp.robot("cloud"), Inbox()
        other.start(other_inbox)
        await until(lambda: other.sends_datagrams("cloud"))
        theirs, ours = link_at(service, 0), link_at(service, 1)
        assert theirs._cipher is not None and ours._cipher is not None
        mine = link_of(other)
        assert mine._cipher is not None
        question = b"\1\0" + (1).to_bytes(4, "big") * 2 + b"\0\0" + b"as another"
        # Sealed with its own keys, and said to be of the other's association.
        datagram = mine._cipher.encrypt(question)
        for association in (theirs._cipher.association, 0, 2**32 - 1):
            with stranger(place_of(udp)) as to_service:
                to_service.send(association.to_bytes(4, "big") + datagram[4:])
        robot.call("cloud", 5, b"mine")
        call = await calls.next()
        assert call.payload == b"mine"
        echo(call)
        assert len(await inbox.of_call(5)) == 2
        await answers_of(other, other_inbox, calls)

    async def test_who_sends_more_than_it_has_turns_loses_its_own_link(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        calls: list[bytes] = []
        robot, inbox, service = await connected(udp, noting(calls))
        greedy, greedy_inbox = udp.robot("cloud"), Inbox()
        greedy.start(greedy_inbox)
        await until(lambda: greedy.sends_datagrams("cloud"))
        ours, at_service = link_of(greedy), link_at(service, 1)
        assert ours._cipher is not None
        with monkeypatch.context() as at_once:
            now = at_service._loop.time()
            at_once.setattr(at_service._loop, "time", lambda: now)
            for k in range(1, 6001):
                question = b"\1\0" + k.to_bytes(4, "big") * 2 + b"\0\0flood"
                # As the system would hand them over, if it kept as many.
                at_service.take_datagram(ours._cipher.encrypt(question), ("127.0.0.1", 9))
        assert at_service.ended
        assert at_service.reason == "sends more datagrams than can be heard beside those of others"
        assert 0 < len(calls) < 6000 - 4096
        await greedy_inbox.wait_for(ServiceVanished("cloud", "b1"))
        await answers(robot, inbox, 6)
        assert ServiceVanished("cloud", "b1") not in inbox

    async def test_keys_are_of_no_use_once_the_certificate_is_revoked(
        self, udp: StreamWire
    ) -> None:
        calls: list[bytes] = []
        robot, inbox, service = await connected(udp, noting(calls))
        kept, at_service = link_of(robot)._cipher, link_at(service)
        assert kept is not None
        assert service.end_links(lambda peer: "is revoked" if peer.name == "robot" else None) == 1
        with stranger(place_of(udp)) as to_service:
            for k in range(1, 200):
                question = b"\1\0" + k.to_bytes(4, "big") * 2 + b"\0\0stolen"
                at_service.take_datagram(kept.encrypt(question), ("127.0.0.1", 9))
                to_service.send(kept.encrypt(question))
            await inbox.wait_for(ServiceVanished("cloud", "b1"))
            await inbox.appeared(times=2)
            await until(lambda: robot.sends_datagrams("cloud"))
            await answers(robot, inbox, 1)  # over a new link, behind all of these
            with pytest.raises(BlockingIOError):
                to_service.recv(1)
        assert calls == [b"question"]

    async def test_what_was_recorded_leads_no_answer_elsewhere(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot, inbox, service = await connected(udp)
        link = link_of(robot)
        sent: list[bytes] = []
        put = link._put

        def record(datagram: bytes) -> None:
            sent.append(datagram)
            put(datagram)

        monkeypatch.setattr(link, "_put", record)
        for call in range(5):
            await answers(robot, inbox, call)
        before = link_at(service)._return_path.address
        with stranger(place_of(udp)) as to_service:
            for datagram in sent:
                to_service.send(datagram)
            await answers(robot, inbox, 6)
            with pytest.raises(BlockingIOError):
                to_service.recv(1)
        assert link_at(service)._return_path.address == before

    async def test_one_that_was_held_back_leads_no_answer_elsewhere(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """It is genuine and comes for the first time, but newer ones have come before it."""
        robot, inbox, service = await connected(udp)
        link = link_of(robot)
        held: list[bytes] = []
        put = link._put
        monkeypatch.setattr(link, "_put", held.append)
        link._exchange.probe(asyncio.get_running_loop().time())
        monkeypatch.setattr(link, "_put", put)
        await answers(robot, inbox, 1)
        before = link_at(service)._return_path.address
        with stranger(place_of(udp)) as to_service:
            for datagram in held:
                to_service.send(datagram)
            await answers(robot, inbox, 2)
            await answers(robot, inbox, 3)
            assert link_at(service)._return_path.address == before
            with pytest.raises(BlockingIOError):
                to_service.recv(1)

    @given(data=st.lists(st.binary(max_size=80), max_size=5), tail=st.binary(max_size=40))
    @settings(max_examples=30)
    def test_arbitrary_datagrams(
        self, data: list[bytes], tail: bytes, robot_tls: TlsFiles, service_tls: TlsFiles
    ) -> None:
        """Strangers send it, and a robot that has keys: its link alone may go."""

        async def run() -> None:
            wire = StreamWire("udp", Path(), robot_tls=robot_tls, service_tls=service_tls)
            try:
                robot, inbox, _ = await connected(wire)
                link = link_of(robot)
                hostile = wire.robot("cloud")
                hostile.start(Inbox())
                await until(lambda: hostile.sends_datagrams("cloud"))
                with stranger(place_of(wire)) as to_service:
                    for each in data:
                        to_service.send(each)
                        for kind in range(7):
                            link_of(hostile)._send_datagram(bytes((kind,)) + each[:1] + tail)
                await answers(robot, inbox, 1)
                assert link_of(robot) is link
            finally:
                await wire.close_on_loop()

        asyncio.run(run())


STREAM: tuple[Carrier, ...] = ("streams",)
DATAGRAMS: tuple[Carrier, ...] = ("datagrams",)


class Line(NamedTuple):
    """A robot and its service, and what carries the stream and the datagrams between them."""

    robot: StreamRobotTransport
    inbox: Inbox
    proxy: Proxy


@contextlib.asynccontextmanager
async def on_a_line(
    wire: StreamWire, serve: Callable[[IncomingCall], None] = echo
) -> AsyncIterator[Line]:
    """Connect them over a line on which streams and datagrams can be disturbed apart."""
    await wire.service("cloud", "b1").start(serve)
    _, target = place_of(wire)
    entry = free_port()
    wire._endpoints["cloud"] = f"udp/127.0.0.1:{entry}"
    with Proxy(entry, target, "seed", datagrams=True) as proxy:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        await until(lambda: robot.sends_datagrams("cloud"))
        yield Line(robot, inbox, proxy)
        await robot.close()


async def answers_of(robot: StreamRobotTransport, inbox: Inbox, calls: Received) -> None:
    robot.call("cloud", 1, b"other")
    call = await calls.next()
    assert call.payload == b"other"
    echo(call)
    assert await inbox.of_call(1) == [ReplyReceived(1, b"other"), CallEnded(1)]


class TestEnds:
    async def test_a_stream_that_breaks_ends_nothing_while_datagrams_come(
        self, udp: StreamWire
    ) -> None:
        calls = Received()
        async with on_a_line(udp, calls) as (robot, inbox, proxy):
            link = link_of(robot)
            robot.call("cloud", 1, b"in the middle")
            first = await calls.next()
            heal = await asyncio.to_thread(proxy.impair, Impairment(cut=True, carriers=STREAM))
            await until(lambda: link.without_stream)
            robot.call("cloud", 2, b"without a stream")
            second = await calls.next()
            echo(second)
            assert await inbox.of_call(2) == [ReplyReceived(2, b"without a stream"), CallEnded(2)]
            await asyncio.to_thread(heal)
            await until(lambda: link_of(robot) is not link)
            echo(first)
            assert await inbox.of_call(1) == [ReplyReceived(1, b"in the middle"), CallEnded(1)]
            robot.call("cloud", 3, bytes(100_000))
            echo(await calls.next())
            assert len(await inbox.of_call(3)) == 2
            await until(lambda: link.ended)
            assert [
                e for e in inbox.events if isinstance(e, ServiceAppeared | ServiceVanished)
            ] == [ServiceAppeared("cloud", "b1")]

    @pytest.mark.parametrize("direction", ["both", "to_service", "to_robot"])
    async def test_a_stream_that_is_held_up_ends_nothing(
        self, direction: Direction, udp: StreamWire
    ) -> None:
        """For longer than a lease neither end hears the other on the stream, and nobody asks."""
        udp.lease_ms = 2000.0
        async with on_a_line(udp) as (robot, inbox, proxy):
            link = link_of(robot)
            silent = Impairment(direction=direction, silent=True, carriers=STREAM)
            heal = await asyncio.to_thread(proxy.impair, silent)
            await asyncio.sleep(3.0)
            await answers(robot, inbox, 1)
            await asyncio.to_thread(heal)
            robot.call("cloud", 2, bytes(100_000))
            assert len(await inbox.of_call(2)) == 2
            assert link_of(robot) is link
            assert [event for event, _ in udp.events if event == "robot_disconnected"] == []

    async def test_where_no_datagram_gets_through_it_is_told_and_all_goes_on_the_stream(
        self, udp: StreamWire, robot_tls: TlsFiles, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(datagram_links, "_BLOCKED_AFTER_S", 0.1)
        await udp.service("cloud", "b1").start(echo)
        _, target = place_of(udp)
        entry = free_port()
        closed: list[tuple[str, str]] = []
        with Proxy(entry, target, "filtered"):
            robot = StreamRobotTransport(
                {"cloud": f"udp/127.0.0.1:{entry}"},
                tls=robot_tls,
                on_event=lambda event, **fields: closed.append((event, fields["service"])),
            )
            inbox = Inbox()
            robot.start(inbox)
            await inbox.appeared()
            await until(lambda: bool(closed))
            await answers(robot, inbox, 1)
            assert not robot.sends_datagrams("cloud")
            assert closed == [("no_datagrams", "cloud")]
            await robot.close()

    async def test_adrift_it_is_lost_when_nothing_comes(self, udp: StreamWire) -> None:
        udp.lease_ms = LEASE_MS
        async with on_a_line(udp) as (robot, inbox, proxy):
            link = link_of(robot)
            await asyncio.to_thread(proxy.impair, Impairment(cut=True, carriers=STREAM))
            await until(lambda: link.without_stream)
            await answers(robot, inbox, 1)
            await asyncio.to_thread(proxy.impair, Impairment(cut=True, carriers=DATAGRAMS))
            await inbox.wait_for(ServiceVanished("cloud", "b1"))
            robot.call("cloud", 2, b"nobody is there")
            assert await inbox.of_call(2) == [CallEnded(2)]

    async def test_a_port_that_is_closed_is_a_service_that_is_gone(self, udp: StreamWire) -> None:
        """Although its stream, held open by a line that has fallen silent, says nothing."""
        udp.lease_ms = 3.6e6
        async with on_a_line(udp) as (robot, inbox, proxy):
            await at_rest(link_of(robot))
            await asyncio.to_thread(proxy.impair, Impairment(silent=True, carriers=STREAM))
            # From now on the system answers.
            await asyncio.to_thread(proxy.impair, Impairment(cut=True, carriers=DATAGRAMS))
            link = link_of(robot)
            robot.call("cloud", 1, b"question")
            await inbox.wait_for(ServiceVanished("cloud", "b1"), CallEnded(1))
            assert link.reason == "is gone: its port is closed"

    async def test_who_cannot_quote_what_was_sent_is_not_believed(
        self, udp: StreamWire, robot_tls: TlsFiles
    ) -> None:
        """Anybody may write in the name of a host that a port of it is closed."""
        await udp.service("cloud", "b1").start(echo)
        _, target = place_of(udp)
        entry = free_port()
        with Proxy(entry, target, "seed", datagrams=True) as proxy:
            robot = StreamRobotTransport(
                {"cloud": f"udp/127.0.0.1:{entry}"}, tls=robot_tls, lease_ms=3.6e6
            )
            udp.ends.insert(0, robot)
            inbox = Inbox()
            robot.start(inbox)
            await until(lambda: robot.sends_datagrams("cloud"))
            link = link_of(robot)
            await at_rest(link)
            await answers(robot, inbox, 1)
            await at_rest(link)
            ours = link._socket
            assert ours is not None
            closed = Impairment(cut=True, carriers=DATAGRAMS)
            heal = await asyncio.to_thread(proxy.impair, closed)
            header = link._sent[-1][:8]
            for unlike in (b"", header, header + bytes(24), bytes(1200)):
                ours.send(unlike)  # the system's answer quotes it
                await until(lambda: not select.select([ours], [], [], 0.0)[0])
            await asyncio.to_thread(heal)
            await answers(robot, inbox, 2)
            assert link_of(robot) is link
            assert ServiceVanished("cloud", "b1") not in inbox
            await robot.close()

    async def test_a_service_that_closes_has_answered_before(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        calls = Received()
        robot, inbox, service = await connected(udp, calls)
        robot.call("cloud", 1, b"last")
        call = await calls.next()
        link = link_at(service)
        monkeypatch.setattr(link, "_put", lambda _: None)  # lost
        echo(call)
        await service.close()
        assert await inbox.of_call(1) == [ReplyReceived(1, b"last"), CallEnded(1)]

    async def test_keys_that_are_used_up_make_way_for_new_ones(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot, _, _ = await connected(udp)
        link = link_of(robot)
        monkeypatch.setattr(datagram_cipher, "MAX_DATAGRAMS", 10)
        for call in range(20):
            robot.call("cloud", call, b"question")
        await until(lambda: robot.sends_datagrams("cloud") and link_of(robot) is not link)
        assert link.ended


class TestWhatGoesTogether:
    async def test_a_robot_over_tls_at_a_service_over_udp(
        self, udp: StreamWire, robot_tls: TlsFiles
    ) -> None:
        await udp.service("cloud", "b1").start(echo)
        refusals: list[str] = []
        robot = StreamRobotTransport(
            {"cloud": udp.endpoint("cloud").replace("udp", "tls")},
            tls=robot_tls,
            on_event=lambda _, **fields: refusals.append(fields["reason"]),
        )
        robot.start(Inbox())
        await until(lambda: bool(refusals))
        wanted = "is at udp/..., and the other end at tls/...: write the same at both ends"
        assert wanted in refusals[0]
        await robot.close()

    @pytest.mark.parametrize("end", ["robot", "service"])
    def test_without_the_package_it_is_said_how_to_get_it(
        self, end: str, robot_tls: TlsFiles, service_tls: TlsFiles, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.ciphers.aead", None)
        with pytest.raises(TransportError, match="pip install cryptography"):
            if end == "robot":
                StreamRobotTransport({"c": "udp/127.0.0.1:1"}, tls=robot_tls)
            else:
                StreamServiceTransport(
                    "cloud", incarnation="b1", listen=["udp/127.0.0.1:0"], tls=service_tls
                )

    def test_without_credentials(self) -> None:
        with pytest.raises(TransportError, match="udp needs credentials"):
            StreamRobotTransport({"cloud": "udp/127.0.0.1:1"})
        with pytest.raises(TransportError, match="udp needs credentials"):
            StreamServiceTransport("cloud", incarnation="b1", listen=["udp/127.0.0.1:0"])
