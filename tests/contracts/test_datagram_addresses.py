"""Where datagrams go: spoofed and copied addresses, robots that move, forged reports of routers."""

import asyncio
import os
import socket
import struct
from typing import Any, cast

import pytest
from tests.contracts.test_datagram_links import (
    at_rest,
    connected,
    link_at,
    link_of,
    noting,
    on_a_line,
    place_of,
    stranger,
)
from tests.contracts.wires import Inbox, StreamWire, answers, echo, until
from tests.ports import free_port

from holdfast.protocol.robot_events import ServiceAppeared, ServiceVanished
from holdfast.transport.datagram_links import RobotDatagramLink
from holdfast.transport.exchanges import ECHO
from holdfast_lab.testbed.bad_line import Impairment
from holdfast_lab.testbed.proxy import Proxy

PROBE_BYTES = 34


def all_of(receiver: socket.socket) -> list[bytes]:
    """Return the datagrams that have come to a socket."""
    come = []
    while True:
        try:
            come.append(receiver.recv(65_536))
        except BlockingIOError:
            return come


def overheard(monkeypatch: pytest.MonkeyPatch, link: RobotDatagramLink, method: str) -> list[bytes]:
    """Return a list to which each datagram is added that a method of a link gets."""
    seen: list[bytes] = []
    do = getattr(link, method)

    def add(datagram: bytes, *more: object) -> None:
        seen.append(datagram)
        do(datagram, *more)

    monkeypatch.setattr(link, method, add)
    return seen


