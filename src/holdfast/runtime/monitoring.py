"""Health and metrics over HTTP, served by the service's own event loop.

A monitor sends a plain GET: ``/livez`` shows that the loop runs, which the response itself proves;
``/readyz`` that robots are accepted; ``/metrics`` the counters. A request's head is read, the rest
ignored, one response sent, and the connection closed. Heads, connections and time are bounded, so
clients cannot slow the robots down. ``http.server`` answers from threads without these bounds,
which prove nothing about the loop, and takes 15 ms of a service's start.
"""

from __future__ import annotations

import asyncio
import errno
import functools
import socket
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, TypeAlias

from holdfast.errors import HealthError
from holdfast.runtime.addresses import host_and_port, why_not_bound

_MAX_HEAD_BYTES = 8192
_MAX_CONNECTIONS = 64
_TIMEOUT_S = 5.0
"""For a whole connection."""


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


Pages: TypeAlias = Mapping[str, Callable[[], Page]]
"""A function for each path."""


class MonitoringServers:
    """Answers GET and HEAD at several addresses; pages of the same address share a server."""

    def __init__(self) -> None:
        self._servers: list[asyncio.Server] = []
        # One for each connection, the oldest first.
        self._tasks: dict[asyncio.Task[Any], None] = {}

    async def start(self, offered: Mapping[str, tuple[HttpAddress, Pages]]) -> dict[str, str]:
        """Offer pages for each purpose, in the running loop; return ``HOST:PORT`` for each.

        Raises HealthError if it cannot listen at an address; the message names it.
        """
        pages: dict[HttpAddress, dict[str, Callable[[], Page]]] = {}
        for address, own in offered.values():
            pages.setdefault(address, {}).update(own)
        found = {address: await self._listen(address, own) for address, own in pages.items()}
        return {purpose: found[address] for purpose, (address, _) in offered.items()}

    async def close(self) -> None:
        """Stop listening, and end all connections; may be repeated."""
        for server in self._servers:
            server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _listen(self, address: HttpAddress, pages: Pages) -> str:
        try:
            # The first address alone, so that there is one port.
            family, *_, where = socket.getaddrinfo(
                *address, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
            )[0]
            server = await asyncio.start_server(
                functools.partial(self._serve, pages),
                str(where[0]),
                address.port,
                family=family,
                limit=_MAX_HEAD_BYTES,
            )
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                reason = "another program listens there"
            else:
                reason = why_not_bound(error)
            raise HealthError(f"health or metrics at {address}: {reason}") from error
        self._servers.append(server)
        return str(address._replace(port=server.sockets[0].getsockname()[1]))

    async def _serve(
        self, pages: Pages, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
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
                writer.write(await _response(reader, pages))
                await writer.drain()
        except (OSError, TimeoutError, asyncio.IncompleteReadError):
            pass
        finally:
            self._tasks.pop(task, None)
            writer.transport.abort()


async def _response(reader: asyncio.StreamReader, pages: Pages) -> bytes:
    from http import HTTPStatus  # no start waits for it

    words: list[bytes] = []
    try:
        head = await reader.readuntil(b"\r\n\r\n")
    except asyncio.LimitOverrunError:
        page = Page(431, b"a request's head has at most 8192 bytes\n")
    else:
        words = head.splitlines()[0].split()
        if len(words) != 3 or not words[2].startswith(b"HTTP/1."):
            page = Page(400, b"this is no request of HTTP/1\n")
        elif words[0] not in (b"GET", b"HEAD"):
            page = Page(405, b"GET and HEAD are answered\n")
        elif make := pages.get(words[1].partition(b"?")[0].decode("latin-1")):
            page = make()
        else:
            page = Page(404, f"there are {', '.join(sorted(pages))}\n".encode())
    told = (
        f"HTTP/1.1 {page.status} {HTTPStatus(page.status).phrase}\r\n"
        f"Content-Type: {page.content_type}\r\n"
        f"Content-Length: {len(page.body)}\r\n"
        "Cache-Control: no-store\r\n"
        "Connection: close\r\n\r\n"
    )
    return told.encode() + (b"" if words[:1] == [b"HEAD"] else page.body)
