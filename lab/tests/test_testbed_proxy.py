"""The bad line: what it does to bytes, and what it never does. No time is asserted."""

import contextlib
import socket
import socketserver
import threading
from collections.abc import Iterator
from typing import Any

import pytest

from holdfast_lab.testbed.bad_line import Impairment
from holdfast_lab.testbed.processes import free_port
from holdfast_lab.testbed.proxy import Proxy

PATIENCE_S = 20.0
BRIEFLY_S = 0.15
"""Long enough for what comes through to come; if a machine is slower, a test only sees less."""


class EchoStream(socketserver.BaseRequestHandler):
    """Sends back what it gets."""

    def handle(self) -> None:
        with contextlib.suppress(OSError):
            while data := self.request.recv(65536):
                self.request.sendall(data)


class EchoDatagram(socketserver.BaseRequestHandler):
    """Sends a datagram back to whoever sent it."""

    def handle(self) -> None:
        content, own = self.request
        own.sendto(content, self.client_address)


class Service(socketserver.ThreadingTCPServer):
    daemon_threads = True


@contextlib.contextmanager
def served(service: socketserver.TCPServer) -> Iterator[int]:
    """Serve, and return the port."""
    with service:
        thread = threading.Thread(target=service.serve_forever, args=(0.01,))
        thread.start()
        yield int(service.socket.getsockname()[1])
        service.shutdown()
        thread.join(PATIENCE_S)


@pytest.fixture
def echo() -> Iterator[int]:
    with served(Service(("127.0.0.1", 0), EchoStream)) as port:
        yield port


@pytest.fixture
def datagram_echo() -> Iterator[int]:
    with served(socketserver.UDPServer(("127.0.0.1", 0), EchoDatagram)) as port:
        yield port


@pytest.fixture
def proxy(echo: int) -> Iterator[tuple[Proxy, int]]:
    port = free_port()
    with Proxy(port, echo, "seed") as proxy:
        yield proxy, port


def connect(port: int) -> socket.socket:
    connection = socket.create_connection(("127.0.0.1", port), PATIENCE_S)
    connection.settimeout(PATIENCE_S)
    return connection


