"""What every wire must do, over all of them; and what only processes and certificates can show.

Waits are bounded by ``PATIENCE_S``, which is long: a test fails when something does not happen, not
when a busy machine makes it happen late.
"""

from __future__ import annotations

import contextlib
import datetime as dt
import ipaddress
import itertools
import json
import os
import queue
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Protocol

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509 import oid
from tests.intruder import MODES, Intruder, Mode, open_session
from tests.ports import free_port
from tests.processes.faults import PATIENT

from holdfast.errors import InvalidValueError, TransportError
from holdfast.runtime.transport.contract import IncomingCall, RobotTransport, ServiceTransport
from holdfast.runtime.transport.in_process import InProcessNetwork
from holdfast.runtime.transport.zenoh_transport import ZenohRobotTransport, ZenohServiceTransport
from holdfast.session.events import Appeared, Ended, Replied, TransportEvent, Vanished
from holdfast.session.messages import Refused, decode_reply
from holdfast.transport.endpoints import PrivateSocket, ServiceAddress, TlsFiles

PATIENCE_S = 30.0
LEASE_MS = 2000.0
"""For what is found by its silence."""

MAX_BYTES = 4_000_000
TWO_MEGABYTES = 2_000_000


class Inbox:
    """Takes events, and lets a test wait for some."""

    def __init__(self) -> None:
        self.events: list[TransportEvent] = []
        self.threads: list[int] = []
        self._changed = threading.Condition()

    def __call__(self, event: TransportEvent) -> None:
        with self._changed:
            self.events.append(event)
            self.threads.append(threading.get_ident())
            self._changed.notify_all()

    def wait(self, condition: Callable[[list[TransportEvent]], bool]) -> list[TransportEvent]:
        with self._changed:
            if not self._changed.wait_for(lambda: condition(self.events), PATIENCE_S):
                raise AssertionError(f"not in {PATIENCE_S} s; there were {self.events}")
            return list(self.events)

    def wait_for(self, *events: TransportEvent) -> None:
        self.wait(lambda _: all(event in self for event in events))

    def __contains__(self, event: TransportEvent) -> bool:
        return self.count(event) > 0

    def count(self, event: TransportEvent) -> int:
        # By type as well: named tuples are equal if their fields are.
        return sum(type(each) is type(event) and each == event for each in self.events)

    def of_call(self, call: int) -> list[TransportEvent]:
        """Wait for the end of a call and return what came of it."""
        events = self.wait(lambda _: Ended(call) in self)
        return [e for e in events if isinstance(e, Replied | Ended) and e.call == call]


class Wire(Protocol):
    """Makes ends that belong together; the fixture closes them."""

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


class ZenohWire:
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
        self._directory = directory
        self._robot_tls = robot_tls
        self.service_tls = service_tls
        self.robot_listens = robot_listens
        # What is closed or killed is found at once; a machine that stands still is no lost link.
        self.lease_ms = PATIENT["lease_ms"]
        self._endpoints: dict[str, str] = {}
        self.ends: list[RobotTransport | ServiceTransport] = []

    def endpoint(self, name: str) -> str:
        if name not in self._endpoints:
            self._endpoints[name] = unused_endpoint(self.protocol, self._directory)
        return self._endpoints[name]

    def robot(self, *services: str, max_message_bytes: int = MAX_BYTES) -> ZenohRobotTransport:
        robot = ZenohRobotTransport(
            {name: ServiceAddress(self.endpoint(name), self.robot_listens) for name in services},
            lease_ms=self.lease_ms,
            decision_timeout_ms=PATIENCE_S * 1e3,
            max_message_bytes=max_message_bytes,
            tls=self._robot_tls,
        )
        self.ends.append(robot)
        return robot

    def service(self, name: str, boot: str) -> ZenohServiceTransport:
        endpoints = [self.endpoint(name)]
        service = ZenohServiceTransport(
            name,
            boot=boot,
            listen=[] if self.robot_listens else endpoints,
            connect=endpoints if self.robot_listens else [],
            lease_ms=self.lease_ms,
            max_message_bytes=MAX_BYTES,
            tls=self.service_tls,
        )
        self.ends.append(service)
        return service


def unused_endpoint(protocol: str, directory: Path) -> str:
    if protocol == "unixsock-stream":
        return f"{protocol}/{directory}/{len(list(directory.iterdir()))}-{os.urandom(4).hex()}"
    return f"{protocol}/127.0.0.1:{free_port()}"


def close_all(ends: Sequence[RobotTransport | ServiceTransport]) -> None:
    # Robots first: over QUIC, one that looks for a lost service takes a second to close.
    for end in sorted(ends, key=lambda end: hasattr(end, "endpoints")):
        end.close()


class Authority:
    """Certifies, with keys that are made for the test."""

    def __init__(self, directory: Path) -> None:

        self.directory = directory
        directory.mkdir()
        self._key = ec.generate_private_key(ec.SECP256R1())
        self._name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, directory.name)])
        self._certificate = self._certify(self._name, self._key.public_key(), is_authority=True)

    def issue(self, name: str) -> TlsFiles:

        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)])
        certificate = self._certify(subject, key.public_key(), is_authority=False)
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
        self, subject: x509.Name, public_key: ec.EllipticCurvePublicKey, *, is_authority: bool
    ) -> x509.Certificate:

        now = dt.datetime.now(dt.UTC)
        usages = [oid.ExtendedKeyUsageOID.SERVER_AUTH, oid.ExtendedKeyUsageOID.CLIENT_AUTH]
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
    return authority.issue("robot")


@pytest.fixture(scope="session")
def service_tls(authority: Authority) -> TlsFiles:
    return authority.issue("service")


@pytest.fixture
def socket_directory() -> Iterator[Path]:
    """Pytest's own directories have paths too long for a socket."""
    with PrivateSocket() as place:
        yield Path(place.endpoint.removeprefix("unixsock-stream/")).parent


