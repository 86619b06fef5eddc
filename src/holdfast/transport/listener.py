"""A socket that peers connect to, and the connections of which nothing is known yet.

Anybody can open a connection, and most that are opened to a port of the internet say nothing or
nonsense. So a connection costs next to nothing until its first byte has come; those that say
nothing are closed after a while, and when there are too many, one of whoever has the most goes.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import socket
import stat
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from holdfast.errors import TransportError
from holdfast.transport.endpoints import Endpoint, why_not_bound
from holdfast.transport.links import OPENING_TIMEOUT_S

__all__ = ["BACKLOG", "MAX_SILENT", "Listener", "listen", "one_too_many", "remove_socket_file"]

BACKLOG: Final = 1024
"""Connections that wait to be accepted."""

_ACCEPTED_AT_ONCE: Final = 32
"""Before links that stand are heard again."""

_PAUSE_S: Final = 0.1
"""After the system has refused to accept: no descriptor is free."""

_LOCK_TIMEOUT_S: Final = 10.0
_LOCK_PAUSE_S: Final = 0.01
"""For the lock of a local socket's directory; whoever begins to listen holds it for a moment."""

MAX_SILENT: Final = 256
"""Connections of which no byte has come."""

_MAPPED = b"\0" * 10 + b"\xff\xff"
"""Before an IPv4 address that is written as one of IPv6."""

_T = TypeVar("_T")


class Listener:
    """Accepts connections, and hands over those of which a first byte has come.

    Parameters
    ----------
    endpoint : Endpoint
        Port 0 takes a free one.
    accepted : callable
        Gets the socket of such a connection, and from which network it came.
    speaks_first : bool
        Whether it is this end that has to speak first: then connections are handed over at once.
    listening : socket or None
        One that listens there already, for the process that made it as well.

    Attributes
    ----------
    endpoint : Endpoint
        Where it listens, port 0 replaced.

    Raises
    ------
    TransportError
        If it cannot listen there; the message names the endpoint.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        accepted: Callable[[socket.socket, bytes], None],
        *,
        speaks_first: bool = False,
        listening: socket.socket | None = None,
    ) -> None:
        self._accepted = accepted
        self._speaks_first = speaks_first
        self._loop = asyncio.get_running_loop()
        try:
            self._socket = listen(endpoint) if listening is None else listening
            self._socket.setblocking(False)
        except OSError as error:
            raise TransportError(f"cannot listen on {endpoint}: {why_not_bound(error)}") from error
        self._socket_file: os.stat_result | None = None
        if endpoint.is_local_socket and listening is not None:
            self.endpoint = endpoint
        elif endpoint.is_local_socket:
            self._socket_file = Path(endpoint.host).stat()
            self.endpoint = endpoint
        else:
            self.endpoint = endpoint.with_port(self._socket.getsockname()[1])
        self._silent: dict[socket.socket, bytes] = {}
        self._timers: dict[socket.socket, asyncio.TimerHandle] = {}
        self._pause: asyncio.TimerHandle | None = None
        self._loop.add_reader(self._socket, self._accept)

    def close(self) -> None:
        """Take no more connections, and close those of which nothing has come. May be repeated."""
        if self._socket.fileno() < 0:
            return
        if self._pause is not None:
            self._pause.cancel()
        self._loop.remove_reader(self._socket)
        if self._socket_file is not None:
            remove_socket_file(self.endpoint, self._socket_file)
        self._socket.close()
        for connection in list(self._silent):
            self._forget(connection)
            connection.close()

    def _accept(self) -> None:
        for _ in range(_ACCEPTED_AT_ONCE):
            try:
                connection, address = self._socket.accept()
            except (BlockingIOError, InterruptedError):
                return
            except OSError as error:
                if error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
                    self._loop.remove_reader(self._socket)
                    self._pause = self._loop.call_later(_PAUSE_S, self._go_on)
                return  # else it was gone before it was accepted
            connection.setblocking(False)
            network = _network_of(connection.family, address)
            if self._speaks_first:
                self._accepted(connection, network)
                continue
            if len(self._silent) >= MAX_SILENT:
                other = one_too_many(self._silent)
                self._forget(other)
                other.close()
            self._silent[connection] = network
            self._timers[connection] = self._loop.call_later(
                OPENING_TIMEOUT_S, self._look, connection
            )
            self._loop.add_reader(connection, self._look, connection)

    def _go_on(self) -> None:
        self._loop.add_reader(self._socket, self._accept)

    def _look(self, connection: socket.socket) -> None:
        """Hand a connection over if something has come, else close it."""
        network = self._forget(connection)
        try:
            first = connection.recv(1, socket.MSG_PEEK)
        except OSError:
            first = b""
        if first:
            self._accepted(connection, network)
        else:
            connection.close()

    def _forget(self, connection: socket.socket) -> bytes:
        self._timers.pop(connection).cancel()
        self._loop.remove_reader(connection)
        return self._silent.pop(connection)


def one_too_many(networks: Mapping[_T, bytes]) -> _T:
    """Return which of some connections is to go: the oldest of the network with the most.

    So whoever opens a thousand a second keeps out nobody who needs half a second to say hello.

    Parameters
    ----------
    networks : mapping
        From which network each came, the oldest first.
    """
    most, _ = Counter(networks.values()).most_common(1)[0]
    return next(each for each, network in networks.items() if network == most)


def _network_of(family: int, address: Any) -> bytes:
    """Return what one owner has of addresses: a host's own one, or 64 bits of IPv6."""
    if family == socket.AF_INET:
        return socket.inet_pton(family, address[0])
    if family == socket.AF_INET6:
        packed = socket.inet_pton(family, address[0].partition("%")[0])
        return packed[12:] if packed.startswith(_MAPPED) else packed[:8]
    return b""


