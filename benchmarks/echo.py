"""A bare echo over asyncio: what the system and an event loop cost by themselves.

No frames, no messages: whatever comes goes back as it came. As a program it takes a port of
loopback, prints a line when it listens, and ends with its standard input.
"""

from __future__ import annotations

import asyncio
import socket
import sys
from time import perf_counter
from typing import Self

__all__ = ["ECHO_BYTES", "EchoClient"]

ECHO_BYTES = 120
"""Bytes of an echo; a request has about as many."""


class _Quick(asyncio.Protocol):
    """A connection that sends at once what it is given."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.Transport)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.transport = transport


class _Echo(_Quick):
    """The far end."""

    def data_received(self, data: bytes) -> None:
        self.transport.write(data)


class _Client(_Quick):
    """The near end: stops the loop when the whole echo is there."""

    missing = 0
    complete_at = 0.0

    def data_received(self, data: bytes) -> None:
        self.missing -= len(data)
        if self.missing <= 0:
            self.complete_at = perf_counter()
            asyncio.get_running_loop().stop()


class EchoClient:
    """Sends bytes to an echo and waits for them, on an event loop of its own."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._loop = asyncio.new_event_loop()

    def __enter__(self) -> Self:
        connecting = self._loop.create_connection(_Client, "127.0.0.1", self._port)
        _, self._client = self._loop.run_until_complete(connecting)
        return self

    def __exit__(self, *_: object) -> None:
        self._client.transport.abort()
        self._loop.run_until_complete(asyncio.sleep(0))
        self._loop.close()

    def round_trip_s(self) -> float:
        """Return the seconds from before some bytes are sent until all of them are back."""
        client = self._client
        client.missing = ECHO_BYTES
        start = perf_counter()
        client.transport.write(bytes(ECHO_BYTES))
        self._loop.run_forever()
        return client.complete_at - start


async def _serve(port: int) -> None:
    loop = asyncio.get_running_loop()
    server = await loop.create_server(_Echo, "127.0.0.1", port)
    print("ready", flush=True)
    await loop.run_in_executor(None, sys.stdin.read)
    server.close()


if __name__ == "__main__":
    asyncio.run(_serve(int(sys.argv[1])))