WIRES = ["in_process", "tcp", "tls", "quic", "unixsock-stream", "robot_listens"]


@pytest.fixture(params=WIRES)
def wire(request: pytest.FixtureRequest, socket_directory: Path) -> Iterator[Wire]:
    made: InProcessWire | ZenohWire
    if request.param == "in_process":
        made = InProcessWire()
    elif request.param == "robot_listens":
        made = ZenohWire("unixsock-stream", socket_directory, robot_listens=True)
    elif request.param in ("tls", "quic"):
        made = ZenohWire(
            request.param,
            socket_directory,
            robot_tls=request.getfixturevalue("robot_tls"),
            service_tls=request.getfixturevalue("service_tls"),
        )
    else:
        made = ZenohWire(request.param, socket_directory)
    yield made
    close_all(made.ends)


@pytest.fixture
def tcp(socket_directory: Path) -> Iterator[ZenohWire]:
    made = ZenohWire("tcp", socket_directory)
    yield made
    close_all(made.ends)


def echo(call: IncomingCall) -> None:
    call.reply(call.payload)
    call.end()


def aside(answer: Callable[[IncomingCall], None]) -> Callable[[IncomingCall], None]:
    """Return a service that answers on threads of its own: large replies can block."""

    def answer_aside(call: IncomingCall) -> None:
        threading.Thread(target=answer, args=(call,)).start()

    return answer_aside


def echo_of_size(call: IncomingCall) -> None:
    call.reply(b"%d" % len(call.payload))
    call.end()


def saying(text: bytes) -> Callable[[IncomingCall], None]:
    """Return a service that always says the same."""

    def answer(call: IncomingCall) -> None:
        call.reply(text)
        call.end()

    return answer


def silent(call: IncomingCall) -> None:
    """Take a call and leave it open."""


def connected(
    wire: Wire, service: Callable[[IncomingCall], None] = echo, boot: str = "b1"
) -> tuple[RobotTransport, Inbox, ServiceTransport]:
    """Return both ends of one service, once the robot sees it."""
    serving = wire.service("cloud", boot)
    serving.start(service)
    robot = wire.robot("cloud")
    inbox = Inbox()
    robot.start(inbox)
    inbox.wait_for(Appeared("cloud", boot))
    return robot, inbox, serving


