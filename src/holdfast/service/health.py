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
from typing import NamedTuple, TypeAlias

from holdfast.errors import HealthError, TransportError
from holdfast.transport.endpoints import host_and_port, parse_host, why_not_bound

__all__ = [
    "HttpAddress",
    "HttpServer",
    "MonitoringServers",
    "Page",
    "Pages",
    "parse_http_address",
]

_MAX_HEAD_BYTES = 8192
_MAX_CONNECTIONS = 64
_TIMEOUT_S = 5.0
"""For a whole connection."""

_REASONS = {
    200: "OK",
    400: "Bad Request",
    404: "Not Found",
    405: "Method Not Allowed",
    431: "Request Header Fields Too Large",
    503: "Service Unavailable",
}
_LOOPBACK = "127.0.0.1"


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


def parse_http_address(text: str) -> HttpAddress:
    """Read ``HOST:PORT``, or ``PORT`` of the loopback address; raise HealthError for others."""
    host, colon, port = text.rpartition(":")
    try:
        host = parse_host(host) if colon else _LOOPBACK
    except TransportError as error:
        raise HealthError(f"{text!r:.80}: {error}") from None
    if not re.fullmatch("[0-9]{1,5}", port) or int(port) > 65535:
        raise HealthError(f"{text!r:.80}: port {port!r:.80} is not a whole number from 0 to 65535")
    return HttpAddress(host, int(port))


class HttpServer:
    """Answers GET and HEAD at one address."""

    def __init__(self, address: HttpAddress, pages: Pages) -> None:
        self._address = address
        self._pages = pages
        self._server: asyncio.Server | None = None
        # The oldest first.
        self._connections: dict[_Connection, None] = {}

    async def start(self) -> HttpAddress:
        """Listen, in the running loop; return the address, with the chosen port instead of 0.

        Raises
        ------
        HealthError
            If it cannot listen there; the message names the address.
        """
        loop = asyncio.get_running_loop()
        try:
            # The first address alone, so that there is one port.
            family, *_, where = socket.getaddrinfo(
                *self._address, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            self._server = await loop.create_server(
                lambda: _Connection(self), str(where[0]), self._address.port, family=family
            )
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                reason = "another program listens there"
            else:
                reason = why_not_bound(error)
            raise HealthError(f"health or metrics at {self._address}: {reason}") from error
        return self._address._replace(port=self._server.sockets[0].getsockname()[1])

    def close(self) -> None:
        """Stop listening, and end all connections; may be repeated."""
        if self._server is not None:
            self._server.close()
        for connection in list(self._connections):
            connection.abort()

    def begun(self, connection: _Connection) -> None:
        """Add a connection; if there are too many, end the oldest."""
        if len(self._connections) >= _MAX_CONNECTIONS:
            next(iter(self._connections)).abort()
        self._connections[connection] = None

    def ended(self, connection: _Connection) -> None:
        """Forget a connection."""
        self._connections.pop(connection, None)

    async def page(self, method: bytes, target: bytes) -> Page:
        """Return the response to a request."""
        if method not in (b"GET", b"HEAD"):
            return Page(405, b"GET and HEAD are answered\n")
        page = self._pages.get(target.partition(b"?")[0].decode("latin-1"))
        if page is None:
            return Page(404, f"there are {', '.join(sorted(self._pages))}\n".encode())
        return await page()


class MonitoringServers:
    """Servers at several addresses; pages of the same address share one."""

    def __init__(self) -> None:
        self._addresses: dict[str, HttpAddress] = {}
        self._pages: dict[HttpAddress, dict[str, Callable[[], Awaitable[Page]]]] = {}
        self._servers: list[HttpServer] = []

    def add(self, purpose: str, address: HttpAddress, pages: Pages) -> None:
        """Add pages at an address, before the start."""
        self._addresses[purpose] = address
        self._pages.setdefault(address, {}).update(pages)

    async def start(self) -> dict[str, str]:
        """Listen; return ``HOST:PORT`` for each purpose.

        Raises
        ------
        HealthError
            If it cannot listen at an address; the message names it.
        """
        found = {}
        for address, pages in self._pages.items():
            server = HttpServer(address, pages)
            found[address] = str(await server.start())
            self._servers.append(server)
        return {purpose: found[address] for purpose, address in self._addresses.items()}

    def close(self) -> None:
        """Stop all servers; may be repeated."""
        for server in self._servers:
            server.close()


class _Connection(asyncio.Protocol):
    """One request and its response."""

    def __init__(self, server: HttpServer) -> None:
        self._server = server
        self._head = bytearray()
        self._answering: asyncio.Task[None] | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._timeout = asyncio.get_running_loop().call_later(_TIMEOUT_S, self.abort)
        self._server.begun(self)

    def data_received(self, data: bytes) -> None:
        if self._answering is not None:
            return
        self._head += data
        whole = b"\r\n\r\n" in self._head or b"\n\n" in self._head
        if whole or len(self._head) > _MAX_HEAD_BYTES:
            self._transport.pause_reading()
            self._answering = asyncio.get_running_loop().create_task(self._answer(whole=whole))

    def connection_lost(self, exc: Exception | None) -> None:
        del exc
        self._timeout.cancel()
        self._server.ended(self)
        if self._answering is not None:
            self._answering.cancel()

    def abort(self) -> None:
        """End the connection now."""
        self._server.ended(self)
        self._transport.abort()

    async def _answer(self, *, whole: bool) -> None:
        words = bytes(self._head).splitlines()[0].split() if whole and self._head.strip() else []
        if not whole:
            page = Page(431, b"a request's head has at most 8192 bytes\n")
        elif len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            page = Page(400, b"this is no request of HTTP/1\n")
        else:
            page = await self._server.page(words[0], words[1])
        head = (
            f"HTTP/1.1 {page.status} {_REASONS[page.status]}\r\n"
            f"Content-Type: {page.content_type}\r\n"
            f"Content-Length: {len(page.body)}\r\n"
            "Cache-Control: no-store\r\n"
            "Connection: close\r\n\r\n"
        )
        body = b"" if words[:1] == [b"HEAD"] else page.body
        self._transport.write(head.encode() + body)
        self._transport.close()
