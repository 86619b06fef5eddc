"""What every wire must do, over all of them; and what only sockets, processes and keys can show.

Waits are bounded by ``PATIENCE_S``, which is long: a test fails when something does not happen, not
when a busy machine makes it happen late.
"""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import functools
import ipaddress
import itertools
import os
import signal
import socket
import ssl
import stat
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Protocol, TypeAlias

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509 import oid
from tests.ports import free_port
from tests.processes.faults import PATIENT

from holdfast.errors import InvalidValueError, TransportError
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent, Vanished
from holdfast.session.messages import Refused, decode_reply
from holdfast.transport import dialer as dialer_module
from holdfast.transport import frames, links, listener, robot_end, service_end
from holdfast.transport.contract import IncomingCall, RobotTransport, ServiceTransport
from holdfast.transport.dialer import Dialer
from holdfast.transport.endpoints import PrivateSocket, ServiceAddress, TlsFiles
from holdfast.transport.in_process import InProcessNetwork
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.service_end import StreamServiceTransport
from holdfast.transport.tls import TlsStream, client_context, server_context

PATIENCE_S = 30.0
LEASE_MS = 2000.0
"""For what is found by its silence."""

MAX_BYTES = 4_000_000
TWO_MEGABYTES = 2_000_000

Serve: TypeAlias = Callable[[IncomingCall], None]


async def until(condition: Callable[[], bool], what: Callable[[], object] = object) -> None:
    """Wait until something is so."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise AssertionError(f"not in {PATIENCE_S} s: {what()}")
        await asyncio.sleep(0.005)


class Inbox:
    """Takes events, and lets a test wait for some."""

    def __init__(self) -> None:
        self.events: list[TransportEvent] = []
        self.threads: set[int] = set()
        self._changed = asyncio.Event()

    def __call__(self, event: TransportEvent) -> None:
        self.events.append(event)
        self.threads.add(threading.get_ident())
        self._changed.set()

    async def wait(self, condition: Callable[[list[TransportEvent]], bool]) -> None:
        try:
            async with asyncio.timeout(PATIENCE_S):
                while not condition(self.events):
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            raise AssertionError(f"not in {PATIENCE_S} s; there were {self.events}") from None

    async def wait_for(self, *events: TransportEvent) -> None:
        await self.wait(lambda _: all(event in self for event in events))

    async def appeared(self, service: str = "cloud", times: int = 1) -> str:
        """Wait until a service has appeared so often; return what it was called last."""
        await self.wait(lambda _: len(self.boots(service)) >= times)
        return self.boots(service)[times - 1]

    def boots(self, service: str = "cloud") -> list[str]:
        return [e.boot for e in self.events if isinstance(e, Appeared) and e.service == service]

    def __contains__(self, event: TransportEvent) -> bool:
        return self.count(event) > 0

    def count(self, event: TransportEvent) -> int:
        # By type as well: named tuples are equal if their fields are.
        return sum(type(each) is type(event) and each == event for each in self.events)

    async def of_call(self, call: int) -> list[TransportEvent]:
        """Wait for the end of a call and return what came of it."""
        await self.wait(lambda _: Ended(call) in self)
        return [e for e in self.events if isinstance(e, Replied | Ended) and e.call == call]


class Received:
    """Takes calls, and lets a test wait for the next one."""

    def __init__(self) -> None:
        self._calls: asyncio.Queue[IncomingCall] = asyncio.Queue()

    def __call__(self, call: IncomingCall) -> None:
        self._calls.put_nowait(call)

    async def next(self) -> IncomingCall:
        async with asyncio.timeout(PATIENCE_S):
            return await self._calls.get()


class Wire(Protocol):
    """Makes ends that belong together, and closes them."""

    def robot(self, *services: str, max_message_bytes: int = MAX_BYTES) -> RobotTransport: ...

    def service(self, name: str, boot: str) -> ServiceTransport: ...


class InProcessWire:
    def __init__(self) -> None:
        self._network = InProcessNetwork(max_message_bytes=MAX_BYTES)
        self.ends: list[RobotTransport | ServiceTransport] = []

    def robot(self, *services: str, max_message_bytes: int = MAX_BYTES) -> RobotTransport:
        robot = self._network.robot(services)
        self.ends.append(robot)
        return robot

    def service(self, name: str, boot: str) -> ServiceTransport:
        service = self._network.service(name, boot)
        self.ends.append(service)
        return service

    async def close_on_loop(self) -> None:
        for end in self.ends:
            await end.close()


class StreamWire:
    """One endpoint for each name; either the services listen at it or the robot does."""

    def __init__(
        self,
        protocol: str,
        directory: Path,
        *,
        robot_tls: TlsFiles | None = None,
        service_tls: TlsFiles | None = None,
        robot_listens: bool = False,
    ) -> None:
        self.protocol = protocol
        self.directory = directory
        self.robot_tls = robot_tls
        self.service_tls = service_tls
        self.robot_listens = robot_listens
        # What is closed or killed is found at once; a machine that stands still is no lost link.
        self.lease_ms = PATIENT["lease_ms"]
        self._endpoints: dict[str, str] = {}
        self.ends: list[RobotTransport | ServiceTransport] = []
        self.told: list[tuple[str, dict[str, object]]] = []
        self.refusals: list[tuple[str, str]] = []

    def endpoint(self, name: str) -> str:
        if name not in self._endpoints:
            self._endpoints[name] = unused_endpoint(self.protocol, self.directory)
        return self._endpoints[name]

    def robot(
        self, *services: str, max_message_bytes: int = MAX_BYTES, name: str = ""
    ) -> StreamRobotTransport:
        robot = StreamRobotTransport(
            {name: ServiceAddress(self.endpoint(name), self.robot_listens) for name in services},
            name=name,
            lease_ms=self.lease_ms,
            max_message_bytes=max_message_bytes,
            tls=self.robot_tls,
            on_unreachable=lambda *refusal: self.refusals.append(refusal),
        )
        self.ends.append(robot)
        return robot

    def service(self, name: str, boot: str) -> StreamServiceTransport:
        endpoints = [self.endpoint(name)]
        service = StreamServiceTransport(
            name,
            boot=boot,
            listen=[] if self.robot_listens else endpoints,
            connect=endpoints if self.robot_listens else [],
            lease_ms=self.lease_ms,
            max_message_bytes=MAX_BYTES,
            tls=self.service_tls,
            on_event=lambda event, **fields: self.told.append((event, fields)),
        )
        self.ends.append(service)
        return service

    def reasons(self) -> list[str]:
        """Return why links were refused, at the service's end."""
        return [str(fields["reason"]) for event, fields in self.told if event == "link_refused"]

    def heard(self) -> list[tuple[str, object, object]]:
        """Return the events of the service's end, with the robot and the reason of each."""
        return [(event, each.get("robot"), each.get("reason")) for event, each in self.told]

    async def close_on_loop(self) -> None:
        for end in self.ends:
            await end.close()


def unused_endpoint(protocol: str, directory: Path) -> str:
    if protocol == "unix":
        return f"{protocol}/{directory}/{len(list(directory.iterdir()))}-{os.urandom(4).hex()}"
    return f"{protocol}/127.0.0.1:{free_port()}"


class Authority:
    """Certifies, with keys that are made for the test."""

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        directory.mkdir()
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, directory.name)])
        self._certificate = self._certify(self._name, self._key.public_key())

    def issue(self, name: str, *usages: x509.ObjectIdentifier) -> TlsFiles:
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        certificate = self._certify(subject, key.public_key(), usages)
        place = self.directory / name
        place.mkdir()
        files = TlsFiles(
            place / "authority.pem",
            place / "certificate.pem",
            place / "key.pem",
        )
        pem = serialization.Encoding.PEM
        files.authority.write_bytes(self._certificate.public_bytes(pem))
        files.certificate.write_bytes(certificate.public_bytes(pem))
        files.key.write_bytes(
            key.private_bytes(pem, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
        )
        return files

    def _certify(
        self,
        subject: x509.Name,
        public_key: ec.EllipticCurvePublicKey,
        usages: tuple[x509.ObjectIdentifier, ...] = (),
    ) -> x509.Certificate:
        now = dt.datetime.now(dt.UTC)
        is_authority = not usages
        names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        builder = (
            x509.CertificateBuilder()
            .subject_name(subject)
            .issuer_name(self._name)
            .public_key(public_key)
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - dt.timedelta(hours=1))
            .not_valid_after(now + dt.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=is_authority, path_length=None), critical=True)
        )
        if not is_authority:
            builder = builder.add_extension(x509.ExtendedKeyUsage(usages), critical=False)
            builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        return builder.sign(self._key, hashes.SHA256())


@pytest.fixture(scope="session")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("tls") / "authority")


@pytest.fixture(scope="session")
def robot_tls(authority: Authority) -> TlsFiles:
    return authority.issue("robot", oid.ExtendedKeyUsageOID.CLIENT_AUTH)


@pytest.fixture(scope="session")
def service_tls(authority: Authority) -> TlsFiles:
    return authority.issue("service", oid.ExtendedKeyUsageOID.SERVER_AUTH)


@pytest.fixture
def socket_directory() -> Iterator[Path]:
    """Pytest's own directories have paths too long for a socket."""
    with PrivateSocket() as place:
        yield Path(place.endpoint.removeprefix("unix/")).parent


WIRES = ["in_process", "tcp", "tls", "udp", "unix", "robot_listens", "robot_listens_tls"]