class TestEveryWire:
    def test_a_call_brings_the_reply_and_one_end(self, wire: Wire) -> None:
        robot, inbox, _ = connected(wire)
        robot.call("cloud", 7, b"question")
        assert inbox.of_call(7) == [Replied(7, b"question"), Ended(7)]

    def test_several_replies_come_in_order(self, wire: Wire) -> None:
        def count(call: IncomingCall) -> None:
            for i in range(50):
                call.reply(b"%d" % i)
            call.end()

        robot, inbox, _ = connected(wire, count)
        robot.call("cloud", 1, b"")
        expected: list[TransportEvent] = [Replied(1, b"%d" % i) for i in range(50)]
        assert inbox.of_call(1) == [*expected, Ended(1)]

    def test_replies_come_while_the_call_is_open(self, wire: Wire) -> None:
        calls: queue.SimpleQueue[IncomingCall] = queue.SimpleQueue()
        robot, inbox, _ = connected(wire, calls.put)
        robot.call("cloud", 1, b"question")
        call = calls.get(timeout=PATIENCE_S)
        assert call.size_bytes == len(call.payload) == 8
        call.reply(b"first")
        inbox.wait_for(Replied(1, b"first"))
        assert Ended(1) not in inbox
        call.reply(b"second")
        call.end()
        assert inbox.of_call(1) == [Replied(1, b"first"), Replied(1, b"second"), Ended(1)]

    def test_what_comes_after_the_end_is_no_error_and_goes_nowhere(self, wire: Wire) -> None:
        calls: queue.SimpleQueue[IncomingCall] = queue.SimpleQueue()
        robot, inbox, _ = connected(wire, calls.put)
        robot.call("cloud", 1, b"")
        call = calls.get(timeout=PATIENCE_S)
        call.end()
        call.end()
        call.reply(b"late")
        robot.call("cloud", 2, b"")
        echo(calls.get(timeout=PATIENCE_S))
        assert inbox.of_call(2) == [Replied(2, b""), Ended(2)]
        assert inbox.of_call(1) == [Ended(1)]

    def test_an_absent_service_ends_a_call_from_another_thread(self, wire: Wire) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        robot.call("cloud", 1, b"question")
        assert inbox.of_call(1) == [Ended(1)]
        assert threading.get_ident() not in inbox.threads

    def test_a_service_that_starts_after_the_robot_appears(self, wire: Wire) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        service = wire.service("cloud", "later")
        service.start(echo)
        inbox.wait_for(Appeared("cloud", "later"))
        robot.call("cloud", 1, b"question")
        assert inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    def test_a_service_that_has_appeared_can_be_called_at_once(self, wire: Wire) -> None:
        service = wire.service("cloud", "b1")
        robot = wire.robot("cloud")
        appeared: queue.SimpleQueue[TransportEvent] = queue.SimpleQueue()
        inbox = Inbox()

        def deliver(event: TransportEvent) -> None:
            appeared.put(event)
            inbox(event)

        robot.start(deliver)
        service.start(echo)
        assert appeared.get(timeout=PATIENCE_S) == Appeared("cloud", "b1")
        robot.call("cloud", 1, b"question")
        assert inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    def test_large_messages_both_ways(self, wire: Wire) -> None:
        robot, inbox, _ = connected(wire, aside(echo))
        payload = bytes(range(256)) * (TWO_MEGABYTES // 256)
        robot.call("cloud", 1, payload)
        robot.call("cloud", 2, b"small, while the large one is on its way")
        assert inbox.of_call(1) == [Replied(1, payload), Ended(1)]
        assert len(inbox.of_call(2)) == 2

    def test_an_empty_message_is_a_message(self, wire: Wire) -> None:
        robot, inbox, _ = connected(wire)
        robot.call("cloud", 1, b"")
        assert inbox.of_call(1) == [Replied(1, b""), Ended(1)]

    def test_many_calls_at_once_from_several_threads(self, wire: Wire) -> None:
        with ThreadPoolExecutor(4) as workers:

            def work(call: IncomingCall) -> None:
                call.reply(b"first")
                echo(call)

            def ask(first: int) -> None:
                for number in range(first, 200, 8):
                    robot.call("cloud", number, b"%d" % number)

            def hand_over(call: IncomingCall) -> None:
                workers.submit(work, call)

            robot, inbox, _ = connected(wire, hand_over)
            threads = [threading.Thread(target=ask, args=(first,)) for first in range(8)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join(PATIENCE_S)
            for number in range(200):
                assert inbox.of_call(number) == [
                    Replied(number, b"first"),
                    Replied(number, b"%d" % number),
                    Ended(number),
                ]

    def test_nothing_comes_of_an_abandoned_call(self, wire: Wire) -> None:
        calls: queue.SimpleQueue[IncomingCall] = queue.SimpleQueue()
        robot, inbox, service = connected(wire, calls.put)
        robot.call("cloud", 1, b"abandoned")
        call = calls.get(timeout=PATIENCE_S)
        robot.abandon(1)
        robot.abandon(1)
        robot.abandon(99)
        echo(call)
        robot.call("cloud", 2, b"other")
        echo(calls.get(timeout=PATIENCE_S))
        assert inbox.of_call(2) == [Replied(2, b"other"), Ended(2)]
        service.close()
        inbox.wait_for(Vanished("cloud", "b1"))
        assert [e for e in inbox.events if isinstance(e, Replied | Ended) and e.call == 1] == []

    def test_an_abandoned_number_can_be_used_again(self, wire: Wire) -> None:
        calls: queue.SimpleQueue[IncomingCall] = queue.SimpleQueue()
        robot, inbox, _ = connected(wire, calls.put)
        robot.call("cloud", 1, b"old")
        old = calls.get(timeout=PATIENCE_S)
        robot.abandon(1)
        robot.call("cloud", 1, b"new")
        new = calls.get(timeout=PATIENCE_S)
        echo(old)
        echo(new)
        assert inbox.of_call(1) == [Replied(1, b"new"), Ended(1)]

    def test_a_service_that_closes_ends_the_calls_that_it_has(self, wire: Wire) -> None:
        calls: queue.SimpleQueue[IncomingCall] = queue.SimpleQueue()
        robot, inbox, service = connected(wire, calls.put)
        for number in range(3):
            robot.call("cloud", number, b"")
        for _ in range(3):
            calls.get(timeout=PATIENCE_S)
        service.close()
        inbox.wait_for(Vanished("cloud", "b1"))
        for number in range(3):
            assert inbox.of_call(number) == [Ended(number)]

    def test_a_call_after_the_service_has_gone_ends(self, wire: Wire) -> None:
        robot, inbox, service = connected(wire)
        service.close()
        inbox.wait_for(Vanished("cloud", "b1"))
        robot.call("cloud", 1, b"question")
        assert inbox.of_call(1) == [Ended(1)]

    def test_a_restarted_service_is_another_one(self, wire: Wire) -> None:
        if isinstance(wire, ZenohWire) and wire.protocol == "quic":
            pytest.skip("a process keeps a QUIC port for a while: see TestProcesses")
        robot, inbox, service = connected(wire)
        for k in range(2, 5):
            service.close()
            inbox.wait_for(Vanished("cloud", f"b{k - 1}"))
            service = wire.service("cloud", f"b{k}")
            service.start(saying(b"%d" % k))
            inbox.wait_for(Appeared("cloud", f"b{k}"))
            robot.call("cloud", k, b"who?")
            assert inbox.of_call(k) == [Replied(k, b"%d" % k), Ended(k)]
        seen = [event for event in inbox.events if isinstance(event, Appeared | Vanished)]
        boots = ["b1", "b2", "b3"]
        there_and_gone = [event("cloud", boot) for boot in boots for event in (Appeared, Vanished)]
        assert list(map(repr, seen)) == list(map(repr, [*there_and_gone, Appeared("cloud", "b4")]))

    def test_two_services_are_never_mixed(self, wire: Wire) -> None:
        for name in ("east", "west"):
            wire.service(name, "b1").start(saying(name.encode()))
        robot, inbox = wire.robot("east", "west"), Inbox()
        robot.start(inbox)
        inbox.wait_for(Appeared("east", "b1"), Appeared("west", "b1"))
        for number in range(40):
            robot.call(("east", "west")[number % 2], number, b"who?")
        for number in range(40):
            name = ("east", "west")[number % 2]
            assert inbox.of_call(number) == [Replied(number, name.encode()), Ended(number)]

    def test_one_of_two_services_vanishes_alone(self, wire: Wire) -> None:
        services = {name: wire.service(name, "b1") for name in ("east", "west")}
        for service in services.values():
            service.start(silent)
        robot, inbox = wire.robot("east", "west"), Inbox()
        robot.start(inbox)
        inbox.wait_for(Appeared("east", "b1"), Appeared("west", "b1"))
        robot.call("east", 1, b"")
        robot.call("west", 2, b"")
        services["east"].close()
        inbox.wait_for(Vanished("east", "b1"), Ended(1))
        assert Vanished("west", "b1") not in inbox
        assert Ended(2) not in inbox

    def test_a_request_that_is_too_large_is_refused(self, wire: Wire) -> None:
        robot, inbox, _ = connected(wire, aside(echo))
        robot.call("cloud", 1, bytes(MAX_BYTES + 1))
        replied, ended = inbox.of_call(1)
        assert ended == Ended(1)
        assert isinstance(replied, Replied)
        refused = decode_reply(replied.payload)
        assert isinstance(refused, Refused)
        assert refused.code == "too_large"
        assert str(MAX_BYTES) in refused.text
        robot.call("cloud", 2, bytes(MAX_BYTES))
        assert inbox.of_call(2) == [Replied(2, bytes(MAX_BYTES)), Ended(2)]

    def test_a_reply_that_is_too_large_is_dropped(self, wire: Wire) -> None:
        def answer(call: IncomingCall) -> None:
            call.reply(bytes(MAX_BYTES + 1))
            call.reply(b"small")
            call.end()

        robot, inbox, _ = connected(wire, aside(answer))
        robot.call("cloud", 1, b"")
        assert inbox.of_call(1) == [Replied(1, b"small"), Ended(1)]

    def test_a_robot_that_goes_hinders_nobody(self, wire: Wire) -> None:
        if isinstance(wire, ZenohWire) and wire.robot_listens:
            pytest.skip("only one robot can listen at an endpoint")
        calls: queue.SimpleQueue[IncomingCall] = queue.SimpleQueue()
        robot, _, _ = connected(wire, calls.put)
        other, inbox = wire.robot("cloud"), Inbox()
        other.start(inbox)
        inbox.wait_for(Appeared("cloud", "b1"))
        robot.call("cloud", 1, b"")
        orphan = calls.get(timeout=PATIENCE_S)
        robot.close()
        orphan.reply(b"to nobody")
        orphan.end()
        other.call("cloud", 1, b"question")
        echo(calls.get(timeout=PATIENCE_S))
        assert inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    def test_a_robot_that_returns_sees_the_service(self, wire: Wire) -> None:
        robot, _, _ = connected(wire)
        robot.close()
        again, inbox = wire.robot("cloud"), Inbox()
        again.start(inbox)
        inbox.wait_for(Appeared("cloud", "b1"))
        again.call("cloud", 1, b"question")
        assert inbox.of_call(1) == [Replied(1, b"question"), Ended(1)]

    def test_a_closed_robot_delivers_nothing_more(self, wire: Wire) -> None:
        calls: queue.SimpleQueue[IncomingCall] = queue.SimpleQueue()
        robot, inbox, service = connected(wire, calls.put)
        robot.call("cloud", 1, b"")
        call = calls.get(timeout=PATIENCE_S)
        robot.close()
        robot.close()
        before = list(inbox.events)
        robot.call("cloud", 2, b"")
        robot.abandon(1)
        echo(call)
        service.close()
        service.close()
        assert inbox.events == before == [Appeared("cloud", "b1")]

    def test_a_closed_service_delivers_nothing_more(self, wire: Wire) -> None:
        received: list[IncomingCall] = []

        def serve(call: IncomingCall) -> None:
            received.append(call)
            echo(call)

        robot, inbox, service = connected(wire, serve)
        numbers = iter(range(1_000_000))
        stop = threading.Event()

        def flood() -> None:
            while not stop.is_set():
                robot.call("cloud", number := next(numbers), b"")
                inbox.of_call(number)

        thread = threading.Thread(target=flood)
        thread.start()
        try:
            inbox.wait(lambda events: sum(isinstance(e, Replied) for e in events) > 20)
            service.close()
            at_close = len(received)
            inbox.wait_for(Vanished("cloud", "b1"))
        finally:
            stop.set()
            thread.join(PATIENCE_S)
        assert len(received) == at_close

    def test_ends_that_were_never_started_can_be_closed(self, wire: Wire) -> None:
        robot, service = wire.robot("cloud"), wire.service("cloud", "b1")
        for end in (robot, service):
            end.close()
            end.close()

    def test_mistakes_of_the_caller_are_told(self, wire: Wire) -> None:
        robot, inbox, _ = connected(wire, silent)
        with pytest.raises(InvalidValueError, match=r"'elsewhere'.*cloud"):
            robot.call("elsewhere", 1, b"")
        robot.call("cloud", 1, b"")
        with pytest.raises(InvalidValueError, match="call 1 is in flight"):
            robot.call("cloud", 1, b"")
        assert [e for e in inbox.events if isinstance(e, Ended)] == []


class TestZenoh:
    def test_port_0_becomes_a_port(self) -> None:
        service = ZenohServiceTransport("cloud", boot="b1", listen=["tcp/127.0.0.1:0"])
        service.start(echo)
        robot, inbox = ZenohRobotTransport({"cloud": ServiceAddress(service.endpoints[0])}), Inbox()
        with contextlib.closing(service), contextlib.closing(robot):
            robot.start(inbox)
            inbox.wait_for(Appeared("cloud", "b1"))
        assert not service.endpoints[0].endswith(":0")

    def test_a_listening_robot_knows_its_port_before_it_starts(self) -> None:
        robot = ZenohRobotTransport({"local": ServiceAddress("tcp/127.0.0.1:0", listens=True)})
        inbox = Inbox()
        robot.start(inbox)
        service = ZenohServiceTransport("r", boot="b1", connect=[robot.endpoint_of("local")])
        with contextlib.closing(service), contextlib.closing(robot):
            service.start(echo)
            inbox.wait_for(Appeared("local", "b1"))

    def test_a_name_that_was_asked_for_must_be_the_service_s(self, tcp: ZenohWire) -> None:
        tcp.service("cloud", "b1").start(echo)
        endpoint = tcp.endpoint("cloud")
        robot = ZenohRobotTransport(
            {
                "right": ServiceAddress(endpoint, name="cloud"),
                "wrong": ServiceAddress(endpoint, name="other"),
            }
        )
        tcp.ends.append(robot)
        inbox = Inbox()
        robot.start(inbox)
        inbox.wait_for(Appeared("right", "b1"))
        robot.call("wrong", 1, b"")
        assert inbox.of_call(1) == [Ended(1)]

    def test_the_service_refuses_what_is_too_large_for_it(self, tcp: ZenohWire) -> None:
        received: list[IncomingCall] = []
        tcp.service("cloud", "b1").start(received.append)
        robot, inbox = tcp.robot("cloud", max_message_bytes=2 * MAX_BYTES), Inbox()
        robot.start(inbox)
        inbox.wait_for(Appeared("cloud", "b1"))
        robot.call("cloud", 1, bytes(MAX_BYTES + 1))
        replied, _ = inbox.of_call(1)
        assert isinstance(replied, Replied)
        refused = decode_reply(replied.payload)
        assert isinstance(refused, Refused)
        assert refused.code == "too_large"
        assert received == []

    def test_a_call_that_takes_too_long_ends(self, tcp: ZenohWire) -> None:
        tcp.service("cloud", "b1").start(silent)
        address = ServiceAddress(tcp.endpoint("cloud"))
        robot = ZenohRobotTransport({"cloud": address}, decision_timeout_ms=100.0)
        tcp.ends.append(robot)
        inbox = Inbox()
        robot.start(inbox)
        inbox.wait_for(Appeared("cloud", "b1"))
        robot.call("cloud", 1, b"")
        assert inbox.of_call(1) == [Ended(1)]
        assert not any(isinstance(event, Vanished) for event in inbox.events)

    def test_a_taken_port_is_an_error_that_names_it(self, tcp: ZenohWire) -> None:
        tcp.service("cloud", "b1").start(echo)
        endpoint = tcp.endpoint("cloud")
        with pytest.raises(TransportError, match=f"cannot listen on {endpoint}: Address already"):
            tcp.service("cloud", "b2").start(echo)

    def test_one_bad_endpoint_of_two_is_an_error(self, tcp: ZenohWire) -> None:
        taken, free = tcp.endpoint("taken"), tcp.endpoint("free")
        tcp.service("taken", "b1").start(echo)
        both = ZenohServiceTransport("both", boot="b1", listen=[free, taken])
        tcp.ends.append(both)
        with pytest.raises(TransportError, match="cannot listen on"):
            both.start(echo)
        tcp.service("free", "b1").start(echo)  # the first one was given back

    def test_a_taken_socket_is_an_error_that_names_it(self, socket_directory: Path) -> None:
        wire = ZenohWire("unixsock-stream", socket_directory)
        wire.service("cloud", "b1").start(echo)
        try:
            with pytest.raises(TransportError, match=r"unixsock-stream/.*: another process"):
                wire.service("cloud", "b2").start(echo)
        finally:
            close_all(wire.ends)

    @pytest.mark.parametrize("bad", ["", "a/b", "a*", "a b", "x" * 101, "$x", "@x"])
    def test_names_that_are_no_part_of_a_key_are_refused(self, bad: str) -> None:
        with pytest.raises(TransportError, match="name of a service"):
            ZenohServiceTransport(bad, boot="b1", listen=["tcp/127.0.0.1:0"])
        with pytest.raises(TransportError, match="boot of a service"):
            ZenohServiceTransport("cloud", boot=bad, listen=["tcp/127.0.0.1:0"])

    def test_the_right_credentials_or_none(self, robot_tls: TlsFiles, tmp_path: Path) -> None:
        with pytest.raises(TransportError, match=r"tls needs credentials.*--tls"):
            ZenohRobotTransport({"cloud": ServiceAddress("tls/localhost:7447")})
        with pytest.raises(TransportError, match=r"tcp does not use the credentials"):
            ZenohRobotTransport({"cloud": ServiceAddress("tcp/localhost:7447")}, tls=robot_tls)
        missing = TlsFiles(robot_tls.authority, tmp_path / "missing.pem", robot_tls.key)
        with pytest.raises(TransportError, match=r"missing\.pem cannot be read: No such file"):
            ZenohRobotTransport({"cloud": ServiceAddress("tls/localhost:7447")}, tls=missing)

    def test_a_robot_connects_to_a_port_and_a_service_has_an_endpoint(self) -> None:
        with pytest.raises(TransportError, match="port 0 is for listening"):
            ZenohRobotTransport({"cloud": ServiceAddress("tcp/127.0.0.1:0")})
        with pytest.raises(TransportError, match="has no endpoint"):
            ZenohServiceTransport("cloud", boot="b1")

    def test_robots_do_not_see_each_other(self, tcp: ZenohWire) -> None:
        """A robot that plays the service's part fools only itself."""
        tcp.service("cloud", "b1").start(echo)
        settings = {
            "mode": "peer",
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "listen": {"endpoints": []},
            "connect": {"endpoints": [tcp.endpoint("cloud")]},
        }
        with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))) as rogue:
            answered = []
            rogue.declare_queryable("holdfast/**", lambda query: answered.append(query))
            rogue.liveliness().declare_token("holdfast/1/cloud/rogue/alive")
            robot, inbox = tcp.robot("cloud"), Inbox()
            robot.start(inbox)
            inbox.wait_for(Appeared("cloud", "b1"))
            for number in range(20):
                robot.call("cloud", number, b"question")
                assert inbox.of_call(number) == [Replied(number, b"question"), Ended(number)]
            assert Appeared("cloud", "rogue") not in inbox
            assert answered == []

    def test_a_large_request_gets_through_a_slow_link(self, tcp: ZenohWire) -> None:
        """Although it takes several leases; a link that carries it is no broken one."""
        tcp.service("cloud", "b1").start(echo_of_size)
        port = int(tcp.endpoint("cloud").rpartition(":")[2])
        with slow_proxy(port, bytes_per_second=40_000) as slow_port:
            address = ServiceAddress(f"tcp/127.0.0.1:{slow_port}")
            # What Zenoh sends at once takes half of it, so that the machine may falter meanwhile.
            robot = ZenohRobotTransport({"cloud": address}, lease_ms=2000.0)
            inbox = Inbox()
            robot.start(inbox)
            inbox.wait_for(Appeared("cloud", "b1"))
            robot.call("cloud", 1, bytes(200_000))
            robot.call("cloud", 2, b"small")
            assert inbox.of_call(1) == [Replied(1, b"200000"), Ended(1)]
            assert inbox.of_call(2) == [Replied(2, b"5"), Ended(2)]
            assert Vanished("cloud", "b1") not in inbox
            robot.close()

    def test_broken_parts_are_nobody_else_s_trouble(self, tcp: ZenohWire) -> None:
        sizes: list[int] = []

        def serve(call: IncomingCall) -> None:
            sizes.append(len(call.payload))
            echo(call)

        tcp.service("cloud", "b1").start(serve)
        settings = {
            "mode": "peer",
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "listen": {"endpoints": []},
            "connect": {"endpoints": [tcp.endpoint("cloud")]},
        }
        robot, inbox = tcp.robot("cloud"), Inbox()
        robot.start(inbox)
        inbox.wait_for(Appeared("cloud", "b1"))
        part = struct.Struct("<16sQII")
        name = bytes(16)
        with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))) as rogue:
            key = "holdfast/1/cloud/b1/decide"
            while not list(rogue.get(key, payload=b"hello", timeout=PATIENCE_S)):
                time.sleep(0.01)

            def send(attachment: bytes, size: int = 2000) -> list[bytes]:
                replies = rogue.get(
                    key, payload=bytes(size), attachment=attachment, timeout=PATIENCE_S
                )
                return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

            assert send(b"") == send(b"x" * 31) == []  # not understood
            assert send(part.pack(name, 4000, 7, 2)) == []  # beyond the last
            assert send(part.pack(name, 4000, 0, 2**32 - 1)) == [b""]  # too many parts: not kept
            assert send(part.pack(name, 4000, 1, 2)) == []  # the last without the others
            assert send(part.pack(name, 4000, 0, 2)) == [b""]
            assert send(part.pack(name, 4000, 0, 2)) == [b""]  # twice
            assert send(part.pack(name, 9000, 1, 2)) == []  # another size than was said
            (refused,) = send(part.pack(name, 2**63, 0, 2))
            reply = decode_reply(refused)
            assert isinstance(reply, Refused)
            assert reply.code == "too_large"
            for k in range(600):  # more than are kept
                assert send(part.pack(k.to_bytes(16, "big"), 4000, 0, 2)) == [b""]
        sizes.clear()
        robot.call("cloud", 1, bytes(1_000_000))
        assert inbox.of_call(1) == [Replied(1, bytes(1_000_000)), Ended(1)]
        assert sizes == [1_000_000]


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


