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
import struct
import xmlrpc.client
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from holdfast.errors import HoldfastError

__all__ = [
    "CALLER",
    "CallError",
    "Connection",
    "GoneError",
    "SilentError",
    "call",
    "offers_service",
]

CALLER = "/holdfast_guard"
"""As whom the guard asks."""

_MAX_ANSWER_BYTES = 256 * 1024 * 1024
_MAX_HEAD_BYTES = 64 * 1024
_MAX_HANDSHAKE_BYTES = 1024 * 1024


class CallError(HoldfastError):
    """No usable answer came."""


class SilentError(CallError):
    """No answer came in time."""


class GoneError(CallError):
    """Nobody listens there, so whoever did has ended."""


class _Place(NamedTuple):
    host: str
    port: int


def _place_of(uri: str) -> _Place:
    try:
        parts = urlsplit(uri)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
    if not host or not port:
        raise CallError(f"{uri!r:.200} names no host and port")
    return _Place(host, port)


async def _connect(uri: str) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    place = _place_of(uri)
    # ROS 1 speaks IPv6 only if told to, and of a name with several addresses it takes the first.
    family = socket.AF_INET6 if ":" in place.host else socket.AF_INET
    try:
        return await asyncio.open_connection(*place, family=family, limit=_MAX_HEAD_BYTES)
    except ConnectionRefusedError as error:
        raise GoneError(f"{uri}: nobody listens there") from error
    except OSError as error:
        raise CallError(f"{uri}: {error.strerror or error}") from error


class Connection:
    """A connection to a master or node, for one question after another.

    Parameters
    ----------
    uri : str
        Of its XML-RPC server.
    """

    def __init__(self, uri: str) -> None:
        self.uri = uri
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
        return _value_of(await self._answer(method, (CALLER, *arguments), within_s), method)

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
        except CallError:
            self.close()
            raise
        except Exception as error:
            # Whatever somebody answers, and however the parser takes it, is no answer.
            self.close()
            raise CallError(f"{self.uri}: {method}: {error or type(error).__name__}") from error
        except asyncio.CancelledError:
            self.close()
            raise

    async def _exchange(self, body: bytes) -> Any:
        if self._streams is None:
            self._streams = await _connect(self.uri)
        reader, writer = self._streams
        place = _place_of(self.uri)
        head = (
            f"POST {urlsplit(self.uri).path or '/'} HTTP/1.1\r\nHost: {place.host}:{place.port}\r\n"
            f"Content-Type: text/xml\r\nContent-Length: {len(body)}\r\n\r\n"
        )
        writer.write(head.encode() + body)
        status, *lines = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        headers = {}
        for line in lines:
            name, _, value = line.partition(":")
            headers[name.strip().lower()] = value.strip()
        size = int(headers.get("content-length", "-1"))
        if status.split(" ")[1:2] != ["200"]:
            raise ValueError(f"it answers {status:.100}")
        if not 0 <= size <= _MAX_ANSWER_BYTES:
            raise ValueError(f"its answer has {size} bytes; allowed are {_MAX_ANSWER_BYTES}")
        content = await reader.readexactly(size)
        if status.startswith("HTTP/1.0") or headers.get("connection", "").lower() == "close":
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


async def call(uri: str, method: str, *arguments: object, within_s: float) -> Any:
    """Ask one thing; see :meth:`Connection.call`."""
    connection = Connection(uri)
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
    fields = f"probe=1\0md5sum=*\0callerid={CALLER}\0service={service}"
    header = b"".join(
        struct.pack("<I", len(field)) + field for field in map(str.encode, fields.split("\0"))
    )
    writer = None
    try:
        async with asyncio.timeout(within_s):
            reader, writer = await _connect(uri)
            writer.write(struct.pack("<I", len(header)) + header)
            (size,) = struct.unpack("<I", await reader.readexactly(4))
            if size > _MAX_HANDSHAKE_BYTES:
                return False
            answer = await reader.readexactly(size)
            # The first field of a refusal; each is preceded by its length.
            return b"error=" not in _names_of(answer)
    except GoneError:
        return False
    except asyncio.IncompleteReadError:
        # It listens, and hangs up on who asks for this service.
        return False
    except (CallError, OSError, struct.error):
        return None
    finally:
        if writer is not None:
            writer.close()


def _names_of(header: bytes) -> set[bytes]:
    """Return the names of a connection header's fields, each with its equals sign."""
    names = set()
    place = 0
    while place + 4 <= len(header):
        (size,) = struct.unpack_from("<I", header, place)
        field = header[place + 4 : place + 4 + size]
        names.add(field.partition(b"=")[0] + b"=")
        place += 4 + size
    return names
