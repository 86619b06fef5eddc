"""Wires, ends and helpers of the transport's tests.

Waits are bounded by ``PATIENCE_S``, which is long: a test fails when something does not happen, not
when a busy machine makes it happen late.
"""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path
from typing import Any, Protocol, TypeAlias

from tests.ports import free_port
from tests.processes.faults import PATIENT

from holdfast.protocol.messages import Refused, decode_reply
from holdfast.protocol.robot_events import (
    CallEnded,
    ReplyReceived,
    ServiceAppeared,
    ServiceVanished,
    TransportEvent,
)
from holdfast.transport import frames
from holdfast.transport.contract import IncomingCall, RobotTransport, ServiceTransport
from holdfast.transport.endpoints import TlsFiles
from holdfast.transport.robot_end import StreamRobotTransport
from holdfast.transport.service_end import StreamServiceTransport
from holdfast_lab.testbed.in_process import InProcessNetwork

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
        await self.wait(lambda _: len(self.incarnations(service)) >= times)
        return self.incarnations(service)[times - 1]

    def incarnations(self, service: str = "cloud") -> list[str]:
        return [
            e.incarnation
            for e in self.events
            if isinstance(e, ServiceAppeared) and e.service == service
        ]

    def __contains__(self, event: TransportEvent) -> bool:
        return self.count(event) > 0

    def count(self, event: TransportEvent) -> int:
        # By type as well: named tuples are equal if their fields are. For no reason: for any.
        size = 2 if isinstance(event, ServiceVanished) and not event.reason else len(event)
        return sum(type(e) is type(event) and e[:size] == event[:size] for e in self.events)

    async def of_call(self, call: int) -> list[TransportEvent]:
        """Wait for the end of a call and return what came of it."""
        await self.wait(lambda _: CallEnded(call) in self)
        return [
            e for e in self.events if isinstance(e, ReplyReceived | CallEnded) and e.call == call
        ]


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

    def service(self, name: str, incarnation: str) -> ServiceTransport: ...


class InProcessWire:
    def __init__(self) -> None:
        self._network = InProcessNetwork(max_message_bytes=MAX_BYTES)
        self.ends: list[RobotTransport | ServiceTransport] = []

    def robot(self, *services: str, max_message_bytes: int = MAX_BYTES) -> RobotTransport:
        robot = self._network.robot(services)
        self.ends.append(robot)
        return robot

    def service(self, name: str, incarnation: str) -> ServiceTransport:
        service = self._network.service(name, incarnation)
        self.ends.append(service)
        return service

    async def close_on_loop(self) -> None:
        for end in self.ends:
            await end.close()


class StreamWire:
    """One endpoint for each name; or the service inherits its connection to the robot."""

    def __init__(
        self,
        protocol: str,
        directory: Path,
        *,
        robot_tls: TlsFiles | None = None,
        service_tls: TlsFiles | None = None,
        launched: bool = False,
    ) -> None:
        self.protocol = protocol
        self.directory = directory
        self.robot_tls = robot_tls
        self.service_tls = service_tls
        self.launched = launched
        self._unattached: list[tuple[str, socket.socket]] = []
        # What is closed or killed is found at once; a machine that stands still is no lost link.
        self.lease_ms = PATIENT["lease_ms"]
        self._endpoints: dict[str, str] = {}
        self.ends: list[RobotTransport | ServiceTransport] = []
        self.events: list[tuple[str, dict[str, object]]] = []
        self.refusals: list[tuple[str, str]] = []

    def endpoint(self, name: str) -> str:
        if name not in self._endpoints:
            self._endpoints[name] = unused_endpoint(self.protocol, self.directory)
        return self._endpoints[name]

    def robot(
        self, *services: str, max_message_bytes: int = MAX_BYTES, name: str = ""
    ) -> StreamRobotTransport:
        robot = StreamRobotTransport(
            {name: None if self.launched else self.endpoint(name) for name in services},
            name=name,
            lease_ms=self.lease_ms,
            max_message_bytes=max_message_bytes,
            tls=self.robot_tls,
            on_event=unreachable_into(self.refusals),
        )
        self.ends.append(robot)
        for each, connection in self._unattached:
            robot.attach(each, connection)
        self._unattached.clear()
        return robot

    def connection(self, name: str) -> socket.socket:
        """Return a launched service's end of its connection to the robot."""
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        robots = [end for end in self.ends if isinstance(end, StreamRobotTransport)]
        if robots:
            robots[-1].attach(name, ours)
        else:
            self._unattached.append((name, ours))
        return theirs

    def service(self, name: str, incarnation: str) -> StreamServiceTransport:
        service = StreamServiceTransport(
            name,
            incarnation=incarnation,
            listen=[] if self.launched else [self.endpoint(name)],
            robot=self.connection(name) if self.launched else None,
            lease_ms=self.lease_ms,
            max_message_bytes=MAX_BYTES,
            tls=self.service_tls,
            on_event=lambda event, **fields: self.events.append((event, fields)),
        )
        self.ends.append(service)
        return service

    def reasons(self) -> list[str]:
        """Return why links were refused, at the service's end."""
        return [str(fields["reason"]) for event, fields in self.events if event == "link_refused"]

    def heard(self) -> list[tuple[str, object, object]]:
        """Return the events of the service's end, with the robot and the reason of each."""
        return [(event, each.get("robot"), each.get("reason")) for event, each in self.events]

    async def close_on_loop(self) -> None:
        for end in self.ends:
            await end.close()