@pytest.fixture(params=WIRES)
def wire(
    request: pytest.FixtureRequest,
    socket_directory: Path,
    robot_tls: TlsFiles,
    service_tls: TlsFiles,
) -> Wire:
    match request.param:
        case "in_process":
            return InProcessWire()
        case "robot_listens":
            return StreamWire("unix", socket_directory, robot_listens=True)
        case "tls" | "udp" | "robot_listens_tls":
            return StreamWire(
                "udp" if request.param == "udp" else "tls",
                socket_directory,
                robot_tls=robot_tls,
                service_tls=service_tls,
                robot_listens=request.param == "robot_listens_tls",
            )
        case protocol:
            return StreamWire(protocol, socket_directory)


@pytest.fixture
def tcp(socket_directory: Path) -> StreamWire:
    return StreamWire("tcp", socket_directory)


@pytest.fixture
def tls(socket_directory: Path, robot_tls: TlsFiles, service_tls: TlsFiles) -> StreamWire:
    return StreamWire("tls", socket_directory, robot_tls=robot_tls, service_tls=service_tls)


def echo(call: IncomingCall) -> None:
    call.reply(call.payload)
    call.end()


def echo_of_size(call: IncomingCall) -> None:
    call.reply(b"%d" % len(call.payload))
    call.end()


def saying(text: bytes) -> Serve:
    """Return a service that always says the same."""

    def answer(call: IncomingCall) -> None:
        call.reply(text)
        call.end()

    return answer


def silent(call: IncomingCall) -> None:
    """Take a call and leave it open."""


async def connected(
    wire: Wire, service: Serve = echo, boot: str = "b1"
) -> tuple[RobotTransport, Inbox, ServiceTransport]:
    """Return both ends of one service, once the robot sees it."""
    serving = wire.service("cloud", boot)
    await serving.start(service)
    robot = wire.robot("cloud")
    inbox = Inbox()
    robot.start(inbox)
    await inbox.wait_for(Appeared("cloud", boot))
    if isinstance(wire, StreamWire) and wire.protocol == "udp":
        assert isinstance(robot, StreamRobotTransport)
        await until(lambda: robot.sends_datagrams("cloud"))
    return robot, inbox, serving


def refusal_of(events: list[TransportEvent]) -> Refused:
    """Return what a call was refused with, which then ended."""
    replied, _ = events
    assert isinstance(replied, Replied)
    refused = decode_reply(replied.payload)
    assert isinstance(refused, Refused)
    return refused


class TestEveryWire:
    async def test_a_call_brings_the_reply_and_one_end(self, wire: Wire) -> None:
        robot, inbox, _ = await connected(wire)
        robot.call("cloud", 7, b"question")
        assert await inbox.of_call(7) == [Replied(7, b"question"), Ended(7)]

    async def test_several_replies_come_in_order(self, wire: Wire) -> None:
        def count(call: IncomingCall) -> None:
            for i in range(50):
                call.reply(b"%d" % i)
            call.end()

        robot, inbox, _ = await connected(wire, count)
        robot.call("cloud", 1, b"")
        expected: list[TransportEvent] = [Replied(1, b"%d" % i) for i in range(50)]
        assert await inbox.of_call(1) == [*expected, Ended(1)]

    async def test_replies_come_while_the_call_is_open(self, wire: Wire) -> None:
        calls = Received()
        robot, inbox, _ = await connected(wire, calls)
        robot.call("cloud", 1, b"question")
        call = await calls.next()
        assert call.payload == b"question"
        call.reply(b"first")
        await inbox.wait_for(Replied(1, b"first"))
        assert Ended(1) not in inbox
        call.reply(b"second")
        call.end()
        assert await inbox.of_call(1) == [Replied(1, b"first"), Replied(1, b"second"), Ended(1)]

    async def test_what_comes_after_the_end_is_no_error_and_goes_nowhere(self, wire: Wire) -> None:
        calls = Received()
        robot, inbox, _ = await connected(wire, calls)
        robot.call("cloud", 1, b"")
        call = await calls.next()
        call.end()
        call.end()
        call.reply(b"late")
        robot.call("cloud", 2, b"")
        echo(await calls.next())
        assert await inbox.of_call(2) == [Replied(2, b""), Ended(2)]
        assert await inbox.of_call(1) == [Ended(1)]

    async def test_an_absent_service_ends_a_call(self, wire: Wire) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Ended(1)]

    async def test_nothing_is_delivered_from_inside_a_method(self, wire: Wire) -> None:
        inside = False
        inbox = Inbox()
        serving = wire.service("cloud", "b1")

        def deliver(event: TransportEvent) -> None:
            assert not inside
            inbox(event)

        def serve(call: IncomingCall) -> None:
            nonlocal inside
            assert not inside
            inside = True
            call.reply(call.payload)
            call.end()
            inside = False

        robot = wire.robot("cloud")
        inside = True
        robot.start(deliver)
        robot.call("cloud", 1, b"nobody is there")
        inside = False
        await serving.start(serve)
        await inbox.appeared()
        inside = True
        robot.call("cloud", 2, b"question")
        robot.call("cloud", 3, bytes(MAX_BYTES + 1))
        robot.call("cloud", 4, b"given up")
        robot.abandon(4)
        inside = False
        assert await inbox.of_call(1) == [Ended(1)]
        assert await inbox.of_call(2) == [Replied(2, b"question"), Ended(2)]
        assert len(await inbox.of_call(3)) == 2
        assert inbox.threads == {threading.get_ident()}

    async def test_a_service_that_starts_after_the_robot_appears(self, wire: Wire) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        service = wire.service("cloud", "later")
        await service.start(echo)
        await inbox.wait_for(Appeared("cloud", "later"))
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    async def test_a_service_that_has_appeared_can_be_called_as_soon_as_that_is_heard(
        self, wire: Wire
    ) -> None:
        service = wire.service("cloud", "b1")
        robot = wire.robot("cloud")
        inbox = Inbox()

        def deliver(event: TransportEvent) -> None:
            if isinstance(event, Appeared):
                robot.call("cloud", 1, b"question")
            inbox(event)

        robot.start(deliver)
        await service.start(echo)
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    async def test_large_messages_both_ways(self, wire: Wire) -> None:
        robot, inbox, _ = await connected(wire, echo)
        payload = bytes(range(256)) * (TWO_MEGABYTES // 256)
        robot.call("cloud", 1, payload)
        robot.call("cloud", 2, b"small, while the large one is on its way")
        assert await inbox.of_call(1) == [Replied(1, payload), Ended(1)]
        assert len(await inbox.of_call(2)) == 2

    async def test_an_empty_message_is_a_message(self, wire: Wire) -> None:
        robot, inbox, _ = await connected(wire)
        robot.call("cloud", 1, b"")
        assert await inbox.of_call(1) == [Replied(1, b""), Ended(1)]

    async def test_many_calls_at_once_with_answers_from_other_threads(self, wire: Wire) -> None:
        loop = asyncio.get_running_loop()
        with ThreadPoolExecutor(4) as workers:

            def answer(call: IncomingCall) -> None:
                call.reply(b"first")
                echo(call)

            def hand_over(call: IncomingCall) -> None:
                workers.submit(loop.call_soon_threadsafe, answer, call)

            robot, inbox, _ = await connected(wire, hand_over)
            for number in range(200):
                robot.call("cloud", number, b"%d" % number)
            for number in range(200):
                assert await inbox.of_call(number) == [
                    Replied(number, b"first"),
                    Replied(number, b"%d" % number),
                    Ended(number),
                ]

    async def test_nothing_comes_of_an_abandoned_call(self, wire: Wire) -> None:
        calls = Received()
        robot, inbox, service = await connected(wire, calls)
        robot.call("cloud", 1, b"abandoned")
        call = await calls.next()
        robot.abandon(1)
        robot.abandon(1)
        robot.abandon(99)
        echo(call)
        robot.call("cloud", 2, b"other")
        echo(await calls.next())
        assert await inbox.of_call(2) == [Replied(2, b"other"), Ended(2)]
        await service.close()
        await inbox.wait_for(Vanished("cloud", "b1"))
        assert [e for e in inbox.events if isinstance(e, Replied | Ended) and e.call == 1] == []

    async def test_an_abandoned_number_can_be_used_again(self, wire: Wire) -> None:
        calls = Received()
        robot, inbox, _ = await connected(wire, calls)
        robot.call("cloud", 1, b"old")
        old = await calls.next()
        robot.abandon(1)
        robot.call("cloud", 1, b"new")
        new = await calls.next()
        echo(old)
        echo(new)
        assert await inbox.of_call(1) == [Replied(1, b"new"), Ended(1)]

    async def test_a_service_that_closes_ends_the_calls_that_it_has(self, wire: Wire) -> None:
        calls = Received()
        robot, inbox, service = await connected(wire, calls)
        for number in range(3):
            robot.call("cloud", number, b"")
        for _ in range(3):
            await calls.next()
        await service.close()
        await inbox.wait_for(Vanished("cloud", "b1"))
        for number in range(3):
            assert await inbox.of_call(number) == [Ended(number)]

    async def test_a_call_after_the_service_has_gone_ends(self, wire: Wire) -> None:
        robot, inbox, service = await connected(wire)
        await service.close()
        await inbox.wait_for(Vanished("cloud", "b1"))
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Ended(1)]

    async def test_a_restarted_service_is_another_one(self, wire: Wire) -> None:
        robot, inbox, service = await connected(wire)
        boots = ["b1"]
        for k in range(2, 5):
            await service.close()
            await inbox.wait_for(Vanished("cloud", boots[-1]))
            service = wire.service("cloud", f"b{k}")
            await service.start(saying(b"%d" % k))
            boots.append(await inbox.appeared(times=k))
            robot.call("cloud", k, b"who?")
            assert await inbox.of_call(k) == [Replied(k, b"%d" % k), Ended(k)]
        seen = [event for event in inbox.events if isinstance(event, Appeared | Vanished)]
        there_and_gone = [e("cloud", boot) for boot in boots for e in (Appeared, Vanished)]
        assert list(map(repr, seen)) == list(map(repr, there_and_gone[:-1]))
        assert len(set(boots)) == 4
        if not (isinstance(wire, StreamWire) and wire.protocol in ("tls", "udp")):
            # Over TLS it is seen before it can say what it is called.
            assert boots == ["b1", "b2", "b3", "b4"]

    async def test_two_services_are_never_mixed(self, wire: Wire) -> None:
        for name in ("east", "west"):
            await wire.service(name, "b1").start(saying(name.encode()))
        robot, inbox = wire.robot("east", "west"), Inbox()
        robot.start(inbox)
        await inbox.wait_for(Appeared("east", "b1"), Appeared("west", "b1"))
        for number in range(40):
            robot.call(("east", "west")[number % 2], number, b"who?")
        for number in range(40):
            name = ("east", "west")[number % 2]
            assert await inbox.of_call(number) == [Replied(number, name.encode()), Ended(number)]

    async def test_one_of_two_services_vanishes_alone(self, wire: Wire) -> None:
        services = {name: wire.service(name, "b1") for name in ("east", "west")}
        for service in services.values():
            await service.start(silent)
        robot, inbox = wire.robot("east", "west"), Inbox()
        robot.start(inbox)
        await inbox.wait_for(Appeared("east", "b1"), Appeared("west", "b1"))
        robot.call("east", 1, b"")
        robot.call("west", 2, b"")
        await services["east"].close()
        await inbox.wait_for(Vanished("east", "b1"), Ended(1))
        assert Vanished("west", "b1") not in inbox
        assert Ended(2) not in inbox

    async def test_a_service_that_is_about_to_end_answers_those_that_are_there(
        self, wire: Wire
    ) -> None:
        calls = Received()
        robot, inbox, service = await connected(wire, calls)
        robot.call("cloud", 1, b"before")
        before = await calls.next()
        gone = service.dismiss()
        robot.call("cloud", 2, b"after")
        echo(await calls.next())
        assert await inbox.of_call(2) == [Replied(2, b"after"), Ended(2)]
        assert Vanished("cloud", "b1") not in inbox
        echo(before)
        assert await inbox.of_call(1) == [Replied(1, b"before"), Ended(1)]
        if isinstance(wire, StreamWire):  # else nobody is told
            await inbox.wait_for(Vanished("cloud", "b1"))
        async with asyncio.timeout(PATIENCE_S):
            await gone

    async def test_a_request_that_is_too_large_is_refused(self, wire: Wire) -> None:
        robot, inbox, _ = await connected(wire)
        robot.call("cloud", 1, bytes(MAX_BYTES + 1))
        refused = refusal_of(await inbox.of_call(1))
        assert refused.code == "too_large"
        assert str(MAX_BYTES) in refused.text
        robot.call("cloud", 2, bytes(MAX_BYTES))
        assert await inbox.of_call(2) == [Replied(2, bytes(MAX_BYTES)), Ended(2)]

    async def test_a_reply_that_is_too_large_is_dropped(self, wire: Wire) -> None:
        def answer(call: IncomingCall) -> None:
            call.reply(bytes(MAX_BYTES + 1))
            call.reply(b"small")
            call.end()

        robot, inbox, _ = await connected(wire, answer)
        robot.call("cloud", 1, b"")
        assert await inbox.of_call(1) == [Replied(1, b"small"), Ended(1)]

    async def test_a_robot_that_goes_hinders_nobody(self, wire: Wire) -> None:
        if isinstance(wire, StreamWire) and wire.robot_listens:
            pytest.skip("only one robot can listen at an endpoint")
        calls = Received()
        robot, _, _ = await connected(wire, calls)
        other, inbox = wire.robot("cloud"), Inbox()
        other.start(inbox)
        await inbox.wait_for(Appeared("cloud", "b1"))
        robot.call("cloud", 1, b"")
        orphan = await calls.next()
        await robot.close()
        orphan.reply(b"to nobody")
        orphan.end()
        other.call("cloud", 1, b"question")
        echo(await calls.next())
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    async def test_a_robot_that_returns_sees_the_service(self, wire: Wire) -> None:
        robot, _, _ = await connected(wire)
        await robot.close()
        again, inbox = wire.robot("cloud"), Inbox()
        again.start(inbox)
        await inbox.wait_for(Appeared("cloud", "b1"))
        again.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    async def test_a_closed_robot_delivers_nothing_more(self, wire: Wire) -> None:
        calls = Received()
        robot, inbox, service = await connected(wire, calls)
        robot.call("cloud", 1, b"")
        call = await calls.next()
        await robot.close()
        await robot.close()
        before = list(inbox.events)
        robot.call("cloud", 2, b"")
        robot.abandon(1)
        echo(call)
        await service.close()
        await service.close()
        assert inbox.events == before == [Appeared("cloud", "b1")]

    async def test_a_closed_service_delivers_nothing_more(self, wire: Wire) -> None:
        received: list[IncomingCall] = []
        numbers = itertools.count()

        def serve(call: IncomingCall) -> None:
            received.append(call)
            echo(call)

        robot, inbox, service = await connected(wire, serve)

        async def flood() -> None:
            while True:
                for _ in range(10):
                    robot.call("cloud", next(numbers), b"")
                await asyncio.sleep(0)

        flooding = asyncio.get_running_loop().create_task(flood())
        await inbox.wait(lambda events: sum(isinstance(e, Replied) for e in events) > 20)
        await service.close()
        at_close = len(received)
        await inbox.wait_for(Vanished("cloud", "b1"))
        flooding.cancel()
        assert len(received) == at_close

    async def test_ends_that_were_never_started_can_be_closed(self, wire: Wire) -> None:
        robot, service = wire.robot("cloud"), wire.service("cloud", "b1")
        for end in (robot, service):
            await end.close()
            await end.close()

    async def test_mistakes_of_the_caller_are_told(self, wire: Wire) -> None:
        robot, inbox, _ = await connected(wire, silent)
        with pytest.raises(InvalidValueError, match=r"'elsewhere'.*cloud"):
            robot.call("elsewhere", 1, b"")
        robot.call("cloud", 1, b"")
        with pytest.raises(InvalidValueError, match="call 1 is in flight"):
            robot.call("cloud", 1, b"")
        assert [e for e in inbox.events if isinstance(e, Ended)] == []