@pytest.mark.parametrize("protocol", ["tls", "quic"])
class TestCertificates:
    def test_strangers_see_nothing(
        self,
        protocol: str,
        robot_tls: TlsFiles,
        service_tls: TlsFiles,
        tmp_path: Path,
        socket_directory: Path,
    ) -> None:
        foreign = Authority(tmp_path / "foreign").issue("robot")
        # A stranger's certificate, but the right authority: it believes the service.
        stranger = TlsFiles(robot_tls.authority, foreign.certificate, foreign.key)
        wire = ZenohWire(protocol, socket_directory, robot_tls=robot_tls, service_tls=service_tls)
        received: list[bytes] = []

        def serve(call: IncomingCall) -> None:
            received.append(call.payload)
            echo(call)

        wire.service("cloud", "b1").start(serve)
        address = ServiceAddress(wire.endpoint("cloud"))
        outsiders = [
            ZenohRobotTransport({"cloud": address}, tls=files) for files in (foreign, stranger)
        ]
        inboxes = [Inbox() for _ in outsiders]
        for outsider, inbox in zip(outsiders, inboxes, strict=True):
            outsider.start(inbox)
        bare = bare_session(address.endpoint, robot_tls.authority)
        tokens: list[object] = []
        bare.liveliness().declare_subscriber("**", tokens.append, history=True)
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        inbox.wait_for(Appeared("cloud", "b1"))
        time.sleep(0.5)  # the others have had as many attempts as they like
        for number, outsider in enumerate(outsiders):
            outsider.call("cloud", number, b"stranger")
            assert inboxes[number].of_call(number) == [Ended(number)]
            assert inboxes[number].events == [Ended(number)]
        assert list(bare.get("**", payload=b"bare", timeout=1.0)) == []
        assert tokens == []
        robot.call("cloud", 1, b"friend")
        assert inbox.of_call(1) == [Replied(1, b"friend"), Ended(1)]
        assert received == [b"friend"]
        bare.close()
        close_all([*wire.ends, *outsiders])

    def test_a_robot_does_not_believe_a_service_of_another_authority(
        self, protocol: str, robot_tls: TlsFiles, tmp_path: Path, socket_directory: Path
    ) -> None:
        foreign = Authority(tmp_path / "foreign").issue("service")
        wire = ZenohWire(protocol, socket_directory, robot_tls=robot_tls, service_tls=foreign)
        wire.service("cloud", "b1").start(echo)
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        time.sleep(0.5)
        assert inbox.events == []
        close_all(wire.ends)


