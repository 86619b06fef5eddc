"""XML-RPC calls to ROS 1 masters and nodes, with deadlines.

The standard library's XML-RPC client has no deadline of its own and makes one call at a time. Here
a call is a coroutine, and a timeout differs from a refused connection: a node whose port refuses
connections is dead, a silent one may be stopped, far away or slow.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import xmlrpc.client
from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple, Self
from urllib.parse import urlsplit

from ros1_master_guard.errors import CallError, GoneError, ProtocolError, SilentError
from ros1_master_guard.headers import MAX_HEADER_BYTES, host_and_port_of

CALLER: Final = "/ros1_master_guard"  # where no node calls
_MAX_RESPONSE_BYTES: Final = 256 * 1024 * 1024

MAX_SHORT_BYTES: Final = 16 * 1024
"""Bound on an answer of a node, or of a master about one name. A malformed one may cost a square of
its bytes: texts that are copied, mappings whose names have one hash."""


class HttpHead(NamedTuple):
    """The head of an HTTP message."""

    line: str
    size: int  # of the content in bytes; -1: not given
    ends: bool  # whether the connection ends after the message

    @classmethod
    async def read(cls, reader: asyncio.StreamReader) -> Self:
        """Read a head; raise ValueError if the size is no number, or as ``readuntil`` does."""
        line, *lines = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        fields = {}
        for each in lines:
            name, _, value = each.partition(":")
            fields[name.strip().lower()] = value.strip()
        ends = "HTTP/1.0" in line or "close" in fields.get("connection", "").lower()
        return cls(line, int(fields.get("content-length", "-1")), ends)


async def message(reader: asyncio.StreamReader, max_bytes: int, begun: bytes = b"") -> bytes:
    """Read a message of TCPROS after its length; ``begun`` are bytes of the length read before.

    Raises ProtocolError if it is larger than allowed, and EOFError or OSError if none arrives.
    """
    size = int.from_bytes(begun + await reader.readexactly(4 - len(begun)), "little")
    if size > max_bytes:
        raise ProtocolError(f"sends {size} bytes; {max_bytes} are allowed")
    return await reader.readexactly(size)


def decoded(content: bytes) -> tuple[tuple[Any, ...], str | None]:
    """Decode an XML-RPC message of a peer; return its values, and the method if it is a call.

    A document type is refused: from a few hundred bytes of nested entities millions of elements
    are made. ROS sends none, and no other encoding than UTF-8, which could hide it. Raises Fault if
    the message says so, and anything else if it is malformed.
    """
    if b"<!DOCTYPE" in content or b"\0" in content:
        raise xmlrpc.client.ResponseError("a document type, which ROS never sends")
    return xmlrpc.client.loads(content)


async def connect(uri: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """Connect to the host and port that a URI names; raise GoneError if nobody listens there."""
    place = host_and_port_of(uri)
    if place is None:
        raise CallError(f"{uri!r:.200} names no host and port")
    host, port = place
    # As in ROS 1: IPv4 unless the host is an IPv6 address, and the first address of a name.
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return await asyncio.open_connection(host, port, family=family, limit=MAX_HEADER_BYTES)
    except ConnectionRefusedError as error:
        raise GoneError(f"{uri}: nobody listens there") from error
    except OSError as error:
        raise CallError(f"{uri}: {error.strerror or error}") from error


class Connection:
    """A connection to the XML-RPC server of a master or node; ``caller`` is the calling node.

    Larger answers than ``max_answer_bytes`` are errors.
    """

    def __init__(
        self, uri: str, caller: str = CALLER, max_answer_bytes: int = _MAX_RESPONSE_BYTES
    ) -> None:
        self._max_answer_bytes = max_answer_bytes
        self.uri = uri
        self._caller = caller
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def call(self, method: str, *arguments: object, within_s: float) -> Any:
        """Call a method with the caller's name and these arguments; return its value.

        Raises GoneError if nobody listens there, SilentError if no response came in time, and
        CallError if the response reports an error or is malformed.
        """
        return _value_of(await self._request(method, (self._caller, *arguments), within_s), method)

    async def calls(
        self, calls: Iterable[tuple[str, Sequence[object]]], *, within_s: float
    ) -> list[Any]:
        """Make several calls in one request; the value of a refused one is None.

        Each is a method and all its arguments, the caller's name included.
        """
        batch = [{"methodName": method, "params": list(arguments)} for method, arguments in calls]
        responses = await self._request("system.multicall", (batch,), within_s)
        if not isinstance(responses, list) or len(responses) != len(batch):
            raise CallError(f"{self.uri}: system.multicall: the answer has another form")
        values: list[Any] = []
        for response in responses:
            values.append(None)
            # The response to a failed call is a dict.
            with contextlib.suppress(CallError, LookupError, TypeError):
                values[-1] = _value_of(response[0], "system.multicall")
        return values

    async def _request(self, method: str, arguments: tuple[Any, ...], within_s: float) -> Any:
        try:
            body = xmlrpc.client.dumps(arguments, method).encode()
            async with asyncio.timeout(within_s):
                return await self._exchange(body)
        except TimeoutError as error:
            self.close()
            raise SilentError(f"{self.uri}: {method}: no answer within {within_s:g} s") from error
        except xmlrpc.client.Fault as fault:
            raise CallError(f"{self.uri}: {method}: {fault.faultString:.500}") from fault
        except BaseException as error:
            self.close()
            if isinstance(error, CallError) or not isinstance(error, Exception):
                raise
            # A malformed response can make the parser raise anything.
            raise CallError(f"{self.uri}: {method}: {error or type(error).__name__}") from error

    async def _exchange(self, body: bytes) -> Any:
        if self._streams is None:
            self._streams = await connect(self.uri)
        reader, writer = self._streams
        place = urlsplit(self.uri)
        head_lines = f"POST {place.path or '/'} HTTP/1.1", f"Host: {place.netloc}"
        more_lines = "Content-Type: text/xml", f"Content-Length: {len(body)}"
        writer.write("\r\n".join([*head_lines, *more_lines, "\r\n"]).encode() + body)
        head = await HttpHead.read(reader)
        if head.line.split(" ")[1:2] != ["200"]:
            raise ValueError(f"it answers {head.line:.100}")
        if not 0 <= head.size <= (most := self._max_answer_bytes):
            raise ValueError(f"its answer has {head.size} bytes; allowed are {most}")
        content = await reader.readexactly(head.size)
        if head.ends:
            self.close()
        return decoded(content)[0][0]

    def close(self) -> None:
        """Close the connection; the next call opens another."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


def _value_of(answer: object, method: str) -> Any:
    if not isinstance(answer, list) or len(answer) != 3:
        raise CallError(f"{method}: the answer has another form")
    code, message, value = answer
    if code != 1:
        raise CallError(f"{method}: {message!s:.500}")
    return value


async def call(
    uri: str, method: str, *arguments: object, within_s: float, caller: str = CALLER
) -> Any:
    """Make one call with a short answer, on a new connection; see :meth:`Connection.call`."""
    with contextlib.closing(Connection(uri, caller, MAX_SHORT_BYTES)) as connection:
        return await connection.call(method, *arguments, within_s=within_s)