@contextlib.contextmanager
def slow_proxy(port: int, bytes_per_second: float) -> Iterator[int]:
    """Carry connections to a port, slowly, with little room for what is on its way."""
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)
    listener.bind(("127.0.0.1", 0))
    listener.listen()
    sockets = [listener]

    def carry(source: socket.socket, target: socket.socket) -> None:
        due_s = 0.0
        with contextlib.suppress(OSError):
            while data := source.recv(2048):
                # Who slept too long catches up, or the link would be slower than it says.
                due_s = max(due_s, time.monotonic() - 0.1) + len(data) / bytes_per_second
                time.sleep(max(0.0, due_s - time.monotonic()))
                target.sendall(data)

    def accept() -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = listener.accept()
                far = socket.create_connection(("127.0.0.1", port))
                sockets.extend((near, far))
                for ends in ((near, far), (far, near)):
                    threading.Thread(target=carry, args=ends, daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield listener.getsockname()[1]
    finally:
        for each in sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)  # wakes who waits for it
            each.close()


class Visitor:
    """A client that says what no client of ours would."""

    def __init__(self, endpoint: str) -> None:
        place = endpoint.partition("/")[2]
        host, _, port = place.rpartition(":")
        family = socket.AF_INET if port.isdigit() else socket.AF_UNIX
        self.socket = socket.socket(family)
        self.socket.setblocking(False)
        self.address: Any = (host, int(port)) if port.isdigit() else place

    async def connect(self) -> Visitor:
        await asyncio.get_running_loop().sock_connect(self.socket, self.address)
        return self

    async def say(self, data: bytes) -> None:
        await asyncio.get_running_loop().sock_sendall(self.socket, data)

    async def hear(self) -> bytes:
        """Return all that comes until the other end closes."""
        heard = b""
        async with asyncio.timeout(PATIENCE_S):
            with contextlib.suppress(ConnectionError):
                while data := await asyncio.get_running_loop().sock_recv(self.socket, 65536):
                    heard += data
        return heard

    def __enter__(self) -> Visitor:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()


HELLO = frames.encode_hello("robot", "", "i1", 30_000.0)