@pytest.mark.parametrize("mode", MODES)
class TestOtherClients:
    """What a client of an honest service can do to the service's robots: nothing."""

    @pytest.mark.parametrize("protocol", ["tcp", "tls", "quic", "unixsock-stream"])
    def test_nobody_passes_for_the_service(
        self,
        protocol: str,
        mode: Mode,
        socket_directory: Path,
        robot_tls: TlsFiles,
        service_tls: TlsFiles,
    ) -> None:
        encrypted = protocol in ("tls", "quic")
        stolen = robot_tls if encrypted else None
        wire = ZenohWire(
            protocol,
            socket_directory,
            robot_tls=stolen,
            service_tls=service_tls if encrypted else None,
        )
        wire.service("cloud", "b1").start(echo)
        endpoint = wire.endpoint("cloud")
        robot, inbox = wire.robot("cloud"), Inbox()
        with Intruder(endpoint, mode, lambda _: b"forged", tls=stolen) as before:
            assert before.boots == [("cloud", "b1")]
            robot.start(inbox)
            inbox.wait_for(Appeared("cloud", "b1"))
            with Intruder(endpoint, mode, lambda _: b"forged", tls=stolen) as after:
                for number in range(20):
                    robot.call("cloud", number, b"%d" % number)
                for number in range(20):
                    question = b"%d" % number
                    assert inbox.of_call(number) == [Replied(number, question), Ended(number)]
                after.session.put("holdfast/1/cloud/b1/decide", b"published")
                assert after.ask("holdfast/1/cloud/b1/decide") == [b"question"]
                assert before.received == after.received == []
                assert before.overheard == after.overheard == []
        # Both have hung up, and took with them whatever they had said was there.
        robot.call("cloud", 20, b"and now?")
        assert inbox.of_call(20) == [Replied(20, b"and now?"), Ended(20)]
        seen = [event for event in inbox.events if isinstance(event, Appeared | Vanished)]
        assert seen == [Appeared("cloud", "b1")]
        close_all(wire.ends)

    def test_a_robot_that_listens_hands_nothing_on(
        self, mode: Mode, socket_directory: Path
    ) -> None:
        wire = ZenohWire("unixsock-stream", socket_directory, robot_listens=True)
        received: list[bytes] = []

        def serve(call: IncomingCall) -> None:
            received.append(call.payload)
            echo(call)

        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        wire.service("cloud", "b1").start(serve)
        inbox.wait_for(Appeared("cloud", "b1"))
        with open_session(wire.endpoint("cloud"), mode) as other:
            for key in ("holdfast/1/cloud/b1/decide", "**"):
                assert list(other.get(key, payload=b"stranger", timeout=PATIENCE_S)) == []
            robot.call("cloud", 1, b"friend")
            assert inbox.of_call(1) == [Replied(1, b"friend"), Ended(1)]
        assert received == [b"friend"]
        close_all(wire.ends)


