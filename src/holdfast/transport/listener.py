"""A listening socket, and accepted connections before their first byte.

Anybody can open a connection, and most connections to a public port send nothing or nonsense. So a
connection costs very little before its first byte. Silent ones are closed after a while; if there
are too many, one of the network with the most is closed.

When many robots come back at once, connections wait with their first byte unread, in turns by
network, and are delivered as fast as handshakes are computed. One whose peer has given up meanwhile
costs none.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import itertools
import os
import select
import socket
import stat
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, TypeVar

from holdfast.errors import TransportError
from holdfast.runtime.addresses import why_not_bound
from holdfast.transport.endpoints import Endpoint
from holdfast.transport.links import OPENING_TIMEOUT_S

_BACKLOG: Final = 4096
"""Connections that wait to be accepted."""

_ACCEPTED_AT_ONCE: Final = 2
"""Accepted, and delivered, before the event loop serves existing links."""

_PAUSE_S: Final = 0.1
"""After the system could not accept, because no descriptor was free."""

_LOCK_TIMEOUT_S: Final = 10.0
_LOCK_PAUSE_S: Final = 0.01
"""For the lock of a local socket's directory, which is held only for a moment."""

MAX_SILENT: Final = 256
"""Connections without a first byte."""

MAX_WAITING: Final = 1024
"""Connections with a first byte that are not delivered yet."""

_DELIVERY_PAUSE_S: Final = 0.001
"""Between two deliveries, so that existing links are served."""

_MAPPED = b"\0" * 10 + b"\xff\xff"
"""Prefix of an IPv4 address within IPv6."""

_T = TypeVar("_T")


class Listener:
    """Accepts connections, and delivers each when its first byte has come.

    Raises TransportError if it cannot listen there; the message names the endpoint.
    """

    def __init__(
        self,
        endpoint: Endpoint,  # port 0 takes a free one; the attribute has its number
        # Gets the socket of such a connection, and the network from which it came.
        accepted: Callable[[socket.socket, bytes], None],
        *,
        # Whether another connection can be taken now.
        may_deliver: Callable[[], bool] = lambda: True,
        # One that listens there already, or is bound there for several processes.
        shared: socket.socket | None = None,
    ) -> None:
        self._accepted = accepted
        self._may_deliver = may_deliver
        self._loop = asyncio.get_running_loop()
        try:
            self._socket = listen(endpoint) if shared is None else _listen_beside(shared)
            self._socket.setblocking(False)
        except OSError as error:
            raise TransportError(f"cannot listen on {endpoint}: {why_not_bound(error)}") from error
        self.endpoint = endpoint
        self._socket_file: os.stat_result | None = None
        if not endpoint.is_local_socket:
            self.endpoint = endpoint._replace(port=self._socket.getsockname()[1])
        elif shared is None:
            self._socket_file = Path(endpoint.host).stat()
        self._silent: dict[socket.socket, bytes] = {}
        self._timers: dict[socket.socket, asyncio.TimerHandle] = {}
        self._waiting: OrderedDict[bytes, deque[socket.socket]] = OrderedDict()
        self._delivery: asyncio.TimerHandle | None = None
        self._pause: asyncio.TimerHandle | None = None
        self._loop.add_reader(self._socket, self._accept)

    def close(self) -> None:
        """Stop listening, and close silent connections. May be repeated."""
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
        if self._delivery is not None:
            self._delivery.cancel()
        for connection in itertools.chain(*self._waiting.values()):
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
                    self._pause = self._loop.call_later(_PAUSE_S, self._resume)
                return  # otherwise the peer is gone already
            connection.setblocking(False)
            network = _network_of(connection.family, address)
            if len(self._silent) >= MAX_SILENT:
                other = connection_to_drop(self._silent)
                self._forget(other)
                other.close()
            self._silent[connection] = network
            self._timers[connection] = self._loop.call_later(
                OPENING_TIMEOUT_S, self._queue_or_close, connection
            )
            self._loop.add_reader(connection, self._queue_or_close, connection)

    def _resume(self) -> None:
        self._loop.add_reader(self._socket, self._accept)

    def _queue_or_close(self, connection: socket.socket) -> None:
        """Let a connection that has a first byte wait for its delivery; else close it."""
        network = self._forget(connection)
        try:
            first = connection.recv(1, socket.MSG_PEEK)
        except OSError:
            first = b""
        if not first:
            connection.close()
            return
        self._waiting.setdefault(network, deque()).append(connection)
        if sum(map(len, self._waiting.values())) > MAX_WAITING:
            # The newest of the network with the most, of equals the last that came: others have
            # waited for longer.
            most = max(reversed(self._waiting), key=lambda each: len(self._waiting[each]))
            self._waiting[most].pop().close()
            if not self._waiting[most]:
                del self._waiting[most]
        if self._delivery is None:
            self._deliver(have_waited=False)

    def _deliver(self, *, have_waited: bool = True) -> None:
        """Deliver some of the connections that wait, and come again."""
        self._delivery = None
        if not self._waiting:
            return
        self._delivery = self._loop.call_later(_DELIVERY_PAUSE_S, self._deliver)
        delivered = 0
        while self._waiting and delivered < _ACCEPTED_AT_ONCE and self._may_deliver():
            network, waiting = self._waiting.popitem(last=False)
            connection = waiting.popleft()
            if waiting:
                self._waiting[network] = waiting
            if have_waited and _has_hung_up(connection):
                connection.close()
            else:
                delivered += 1
                self._accepted(connection, network)

    def _forget(self, connection: socket.socket) -> bytes:
        self._timers.pop(connection).cancel()
        self._loop.remove_reader(connection)
        return self._silent.pop(connection)