class TestStreams:
    async def test_port_0_becomes_a_port(self) -> None:
        service = StreamServiceTransport("cloud", boot="b1", listen=["tcp/127.0.0.1:0"])
        await service.start(echo)
        robot = StreamRobotTransport({"cloud": ServiceAddress(service.endpoints[0])})
        inbox = Inbox()
        robot.start(inbox)
        await inbox.wait_for(Appeared("cloud", "b1"))
        assert not service.endpoints[0].endswith(":0")
        await robot.close()
        await service.close()

    async def test_a_service_that_takes_no_more_links_does_not_look_for_robots(
        self, socket_directory: Path
    ) -> None:
        wire = StreamWire("unix", socket_directory, robot_listens=True)
        robot, inbox, service = await connected(wire)
        assert isinstance(service, StreamServiceTransport)
        (dialer,) = service._dialers.values()
        robot.call("cloud", 1, b"")
        await inbox.of_call(1)
        service.dismiss()
        await until(lambda: len(wire.told) == 2)
        assert dialer._next is None
        await wire.close_on_loop()

    async def test_a_host_name_is_looked_up(self, tcp: StreamWire) -> None:
        await tcp.service("cloud", "b1").start(echo)
        endpoint = tcp.endpoint("cloud").replace("127.0.0.1", "localhost")
        robot, inbox = StreamRobotTransport({"cloud": ServiceAddress(endpoint)}), Inbox()
        tcp.ends.append(robot)
        robot.start(inbox)
        await inbox.wait_for(Appeared("cloud", "b1"))

    async def test_a_name_that_was_asked_for_must_be_the_service_s(self, tcp: StreamWire) -> None:
        await tcp.service("cloud", "b1").start(echo)
        endpoint = tcp.endpoint("cloud")
        refusals: list[tuple[str, str]] = []
        robot = StreamRobotTransport(
            {
                "right": ServiceAddress(endpoint, name="cloud"),
                "wrong": ServiceAddress(endpoint, name="other"),
            },
            on_unreachable=lambda *refusal: refusals.append(refusal),
        )
        tcp.ends.append(robot)
        inbox = Inbox()
        robot.start(inbox)
        await inbox.wait_for(Appeared("right", "b1"))
        await until(lambda: bool(refusals))
        assert refusals == [("wrong", "is the service cloud, and other was expected")]
        robot.call("wrong", 1, b"")
        assert await inbox.of_call(1) == [Ended(1)]

    async def test_of_two_services_at_a_listening_robot_the_newest_is_called(
        self, socket_directory: Path
    ) -> None:
        wire = StreamWire("unix", socket_directory, robot_listens=True)
        robot, inbox, _ = await connected(wire, saying(b"old"))
        newer = wire.service("cloud", "b2")
        await newer.start(saying(b"new"))
        await inbox.wait_for(Appeared("cloud", "b2"))
        robot.call("cloud", 1, b"")
        assert await inbox.of_call(1) == [Replied(1, b"new"), Ended(1)]
        await newer.close()
        await inbox.wait(lambda _: inbox.count(Appeared("cloud", "b1")) == 2)
        robot.call("cloud", 2, b"")
        assert await inbox.of_call(2) == [Replied(2, b"old"), Ended(2)]
        await wire.close_on_loop()

    async def test_a_robot_remembers_the_last_few_reasons(self, socket_directory: Path) -> None:
        """A peer may say another one in each goodbye, for as long as it likes."""
        wire = StreamWire("unix", socket_directory, robot_listens=True)
        robot = wire.robot("cloud")
        robot.start(Inbox())
        endpoint = wire.endpoint("cloud")
        texts = ["is 0", "is 0", *(f"is {number}" for number in range(1, 20)), "is 0", "is 0"]
        told = [text for at, text in enumerate(texts) if at not in (1, len(texts) - 1)]
        for text in texts:
            with await Visitor(endpoint).connect() as visitor:
                await visitor.say(frames.MAGIC + frames.encode_goodbye(text))
                await visitor.hear()
        await until(lambda: len(wire.refusals) >= len(told), lambda: wire.refusals)
        assert [reason for _, reason in wire.refusals] == [
            f"refuses this end, which {text}" for text in told
        ]
        await wire.close_on_loop()

    async def test_the_service_refuses_what_is_too_large_for_it(self, tcp: StreamWire) -> None:
        received: list[IncomingCall] = []
        await tcp.service("cloud", "b1").start(received.append)
        robot, inbox = tcp.robot("cloud", max_message_bytes=2 * MAX_BYTES), Inbox()
        robot.start(inbox)
        await inbox.wait_for(Appeared("cloud", "b1"))
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
        greeting, last = frames.FrameDecoder(MAX_BYTES).feed(heard)
        assert greeting.kind == frames.HELLO
        assert last == (frames.LAST, 5, b"question", 0)

    @pytest.mark.parametrize("robot_listens", [False, True])
    async def test_nothing_waits_for_more_to_be_sent_with_it(
        self, socket_directory: Path, robot_listens: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        made: list[links.Link] = []
        begin = links.Link.connection_made

        def connection_made(link: links.Link, transport: asyncio.BaseTransport) -> None:
            begin(link, transport)
            stream = transport.get_extra_info("socket")
            assert stream.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            made.append(link)

        monkeypatch.setattr(links.Link, "connection_made", connection_made)
        wire = StreamWire("tcp", socket_directory, robot_listens=robot_listens)
        await connected(wire)
        assert len(made) == 2
        await wire.close_on_loop()

    async def test_a_taken_port_is_an_error_that_names_it(self, tcp: StreamWire) -> None:
        await tcp.service("cloud", "b1").start(echo)
        endpoint = tcp.endpoint("cloud")
        with pytest.raises(TransportError, match=f"cannot listen on {endpoint}: Address already"):
            await tcp.service("cloud", "b2").start(echo)
        robot = StreamRobotTransport({"cloud": ServiceAddress(endpoint, listens=True)})
        with pytest.raises(TransportError, match=f"cannot listen on {endpoint}: Address already"):
            robot.start(Inbox())

    async def test_an_address_of_another_machine_is_an_error_that_says_so(self) -> None:
        service = StreamServiceTransport("cloud", boot="b1", listen=["tcp/192.0.2.1:7447"])
        reason = r"tcp/192\.0\.2\.1:7447: .*: this machine has no such address \(0\.0\.0\.0"
        with pytest.raises(TransportError, match=reason):
            await service.start(echo)

    async def test_one_bad_endpoint_of_two_is_an_error(self, tcp: StreamWire) -> None:
        taken, free = tcp.endpoint("taken"), tcp.endpoint("free")
        await tcp.service("taken", "b1").start(echo)
        both = StreamServiceTransport("both", boot="b1", listen=[free, taken])
        with pytest.raises(TransportError, match="cannot listen on"):
            await both.start(echo)
        await tcp.service("free", "b1").start(echo)  # the first one was given back

    async def test_a_taken_socket_is_an_error_that_names_it(self, socket_directory: Path) -> None:
        wire = StreamWire("unix", socket_directory)
        _, inbox, _ = await connected(wire)
        with pytest.raises(TransportError, match=r"unix/.*: another process listens there"):
            await wire.service("cloud", "b2").start(echo)
        assert Vanished("cloud", "b1") not in inbox
        await wire.close_on_loop()

    async def test_what_a_killed_process_left_is_replaced_and_nothing_else(
        self, socket_directory: Path
    ) -> None:
        wire = StreamWire("unix", socket_directory)
        path = Path(wire.endpoint("cloud").removeprefix("unix/"))
        with socket.socket(socket.AF_UNIX) as left:
            left.bind(str(path))
        robot, inbox, service = await connected(wire)
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]
        assert stat.S_ISSOCK(path.stat().st_mode)
        await service.close()
        assert not path.exists()
        path.write_text("somebody's data")
        with pytest.raises(TransportError, match=r"unix/.*: there is a file of that name"):
            await wire.service("cloud", "b2").start(echo)
        assert path.read_text() == "somebody's data"
        await wire.close_on_loop()

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
            StreamServiceTransport(bad, boot="b1", listen=["tcp/127.0.0.1:0"])
        with pytest.raises(TransportError, match="boot of a service"):
            StreamServiceTransport("cloud", boot=bad, listen=["tcp/127.0.0.1:0"])
        with pytest.raises(TransportError, match="incarnation of a robot"):
            StreamRobotTransport({}, incarnation=bad)

    def test_the_right_credentials_or_none(self, robot_tls: TlsFiles, tmp_path: Path) -> None:
        with pytest.raises(TransportError, match=r"tls needs credentials.*--tls"):
            StreamRobotTransport({"cloud": ServiceAddress("tls/localhost:7447")})
        with pytest.raises(TransportError, match=r"tcp does not use the credentials"):
            StreamRobotTransport({"cloud": ServiceAddress("tcp/localhost:7447")}, tls=robot_tls)
        missing = TlsFiles(robot_tls.authority, tmp_path / "missing.pem", robot_tls.key)
        with pytest.raises(TransportError, match=r"missing\.pem cannot be read: No such file"):
            StreamRobotTransport({"cloud": ServiceAddress("tls/localhost:7447")}, tls=missing)

    def test_a_robot_connects_to_a_port_and_a_service_has_an_endpoint(self) -> None:
        with pytest.raises(TransportError, match="port 0 is for listening"):
            StreamRobotTransport({"cloud": ServiceAddress("tcp/127.0.0.1:0")})
        with pytest.raises(TransportError, match="has no endpoint"):
            StreamServiceTransport("cloud", boot="b1")

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
            address = ServiceAddress(f"tcp/127.0.0.1:{slow_port}")
            robot = StreamRobotTransport({"cloud": address}, lease_ms=600.0)
            inbox = Inbox()
            robot.start(inbox)
            await inbox.wait_for(Appeared("cloud", "b1"))
            robot.call("cloud", 1, bytes(200_000))
            robot.call("cloud", 2, b"small")
            assert await inbox.of_call(1) == [Replied(1, b"200000"), Ended(1)]
            assert await inbox.of_call(2) == [Replied(2, b"5"), Ended(2)]
            assert Vanished("cloud", "b1") not in inbox
            await robot.close()


