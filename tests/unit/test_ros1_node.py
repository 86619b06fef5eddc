"""A node of ROS 1 among masters that lie, and among those who do not speak as they should."""

import asyncio
import contextlib
import gc
import socket
import struct
import threading
import warnings
import xmlrpc.client
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any, cast

import pytest
from tests.ports import free_port

from holdfast_ros import ros1_node
from holdfast_ros.ros1_environment import RosEnvironment, RosType
from holdfast_ros.ros1_node import RosNode
from ros1_master_guard.headers import encode_header
from ros1_master_guard.ros1_calls import Connection, HttpHead

PATIENCE_S = 30.0
TYPE = RosType("std_srvs/Trigger", "937c9679a518e3a18d831e57125ea522")
FAULT = {"faultCode": 1, "faultString": "no"}


def answer(content: bytes, head: bytes = b"") -> bytes:
    size = str(len(content)).encode()
    return b"HTTP/1.1 200 OK\r\n" + head + b"Content-Length: " + size + b"\r\n\r\n" + content


def saying(value: Any) -> bytes:
    return answer(xmlrpc.client.dumps((value,), methodresponse=True).encode())


MEMBER = b"<struct><member><name>a</name></member></struct>"
NO_ANSWERS = {
    "empty": answer(b"<methodResponse><params></params></methodResponse>"),
    "member": answer(
        b"<methodResponse><params><param><value>%b</value></param></params></methodResponse>"
        % MEMBER
    ),
    "fault": answer(b"<methodResponse><fault></fault></methodResponse>"),
    "header": b"HTTP/1.1 200 OK\r\nA: " + b"x" * 200_000 + b"\r\n\r\n",
    "html": answer(b"<html>hello"),
    "number": saying(5),
    "dict": saying(FAULT),
    "words": saying(["one", "", []]),
    "size": answer(b"", b"Content-Length: \xb2\r\n"),
}


class Master:
    """Who answers as it is told to; what it is told, it keeps."""

    def __init__(self) -> None:
        self.says: Callable[[str], bytes] = self.knows
        self.asked: list[str] = []
        self.services: dict[str, str] = {}
        self.nodes: dict[str, str] = {}
        self.port = free_port()

    def knows(self, method: str) -> bytes:
        """Answer as a master does."""
        raise NotImplementedError

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            with contextlib.suppress(EOFError, OSError, asyncio.CancelledError):
                while True:
                    head = await HttpHead.read(reader)
                    arguments, method = xmlrpc.client.loads(await reader.readexactly(head.size))
                    assert method is not None
                    self.asked.append(method)
                    if self.says == self.knows:
                        writer.write(saying(self.truth(method, arguments)))
                    else:
                        writer.write(self.says(method))
        finally:
            writer.close()

    def truth(self, method: str, arguments: tuple[Any, ...]) -> Any:
        if method == "system.multicall":
            return [
                [self.truth(each["methodName"], tuple(each["params"]))] for each in arguments[0]
            ]
        if method == "registerService":
            self.nodes[arguments[0]] = arguments[3]
            self.services[arguments[1]] = arguments[2]
        known = {"lookupNode": self.nodes, "lookupService": self.services}.get(method)
        if known is None:
            return [1, "", 0]
        return [1, "", known[arguments[1]]] if arguments[1] in known else [-1, "unknown", ""]


@pytest.fixture
def master() -> Iterator[Master]:
    master, ended = Master(), asyncio.Event()
    listens = threading.Event()
    loop = asyncio.new_event_loop()

    async def run() -> None:
        server = await asyncio.start_server(master.serve, "127.0.0.1", master.port)
        listens.set()
        await ended.wait()
        server.close()

    thread = threading.Thread(target=lambda: loop.run_until_complete(run()))
    thread.start()
    assert listens.wait(PATIENCE_S)
    yield master
    loop.call_soon_threadsafe(ended.set)
    thread.join(PATIENCE_S)
    # What was just accepted first gets its handler, which closes it when it is cancelled.
    loop.run_until_complete(asyncio.sleep(0.02))
    for task in asyncio.all_tasks(loop):
        task.cancel()
    loop.run_until_complete(asyncio.sleep(0.02))  # until the connections are closed
    loop.close()
    # A connection that nobody had taken yet ends with its loop, unclosed: this master's alone.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()


