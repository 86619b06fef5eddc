"""Health and metrics over HTTP, served by the service's own event loop.

A monitor sends a plain GET: ``/livez`` shows that the loop runs, which the response itself proves;
``/readyz`` that robots are accepted; ``/metrics`` the counters. This needs no web server: a
request's head is read, the rest ignored, one response sent, and the connection closed. Heads,
connections and time are bounded, so clients cannot slow the robots down.
"""

from __future__ import annotations

import asyncio
import errno
import re
import socket
from collections.abc import Awaitable, Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

from holdfast.errors import HealthError
from holdfast.runtime.addresses import host_and_port, why_not_bound

__all__ = [
    "HttpAddress",
    "HttpServer",
    "MonitoringServers",
    "Page",
    "Pages",
]

_MAX_HEAD_BYTES = 8192
_MAX_CONNECTIONS = 64
_TIMEOUT_S = 5.0
"""For a whole connection."""

_END_OF_HEAD = re.compile(rb"\r?\n\r?\n")


class HttpAddress(NamedTuple):
    """A host, an IPv6 one without brackets, and a port; 0 is any. ``str`` gives ``HOST:PORT``."""

    host: str
    port: int

    def __str__(self) -> str:
        return host_and_port(self.host, self.port)


class Page(NamedTuple):
    """A response."""

    status: int
    body: bytes
    content_type: str = "text/plain; charset=utf-8"

    @classmethod
    def of(cls, trouble: str | None) -> Page:
        """Return the page "ok" or, with status 503, the trouble."""
        return cls(200 if trouble is None else 503, f"{trouble or 'ok'}\n".encode())


Pages: TypeAlias = Mapping[str, Callable[[], Awaitable[Page]]]
"""A function for each path."""


class HttpServer:
    """Answers GET and HEAD at one address."""

    def __init__(self, address: HttpAddress, pages: Pages) -> None:
        self._address = address
        self._pages = pages
        self._server: asyncio.Server | None = None
        # One for each connection, the oldest first.
        self._tasks: dict[asyncio.Task[Any], None] = {}

    async def start(self) -> HttpAddress:
        """Listen, in the running loop; return the address, with the chosen port instead of 0.

        Raises
        ------
        HealthError
            If it cannot listen there; the message names the address.
        """
        try:
            # The first address alone, so that there is one port.
            family, *_, where = socket.getaddrinfo(
                *self._address, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            self._server = await asyncio.start_server(
                self._serve, str(where[0]), self._address.port, family=family, limit=_MAX_HEAD_BYTES
            )
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                reason = "another program listens there"
            else:
                reason = why_not_bound(error)
            raise HealthError(f"health or metrics at {self._address}: {reason}") from error
        return self._address._replace(port=self._server.sockets[0].getsockname()[1])

    async def close(self) -> None:
        """Stop listening, and end all connections; may be repeated."""
        if self._server is not None:
            self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Answer one request."""
        task = asyncio.current_task()
        assert task is not None
        if len(self._tasks) >= _MAX_CONNECTIONS:
            oldest = next(iter(self._tasks))
            del self._tasks[oldest]
            oldest.cancel()
        self._tasks[task] = None
        # Else the end of the connection would wait, without bound, for a reader.
        writer.transport.set_write_buffer_limits(0)
        try:
            async with asyncio.timeout(_TIMEOUT_S):
                if (head := await _head_of(reader)) is not None:
                    writer.write(await self._response(head))
                    await writer.drain()
        except (OSError, TimeoutError):
            pass
        finally:
            self._tasks.pop(task, None)
            writer.transport.abort()

    async def _response(self, head: bytes) -> bytes:
        from http import HTTPStatus  # no start waits for it

        words = head.splitlines()[0].split()
        if _END_OF_HEAD.search(head) is None:
            page = Page(431, b"a request's head has at most 8192 bytes\n")
        elif len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            page = Page(400, b"this is no request of HTTP/1\n")
        elif words[0] not in (b"GET", b"HEAD"):
            page = Page(405, b"GET and HEAD are answered\n")
        elif make := self._pages.get(words[1].partition(b"?")[0].decode("latin-1")):
            page = await make()
        else:
            page = Page(404, f"there are {', '.join(sorted(self._pages))}\n".encode())
        told = (
            f"HTTP/1.1 {page.status} {HTTPStatus(page.status).phrase}\r\n"
            f"Content-Type: {page.content_type}\r\n"
            f"Content-Length: {len(page.body)}\r\n"
            "Cache-Control: no-store\r\n"
            "Connection: close\r\n\r\n"
        )
        return told.encode() + (b"" if words[:1] == [b"HEAD"] else page.body)


async def _head_of(reader: asyncio.StreamReader) -> bytes | None:
    """Read until a head is whole or too large; return None if the connection ends before."""
    head = b""
    while _END_OF_HEAD.search(head) is None and len(head) <= _MAX_HEAD_BYTES:
        data = await reader.read(_MAX_HEAD_BYTES)
        if not data:
            return None
        head += data
    return head


class MonitoringServers:
    """Servers at several addresses; pages of the same address share one."""

    def __init__(self) -> None:
        self._servers: list[HttpServer] = []

    async def start(self, offered: Mapping[str, tuple[HttpAddress, Pages]]) -> dict[str, str]:
        """Offer pages for each purpose; return ``HOST:PORT`` for each.

        Raises
        ------
        HealthError
            If it cannot listen at an address; the message names it.
        """
        pages: dict[HttpAddress, dict[str, Callable[[], Awaitable[Page]]]] = {}
        for address, own in offered.values():
            pages.setdefault(address, {}).update(own)
        found = {}
        for address, all_pages in pages.items():
            self._servers.append(HttpServer(address, all_pages))
            found[address] = str(await self._servers[-1].start())
        return {purpose: found[address] for purpose, (address, _) in offered.items()}

    async def close(self) -> None:
        """Stop all servers; may be repeated."""
        for server in self._servers:
            await server.close()