@pytest.mark.parametrize("protocol", ["tcp", "tls", "udp", "unix"])
class TestVisitors:
    """What connects to a service and is no robot of ours costs the robots nothing."""

    @pytest.fixture
    def wire(
        self, protocol: str, socket_directory: Path, robot_tls: TlsFiles, service_tls: TlsFiles
    ) -> StreamWire:
        if protocol in ("tls", "udp"):
            return StreamWire(
                protocol, socket_directory, robot_tls=robot_tls, service_tls=service_tls
            )
        return StreamWire(protocol, socket_directory)

    @pytest.mark.parametrize(
        ("greeting", "plain", "over_tls"),
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
        self, wire: StreamWire, greeting: bytes, plain: str, over_tls: str | None
    ) -> None:
        await wire.service("cloud", "b1").start(echo)
        wanted = over_tls if wire.protocol in ("tls", "udp") else plain
        if wanted is None:
            pytest.skip("it is the beginning of a greeting")
        with await Visitor(wire.endpoint("cloud")).connect() as visitor:
            await visitor.say(greeting)
            heard = await visitor.hear()
        assert b"boot" not in heard
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
                    assert len(service._ungreeted) <= service_end._MAX_UNGREETED
            robot, inbox = wire.robot("cloud"), Inbox()
            robot.start(inbox)
            await inbox.wait_for(Appeared("cloud", "b1"))
            robot.call("cloud", 1, b"question")
            assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]
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
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        await inbox.wait_for(Appeared("cloud", "b1"))


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
        self, tls: StreamWire, robot_tls: TlsFiles, begun: int
    ) -> None:
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

    async def test_a_service_that_is_slow_is_not_hung_up_on(self, tls: StreamWire) -> None:
        tls.robot_listens = True
        tls.robot("cloud").start(Inbox())
        with contextlib.ExitStack() as stack:
            service = stack.enter_context(Visitor(tls.endpoint("cloud")))
            await service.connect()
            others = self.flood(stack, tls.endpoint("cloud"), b"")
            await self.until_closed(others, self.MANY - robot_end._MAX_UNGREETED)
            assert self.is_open(service.socket)

    def test_an_owner_of_many_addresses_of_ipv6_is_one(self) -> None:
        def network(address: str) -> bytes:
            return listener._network_of(socket.AF_INET6, (address, 1, 0, 0))

        assert network("2001:db8::1") == network("2001:db8::ffff:2")
        assert network("2001:db8::1") != network("2001:db8:0:1::1")
        assert network("fe80::1%lo") == network("fe80::2")
        assert network("::ffff:10.0.0.1") == listener._network_of(socket.AF_INET, ("10.0.0.1", 1))
        assert network("::ffff:10.0.0.1") != network("::ffff:10.0.0.2")


class TestPeers:
    """Peers that have greeted, and then do not do their part."""

    async def test_a_hello_of_another_version_is_refused_in_words_at_both_ends(
        self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        await tcp.service("cloud", "b1").start(echo)
        robot, inbox = tcp.robot("cloud"), Inbox()
        hello = robot.settings.hello()
        other = hello.replace(b"\xa7version\x01", b"\xa7version\x02")
        robot.settings = robot.settings._replace(hello=lambda: other)
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
            greeting = frames.encode_hello("service", "cloud", "b1", 400.0)
            writer.write(greeting.replace(b"\xa7version\x01", b"\xa7version\x07"))
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
                robot.call("cloud", number, b"question")
                assert await inbox.of_call(number) == [Replied(number, b"question"), Ended(number)]
            lost = ("robot_disconnected", "", "does not read what it is sent")
            await until(lambda: tcp.heard().count(lost) == 2, lambda: tcp.told)
        assert Vanished("cloud", "b1") not in inbox

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
            await until(lambda: len(tcp.told) == 2)
            (_, first), (name, fields) = tcp.told
            assert name == "robot_disconnected"
            assert str(fields["reason"]).startswith(reason)
            assert first["address"] == fields["address"] == f"{host}:{port}"
            tcp.told.clear()
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(HELLO)
            await until(lambda: connected in tcp.heard())
            await service.close()
            await until(lambda: len(tcp.told) == 2)
        assert tcp.heard()[-1] == ("robot_disconnected", "", "this service ends")

    async def test_half_a_message_and_silence_costs_the_link_after_the_lease(
        self, tcp: StreamWire
    ) -> None:
        await tcp.service("cloud", "b1").start(echo)
        hello = frames.encode_hello("robot", "r", "i1", 500.0)
        with await Visitor(tcp.endpoint("cloud")).connect() as visitor:
            await visitor.say(hello + frames.encode_frame(frames.CALL, 1, bytes(1000))[:500])
            await visitor.hear()
        await until(lambda: len(tcp.told) == 2)
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
            assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]
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
            await until(lambda: link._waits_for_reader)
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
            await until(lambda: tcp.told[-1][1].get("reason") == lost)
            await large[0].hear()
            # It began before all the others.
            await small.say(little[1000:] + frames.encode_goodbye("done"))
            decoder = frames.FrameDecoder(MAX_BYTES)
            assert [frame.kind for frame in decoder.feed(await small.hear())][1] == frames.LAST
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    async def test_half_received_messages_share_a_bound(self, tcp: StreamWire) -> None:
        robot, inbox, _ = await connected(tcp)
        with contextlib.ExitStack() as stack:
            visitors = [stack.enter_context(Visitor(tcp.endpoint("cloud"))) for _ in range(3)]
            for visitor in visitors:
                await visitor.connect()
                begun = frames.encode_frame(frames.CALL, 1, bytes(MAX_BYTES))[:-1]
                await visitor.say(HELLO + begun)
            lost = "has not finished a message, and others need the memory"
            await until(lambda: tcp.told[-1][1].get("reason") == lost)
            # The first of them began first; the others are still there.
            await visitors[0].hear()
            await visitors[1].say(b"\0")
            robot.call("cloud", 1, bytes(MAX_BYTES))
            assert await inbox.of_call(1) == [Replied(1, bytes(MAX_BYTES)), Ended(1)]
        assert Vanished("cloud", "b1") not in inbox

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
        assert "which is one too many: 1 robots are connected" in tcp.refusals[0][1]
        assert inbox.events == []

    async def test_connections_that_say_nothing_keep_no_service_out(
        self, socket_directory: Path, robot_tls: TlsFiles, service_tls: TlsFiles
    ) -> None:
        wire = StreamWire(
            "tls",
            socket_directory,
            robot_tls=robot_tls,
            service_tls=service_tls,
            robot_listens=True,
        )
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(wire.close_on_loop)
            for _ in range(200):
                visitor = stack.enter_context(Visitor(wire.endpoint("cloud")))
                visitor.socket.setblocking(True)
                visitor.socket.connect(visitor.address)
            links_made = robot._services["cloud"]._made
            for _ in range(100):
                await asyncio.sleep(0)
                assert sum(not link.ended for link in links_made) <= robot_end._MAX_UNGREETED
            await wire.service("cloud", "b1").start(echo)
            await inbox.wait_for(Appeared("cloud", "b1"))