def around(master: Master) -> RosEnvironment:
    return RosEnvironment(f"http://127.0.0.1:{master.port}", "127.0.0.1", "127.0.0.1", "/")


@contextlib.asynccontextmanager
async def running(master: Master, start_s: float = 0.0, **more: Any) -> AsyncIterator[RosNode]:
    """Run a node that offers a service."""
    node = RosNode("cloud", around(master), **more)
    node.offer("cloud", TYPE, echo)
    await node.start(start_s)
    yield node
    await node.close()


@contextlib.asynccontextmanager
async def client(
    at: tuple[str, int],
) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_connection(*at)
    async with asyncio.timeout(PATIENCE_S):
        yield reader, writer
    writer.close()


def post(content: bytes) -> bytes:
    return f"POST / HTTP/1.1\r\nContent-Length: {len(content)}\r\n\r\n".encode() + content


def place_of(node: RosNode) -> tuple[str, int]:
    host, port = node._uri.removeprefix("http://").rstrip("/").split(":")
    return host, int(port)


async def until(true: Callable[[], object]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not true():
            await asyncio.sleep(0.01)


async def echo(request: bytes) -> bytes:
    return request


class TestTheMasterLies:
    @pytest.mark.parametrize("said", NO_ANSWERS.values(), ids=NO_ANSWERS)
    async def test_a_node_goes_on_until_one_speaks_the_truth(
        self, master: Master, said: bytes
    ) -> None:
        told: list[str] = []
        master.says = lambda _: said
        async with running(master, on_event=lambda _, **fields: told.append(fields["status"])):
            await until(lambda: len(master.asked) > 2)
            master.says = master.knows
            await until(lambda: "/cloud" in master.services)
            # Now it is asked whether it knows the node, and lies again.
            await until(lambda: told[-1:] == ["registered"])
            before = len(master.asked)
            master.says = lambda _: said
            await until(lambda: len(master.asked) > before + 1)
            master.services.clear()
            master.says = master.knows
            await until(lambda: "/cloud" in master.services)
        assert told[:2] == ["unreachable", "registered"]

    async def test_a_defect_of_ours_ends_nothing(
        self, master: Master, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        told: list[tuple[str, str]] = []
        call, fails = Connection.call, True

        async def failing(self: Connection, *arguments: Any, **more: Any) -> Any:
            if fails:
                raise KeyError("x")
            return await call(self, *arguments, **more)

        monkeypatch.setattr(Connection, "call", failing)
        monkeypatch.setattr(ros1_node, "_CHECK_INTERVAL_S", 0.01)

        def note(_: str, **fields: str) -> None:
            told.append((fields["status"], fields["reason"]))

        async with running(master, 0.1, on_event=note):
            fails = False
            await until(lambda: "/cloud" in master.services)
        assert told[0] == ("unreachable", "KeyError: 'x'")
        assert [status for status, _ in told][:2] == ["unreachable", "registered"]


@pytest.mark.parametrize(
    "content",
    [
        b"<methodCall><methodName>getPid</methodName><fault></fault></methodCall>",
        b"<methodCall><methodName>x</methodName><params><param><value>%b</value></param></params>"
        b"</methodCall>" % MEMBER,
        b"<html>",
        xmlrpc.client.dumps(("/x", "/topic", 7), "requestTopic").encode(),
        xmlrpc.client.dumps(("/x", ["/topic"], []), "requestTopic").encode(),
    ],
)
async def test_what_is_no_question_to_a_node_is_answered_with_a_fault(
    master: Master, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    async with running(master) as node, client(place_of(node)) as (reader, writer):
        node.publish("topic", RosType("std_msgs/String", "0" * 32, "string data"))
        for _ in range(2):  # on the same connection
            writer.write(post(content))
            head = await HttpHead.read(reader)
            with pytest.raises(xmlrpc.client.Fault):
                xmlrpc.client.loads(await reader.readexactly(head.size))
    assert not caplog.records


async def test_calls_of_many_hold_up_nobody_else(
    master: Master, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Parsing one takes a millisecond: in each turn of the loop there is one at most."""
    turn = 0
    parsed: list[int] = []

    def note(method: str, arguments: object) -> tuple[int, str, int]:
        parsed.append(turn)
        return 1, method, 0

    async def count() -> None:
        nonlocal turn
        while len(parsed) < 20:
            turn += 1
            await asyncio.sleep(0)

    content = xmlrpc.client.dumps(("/x",), "getPid").encode()
    async with asyncio.timeout(PATIENCE_S), running(master) as node:
        streams = [await asyncio.open_connection(*place_of(node)) for _ in range(20)]
        monkeypatch.setattr(node, "_answer", note)
        for _, writer in streams:
            writer.write(post(content))
        await count()
        for reader, writer in streams:
            head = await HttpHead.read(reader)
            assert b"<int>" in await reader.readexactly(head.size)
            writer.close()
    assert len(set(parsed)) == len(parsed)


async def test_a_call_with_a_document_type_is_not_expanded(master: Master) -> None:
    """A few hundred bytes of nested entities took a second of the loop's thread."""
    document = (
        '<?xml version="1.0"?><!DOCTYPE m [<!ENTITY a "getPid">]>'
        "<methodCall><methodName>&a;</methodName><params></params></methodCall>"
    )
    async with running(master) as node, client(place_of(node)) as (reader, writer):
        for encoding in ("utf-8", "utf-16"):
            writer.write(post(document.encode(encoding)))
            head = await HttpHead.read(reader)
            with pytest.raises(xmlrpc.client.Fault, match="document type"):
                xmlrpc.client.loads(await reader.readexactly(head.size))


async def test_a_call_larger_than_any_of_ros_is_not_read(master: Master) -> None:
    async with running(master) as node, client(place_of(node)) as (reader, writer):
        with contextlib.suppress(ConnectionError):
            writer.write(post(b"<a/>" * 4096))
            assert await reader.read() == b""


@pytest.mark.parametrize("turns", range(8))
async def test_a_node_that_ends_leaves_no_connection_open(master: Master, turns: int) -> None:
    """However little of it has begun: its client would wait for ever."""
    node = RosNode("cloud", around(master))
    await node.start(0.0)
    with socket.create_connection(place_of(node)) as client:
        client.setblocking(False)
        for _ in range(turns):
            await asyncio.sleep(0)
        await node.close()
        with contextlib.suppress(ConnectionError):
            answer = asyncio.get_running_loop().sock_recv(client, 100)
            assert await asyncio.wait_for(answer, 5.0) == b""


class Deaf:
    """A subscriber that never reads."""

    def __init__(self) -> None:
        self.transport = self
        self.waiting = 0

    def get_write_buffer_size(self) -> int:
        return self.waiting

    def write(self, data: bytes) -> None:
        self.waiting += len(data)


def test_what_waits_for_a_subscriber_has_a_bound() -> None:
    topic = ros1_node.Topic("/topic", RosType("a/B", "0" * 32, ""))
    deaf = Deaf()
    topic.add(cast(asyncio.StreamWriter, deaf))
    for _ in range(300):
        topic.send(bytes(10_000))
    assert 64 << 10 <= deaf.waiting <= (64 << 10) + 10_004


async def test_half_a_request_holds_no_place_for_ever(
    master: Master, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ros1_node, "_REQUEST_S", 0.05)
    fields = {"service": "/cloud", "md5sum": "*", "callerid": "/x", "persistent": "1"}
    async with running(master) as node:
        address = ("127.0.0.1", node._port)
        for half in (struct.pack("<I", 100) + b"x", b"\1"):
            async with client(address) as (reader, writer):
                writer.write(encode_header(fields) + half)
                await reader.read()
        # Who has begun none may wait.
        async with client(address) as (reader, writer):
            writer.write(encode_header(fields))
            await reader.readexactly(int.from_bytes(await reader.readexactly(4), "little"))
            await asyncio.sleep(0.2)
            writer.write(struct.pack("<I", 2) + b"ab")
            assert await reader.readexactly(7) == b"\1" + struct.pack("<I", 2) + b"ab"
