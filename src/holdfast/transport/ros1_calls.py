"""Questions to ROS 1 masters, nodes and services that never take longer than they may.

The standard library's XML-RPC client has no deadline of its own and answers one question at a time.
Here a question is a coroutine: a hundred nodes are asked at once, and who has not answered in time
is told from who is not there. That difference matters: a node whose port refuses connections is
dead, one that is silent may be stopped, far away or slow.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import xmlrpc.client
from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple, Self
from urllib.parse import urlsplit

from holdfast.errors import HoldfastError, TransportError
from holdfast.transport.endpoints import host_and_port
from holdfast.transport.tcpros import (
    ANY_TYPE,
    MAX_HEADER_BYTES,
    decode_header,
    encode_header,
    host_and_port_of,
)

__all__ = [
    "CALLER",
    "CallError",
    "Connection",
    "GoneError",
    "HttpHead",
    "SilentError",
    "call",
    "message",
    "offers_service",
]

CALLER: Final = "/holdfast"
"""As whom is asked where no node asks."""

_MAX_ANSWER_BYTES: Final = 256 * 1024 * 1024


class CallError(HoldfastError):
    """No usable answer came."""


class SilentError(CallError):
    """No answer came in time."""


class GoneError(CallError):
    """Nobody listens there, so whoever did has ended."""


class HttpHead(NamedTuple):
    """How a request or an answer of HTTP begins.

    Attributes
    ----------
    line : str
        The first one.
    size : int
        Of the content, in bytes; -1 if that is not said.
    ends : bool
        Whether the connection ends after it.
    """

    line: str
    size: int
    ends: bool

    @classmethod
    async def read(cls, reader: asyncio.StreamReader) -> Self:
        """Read one.

        Raises
        ------
        ValueError
            If the size is no number.
        EOFError, OSError, asyncio.LimitOverrunError
            If none comes.
        """
        line, *lines = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        fields = {}
        for each in lines:
            name, _, value = each.partition(":")
            fields[name.strip().lower()] = value.strip()
        ends = "HTTP/1.0" in line or "close" in fields.get("connection", "").lower()
        return cls(line, int(fields.get("content-length", "-1")), ends)


async def message(reader: asyncio.StreamReader, max_bytes: int, begun: bytes = b"") -> bytes:
    """Read what comes after its length: a connection header, or a request.

    Parameters
    ----------
    reader : StreamReader
    max_bytes : int
    begun : bytes
        Of the length, what has been read already.

    Raises
    ------
    TransportError
        If it is larger than allowed; the rest of a sentence about whoever has sent it.
    EOFError, OSError
        If none comes.
    """
    size = int.from_bytes(begun + await reader.readexactly(4 - len(begun)), "little")
    if size > max_bytes:
        raise TransportError(f"sends {size} bytes; {max_bytes} are allowed")
    return await reader.readexactly(size)


async def _connect(uri: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    host, port = _place_of(uri)
    # ROS 1 speaks IPv6 only if told to, and of a name with several addresses it takes the first.
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return await asyncio.open_connection(host, port, family=family, limit=MAX_HEADER_BYTES)
    except ConnectionRefusedError as error:
        raise GoneError(f"{uri}: nobody listens there") from error
    except OSError as error:
        raise CallError(f"{uri}: {error.strerror or error}") from error


def _place_of(uri: str) -> tuple[str, int]:
    place = host_and_port_of(uri)
    if place is None:
        raise CallError(f"{uri!r:.200} names no host and port")
    return place


class Connection:
    """A connection to a master or node, for one question after another.

    Parameters
    ----------
    uri : str
        Of its XML-RPC server.
    caller : str
        The name of the node that asks.
    """

    def __init__(self, uri: str, caller: str = CALLER) -> None:
        self.uri = uri
        self._caller = caller
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def call(self, method: str, *arguments: object, within_s: float) -> Any:
        """Ask, and return the value that a ROS call answers with.

        Parameters
        ----------
        method : str
        *arguments
            After the caller's name, which goes before them.
        within_s : float
            The whole of it takes no longer.

        Raises
        ------
        GoneError
            If nobody listens there.
        SilentError
            If no answer came in time.
        CallError
            If another one came, or one that says no.
        """
        return _value_of(await self._answer(method, (self._caller, *arguments), within_s), method)

    async def calls(
        self, questions: Iterable[tuple[str, Sequence[object]]], *, within_s: float
    ) -> list[Any]:
        """Ask several things at once; the answer to one that is refused is None.

        Parameters
        ----------
        questions : iterable
            Methods and their arguments, the caller's name as well.
        within_s : float

        Raises
        ------
        CallError
            As :meth:`call`.
        """
        asked = [
            {"methodName": method, "params": list(arguments)} for method, arguments in questions
        ]
        answers = await self._answer("system.multicall", (asked,), within_s)
        if not isinstance(answers, list) or len(answers) != len(asked):
            raise CallError(f"{self.uri}: system.multicall: the answer has another form")
        values = []
        for question, answer in zip(asked, answers, strict=True):
            value = None
            # That of a call that failed is a dict.
            with contextlib.suppress(CallError, LookupError, TypeError):
                value = _value_of(answer[0], str(question["methodName"]))
            values.append(value)
        return values

    async def _answer(self, method: str, arguments: tuple[Any, ...], within_s: float) -> Any:
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
            # Whatever somebody answers, and however the parser takes it, is no answer.
            raise CallError(f"{self.uri}: {method}: {error or type(error).__name__}") from error

    async def _exchange(self, body: bytes) -> Any:
        if self._streams is None:
            self._streams = await _connect(self.uri)
        reader, writer = self._streams
        path, where = urlsplit(self.uri).path or "/", host_and_port(*_place_of(self.uri))
        writer.write(
            f"POST {path} HTTP/1.1\r\nHost: {where}\r\nContent-Type: text/xml\r\n"
            f"Content-Length: {len(body)}\r\n\r\n".encode()
            + body
        )
        head = await HttpHead.read(reader)
        if head.line.split(" ")[1:2] != ["200"]:
            raise ValueError(f"it answers {head.line:.100}")
        if not 0 <= head.size <= _MAX_ANSWER_BYTES:
            raise ValueError(f"its answer has {head.size} bytes; allowed are {_MAX_ANSWER_BYTES}")
        content = await reader.readexactly(head.size)
        if head.ends:
            self.close()
        values, _ = xmlrpc.client.loads(content)
        return values[0]

    def close(self) -> None:
        """Close it; the next question opens another one."""
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
    """Ask one thing; see :meth:`Connection.call`."""
    connection = Connection(uri, caller)
    try:
        return await connection.call(method, *arguments, within_s=within_s)
    finally:
        connection.close()


async def offers_service(uri: str, service: str, *, within_s: float) -> bool | None:
    """Tell whether a service is offered at its URI.

    Parameters
    ----------
    uri : str
        As ``rosrpc://host:port``.
    service : str
    within_s : float

    Returns
    -------
    bool or None
        None if that could not be found out in time.
    """
    # What `rosservice` sends to learn a service's type; no call is made.
    asked = {"probe": "1", "md5sum": ANY_TYPE, "callerid": CALLER, "service": service}
    writer = None
    try:
        async with asyncio.timeout(within_s):
            reader, writer = await _connect(uri)
            writer.write(encode_header(asked))
            return "error" not in decode_header(await message(reader, MAX_HEADER_BYTES))
    except GoneError:
        return False
    except (asyncio.IncompleteReadError, TransportError):
        # It listens, and hangs up on who asks for this service, or is none of ROS 1.
        return False
    except (CallError, OSError, ValueError):  # the last: of a host that is no name
        return None
    finally:
        if writer is not None:
            writer.close()
