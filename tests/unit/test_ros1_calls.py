"""Questions to ROS 1 masters, nodes and services that answer, refuse, hang or talk nonsense."""

import asyncio
import itertools
import xmlrpc.client
from collections.abc import Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any

import pytest
from tests.ports import free_port

from ros1_master_guard.errors import CallError, GoneError, SilentError
from ros1_master_guard.ros1_calls import CALLER, MAX_SHORT_BYTES, Connection, call, decoded

PATIENCE_S = 20.0
SHORT_S = 0.05

Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@asynccontextmanager
async def listening(handler: Handler) -> Any:
    """Have somebody listen, and yield his port."""
    connected = 0

    async def handle(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal connected
        connected += 1
        try:
            await handler(reader, writer)
        except (asyncio.IncompleteReadError, ConnectionError, asyncio.CancelledError):
            pass
        finally:
            writer.close()

    server = await asyncio.start_server(handle, "127.0.0.1", free_port())
    try:
        yield server.sockets[0].getsockname()[1], lambda: connected
    finally:
        server.close()


def answering(*values: Any, head: str = "") -> tuple[Handler, list[tuple[Any, str | None]]]:
    """Return who answers one question after another, and what he was asked."""
    asked: list[tuple[Any, str | None]] = []

    async def handler(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for value in values:
            request = (await reader.readuntil(b"\r\n\r\n")).decode()
            (size,) = (
                int(line.split(":")[1])
                for line in request.lower().split("\r\n")
                if line.startswith("content-length")
            )
            asked.append(xmlrpc.client.loads(await reader.readexactly(size)))
            if isinstance(value, xmlrpc.client.Fault):
                body = xmlrpc.client.dumps(value, methodresponse=True).encode()
            else:
                body = xmlrpc.client.dumps((value,), methodresponse=True).encode()
            writer.write(
                f"HTTP/1.1 200 OK\r\n{head}Content-Length: {len(body)}\r\n\r\n".encode() + body
            )
        await reader.read()

    return handler, asked


def saying(data: bytes) -> Handler:
    """Return who says this to anybody."""

    async def handler(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(data)
        await reader.read()

    return handler


async def hanging(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read()


async def hanging_up(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    await reader.read(1)


NONSENSE = {
    "hangs up": hanging_up,
    "another protocol": saying(b"SSH-2.0-OpenSSH\r\n\r\n"),
    "not found": saying(b"HTTP/1.1 404 Not Found\r\nContent-Length: 0\r\n\r\n"),
    "too long": saying(b"HTTP/1.1 200 OK\r\nContent-Length: 1000000000000\r\n\r\n"),
    "negative length": saying(b"HTTP/1.1 200 OK\r\nContent-Length: -1\r\n\r\n"),
    "no length": saying(b"HTTP/1.1 200 OK\r\nContent-Length: many\r\n\r\n"),
    "broken": saying(b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\n<a>"),
    "no answer": saying(b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\n\r\n<a/>"),
    "no head": saying(b"\xff" * 1_000_000),
}


class TestCalls:
    async def test_several_over_one_connection(self) -> None:
        handler, asked = answering([1, "", 42], [1, "", ["x"]])
        async with listening(handler) as (port, connected):
            connection = Connection(f"http://127.0.0.1:{port}/")
            assert await connection.call("getPid", within_s=PATIENCE_S) == 42
            assert await connection.call("getParam", "/é<&", within_s=PATIENCE_S) == ["x"]
            connection.close()
            assert connected() == 1
        assert asked == [((CALLER,), "getPid"), ((CALLER, "/é<&"), "getParam")]

    async def test_several_at_once(self) -> None:
        fault = {"faultCode": 1, "faultString": "no such call"}
        handler, asked = answering([[[1, "", "a"]], fault, [[-1, "unknown", ""]], [[1, "", 0]]])
        async with listening(handler) as (port, _):
            connection = Connection(f"http://127.0.0.1:{port}")
            questions = [("first", ("/caller", 1)), ("second", ()), ("third", ()), ("last", ())]
            assert await connection.calls(questions, within_s=PATIENCE_S) == ["a", None, None, 0]
            connection.close()
        (((calls,), method),) = asked
        assert method == "system.multicall"
        assert calls[0] == {"methodName": "first", "params": ["/caller", 1]}

    async def test_after_an_answer_that_ends_the_connection_there_is_another_one(self) -> None:
        handler, _ = answering([1, "", 1], head="Connection: close\r\n")
        async with listening(handler) as (port, connected):
            connection = Connection(f"http://127.0.0.1:{port}/")
            for _ in range(2):
                assert await connection.call("x", within_s=PATIENCE_S) == 1
            connection.close()
            assert connected() == 2

    @pytest.mark.parametrize(
        ("answer", "reason"),
        [
            ([-1, "unknown node [/x]", ""], r"unknown node \[/x\]"),
            (xmlrpc.client.Fault(1, "not supported"), "not supported"),
            ("text", "another form"),
            ([1, ""], "another form"),
        ],
    )
    async def test_no(self, answer: object, reason: str) -> None:
        handler, _ = answering(answer)
        async with listening(handler) as (port, _):
            with pytest.raises(CallError, match=reason):
                await call(f"http://127.0.0.1:{port}/", "lookupNode", "/x", within_s=PATIENCE_S)

    async def test_nobody_listens(self) -> None:
        with pytest.raises(GoneError, match="nobody listens there"):
            await call(f"http://127.0.0.1:{free_port()}/", "getPid", within_s=PATIENCE_S)

    async def test_no_answer_in_time(self) -> None:
        async with listening(hanging) as (port, _):
            with pytest.raises(SilentError, match=r"getPid: no answer within 0\.05 s"):
                await call(f"http://127.0.0.1:{port}/", "getPid", within_s=SHORT_S)

    @pytest.mark.parametrize("handler", NONSENSE.values(), ids=NONSENSE)
    async def test_nonsense(self, handler: Handler) -> None:
        async with listening(handler) as (port, _):
            with pytest.raises(CallError) as raised:
                await call(f"http://127.0.0.1:{port}/", "getPid", within_s=PATIENCE_S)
            assert not isinstance(raised.value, SilentError | GoneError)

    async def test_a_host_that_is_no_name(self) -> None:
        uri = f"rosrpc://{'x' * 100}.y:1"
        with pytest.raises(CallError):
            await call(uri, "getPid", within_s=PATIENCE_S)

    @pytest.mark.parametrize("uri", ["", "x", "http://", "http://x", "http://x:y/", "rosrpc://:1"])
    async def test_no_address(self, uri: str) -> None:
        with pytest.raises(CallError, match="names no host and port"):
            await call(uri, "getPid", within_s=PATIENCE_S)

    async def test_what_cannot_be_said_is_an_error_too(self) -> None:
        async with listening(hanging) as (port, _):
            for value in (2**40, object()):
                with pytest.raises(CallError):
                    await call(f"http://127.0.0.1:{port}/", "x", value, within_s=PATIENCE_S)


def _bomb() -> str:
    """Return nested entities: from 500 bytes come two million elements."""
    entities = "".join(
        f'<!ENTITY {name} "{20 * f"&{inner};"}">' for inner, name in itertools.pairwise("abcde")
    )
    return (
        f'<?xml version="1.0"?><!DOCTYPE m [<!ENTITY a "<p/>">{entities}]>'
        f"<methodResponse><params>{11 * '&e;'}</params></methodResponse>"
    )


class TestCostlyMessages:
    @pytest.mark.parametrize(
        "content",
        [
            *(_bomb().encode(encoding) for encoding in ("utf-8", "utf-16")),
            b"<!DOCTYPE methodResponse><methodResponse><params/></methodResponse>",
        ],
        ids=["entities", "in UTF-16", "no entity"],
    )
    def test_is_refused(self, content: bytes) -> None:
        with pytest.raises(xmlrpc.client.ResponseError, match="document type"):
            decoded(content)

    async def test_a_node_that_says_much_is_not_read(self) -> None:
        handler, _ = answering([1, "", "x" * MAX_SHORT_BYTES])
        async with listening(handler) as (port, _):
            with pytest.raises(CallError, match=f"allowed are {MAX_SHORT_BYTES}"):
                await call(f"http://127.0.0.1:{port}/", "getPid", within_s=PATIENCE_S)

    @pytest.mark.parametrize(
        "value", [[], {}, "", "é<&\n", [[1, -2.5, True], {"a": {"b": ["", "x"]}}]], ids=repr
    )
    def test_what_ros_sends_is_decoded_as_ever(self, value: Any) -> None:
        content = xmlrpc.client.dumps((value, 5), "m").encode()
        assert decoded(content) == xmlrpc.client.loads(content) == ((value, 5), "m")
        with pytest.raises(xmlrpc.client.Fault, match="no"):
            decoded(xmlrpc.client.dumps(xmlrpc.client.Fault(1, "no")).encode())