def unreachable_into(refusals: list[tuple[str, str]]) -> Callable[..., None]:
    """Return a log that keeps which services are unreachable, and why."""

    def note(event: str, *, reason: str, service: str = "", **_: object) -> None:
        if event == "unreachable":
            refusals.append((service, reason))

    return note


def unused_endpoint(protocol: str, directory: Path) -> str:
    if protocol == "unix":
        return f"{protocol}/{directory}/{len(list(directory.iterdir()))}-{os.urandom(4).hex()}"
    return f"{protocol}/127.0.0.1:{free_port()}"


WIRES = ["in_process", "tcp", "tls", "udp", "unix", "launched"]


def echo(call: IncomingCall) -> None:
    call.reply(call.payload, last=True)


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
    wire: Wire, service: Serve = echo, incarnation: str = "b1"
) -> tuple[RobotTransport, Inbox, ServiceTransport]:
    """Return both ends of one service, once the robot sees it."""
    serving = wire.service("cloud", incarnation)
    await serving.start(service)
    robot = wire.robot("cloud")
    inbox = Inbox()
    robot.start(inbox)
    await inbox.wait_for(ServiceAppeared("cloud", incarnation))
    if isinstance(wire, StreamWire) and wire.protocol == "udp":
        assert isinstance(robot, StreamRobotTransport)
        await until(lambda: robot.sends_datagrams("cloud"))
    return robot, inbox, serving


async def joined(wire: Wire) -> tuple[RobotTransport, Inbox]:
    """Return a robot's end, once it sees the service."""
    robot, inbox = wire.robot("cloud"), Inbox()
    robot.start(inbox)
    await inbox.wait_for(ServiceAppeared("cloud", "b1"))
    return robot, inbox


async def answers(
    robot: RobotTransport, inbox: Inbox, call: int, question: bytes = b"question"
) -> None:
    """Ask a service that echoes; nothing else must come of it."""
    robot.call("cloud", call, question)
    assert await inbox.of_call(call) == [ReplyReceived(call, question), CallEnded(call)]


def refusal_of(events: list[TransportEvent]) -> Refused:
    """Return what a call was refused with, which then ended."""
    replied, _ = events
    assert isinstance(replied, ReplyReceived)
    refused = decode_reply(replied.payload)
    assert isinstance(refused, Refused)
    return refused


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


def assert_matches(text: str, pattern: str) -> None:
    import re

    assert re.search(pattern, text), text


SERVICE = """
import asyncio, socket, sys, threading
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
    endpoint, incarnation, lease_ms, *files = sys.argv[1:]
    tls = TlsFiles(*map(Path, files)) if files else None
    service = StreamServiceTransport(
        "cloud", incarnation=incarnation, lease_ms=float(lease_ms), tls=tls,
        **({"robot": socket.socket(fileno=int(endpoint))} if endpoint.isdigit()
           else {"listen": [endpoint]}),
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
    endpoint: str | socket.socket,
    incarnation: str,
    *,
    lease_ms: float = LEASE_MS,
    tls: TlsFiles | None = None,
) -> AsyncIterator[subprocess.Popen[bytes]]:
    files = [] if tls is None else [str(tls.authority), str(tls.certificate), str(tls.key)]
    inherited = endpoint.fileno() if isinstance(endpoint, socket.socket) else None
    where = str(endpoint if inherited is None else inherited)
    process = subprocess.Popen(
        [sys.executable, "-c", SERVICE, where, incarnation, str(lease_ms), *files],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        pass_fds=[] if inherited is None else [inherited],
    )
    if isinstance(endpoint, socket.socket):
        endpoint.close()
    try:
        assert process.stdout is not None
        ready = await asyncio.get_running_loop().run_in_executor(None, process.stdout.readline)
        assert ready == b"ready\n"
        yield process
    finally:
        process.send_signal(signal.SIGCONT)
        process.kill()
        process.communicate()


Start: TypeAlias = Callable[[str], contextlib.AbstractAsyncContextManager[subprocess.Popen[bytes]]]


async def answered(robot: RobotTransport, inbox: Inbox, numbers: Iterator[int]) -> bool:
    """Whether a service answers after at most a few calls that it loses while it comes back."""
    for number in itertools.islice(numbers, 20):
        robot.call("cloud", number, b"echo")
        if await inbox.of_call(number) == [ReplyReceived(number, b"echo"), CallEnded(number)]:
            return True
        await asyncio.sleep(0.05)
    return False