class TestUnreachable:
    """Why a robot misses a service is told, in words for whoever has to mend it."""

    @staticmethod
    async def told(wire: StreamWire) -> str:
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
        self,
        socket_directory: Path,
        robot_tls: TlsFiles,
        service_tls: TlsFiles,
        protocol: str,
        reason: str,
    ) -> None:
        keys = (robot_tls, service_tls) if protocol in ("tls", "udp") else (None, None)
        wire = StreamWire(protocol, socket_directory, robot_tls=keys[0], service_tls=keys[1])
        robot, inbox = wire.robot("cloud"), Inbox()
        async with contextlib.AsyncExitStack() as stack:
            stack.push_async_callback(wire.close_on_loop)
            robot.start(inbox)
            await until(lambda: bool(wire.refusals))
            dialer = robot._services["cloud"]._dialer
            assert dialer is not None
            turn = dialer._turn
            await until(lambda: dialer._turn > turn + 3)
            assert wire.refusals == [("cloud", reason)]
            service = wire.service("cloud", "b1")
            await service.start(echo)
            await inbox.wait_for(Appeared("cloud", "b1"))
            await service.close()
            await until(lambda: len(wire.refusals) == 2)
            assert wire.refusals[1] == ("cloud", reason)

    async def test_a_name_that_nobody_has(self, tcp: StreamWire) -> None:
        # No server need be asked to know that there is no such network interface.
        host = "fe80::1%absent"
        tcp._endpoints["cloud"] = f"tcp/[{host}]:7447"
        assert await self.told(tcp) == f"host name not found: {host}"

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
        monkeypatch.setattr(Dialer, "_place_of", lambda *_: b"")  # in this order
        tcp._endpoints["cloud"] = f"tcp/robot.example:{port}"
        robot, inbox = tcp.robot("cloud"), Inbox()
        robot.start(inbox)
        await inbox.appeared()
        dialer = robot._services["cloud"]._dialer
        assert dialer is not None
        assert dialer._turn >= 2
        assert tcp.refusals == []

    async def test_nothing_answers(self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(dialer_module, "_CONNECT_TIMEOUT_S", 0.2)
        place = tcp.endpoint("cloud")
        with contextlib.ExitStack() as stack:
            address = ("127.0.0.1", int(place.rpartition(":")[2]))
            stack.enter_context(socket.create_server(address, backlog=0))
            for _ in range(4):  # they fill its queue
                stack.enter_context(Visitor(place)).socket.connect_ex(address)
            assert await self.told(tcp) == "nothing answers"

    async def test_it_closes_each_connection(self, tcp: StreamWire) -> None:
        async with self.listening(tcp, lambda *_: asyncio.sleep(0)):
            assert (await self.told(tcp)).startswith("closes connections without a hello")

    async def test_it_says_nothing(self, tcp: StreamWire, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(links, "OPENING_TIMEOUT_S", 0.2)
        async with self.listening(tcp, lambda reader, _: reader.read()):
            assert await self.told(tcp) == "has said no hello within 0.2 s"

    async def test_it_does_not_speak_tls(self, tls: StreamWire) -> None:
        async def answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            writer.write(b"SSH-2.0-anything\r\n")
            await reader.read()

        async with self.listening(tls, answer):
            assert (await self.told(tls)).startswith("does not speak TLS 1.3 as expected")

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
        assert (await self.told(wires[asked])).startswith(expected)


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
            boot=f"at-{host}",
            listen=[f"{self.wire.protocol}/{host}:{self.port}"],
            tls=self.wire.service_tls,
            on_event=lambda event, **fields: self.wire.told.append((event, fields)),
        )
        await service.start(serve)
        self.wire.ends.append(service)
        self.running[f"at-{host}"] = service
        return service


class TestReplicas:
    @pytest.fixture(params=["tcp", "tls", "udp"])
    def wire(
        self,
        request: pytest.FixtureRequest,
        socket_directory: Path,
        robot_tls: TlsFiles,
        service_tls: TlsFiles,
    ) -> StreamWire:
        keys = (None, None) if request.param == "tcp" else (robot_tls, service_tls)
        return StreamWire(request.param, socket_directory, robot_tls=keys[0], service_tls=keys[1])

    @pytest.fixture
    def replicas(self, wire: StreamWire, monkeypatch: pytest.MonkeyPatch) -> Replicas:
        return Replicas(wire, 3, monkeypatch)

    async def test_one_that_is_about_to_end_is_left_before_it_is_missed(
        self, wire: StreamWire, replicas: Replicas
    ) -> None:
        calls = Received()
        for host in replicas.hosts:
            await replicas.start(host, calls)
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        first = await inbox.appeared()
        robot.call("cloud", 1, b"owed")
        owed = await calls.next()
        gone = replicas.running[first].dismiss()
        connected = [f for e, f in wire.told if e == "robot_connected"]
        await until(
            lambda: len([1 for e, _ in wire.told if e == "robot_connected"]) > len(connected)
        )
        echo(owed)
        assert await inbox.of_call(1) == [Replied(1, b"owed"), Ended(1)]
        second = await inbox.appeared(times=2)
        async with asyncio.timeout(PATIENCE_S):
            await gone
        assert second != first
        robot.call("cloud", 2, b"next")
        echo(await calls.next())
        assert await inbox.of_call(2) == [Replied(2, b"next"), Ended(2)]
        # The robot is told of the next process before it hears that the one before is gone.
        kinds = [type(e) for e in inbox.events if isinstance(e, Appeared | Vanished)]
        assert kinds[:2] == [Appeared, Appeared]
        ends = [reason for event, _, reason in wire.heard() if event == "robot_disconnected"]
        assert ends == ["said goodbye"]
        assert not wire.refusals

    async def test_a_question_asked_while_another_is_owed_goes_to_the_next(
        self, wire: StreamWire, replicas: Replicas
    ) -> None:
        calls = Received()
        for host in replicas.hosts[:2]:
            await replicas.start(host, calls)
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        first = await inbox.appeared()
        robot.call("cloud", 1, b"given up")
        await calls.next()
        replicas.running[first].dismiss()
        service = robot._services["cloud"]
        await until(lambda: service._successor is not None)
        robot.call("cloud", 2, b"new")
        echo(await calls.next())
        assert await inbox.of_call(2) == [Replied(2, b"new"), Ended(2)]
        assert await inbox.appeared(times=2) != first

    async def test_it_goes_on_being_asked_while_nobody_else_answers(
        self, wire: StreamWire, replicas: Replicas
    ) -> None:
        """At the other addresses somebody takes connections and says nothing."""
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
                robot.call("cloud", number, b"echo")
                assert await inbox.of_call(number) == [Replied(number, b"echo"), Ended(number)]
            assert not gone.done()
            assert Vanished("cloud", first) not in inbox
            await robot.close()
        await wire.close_on_loop()

    async def test_the_next_one_is_lost_too(self, wire: StreamWire, replicas: Replicas) -> None:
        calls = Received()
        for host in replicas.hosts:
            await replicas.start(host, calls)
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        first = await inbox.appeared()
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
        assert await inbox.of_call(1) == [Replied(1, b"owed"), Ended(1)]
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
    counts = [chosen.count(boot) // 2 for boot in replicas.running]
    assert min(counts) >= 5, counts
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
    monkeypatch.setattr(dialer_module, "_RESOLVE_AGAIN_S", 0.01)
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


def assert_matches(text: str, pattern: str) -> None:
    import re

    assert re.search(pattern, text), text


class TestCertificates:
    async def test_strangers_see_nothing(
        self, tls: StreamWire, robot_tls: TlsFiles, tmp_path: Path
    ) -> None:
        usage = oid.ExtendedKeyUsageOID.CLIENT_AUTH
        foreign = Authority(tmp_path / "foreign").issue("robot", usage)
        # A stranger's certificate, but the right authority: it believes the service.
        stranger = TlsFiles(robot_tls.authority, foreign.certificate, foreign.key)
        received: list[bytes] = []

        def serve(call: IncomingCall) -> None:
            received.append(call.payload)
            echo(call)

        await tls.service("cloud", "b1").start(serve)
        address = ServiceAddress(tls.endpoint("cloud"))
        refusals: list[tuple[str, str]] = []
        for files in (foreign, stranger):
            outsider = StreamRobotTransport(
                {"cloud": address}, tls=files, on_unreachable=lambda *told: refusals.append(told)
            )
            tls.ends.append(outsider)
            inbox = Inbox()
            refusals.clear()
            outsider.start(inbox)
            await until(lambda: bool(refusals))
            outsider.call("cloud", 1, b"stranger")
            assert await inbox.of_call(1) == [Ended(1)]
            assert inbox.events == [Ended(1)]
            expected = (
                "has a certificate that was" if files is foreign else "refuses this end's cert"
            )
            assert expected in refusals[0][1]
        bare = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        bare.load_verify_locations(robot_tls.authority)
        host, _, port = address.endpoint.removeprefix("tls/").rpartition(":")
        with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
            reader, writer = await asyncio.open_connection(host, int(port), ssl=bare)
            writer.write(HELLO)
            await reader.read()
        writer.close()
        with contextlib.suppress(ssl.SSLError):
            await writer.wait_closed()
        robot, inbox = tls.robot("cloud"), Inbox()
        robot.start(inbox)
        await inbox.wait_for(Appeared("cloud", "b1"))
        robot.call("cloud", 1, b"friend")
        assert await inbox.of_call(1) == [Replied(1, b"friend"), Ended(1)]
        assert received == [b"friend"]
        assert {"shows no certificate"} < set(tls.reasons())

    async def test_a_robot_does_not_believe_a_service_of_another_authority(
        self, tls: StreamWire, tmp_path: Path
    ) -> None:
        usage = oid.ExtendedKeyUsageOID.SERVER_AUTH
        tls.service_tls = Authority(tmp_path / "foreign").issue("service", usage)
        await self.assert_refused(tls, "has a certificate that was not signed by the authority")

    async def test_a_robot_s_certificate_does_not_make_a_service(
        self, tls: StreamWire, robot_tls: TlsFiles
    ) -> None:
        tls.service_tls = robot_tls
        await self.assert_refused(tls, "has a certificate that is not for a service")

    async def test_a_service_s_certificate_does_not_make_a_robot(
        self, tls: StreamWire, service_tls: TlsFiles
    ) -> None:
        tls.robot_tls = service_tls
        await self.assert_refused(tls, "refuses this end's certificate")
        assert tls.reasons()[0] == "has a certificate that is not for a robot"

    async def test_a_robot_has_the_name_of_its_certificate_or_tells_none(
        self, tls: StreamWire
    ) -> None:
        await tls.service("cloud", "b1").start(echo)
        for name in ("robot", ""):
            robot, inbox = tls.robot("cloud", name=name), Inbox()
            robot.start(inbox)
            await inbox.appeared()
        robot, inbox = tls.robot("cloud", name="another"), Inbox()
        robot.start(inbox)
        await until(lambda: bool(tls.refusals) and bool(tls.reasons()))
        reason = "says that it is another, and shows the certificate of robot"
        assert tls.refusals[0] == ("cloud", f"refuses this end, which {reason}")
        assert tls.reasons()[0] == reason

    async def test_a_certificate_must_name_the_host(
        self, tls: StreamWire, authority: Authority
    ) -> None:
        await tls.service("cloud", "b1").start(echo)
        place = tls.endpoint("cloud").replace("127.0.0.1", "127.0.0.2")
        listening = StreamServiceTransport("cloud", boot="b1", listen=[place], tls=tls.service_tls)
        tls.ends.append(listening)
        await listening.start(echo)
        tls._endpoints["cloud"] = place
        robot, inbox = tls.robot("cloud"), Inbox()
        robot.start(inbox)
        await until(lambda: bool(tls.refusals))
        assert "does not name this host" in tls.refusals[0][1]
        assert inbox.events == []

    async def test_an_old_version_of_tls_is_refused(self, tls: StreamWire) -> None:
        await tls.service("cloud", "b1").start(echo)
        assert tls.robot_tls is not None
        context = client_context(tls.robot_tls)
        context.minimum_version = context.maximum_version = ssl.TLSVersion.TLSv1_2
        host, _, port = tls.endpoint("cloud").removeprefix("tls/").rpartition(":")
        with pytest.raises(ssl.SSLError, match="PROTOCOL_VERSION"):
            await asyncio.open_connection(host, int(port), ssl=context)

    @pytest.mark.parametrize("group", ["ffdhe8192", "secp521r1"])
    async def test_nobody_chooses_a_key_exchange_that_takes_long(
        self, tls: StreamWire, group: str
    ) -> None:
        await tls.service("cloud", "b1").start(echo)
        assert tls.robot_tls is not None
        context = client_context(tls.robot_tls)
        context.set_ecdh_curve(group)
        host, _, port = tls.endpoint("cloud").removeprefix("tls/").rpartition(":")
        with pytest.raises(ssl.SSLError, match="HANDSHAKE_FAILURE"):
            await asyncio.open_connection(host, int(port), ssl=context)

    @staticmethod
    async def assert_refused(tls: StreamWire, reason: str) -> None:
        await tls.service("cloud", "b1").start(echo)
        robot, inbox = tls.robot("cloud"), Inbox()
        robot.start(inbox)
        await until(lambda: bool(tls.refusals))
        assert reason in tls.refusals[0][1]
        robot.call("cloud", 1, b"")
        assert await inbox.of_call(1) == [Ended(1)]
        assert inbox.events == [Ended(1)]

    async def test_a_call_names_the_robot_s_certificate(
        self, tls: StreamWire, tcp: StreamWire
    ) -> None:
        for wire, name in ((tls, "robot"), (tcp, None)):
            calls = Received()
            robot, _, _ = await connected(wire, calls)
            robot.call("cloud", 1, b"")
            assert (await calls.next()).robot == name

    async def test_links_of_one_certificate_keep_no_other_out(
        self, tls: StreamWire, authority: Authority, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(service_end, "MAX_LINKS", 3)
        await tls.service("cloud", "b1").start(echo)
        greedy = [(tls.robot("cloud"), Inbox()) for _ in range(3)]
        for robot, inbox in greedy:
            robot.start(inbox)
            await inbox.wait_for(Appeared("cloud", "b1"))
        tls.robot_tls = authority.issue("one of many", oid.ExtendedKeyUsageOID.CLIENT_AUTH)
        other, other_inbox = tls.robot("cloud"), Inbox()
        other.start(other_inbox)
        await other_inbox.wait_for(Appeared("cloud", "b1"))
        reason = "has 3 links, and another robot needs one of 3"
        await until(lambda: tls.refusals[:1] == [("cloud", f"refuses this end, which {reason}")])
        full = "refuses this end, which is one too many: 3 robots are connected"
        await until(lambda: ("cloud", full) in tls.refusals)  # as it is back
        other.call("cloud", 1, b"question")
        assert await other_inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]
        assert Vanished("cloud", "b1") not in other_inbox

    async def test_links_of_some_certificates_can_be_ended(
        self, tls: StreamWire, authority: Authority
    ) -> None:
        robot, inbox, service = await connected(tls)
        assert isinstance(service, StreamServiceTransport)
        tls.robot_tls = authority.issue("other", oid.ExtendedKeyUsageOID.CLIENT_AUTH)
        other, other_inbox = tls.robot("cloud"), Inbox()
        other.start(other_inbox)
        await other_inbox.wait_for(Appeared("cloud", "b1"))
        shown = x509.load_pem_x509_certificate(tls.robot_tls.certificate.read_bytes())
        assert (
            service.end_links(lambda peer: "is revoked" if peer.serial_number == 1 else None) == 0
        )
        assert (
            service.end_links(
                lambda peer: (
                    "is revoked"
                    if peer.serial_number == shown.serial_number
                    and peer.name == "other"
                    and peer.expires_at == shown.not_valid_after_utc.timestamp()
                    and peer.der == shown.public_bytes(serialization.Encoding.DER)
                    else None
                ),
            )
            == 1
        )
        await other_inbox.wait_for(Vanished("cloud", "b1"))
        assert tls.refusals == [("cloud", "refuses this end, which is revoked")]
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    async def test_credentials_are_read_anew_for_links_to_come(
        self, tls: StreamWire, authority: Authority, tmp_path: Path
    ) -> None:
        usage = oid.ExtendedKeyUsageOID.SERVER_AUTH
        tls.service_tls = files = authority.issue("renewed", usage)
        robot, inbox, service = await connected(tls)
        assert isinstance(service, StreamServiceTransport)
        foreign = Authority(tmp_path / "foreign").issue("service", usage)
        files.certificate.write_bytes(b"nonsense")
        with pytest.raises(TransportError, match="cannot be used"):
            service.reload_credentials()
        again, again_inbox = tls.robot("cloud"), Inbox()
        again.start(again_inbox)
        await again_inbox.wait_for(Appeared("cloud", "b1"))
        files.certificate.write_bytes(foreign.certificate.read_bytes())
        files.key.write_bytes(foreign.key.read_bytes())
        service.reload_credentials()
        late, late_inbox = tls.robot("cloud"), Inbox()
        late.start(late_inbox)
        await until(lambda: bool(tls.refusals))
        assert late_inbox.events == []
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    async def test_a_robot_can_be_closed_amid_a_handshake(self, tls: StreamWire) -> None:
        host, _, port = tls.endpoint("cloud").removeprefix("tls/").rpartition(":")
        heard = asyncio.Event()

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            await reader.readexactly(1)
            heard.set()
            await reader.read()
            writer.close()

        async with await asyncio.start_server(serve, host, int(port)):
            robot, inbox = tls.robot("cloud"), Inbox()
            robot.start(inbox)
            await asyncio.wait_for(heard.wait(), PATIENCE_S)
            await robot.close()
        assert inbox.events == []


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
        await inbox.wait_for(Vanished("cloud", "b1"))
        heard: list[bytes] = []
        async with await self.mute_service(tls, incarnation, heard):
            boot = await inbox.appeared(times=2)
            # The handshake says whether it is the process that was there before.
            assert (boot == "b1") is (incarnation == "b1")
            robot.call("cloud", 1, b"question")
            await until(lambda: b"question" in b"".join(heard))
            # It never says hello: that is no service, and is not believed again.
            await inbox.wait_for(Vanished("cloud", boot), Ended(1))
            heard.clear()
            await until(lambda: len(heard) > 0)
            assert len(inbox.boots()) == 2
        await tls.service("cloud", "b3").start(echo)
        assert await inbox.appeared(times=3) == "b3"
        await robot.close()

    async def test_a_process_keeps_the_name_by_which_it_appeared(self, tls: StreamWire) -> None:
        robot, inbox, service = await connected(tls)
        await service.close()
        second = tls.service("cloud", "b2")
        assert isinstance(second, StreamServiceTransport)
        await second.start(echo)
        boot = await inbox.appeared(times=2)
        robot.call("cloud", 1, b"question")
        assert await inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]
        assert second.end_links(lambda _: "is sent away") == 1
        assert await inbox.appeared(times=3) == boot
        assert boot != "b1"

    async def test_a_robot_that_is_refused_does_not_see_the_service_come_and_go(
        self, tls: StreamWire, tmp_path: Path
    ) -> None:
        _, inbox, service = await connected(tls)
        await service.close()
        usage = oid.ExtendedKeyUsageOID.SERVER_AUTH
        # It has our certificate, but believes another authority: it refuses the robot's.
        assert tls.service_tls is not None
        foreign = Authority(tmp_path / "foreign").issue("service", usage)
        ours = tls.service_tls
        tls.service_tls = TlsFiles(foreign.authority, ours.certificate, ours.key)
        await tls.service("cloud", "b2").start(echo)
        await until(lambda: len(tls.reasons()) >= 3)
        assert len(inbox.boots()) <= 2
        await inbox.wait(lambda events: sum(isinstance(e, Vanished) for e in events) >= 1)


SERVICE = """
import asyncio, sys, threading
from pathlib import Path
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.service_end import StreamServiceTransport

def stream(call):
    call.reply(b"more")
    asyncio.get_running_loop().call_later(0.0002, stream, call)

def serve(call):
    if call.payload.startswith(b"echo"):
        call.reply(call.payload)
        call.end()
    elif call.payload == b"stream":
        stream(call)
    else:
        call.reply(b"begun")  # and is never heard of again

async def main():
    endpoint, boot, direction, lease_ms, *files = sys.argv[1:]
    tls = TlsFiles(*map(Path, files)) if files else None
    service = StreamServiceTransport(
        "cloud", boot=boot, lease_ms=float(lease_ms), tls=tls, **{direction: [endpoint]}
    )
    await service.start(serve)
    print("ready", flush=True)
    loop = asyncio.get_running_loop()
    stopped = loop.create_future()
    loop.add_reader(0, stopped.set_result, None)
    await stopped
    loop.remove_reader(0)
    await service.close()

asyncio.run(main())
"""


@contextlib.asynccontextmanager
async def service_process(
    endpoint: str,
    boot: str,
    direction: str = "listen",
    *,
    lease_ms: float = LEASE_MS,
    tls: TlsFiles | None = None,
) -> AsyncIterator[subprocess.Popen[bytes]]:
    files = [] if tls is None else [str(tls.authority), str(tls.certificate), str(tls.key)]
    process = subprocess.Popen(
        [sys.executable, "-c", SERVICE, endpoint, boot, direction, str(lease_ms), *files],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        ready = await asyncio.get_running_loop().run_in_executor(None, process.stdout.readline)
        assert ready == b"ready\n"
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.communicate()


def stop(process: subprocess.Popen[bytes]) -> None:
    """Stop all threads of a child process; returns when they have stopped."""
    process.send_signal(signal.SIGSTOP)
    _, status = os.waitpid(process.pid, os.WUNTRACED)
    assert os.WIFSTOPPED(status)


Start: TypeAlias = Callable[[str], contextlib.AbstractAsyncContextManager[subprocess.Popen[bytes]]]


@pytest.mark.parametrize("kind", ["tcp", "tls", "udp", "unix", "robot_listens"])
class TestProcesses:
    @pytest.fixture
    def wire(
        self, kind: str, socket_directory: Path, robot_tls: TlsFiles, service_tls: TlsFiles
    ) -> StreamWire:
        if kind in ("tls", "udp"):
            wire = StreamWire(kind, socket_directory, robot_tls=robot_tls, service_tls=service_tls)
        elif kind == "robot_listens":
            wire = StreamWire("unix", socket_directory, robot_listens=True)
        else:
            wire = StreamWire(kind, socket_directory)
        wire.lease_ms = LEASE_MS
        return wire

    @pytest.fixture
    def start(self, wire: StreamWire) -> Start:
        direction = "connect" if wire.robot_listens else "listen"
        return lambda boot: service_process(
            wire.endpoint("cloud"), boot, direction, tls=wire.service_tls
        )

    async def test_kill_in_mid_call_ends_the_call_and_the_next_process_is_seen(
        self, wire: StreamWire, start: Start
    ) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        for k in range(3):
            async with start(f"b{k}") as process:
                boot = await inbox.appeared(times=k + 1)
                robot.call("cloud", 2 * k, b"wait")
                await inbox.wait_for(Replied(2 * k, b"begun"))
                process.kill()
                await inbox.wait_for(Vanished("cloud", boot))
                assert await inbox.of_call(2 * k) == [Replied(2 * k, b"begun"), Ended(2 * k)]
                robot.call("cloud", 2 * k + 1, b"echo")
                assert await inbox.of_call(2 * k + 1) == [Ended(2 * k + 1)]
        assert len(set(inbox.boots())) == 3

    @pytest.mark.slow
    async def test_a_stopped_process_is_lost_after_the_lease_and_found_again(
        self, wire: StreamWire, start: Start
    ) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        async with start("b1") as process:
            await inbox.wait_for(Appeared("cloud", "b1"))
            robot.call("cloud", 1, b"wait")
            await inbox.wait_for(Replied(1, b"begun"))
            stop(process)
            await inbox.wait_for(Vanished("cloud", "b1"), Ended(1))
            robot.call("cloud", 2, b"echo")
            assert await inbox.of_call(2) == [Ended(2)]
            process.send_signal(signal.SIGCONT)
            await inbox.wait(lambda _: inbox.count(Appeared("cloud", "b1")) == 2)
            assert await answered(robot, inbox, itertools.count(3))

    @pytest.mark.slow
    async def test_a_large_request_to_a_stopped_process_ends_and_holds_nobody_up(
        self, wire: StreamWire, start: Start
    ) -> None:
        await wire.service("idle", "b1").start(echo)
        robot, inbox = wire.robot("cloud", "idle"), Inbox()
        robot.start(inbox)
        numbers = itertools.count()
        for k in (1, 2):
            async with start(f"b{k}") as process:
                boot = await inbox.appeared(times=k)
                await inbox.wait_for(Appeared("idle", "b1"))
                stop(process)
                large, small, other, late = itertools.islice(numbers, 4)
                robot.call("cloud", large, bytes(MAX_BYTES))  # more than buffers take
                robot.call("cloud", small, b"echo")
                robot.call("idle", other, b"meanwhile")
                assert await inbox.of_call(other) == [Replied(other, b"meanwhile"), Ended(other)]
                await inbox.wait_for(Vanished("cloud", boot))
                assert await inbox.of_call(large) == [Ended(large)]
                assert await inbox.of_call(small) == [Ended(small)]
                robot.call("cloud", late, b"echo")
                assert await inbox.of_call(late) == [Ended(late)]

    @pytest.mark.slow
    async def test_a_service_that_goes_on_just_when_it_was_given_up_answers_again(
        self, wire: StreamWire, start: Start
    ) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        numbers = itertools.count()
        async with start("b1") as process:
            for k in range(1, 4):
                await inbox.appeared(times=k)
                stop(process)
                robot.call("cloud", next(numbers), bytes(0 if wire.robot_listens else MAX_BYTES))
                await inbox.wait(lambda _, k=k: inbox.count(Vanished("cloud", "b1")) >= k)  # type: ignore[misc]
                process.send_signal(signal.SIGCONT)
                await inbox.appeared(times=k + 1)
                assert await answered(robot, inbox, numbers)


async def answered(robot: RobotTransport, inbox: Inbox, numbers: Iterator[int]) -> bool:
    """Whether a service answers after at most a few calls that it loses while it comes back."""
    for number in itertools.islice(numbers, 20):
        robot.call("cloud", number, b"echo")
        if await inbox.of_call(number) == [Replied(number, b"echo"), Ended(number)]:
            return True
        await asyncio.sleep(0.05)
    return False


ROBOT_THAT_STANDS_STILL = """
import asyncio, os, signal, sys
from holdfast.session.events import Appeared, Ended, Vanished
from holdfast.transport.endpoints import ServiceAddress
from holdfast.transport.robot_end import StreamRobotTransport

async def main():
    robot = StreamRobotTransport({"cloud": ServiceAddress(sys.argv[1])}, lease_ms=60_000.0)
    events = asyncio.Queue()
    robot.start(events.put_nowait)
    print(await events.get(), flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)
    robot.call("cloud", 1, b"echo")
    while True:
        event = await events.get()
        print(event, flush=True)
        if isinstance(event, (Ended, Vanished)):
            break
    await robot.close()

asyncio.run(main())
"""


async def test_a_robot_that_stood_still_longer_than_the_lease_gives_nobody_up(
    tcp: StreamWire,
) -> None:
    endpoint = tcp.endpoint("cloud")
    loop = asyncio.get_running_loop()
    async with service_process(endpoint, "b1", lease_ms=300.0):
        robot = subprocess.Popen(
            [sys.executable, "-c", ROBOT_THAT_STANDS_STILL, endpoint], stdout=subprocess.PIPE
        )
        try:
            assert robot.stdout is not None
            read = functools.partial(loop.run_in_executor, None, robot.stdout.readline)
            assert await read() == b"Appeared(service='cloud', boot='b1')\n"
            await loop.run_in_executor(None, os.waitpid, robot.pid, os.WUNTRACED)
            await asyncio.sleep(1.0)  # three leases; the service has spoken in each
            robot.send_signal(signal.SIGCONT)
            assert await read() == b"Replied(call=1, payload=b'echo')\n"
            assert await read() == b"Ended(call=1)\n"
        finally:
            robot.send_signal(signal.SIGCONT)
            robot.kill()
            robot.communicate()


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

    async with service_process(tcp.endpoint("cloud"), "b1", lease_ms=300.0):
        robot, inbox = tcp.robot("cloud"), Inbox()
        robot.start(inbox)
        await inbox.wait_for(Appeared("cloud", "b1"))
        monkeypatch.setattr(selector, "select", select)
        for number in range(2):
            still_s[0] = 0.6
            await until(lambda: still_s[0] == 0.0)
            robot.call("cloud", number, b"echo")
            assert await inbox.of_call(number) == [Replied(number, b"echo"), Ended(number)]
        assert Vanished("cloud", "b1") not in inbox


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


class TestRedialling:
    @pytest.fixture
    def dialled(self, monkeypatch: pytest.MonkeyPatch) -> list[float]:
        """When a connection was tried, by the loop's clock."""
        times: list[float] = []
        connect = Dialer._connect

        def note(self: Dialer, *arguments: Any) -> None:
            times.append(asyncio.get_running_loop().time())
            connect(self, *arguments)

        monkeypatch.setattr(Dialer, "_connect", note)
        return times

    @staticmethod
    @contextlib.asynccontextmanager
    async def coming_and_going(wire: StreamWire, *lasts_s: float) -> AsyncIterator[None]:
        """Serve links that end by themselves: so long after the greeting, and then at once."""
        lasting = iter(lasts_s)
        serving: list[asyncio.Task[None] | None] = []

        async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            boot = f"b{len(serving)}"
            serving.append(asyncio.current_task())
            with contextlib.suppress(ConnectionError):
                writer.write(frames.encode_hello("service", "cloud", boot, 30_000.0))
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
        assert len(inbox.boots()) == len(dialled)

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
        assert 30.0 <= pauses[12] < 30.1
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
            await inbox.wait_for(Ended(number))
            await service.close()
            await asyncio.sleep(1.0)
            # Every few hundredths of a second, as often as after the first one.
            assert len(dialled) - before > 30
        await robot.close()

    @pytest.mark.parametrize(("robots", "services"), [("tcp", "tls"), ("tls", "tcp")])
    async def test_an_end_that_speaks_no_tls_is_not_dialled_all_the_time(
        self,
        tls: StreamWire,
        dialled: list[float],
        monkeypatch: pytest.MonkeyPatch,
        robots: str,
        services: str,
    ) -> None:
        place = tls.endpoint("cloud").partition("/")[2]
        let_time_fly(monkeypatch)
        service = StreamServiceTransport(
            "cloud",
            boot="b1",
            listen=[f"{services}/{place}"],
            tls=tls.service_tls if services == "tls" else None,
        )
        robot = StreamRobotTransport(
            {"cloud": ServiceAddress(f"{robots}/{place}")},
            tls=tls.robot_tls if robots == "tls" else None,
        )
        inbox = Inbox()
        await service.start(echo)
        robot.start(inbox)
        await asyncio.sleep(60.0)
        await robot.close()
        await service.close()
        assert 55 < len(dialled) < 310
        assert inbox.events == []


ROBOT_THAT_ENDS = """
import asyncio, sys
from holdfast.session.events import Appeared
from holdfast.transport.endpoints import ServiceAddress
from holdfast.transport.robot_end import StreamRobotTransport

async def main():
    robot = StreamRobotTransport({"cloud": ServiceAddress(sys.argv[1])})
    seen = asyncio.Event()

    def deliver(event):
        if isinstance(event, Appeared):
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
                stop(service)
            communicate = functools.partial(robot.communicate, timeout=PATIENCE_S)
            _, errors = await loop.run_in_executor(None, communicate)
        finally:
            robot.kill()
            robot.communicate()
        assert (robot.returncode, errors) == (0, b"")