def listen(endpoint: Endpoint) -> socket.socket:
    """Return a socket that listens at an endpoint.

    Raises
    ------
    OSError, TransportError
        If it cannot.
    """
    if endpoint.is_local_socket:
        # Who has bound and does not listen yet looks as if it had been killed.
        with _locked(Path(endpoint.host).parent, endpoint):
            _remove_stale_socket(endpoint)
            return _listening(socket.socket(socket.AF_UNIX), endpoint.host)
    # As bytes, for the codec of other letters takes long to load.
    family, *_, address = socket.getaddrinfo(
        endpoint.host.encode(), endpoint.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    made = socket.socket(family)
    # A service that is started again may have the port of the one that died.
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    return _listening(made, address)


def remove_socket_file(endpoint: Endpoint, made: os.stat_result) -> None:
    """Remove a local socket's file, unless somebody else listens there meanwhile.

    Parameters
    ----------
    endpoint : Endpoint
    made : os.stat_result
        Of the file as it was made. Its socket is still open, so no other file is taken for it.
    """
    path = Path(endpoint.host)
    with contextlib.suppress(OSError):
        if os.path.samestat(path.stat(), made):
            path.unlink()


def _listening(made: socket.socket, address: Any) -> socket.socket:
    try:
        made.bind(address)
        made.listen(BACKLOG)
    except BaseException:
        made.close()
        raise
    return made


@contextlib.contextmanager
def _locked(directory: Path, endpoint: Endpoint) -> Iterator[None]:
    """Let nobody else begin to listen in a directory meanwhile; the lock leaves no file behind."""
    opened = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        until = time.monotonic() + _LOCK_TIMEOUT_S
        while True:
            try:
                fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= until:
                    raise TransportError(
                        f"cannot listen on {endpoint}: another process has locked {directory} "
                        f"for {_LOCK_TIMEOUT_S:g} s"
                    ) from None
                time.sleep(_LOCK_PAUSE_S)
        yield
    finally:
        os.close(opened)


def _remove_stale_socket(endpoint: Endpoint) -> None:
    """Remove what a process has left that was killed.

    Raises
    ------
    TransportError
        If there is something else of that name, or somebody listens there.
    """
    path = Path(endpoint.host)
    try:
        if not stat.S_ISSOCK(path.lstat().st_mode):
            raise TransportError(f"cannot listen on {endpoint}: there is a file of that name")
    except FileNotFoundError:
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.setblocking(False)
        try:
            probe.connect(endpoint.host)
        except ConnectionRefusedError:
            path.unlink(missing_ok=True)
            return
        except BlockingIOError:
            pass  # somebody listens who does not keep up
    raise TransportError(f"cannot listen on {endpoint}: another process listens there")