def bare_session(endpoint: str, authority: Path) -> zenoh.Session:
    """A client that knows the authority and has no certificate."""
    settings = {
        "mode": "peer",
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "listen": {"endpoints": []},
        "connect": {"endpoints": [endpoint]},
        "transport": {"link": {"tls": {"root_ca_certificate": str(authority)}}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(settings)))


SERVICE = """
import sys, threading, time
from pathlib import Path
from holdfast.transport.endpoints import TlsFiles
from holdfast.runtime.transport.zenoh_transport import ZenohServiceTransport

def stream(call):
    while True:
        call.reply(b"more")
        time.sleep(0.0002)

def serve(call):
    if call.payload.startswith(b"echo"):
        call.reply(call.payload)
        call.end()
    elif call.payload == b"stream":
        threading.Thread(target=stream, args=[call], daemon=True).start()
    else:
        call.reply(b"begun")  # and is never heard of again

endpoint, boot, direction, lease_ms, *files = sys.argv[1:]
tls = TlsFiles(*map(Path, files)) if files else None
service = ZenohServiceTransport(
    "cloud", boot=boot, lease_ms=float(lease_ms), tls=tls, **{direction: [endpoint]}
)
service.start(serve)
print("ready", flush=True)
sys.stdin.read()
service.close()
"""