def received(connection: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size and (piece := connection.recv(65536)):
        data += piece
    return data


def comes_briefly(connection: socket.socket) -> bool:
    """Tell whether something comes, if it comes soon."""
    connection.settimeout(BRIEFLY_S)
    try:
        return bool(connection.recv(65536))
    except TimeoutError:
        return False
    finally:
        connection.settimeout(PATIENCE_S)


def test_it_carries_all_bytes_in_order(proxy: tuple[Proxy, int]) -> None:
    _, port = proxy
    data = bytes(range(256)) * 20_000  # more than it holds at a time
    with connect(port) as connection:
        sender = threading.Thread(target=connection.sendall, args=(data,))
        sender.start()
        assert received(connection, len(data)) == data
        sender.join()


@pytest.mark.parametrize(
    "impairment",
    [
        Impairment(latency_s=0.002, jitter_s=0.01),
        Impairment(loss=0.05),
        Impairment(direction="to_robot", jitter_s=0.02),
    ],
    ids=["jitter", "loss", "one way"],
)
def test_what_is_late_is_whole_and_in_order(
    proxy: tuple[Proxy, int], impairment: Impairment
) -> None:
    line, port = proxy
    heal = line.impair(impairment)
    expected = b""
    with connect(port) as connection:
        for number in range(40):
            piece = number.to_bytes(2, "big") * 50
            connection.sendall(piece)
            expected += piece
        heal()
        assert received(connection, len(expected)) == expected


@pytest.mark.parametrize("direction", ["both", "to_service", "to_robot"])
def test_silence_keeps_connections_and_loses_nothing(
    proxy: tuple[Proxy, int], direction: str
) -> None:
    line, port = proxy
    with connect(port) as connection:
        connection.sendall(b"a")
        assert received(connection, 1) == b"a"
        heal = line.impair(Impairment(silent=True, direction=direction))  # type: ignore[arg-type]
        connection.sendall(b"b")
        assert not comes_briefly(connection)
        connection.sendall(b"c")
        heal()
        assert received(connection, 2) == b"bc"


def test_a_cut_resets_and_refuses_until_it_is_healed(proxy: tuple[Proxy, int]) -> None:
    line, port = proxy
    with connect(port) as connection:
        connection.sendall(b"a")
        assert received(connection, 1) == b"a"
        heal = line.impair(Impairment(cut=True))
        with pytest.raises(ConnectionResetError):
            connection.recv(1)
    for _ in range(3):
        with pytest.raises(ConnectionRefusedError):
            connect(port)
    # Meanwhile nobody else can have the port.
    with socket.socket() as other, pytest.raises(OSError, match="in use"):
        other.bind(("127.0.0.1", port))
    heal()
    heal()  # may be repeated
    with connect(port) as connection:
        connection.sendall(b"b")
        assert received(connection, 1) == b"b"


def test_impairments_add_up(proxy: tuple[Proxy, int]) -> None:
    line, port = proxy
    cut, cut_again = line.impair(Impairment(cut=True)), line.impair(Impairment(cut=True))
    silent = line.impair(Impairment(silent=True))
    cut()
    with pytest.raises(ConnectionRefusedError):
        connect(port)
    cut_again()
    with connect(port) as connection:
        connection.sendall(b"a")
        assert not comes_briefly(connection)
        silent()
        assert received(connection, 1) == b"a"


def client_of(port: int) -> socket.socket:
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.connect(("127.0.0.1", port))
    client.settimeout(PATIENCE_S)
    return client


@contextlib.contextmanager
def datagram_line(port: int, target: int, latency_s: float, loss: float) -> Iterator[Proxy]:
    with Proxy(port, target, "seed", datagrams=True) as proxy:
        proxy.impair(Impairment(latency_s=latency_s, loss=loss))
        yield proxy


class TestDatagrams:
    @pytest.mark.parametrize("direction", ["both", "to_service", "to_robot"])
    def test_silence_swallows_them(self, datagram_echo: int, direction: Any) -> None:
        port = free_port()
        with datagram_line(port, datagram_echo, 0.0, 0.0) as proxy, client_of(port) as client:
            heal = proxy.impair(Impairment(silent=True, direction=direction))
            client.send(b"lost")
            assert not comes_briefly(client)
            heal()
            client.send(b"heard")
            assert client.recv(100) == b"heard"

    def test_streams_and_datagrams_are_cut_apart(self, datagram_echo: int) -> None:
        port = free_port()
        heard: list[tuple[str, str, bytes]] = []
        proxy = Proxy(
            port, datagram_echo, "seed", datagrams=True, overhear=lambda *each: heard.append(each)
        )
        with proxy, client_of(port) as client:
            proxy.impair(Impairment(cut=True, carriers=("streams",)))
            with pytest.raises(ConnectionRefusedError):
                socket.create_connection(("127.0.0.1", port))
            client.send(b"heard")
            assert client.recv(100) == b"heard"
            proxy.impair(Impairment(cut=True, carriers=("datagrams",)))
            client.send(b"lost")
            with pytest.raises(ConnectionRefusedError):
                client.recv(100)
        assert heard == [("datagrams", way, b"heard") for way in ("to_service", "to_robot")]

    def test_they_come_twice_again_and_from_elsewhere(self) -> None:
        port = free_port()
        with (
            socket.socket(type=socket.SOCK_DGRAM) as service,
            datagram_line(port, bound_port(service), 0.0, 0.0) as proxy,
            client_of(port) as client,
        ):
            heal = proxy.impair(Impairment(doubled=True))
            client.send(b"one")
            one, again = service.recvfrom(100), service.recvfrom(100)
            assert one == again
            heal()
            proxy.replay()
            content, stranger = service.recvfrom(100)
            assert content == b"one"
            proxy.change_address()
            client.send(b"two")
            content, moved = service.recvfrom(100)
            assert content == b"two"
            assert len({one[1], stranger, moved}) == 3
            service.sendto(b"answer", moved)
            assert client.recv(100) == b"answer"


def bound_port(service: socket.socket) -> int:
    service.settimeout(PATIENCE_S)
    service.bind(("127.0.0.1", 0))
    return int(service.getsockname()[1])