class TestSpoofedAddresses:
    @pytest.mark.parametrize("message", [b"", b"\1\0", bytes(1000)])
    async def test_who_has_not_echoed_gets_at_most_three_times_what_came_from_there(
        self, message: bytes, udp: StreamWire
    ) -> None:
        """A robot with a certificate writes the address of somebody else on its datagrams."""
        robot, inbox, service = await connected(udp)
        link, at_service = link_of(robot), link_at(service)
        assert link._cipher is not None
        ours = at_service._return_path.address
        with stranger(place_of(udp)) as victim:
            sent = 0
            for call in range(100):
                datagram = link._cipher.encrypt(message)
                sent += len(datagram)
                victim.send(datagram)
                await answers(robot, inbox, call)
            come = all_of(victim)
            assert come  # it was asked whether it is the robot
            assert sum(map(len, come)) <= 3 * sent
            assert {len(each) for each in come} == {PROBE_BYTES}
        assert at_service._return_path.address == ours

    async def test_questions_from_there_are_answered_at_the_proved_address(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Somebody beside the path copies each datagram and is faster."""
        questions: list[bytes] = []
        robot, inbox, service = await connected(udp, noting(questions))
        link, at_service = link_of(robot), link_at(service)
        await at_rest(link)
        ours = at_service._return_path.address
        with stranger(place_of(udp)) as beside:
            monkeypatch.setattr(link, "_put", beside.send)  # the robot's own come too late
            for call in range(30):
                await answers(robot, inbox, call)
            assert at_service._return_path.address == ours
            assert {len(each) for each in all_of(beside)} == {PROBE_BYTES}
        assert questions == [b"question"] * 30
        assert link_of(robot) is link

    async def test_the_first_address_has_to_echo_too(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """The stream proves the address of a stream."""
        send, echoes = RobotDatagramLink._send_datagram, False

        def send_no_echo(self: RobotDatagramLink, message: bytes) -> None:
            if echoes or message[0] != ECHO:
                send(self, message)

        monkeypatch.setattr(RobotDatagramLink, "_send_datagram", send_no_echo)
        service = udp.service("cloud", "b1")
        questions: list[bytes] = []
        await service.start(noting(questions))
        robot, inbox = udp.robot("cloud"), Inbox()
        robot.start(inbox)
        await inbox.appeared()
        link, at_service = link_of(robot), link_at(service)
        come = overheard(monkeypatch, link, "take_datagram")
        await until(lambda: len(come) > 5)
        await answers(robot, inbox, 1)
        assert {len(each) for each in come} == {PROBE_BYTES}
        assert at_service._return_path.address is None
        assert not robot.sends_datagrams("cloud")
        echoes = True
        await until(lambda: robot.sends_datagrams("cloud"))
        assert at_service._return_path.address is not None


class TestOneWay:
    async def test_where_only_the_robots_datagrams_get_through_the_stream_carries_all(
        self, udp: StreamWire
    ) -> None:
        """The service's probes show nobody that it lives, so it goes on to say so there."""
        udp.lease_ms = 500.0
        await udp.service("cloud", "b1").start(echo)
        _, target = place_of(udp)
        udp._endpoints["cloud"] = f"udp/127.0.0.1:{free_port()}"
        robot, inbox = udp.robot("cloud"), Inbox()
        carried: list[str] = []
        with Proxy(
            place_of(udp)[1],
            target,
            "one way",
            datagrams=True,
            overhear=lambda carrier, way, _: carried.append(f"{carrier} {way}"),
        ) as proxy:
            blocked = Impairment(direction="to_robot", silent=True, carriers=("datagrams",))
            await asyncio.to_thread(proxy.impair, blocked)
            robot.start(inbox)
            await inbox.appeared()
            # Three leases, in which nothing is asked and the stream's slowest pings are too rare.
            await asyncio.sleep(1.6)
            await answers(robot, inbox, 1)
            assert "datagrams to_service" in carried
            assert "datagrams to_robot" not in carried
            assert not robot.sends_datagrams("cloud")
            assert ServiceVanished("cloud", "b1") not in inbox
            await robot.close()


class TestSocketsOfAService:
    async def test_one_that_no_robot_uses_is_closed(self, udp: StreamWire) -> None:
        robot, inbox, service = await connected(udp)
        other = udp.robot("cloud")
        other.start(Inbox())
        await until(lambda: other.sends_datagrams("cloud"))
        sockets = cast("Any", service._makers["udp"]).keywords["sockets"]
        (used,) = sockets.values()
        await other.close()
        await until(lambda: len(service._links) == 1)
        await answers(robot, inbox, 1)
        await robot.close()
        await until(lambda: not service._links)
        assert sockets == {}
        assert used._socket.fileno() == -1
        again = udp.robot("cloud")
        again.start(Inbox())
        await until(lambda: again.sends_datagrams("cloud"))


class TestMoving:
    async def test_a_robot_whose_address_translation_changes_goes_on(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """As a router does that has forgotten it: the robot itself notices nothing."""
        async with on_a_line(udp) as (robot, inbox, proxy):
            link = link_of(robot)
            service = udp.ends[0]
            at_service = link_at(service)  # type: ignore[arg-type]
            on_stream: list[bytes] = []
            for each in (link, at_service):
                monkeypatch.setattr(
                    each, "_send_on_stream", lambda _, message: on_stream.append(message)
                )
            for call in range(5):
                await at_rest(link)
                before = at_service._return_path.address
                await asyncio.to_thread(proxy.change_address)
                await answers(robot, inbox, call)
                assert at_service._return_path.address != before
            assert link_of(robot) is link
            assert [type(event) for event in inbox.events if not hasattr(event, "call")] == [
                ServiceAppeared
            ]
            monkeypatch.undo()
            assert on_stream == []


HOST, PORT = 1, 3


def unreachable(what: int, source: tuple[str, int], to: tuple[str, int], datagram: bytes) -> bytes:
    """Return what a router says to the sender of a datagram: type 3 of ICMP, with a code."""
    addresses = b"".join(socket.inet_aton(host) for host, _ in (source, to))
    udp_bytes = 8 + len(datagram)
    ip = struct.pack(">BBHHHBBH", 0x45, 0, 20 + udp_bytes, 0, 0, 64, 17, 0) + addresses
    quoted = ip + struct.pack(">HHHH", source[1], to[1], udp_bytes, 0) + datagram
    quoted += bytes(len(quoted) % 2)
    words = struct.unpack(f">{len(quoted) // 2}H", quoted)
    checksum = sum(words) + 0x0300 + what
    while checksum >> 16:
        checksum = (checksum & 0xFFFF) + (checksum >> 16)
    return struct.pack(">BBHI", 3, what, ~checksum & 0xFFFF, 0) + quoted


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can write ICMP")
class TestForgedReports:
    @pytest.mark.parametrize("what", [HOST, PORT])
    async def test_an_observer_cannot_end_a_link_while_answers_come(
        self, what: int, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot, inbox, _ = await connected(udp)
        link = link_of(robot)
        assert link._socket is not None
        ours = link._socket.getsockname()
        seen = overheard(monkeypatch, link, "_put")
        with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP) as observer:
            for call in range(20):
                await answers(robot, inbox, call)
                report = unreachable(what, ours, place_of(udp), seen[-1])
                observer.sendto(report, ("127.0.0.1", 0))
                if what == PORT:
                    await until(lambda: link._verifies)
                    await until(lambda: not link._verifies)
        await answers(robot, inbox, 20)
        assert link._socket.getsockname() == ours
        assert link_of(robot) is link
        assert ServiceVanished("cloud", "b1") not in inbox

    async def test_it_is_believed_when_no_datagram_comes_any_more(
        self, udp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        robot, inbox, service = await connected(udp)
        link = link_of(robot)
        assert link._socket is not None
        await at_rest(link)
        seen = overheard(monkeypatch, link, "_put")
        await answers(robot, inbox, 1)
        monkeypatch.setattr(link_at(service), "_put", lambda _: None)
        with socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_ICMP) as observer:
            report = unreachable(PORT, link._socket.getsockname(), place_of(udp), seen[-1])
            observer.sendto(report, ("127.0.0.1", 0))
            await inbox.wait_for(ServiceVanished("cloud", "b1"))
        assert link.reason == "is gone: its port is closed"
