"""The address of several processes: whose it is, and what a process's end costs it."""

import contextlib
import fcntl
import os
import socket
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from tests.ports import free_port

from holdfast.errors import TransportError
from holdfast.service.listening import SharedEndpoints
from holdfast.transport import listener
from holdfast.transport.endpoints import Endpoint, parse_endpoint
from holdfast.transport.listener import listen

PATIENCE_S = 30.0


@contextlib.contextmanager
def shared(*endpoints: str) -> Iterator[SharedEndpoints]:
    sockets = SharedEndpoints([parse_endpoint(each) for each in endpoints])
    try:
        yield sockets
    finally:
        sockets.close()


def connect(endpoint: Endpoint) -> socket.socket:
    return socket.create_connection((endpoint.host, endpoint.port), timeout=PATIENCE_S)


def process_of(sockets: SharedEndpoints) -> list[socket.socket]:
    """Return the sockets at which a process listens that inherits those."""
    inherited = [socket.socket(fileno=os.dup(each)) for each in sockets.descriptors]
    return [listener._listen_beside(each) for each in inherited]


def accepted(listening: Sequence[socket.socket]) -> int:
    (one,) = listening
    one.setblocking(False)
    number = 0
    with contextlib.suppress(BlockingIOError):
        while True:
            one.accept()[0].close()
            number += 1
    return number


def test_connections_are_spread_over_the_processes() -> None:
    with shared("tcp/127.0.0.1:0") as sockets, contextlib.ExitStack() as stack:
        (endpoint,) = sockets.endpoints
        each = [[stack.enter_context(one) for one in process_of(sockets)] for _ in range(2)]
        for _ in range(100):
            stack.enter_context(connect(endpoint))
        numbers = [accepted(one) for one in each]
    assert sum(numbers) == 100
    assert min(numbers) > 0  # all at one of two fair ones: once in 2**99


def test_a_process_that_is_dead_takes_no_connection() -> None:
    with shared("tcp/127.0.0.1:0") as sockets, contextlib.ExitStack() as stack:
        (endpoint,) = sockets.endpoints
        (dead,), (living,) = process_of(sockets), process_of(sockets)
        stack.enter_context(living)
        dead.close()
        for _ in range(20):
            stack.enter_context(connect(endpoint))
        assert accepted([living]) == 20


def test_a_port_stays_ours_while_no_process_listens() -> None:
    with shared("tcp/127.0.0.1:0") as sockets:
        (endpoint,) = sockets.endpoints
        process_of(sockets)[0].close()
        with pytest.raises(ConnectionRefusedError):
            connect(endpoint)
        with pytest.raises(TransportError, match=f"{endpoint}: Address already in use"):
            SharedEndpoints([endpoint])
        (next_one,) = process_of(sockets)
        with next_one, connect(endpoint):
            assert accepted([next_one]) == 1


@pytest.mark.parametrize("reuse", [False, True])
def test_a_port_that_is_taken(*, reuse: bool) -> None:
    """Even by a program that would share it: robots would meet strangers half of the time."""
    with socket.socket() as other:
        if reuse:
            other.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        other.bind(("127.0.0.1", free_port()))
        other.listen()
        endpoint = f"tcp/127.0.0.1:{other.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"{endpoint}: Address already in use"):
            SharedEndpoints([parse_endpoint(endpoint)])


def test_closed_sockets_are_free_for_others() -> None:
    with shared("tcp/127.0.0.1:0") as sockets:
        (endpoint,) = sockets.endpoints
        (listening,) = process_of(sockets)
        with listening, connect(endpoint):
            # Our end is closed first, so the system remembers the connection for a while.
            assert accepted([listening]) == 1
    with shared(str(endpoint)) as again:
        assert again.endpoints == (endpoint,)


def test_a_local_socket_is_shared_and_removed(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))  # what a service has left that was killed
    with shared(f"unix/{path}") as sockets, socket.socket(socket.AF_UNIX) as client:
        (dead,), (living,) = process_of(sockets), process_of(sockets)
        client.connect(str(path))
        dead.close()  # the other process still listens, with what waits there
        with living:
            assert accepted([living]) == 1
        with pytest.raises(TransportError, match="another process listens there"):
            SharedEndpoints(sockets.endpoints)
    assert not path.exists()


def test_a_local_socket_of_another_service_is_kept(tmp_path: Path) -> None:
    path = tmp_path / "socket"
    with contextlib.ExitStack() as stack:
        with shared(f"unix/{path}") as sockets:
            path.unlink()
            (endpoint,) = sockets.endpoints
            other = stack.enter_context(listen(endpoint))
        sockets.close()  # may be repeated
        client = stack.enter_context(socket.socket(socket.AF_UNIX))
        client.connect(str(path))
        assert accepted([other]) == 1


def test_of_two_that_start_at_once_on_what_is_left_one_listens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "socket"
    with socket.socket(socket.AF_UNIX) as killed:
        killed.bind(str(path))
    endpoint = parse_endpoint(f"unix/{path}")
    listening: list[socket.socket] = []
    refused: list[str] = []

    def start() -> None:
        try:
            listening.append(listen(endpoint))
        except TransportError as error:
            refused.append(str(error))

    second = threading.Thread(target=start)

    class Slow(socket.socket):
        def listen(self, *backlog: int) -> None:
            if threading.current_thread() is not second:
                second.start()
                second.join(0.5)  # time to do what it must not
            super().listen(*backlog)

    monkeypatch.setattr(socket, "socket", Slow)
    start()
    second.join(PATIENCE_S)
    for each in listening:
        each.close()
    assert len(listening) == 1
    assert refused == [f"cannot listen on {endpoint}: another process listens there"]
    assert list(tmp_path.iterdir()) == [path]


def test_a_directory_that_stays_locked_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listener, "_LOCK_TIMEOUT_S", 0.0)
    directory = os.open(tmp_path, os.O_RDONLY)
    try:
        fcntl.flock(directory, fcntl.LOCK_EX)
        with pytest.raises(TransportError, match=f"another process has locked {tmp_path}"):
            listen(parse_endpoint(f"unix/{tmp_path / 'socket'}"))
    finally:
        os.close(directory)
    listen(parse_endpoint(f"unix/{tmp_path / 'socket'}")).close()


def test_an_address_of_another_machine() -> None:
    endpoint = parse_endpoint(f"tcp/192.0.2.1:{free_port()}")
    with pytest.raises(TransportError, match=f"{endpoint}: .*: this machine has no such address"):
        SharedEndpoints([endpoint])


def test_what_was_bound_is_closed_if_another_endpoint_cannot_be() -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", free_port()))
        other.listen()
        taken = parse_endpoint(f"tcp/127.0.0.1:{other.getsockname()[1]}")
        free = parse_endpoint(f"tcp/127.0.0.1:{free_port()}")
        with pytest.raises(TransportError):
            SharedEndpoints([free, taken])
    with shared(str(free)) as sockets:
        assert sockets.endpoints == (free,)


def test_no_local_socket_is_left_if_another_endpoint_cannot_be(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(TransportError, match="there is a file of that name"):
        SharedEndpoints([parse_endpoint(f"unix/{tmp_path / name}") for name in ("free", "file")])
    assert not (tmp_path / "free").exists()