def _has_hung_up(connection: socket.socket) -> bool:
    """Return whether the peer has closed a connection, whatever it has sent before."""
    looked_at = select.poll()
    looked_at.register(connection, select.POLLRDHUP)
    return bool(looked_at.poll(0))


def connection_to_drop(networks: Mapping[_T, bytes]) -> _T:
    """Return the connection to drop: the oldest of the network with the most.

    So a network that opens a thousand a second does not lock out a peer with a slow hello.

    ``networks`` has the network of each connection, the oldest first.
    """
    most, _ = Counter(networks.values()).most_common(1)[0]
    return next(each for each, network in networks.items() if network == most)


def _network_of(family: int, address: Any) -> bytes:
    """Return what one operator controls: an IPv4 address, or 64 bits of an IPv6 address."""
    if family == socket.AF_INET:
        return socket.inet_pton(family, address[0])
    if family == socket.AF_INET6:
        packed = socket.inet_pton(family, address[0].partition("%")[0])
        return packed[12:] if packed.startswith(_MAPPED) else packed[:8]
    return b""


def listen(endpoint: Endpoint) -> socket.socket:
    """Return a socket that listens at an endpoint; raise OSError or TransportError otherwise."""
    if endpoint.is_local_socket:
        # Locked, because a socket that is bound and does not listen yet looks abandoned.
        with _locked(Path(endpoint.host).parent, endpoint):
            _remove_stale_socket(endpoint)
            return _listening(socket.socket(socket.AF_UNIX), endpoint.host)
    # As bytes: the codec for international names is slow to import.
    family, *_, address = socket.getaddrinfo(
        endpoint.host.encode(), endpoint.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
    )[0]
    made = socket.socket(family)
    # A restarted service may reuse the port at once.
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    return _listening(made, address)


def _listen_beside(shared: socket.socket) -> socket.socket:
    """Return a socket of this process that listens where one is bound, and close that one.

    One that listens already is returned. The system spreads a port's connections over its sockets;
    a local socket is one file, so all processes accept from one.
    """
    if shared.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
        return shared
    with shared:
        made = socket.socket(shared.family)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        return _listening(made, shared.getsockname())


def remove_socket_file(endpoint: Endpoint, made: os.stat_result) -> None:
    """Remove a local socket's file, unless another process listens there now.

    ``made`` is the file's status when it was made. Its socket is still open, so the inode is not
    reused.
    """
    path = Path(endpoint.host)
    with contextlib.suppress(OSError):
        if os.path.samestat(path.stat(), made):
            path.unlink()


def _listening(made: socket.socket, address: Any) -> socket.socket:
    try:
        made.bind(address)
        made.listen(_BACKLOG)
    except BaseException:
        made.close()
        raise
    return made


@contextlib.contextmanager
def _locked(directory: Path, endpoint: Endpoint) -> Iterator[None]:
    """Lock a directory against other listeners; the lock leaves no file behind."""
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
    """Remove the socket file of a killed process; raise TransportError if it is in use."""
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
            pass  # a listener with a full backlog
    raise TransportError(f"cannot listen on {endpoint}: another process listens there")
