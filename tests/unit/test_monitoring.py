"""Health over HTTP: what is asked and answered, over real sockets on one event loop."""

import argparse
import asyncio
import contextlib
import re
import socket
from collections.abc import AsyncIterator

import pytest

from holdfast.errors import HealthError
from holdfast.runtime import monitoring as health
from holdfast.runtime.monitoring import HttpAddress, MonitoringServers, Page
from holdfast.service.options import http_address

PATIENCE_S = 30.0


def ready() -> Page:
    return Page.of(None)


def draining() -> Page:
    return Page.of("draining")


@contextlib.asynccontextmanager
async def serving(host: str = "127.0.0.1", port: int = 0) -> AsyncIterator[HttpAddress]:
    servers = MonitoringServers()
    pages = {"/livez": ready, "/readyz": draining}
    try:
        offered = await servers.start({"health": (HttpAddress(host, port), pages)})
        yield http_address(offered["health"])
    finally:
        await servers.close()


async def exchange(address: HttpAddress, request: bytes) -> bytes:
    reader, writer = await asyncio.open_connection(*address)
    try:
        writer.write(request)
        async with asyncio.timeout(PATIENCE_S):
            return await reader.read()
    finally:
        writer.close()


class TestAnswers:
    @pytest.mark.parametrize(
        ("request_line", "status", "body"),
        [
            (b"GET /livez HTTP/1.1", b"200 OK", b"ok\n"),
            (b"GET /livez?verbose HTTP/1.0", b"200 OK", b"ok\n"),
            (b"HEAD /livez HTTP/1.1", b"200 OK", b""),
            (b"GET /readyz HTTP/1.1", b"503 Service Unavailable", b"draining\n"),
            (b"GET / HTTP/1.1", b"404 Not Found", b"there are /livez, /readyz\n"),
            (b"GET /\xff HTTP/1.1", b"404 Not Found", b"there are /livez, /readyz\n"),
            (b"POST /livez HTTP/1.1", b"405 Method Not Allowed", b"GET and HEAD are answered\n"),
            (b"GET /livez", b"400 Bad Request", b"this is no request of HTTP/1\n"),
            (b"", b"400 Bad Request", b"this is no request of HTTP/1\n"),
            (b"\x16\x03\x01 hello TLS", b"400 Bad Request", b"this is no request of HTTP/1\n"),
        ],
    )
    async def test_to_a_request(self, request_line: bytes, status: bytes, body: bytes) -> None:
        async with serving() as address:
            answer = await exchange(address, request_line + b"\r\nHost: here\r\n\r\n")
            head, _, got = answer.partition(b"\r\n\r\n")
            assert head.startswith(b"HTTP/1.1 " + status + b"\r\n")
            assert got == body

    async def test_a_head_in_pieces(self) -> None:
        async with serving() as address:
            reader, writer = await asyncio.open_connection(*address)
            for piece in (b"GET /li", b"vez HTTP/1.1\r\nHo", b"st: here\r\n", b"\r", b"\n"):
                writer.write(piece)
                await writer.drain()
                await asyncio.sleep(0.001)
            async with asyncio.timeout(PATIENCE_S):
                assert (await reader.read()).endswith(b"\r\n\r\nok\n")
            writer.close()

    async def test_a_head_without_an_end(self) -> None:
        async with serving() as address:
            answer = await exchange(address, b"GET /livez HTTP/1.1\r\n" + b"X: y\r\n" * 1365)
            assert answer.startswith(b"HTTP/1.1 431 ")

    async def test_over_version_6(self) -> None:
        if not socket.has_dualstack_ipv6():
            pytest.skip("no IPv6 here")
        async with serving("::1") as address:
            assert (await exchange(address, b"GET /livez HTTP/1.1\r\n\r\n")).endswith(b"ok\n")


class TestBounds:
    async def test_silent_connections_are_sent_away(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(health, "_TIMEOUT_S", 0.05)
        async with serving() as address:
            with contextlib.suppress(ConnectionResetError):
                assert await exchange(address, b"GET /livez HTTP/1.1\r\n") == b""

    async def test_the_oldest_connection_makes_room(self) -> None:
        async with serving() as address:
            silent = [await asyncio.open_connection(*address) for _ in range(65)]
            assert (await exchange(address, b"GET /livez HTTP/1.1\r\n\r\n")).endswith(b"ok\n")
            for reader, _ in silent[:2]:
                async with asyncio.timeout(PATIENCE_S):
                    with contextlib.suppress(ConnectionResetError):
                        assert await reader.read() == b""
            reader, writer = silent[-1]
            writer.write(b"GET /livez HTTP/1.1\r\n\r\n")
            async with asyncio.timeout(PATIENCE_S):
                assert (await reader.read()).endswith(b"ok\n")
            for _, writer in silent:
                writer.close()

    async def test_close_ends_connections_and_frees_the_port(self) -> None:
        async with serving() as address:
            reader, writer = await asyncio.open_connection(*address)
            await asyncio.sleep(0)  # it is accepted in some later turn
            assert (await exchange(address, b"GET /livez HTTP/1.1\r\n\r\n")).endswith(b"ok\n")
        async with asyncio.timeout(PATIENCE_S):
            with contextlib.suppress(ConnectionResetError):
                assert await reader.read() == b""
        writer.close()
        with pytest.raises(ConnectionRefusedError):
            await asyncio.open_connection(*address)
        async with serving(*address) as again:
            assert again == address


class TestAddresses:
    @pytest.mark.parametrize(
        ("text", "host", "port"),
        [
            ("9090", "127.0.0.1", 9090),
            ("0", "127.0.0.1", 0),
            ("0.0.0.0:9090", "0.0.0.0", 9090),
            ("[::1]:9090", "::1", 9090),
            ("planner.example:80", "planner.example", 80),
        ],
    )
    def test_forms(self, text: str, host: str, port: int) -> None:
        assert http_address(text) == HttpAddress(host, port)

    @pytest.mark.parametrize(
        "text",
        [
            *("", "ten", "-1", ":9090", "here:", "here:ten", "here:65536", "::1:9090", "65536"),
            *(f"{'b' * 64}.example:80", "[nonsense]:80", "[fe80::1%eth\u00e9]:80", "300.1.1.1:80"),
        ],
    )
    def test_what_is_none_is_named(self, text: str) -> None:
        with pytest.raises(argparse.ArgumentTypeError, match=re.escape(f"is {text!r}: ")):
            http_address(text)

    async def test_an_address_of_another_machine_is_named_once(self) -> None:
        text = r"health or metrics at 192\.0\.2\.1:8080: Cannot assign requested address: "
        text += r"this machine has no such address \(0\.0\.0\.0 is all that it has\)"
        with pytest.raises(HealthError, match=f"^{text}$"):
            async with serving("192.0.2.1", 8080):
                pass

    async def test_a_port_that_is_taken_is_named(self) -> None:
        with socket.socket() as other:
            other.bind(("127.0.0.1", 0))
            other.listen()
            port = other.getsockname()[1]
            text = rf"127\.0\.0\.1:{port}: another program listens there"
            with pytest.raises(HealthError, match=text):
                async with serving("127.0.0.1", port):
                    pass