@contextlib.contextmanager
def service_process(
    endpoint: str,
    boot: str,
    direction: str = "listen",
    *,
    lease_ms: float = LEASE_MS,
    tls: TlsFiles | None = None,
) -> Iterator[subprocess.Popen[bytes]]:
    files = [] if tls is None else [str(tls.authority), str(tls.certificate), str(tls.key)]
    process = subprocess.Popen(
        [sys.executable, "-c", SERVICE, endpoint, boot, direction, str(lease_ms), *files],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == b"ready\n"
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


@pytest.mark.parametrize("kind", ["tcp", "tls", "quic", "unixsock-stream", "robot_listens"])
@pytest.mark.slow
class TestProcesses:
    @pytest.fixture
    def wire(
        self, kind: str, socket_directory: Path, robot_tls: TlsFiles, service_tls: TlsFiles
    ) -> Iterator[ZenohWire]:
        if kind in ("tls", "quic"):
            wire = ZenohWire(kind, socket_directory, robot_tls=robot_tls, service_tls=service_tls)
        elif kind == "robot_listens":
            wire = ZenohWire("unixsock-stream", socket_directory, robot_listens=True)
        else:
            wire = ZenohWire(kind, socket_directory)
        wire.lease_ms = LEASE_MS
        yield wire
        close_all(wire.ends)

    @pytest.fixture
    def start(
        self, wire: ZenohWire
    ) -> Callable[[str], contextlib.AbstractContextManager[subprocess.Popen[bytes]]]:
        direction = "connect" if wire.robot_listens else "listen"
        return lambda boot: service_process(
            wire.endpoint("cloud"), boot, direction, tls=wire.service_tls
        )

    def test_kill_in_mid_call_ends_the_call_and_the_next_process_is_seen(
        self,
        wire: ZenohWire,
        start: Callable[[str], contextlib.AbstractContextManager[subprocess.Popen[bytes]]],
    ) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        for k in range(3):
            boot = f"b{k}"
            with start(boot) as process:
                inbox.wait_for(Appeared("cloud", boot))
                robot.call("cloud", 2 * k, b"wait")
                inbox.wait_for(Replied(2 * k, b"begun"))
                process.kill()
                inbox.wait_for(Vanished("cloud", boot))
                assert inbox.of_call(2 * k) == [Replied(2 * k, b"begun"), Ended(2 * k)]
                robot.call("cloud", 2 * k + 1, b"echo")
                assert inbox.of_call(2 * k + 1) == [Ended(2 * k + 1)]

    def test_a_stopped_process_is_lost_after_the_lease_and_found_again(
        self,
        wire: ZenohWire,
        start: Callable[[str], contextlib.AbstractContextManager[subprocess.Popen[bytes]]],
    ) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        with start("b1") as process:
            inbox.wait_for(Appeared("cloud", "b1"))
            robot.call("cloud", 1, b"wait")
            inbox.wait_for(Replied(1, b"begun"))
            stop(process)
            inbox.wait_for(Vanished("cloud", "b1"), Ended(1))
            robot.call("cloud", 2, b"echo")
            assert inbox.of_call(2) == [Ended(2)]
            process.send_signal(signal.SIGCONT)
            inbox.wait(lambda _: inbox.count(Appeared("cloud", "b1")) == 2)
            assert answered(robot, inbox, itertools.count(3))

    def test_a_large_request_to_a_stopped_process_ends_and_holds_nobody_up(
        self,
        wire: ZenohWire,
        start: Callable[[str], contextlib.AbstractContextManager[subprocess.Popen[bytes]]],
    ) -> None:
        wire.service("idle", "b1").start(echo)
        robot, inbox = wire.robot("cloud", "idle"), Inbox()
        robot.start(inbox)
        numbers = itertools.count()
        for boot in ("b1", "b2"):
            with start(boot) as process:
                inbox.wait_for(Appeared("cloud", boot), Appeared("idle", "b1"))
                stop(process)
                large, small, other, late = itertools.islice(numbers, 4)
                robot.call("cloud", large, bytes(MAX_BYTES))  # more than buffers take
                robot.call("cloud", small, b"echo")
                robot.call("idle", other, b"meanwhile")
                assert inbox.of_call(other) == [Replied(other, b"meanwhile"), Ended(other)]
                inbox.wait_for(Vanished("cloud", boot))
                assert inbox.of_call(large) == [Ended(large)]
                assert inbox.of_call(small) == [Ended(small)]
                robot.call("cloud", late, b"echo")
                assert inbox.of_call(late) == [Ended(late)]

    def test_a_service_that_goes_on_just_when_it_was_given_up_answers_again(
        self,
        wire: ZenohWire,
        start: Callable[[str], contextlib.AbstractContextManager[subprocess.Popen[bytes]]],
    ) -> None:
        robot, inbox = wire.robot("cloud"), Inbox()
        robot.start(inbox)
        numbers = itertools.count()
        with start("b1") as process:
            for k in range(1, 4):
                inbox.wait(lambda _, k=k: inbox.count(Appeared("cloud", "b1")) >= k)  # type: ignore[misc]
                stop(process)
                robot.call("cloud", next(numbers), bytes(0 if wire.robot_listens else MAX_BYTES))
                inbox.wait(lambda _, k=k: inbox.count(Vanished("cloud", "b1")) >= k)  # type: ignore[misc]
                process.send_signal(signal.SIGCONT)
                inbox.wait(lambda _, k=k: inbox.count(Appeared("cloud", "b1")) > k)  # type: ignore[misc]
                assert answered(robot, inbox, numbers)


def answered(robot: RobotTransport, inbox: Inbox, numbers: Iterator[int]) -> bool:
    """Whether a service answers after at most a few calls that it loses while it comes back."""
    for number in itertools.islice(numbers, 20):
        robot.call("cloud", number, b"echo")
        if inbox.of_call(number) == [Replied(number, b"echo"), Ended(number)]:
            return True
        time.sleep(0.05)
    return False


ROBOT_THAT_ENDS = """
import sys, threading
from holdfast.transport.endpoints import ServiceAddress
from holdfast.runtime.transport.zenoh_transport import ZenohRobotTransport
from holdfast.session.events import Appeared, Ended

seen = threading.Event()
robot = ZenohRobotTransport({"cloud": ServiceAddress(sys.argv[1])})

def deliver(event):
    if isinstance(event, Appeared):
        seen.set()

robot.start(deliver)
assert seen.wait(30)

for number in range(20):
    robot.call("cloud", number, b"stream")
robot.call("cloud", 20, bytes(4_000_000))
seen.clear()
print("calling", flush=True)
seen.wait(float(sys.argv[3]))
if sys.argv[2] == "close":
    robot.close(0.2)
"""


@pytest.mark.parametrize("manner", ["close", "leave"])
@pytest.mark.parametrize(("stopped", "after_s"), [(False, 0.1), (True, 0.1), (True, 0.7)])
@pytest.mark.slow
def test_a_process_ends_quietly_whatever_its_links_do(
    tcp: ZenohWire, manner: str, stopped: bool, after_s: float
) -> None:
    """With replies coming in, with or without ``close``, with a peer that has stopped."""
    endpoint = tcp.endpoint("cloud")
    with service_process(endpoint, "b1", lease_ms=400.0) as service:
        robot = subprocess.Popen(
            [sys.executable, "-c", ROBOT_THAT_ENDS, endpoint, manner, str(after_s)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        try:
            assert robot.stdout is not None
            assert robot.stdout.readline() == b"calling\n"
            if stopped:
                stop(service)
            _, errors = robot.communicate(timeout=PATIENCE_S)
        finally:
            robot.kill()
            robot.communicate()
        assert (robot.returncode, errors) == (0, b"")
