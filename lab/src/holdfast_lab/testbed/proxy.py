"""A bad line through a proxy, which stands between one robot and one service.

Like TCP, it never changes, reorders or drops a byte of an open stream. On a real line a lost packet
is sent again after a timeout, and everything behind it waits; so here loss makes a piece late. On a
silent line all pieces, and the ends of connections, are late until it is healed. Only a cut breaks
connections: it resets both ends and refuses new ones.

It may carry datagrams beside streams, at the same port. Loss and silence drop datagrams, jitter
reorders them, and they may come twice, again later, or from another address.

The queue of pieces is bounded: when it is full, the proxy stops reading, as with a full TCP window.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
import struct
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

from holdfast_lab.errors import CannotStartError
from holdfast_lab.testbed.bad_line import CARRIERS, BadLine, Carrier, Direction, Impairment

Place: TypeAlias = int | Path
"""A port of 127.0.0.1, or the path of a local socket."""

_PIECE_BYTES = 65_536
_PIECES_WAITING = 64
_RETRANSMISSION_S = 0.2
"""Linux sends a lost packet again after this time or longer, on a line that is short."""

_RESET_ON_CLOSE = struct.pack("ii", 1, 0)
_BACKLOG = 16
_LARGEST_DATAGRAM = 65_536
_MOST_CLIENTS = 64
_KEPT_DATAGRAMS = 50


def endpoint_at(transport: str, place: Place) -> str:
    """Return the endpoint of a service at a place of this machine."""
    return f"{transport}/{place}" if isinstance(place, Path) else f"{transport}/127.0.0.1:{place}"


class Proxy(BadLine):
    """A line to a service on this machine; to be used in a ``with`` statement.

    The service listens at ``target``; if nothing does, connections are closed at once. With
    ``datagrams`` it carries datagrams between the same ports, too. ``overhear`` is that of a bad
    line. Raises CannotStartError if it cannot listen.
    """

    def __init__(
        self,
        place: Place,
        target: Place,
        seed: str,
        *,
        datagrams: bool = False,
        overhear: Callable[[Carrier, Direction, bytes], object] = lambda *_: None,
    ) -> None:
        self.place = place
        self._target = target
        self._listener: socket.socket | None = None
        self._datagrams: socket.socket | None = None
        self._carries_datagrams = datagrams
        self._clients: dict[Any, socket.socket] = {}
        self._kept: deque[bytes] = deque(maxlen=_KEPT_DATAGRAMS)
        self._connections: set[asyncio.Task[None]] = set()
        self._sockets: set[socket.socket] = set()
        self._changed = asyncio.Event()
        super().__init__(f"proxy-{place}", seed, overhear)
        try:
            self._call(self._open())
        except OSError as error:
            self.close()
            named = place if isinstance(place, Path) else f"127.0.0.1:{place}"
            raise CannotStartError(
                f"the proxy cannot listen on {named}: {error.strerror}"
            ) from error

    def change_address(self) -> None:
        """Let datagrams come to the service from other ports, as after a change of networks."""
        self._call(self._change_address())

    def replay(self) -> None:
        """Send the last datagrams to the service again, from an address that nobody has had."""
        self._call(self._replay())

    # -- on the thread of the loop -------------------------------------------------------------

    async def _open(self) -> None:
        for carrier in CARRIERS:
            await self._set_up(carrier)

    async def _set_up(self, carrier: Carrier) -> None:
        """Listen, or refuse whatever comes where the line is cut."""
        is_cut = self._is_cut(carrier)
        if carrier == "streams":
            if is_cut or self._listener is None:
                await self._hang_up()
                # A port that is bound but not listened on refuses connections, and stays reserved.
                self._listener = self._bound()
            if not is_cut:
                self._listener.listen(_BACKLOG)
                self._loop.add_reader(self._listener, self._accept, self._listener)
            return
        self._close_datagrams()
        if self._carries_datagrams:
            self._datagrams = self._bound(socket.SOCK_DGRAM)
            if is_cut:
                # Connected to itself, it refuses all other senders.
                self._datagrams.connect(_address(self.place))
            else:
                self._loop.add_reader(self._datagrams, self._questions_come, self._datagrams)

    def _bound(self, kind: socket.SocketKind = socket.SOCK_STREAM) -> socket.socket:
        place = self.place
        if isinstance(place, Path):
            place.unlink(missing_ok=True)
        bound = socket.socket(_family(place), kind)
        try:
            if kind == socket.SOCK_STREAM:
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(_address(place))
            bound.setblocking(False)
        except BaseException:
            bound.close()
            raise
        return bound

    async def _change(self, key: object, impairment: Impairment | None) -> None:
        """Put an impairment on the line, or take it away."""
        were_cut = [self._is_cut(carrier) for carrier in CARRIERS]
        await super()._change(key, impairment)
        self._tell()
        for carrier, was_cut in zip(CARRIERS, were_cut, strict=True):
            if self._is_cut(carrier) != was_cut:
                await self._set_up(carrier)

    async def _end(self) -> None:
        await super()._end()
        self._tell()
        await self._hang_up()
        self._close_datagrams()

    async def _hang_up(self) -> None:
        """Stop listening, and reset all connections."""
        if self._listener is not None:
            self._loop.remove_reader(self._listener)
        tasks = list(self._connections)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for each in self._sockets:
            each.close()
        self._sockets.clear()
        if self._listener is not None:
            self._listener.close()
            self._listener = None

    def _tell(self) -> None:
        """Wake the tasks that wait for a change of the line."""
        self._changed.set()
        self._changed = asyncio.Event()

    async def _until_heard(self, direction: Direction) -> None:
        while self._is_silent("streams", direction):
            await self._changed.wait()

    def _accept(self, listener: socket.socket) -> None:
        try:
            robot, _ = listener.accept()
        except OSError:
            return  # the client has gone again
        self._take(robot)
        task = self._loop.create_task(self._connect(robot))
        self._connections.add(task)
        task.add_done_callback(self._connections.discard)

    def _take(self, each: socket.socket) -> None:
        each.setblocking(False)
        if each.family != socket.AF_UNIX:
            each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            # Until an end comes in order, whatever closes it resets it.
            each.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _RESET_ON_CLOSE)
        self._sockets.add(each)

    async def _connect(self, robot: socket.socket) -> None:
        """Carry one connection from its beginning to its end."""
        service = socket.socket(_family(self._target))
        try:
            self._take(service)
            # On a silent line not even the first packet of a connection comes through.
            await self._until_heard("to_service")
            await self._until_heard("to_robot")
            await self._loop.sock_connect(service, _address(self._target))
            async with asyncio.TaskGroup() as group:
                group.create_task(self._carry(robot, service, "to_service"))
                group.create_task(self._carry(service, robot, "to_robot"))
        except* OSError:
            pass  # reset by one end: so the other is reset as well, now
        finally:
            for each in (robot, service):
                self._sockets.discard(each)
                each.close()

    async def _carry(
        self, source: socket.socket, sink: socket.socket, direction: Direction
    ) -> None:
        pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(_PIECES_WAITING)
        reader = self._loop.create_task(self._read(source, pieces, direction))
        try:
            while True:
                due, piece = await pieces.get()
                await asyncio.sleep(max(0.0, due - self._loop.time()))
                await self._until_heard(direction)
                if not piece:
                    break
                self._overhear("streams", direction, piece)
                await self._loop.sock_sendall(sink, piece)
            with contextlib.suppress(OSError):
                sink.shutdown(socket.SHUT_WR)
        finally:
            reader.cancel()
        await reader

    async def _read(
        self,
        source: socket.socket,
        pieces: asyncio.Queue[tuple[float, bytes]],
        direction: Direction,
    ) -> None:
        """Queue what comes, with the time at which it is due; the last piece is empty."""
        due = 0.0
        while True:
            try:
                piece = await self._loop.sock_recv(source, _PIECE_BYTES)
            except OSError:
                piece = b""
            delay_s, losses = self._fate("streams", direction)
            # No piece overtakes another.
            due = max(due, self._loop.time() + delay_s + losses * _RETRANSMISSION_S)
            await pieces.put((due, piece))
            if not piece:
                return

    # -- datagrams -------------------------------------------------------------------------------

    def _close_datagrams(self) -> None:
        for each in (*self._clients.values(), *([self._datagrams] if self._datagrams else [])):
            self._loop.remove_reader(each)
            each.close()
        self._clients.clear()
        self._datagrams = None

    def _questions_come(self, listener: socket.socket) -> None:
        with contextlib.suppress(OSError):  # no more of them, or an earlier one went nowhere
            while True:
                content, address = listener.recvfrom(_LARGEST_DATAGRAM)
                client = self._clients.pop(address, None) or self._new_client(address)
                self._clients[address] = client  # now the last of all
                self._kept.append(content)
                self._carry_datagram(content, "to_service", client.send)

    def _new_client(self, address: Any) -> socket.socket:
        """Give a client a socket of its own, so that the service's answers find it."""
        while len(self._clients) >= _MOST_CLIENTS:
            oldest = self._clients.pop(next(iter(self._clients)))
            self._loop.remove_reader(oldest)
            oldest.close()
        client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        client.setblocking(False)
        client.connect(_address(self._target))
        self._loop.add_reader(client, self._answers_come, client, address)
        return client

    def _answers_come(self, client: socket.socket, address: Any) -> None:
        listener = self._datagrams
        assert listener is not None  # its clients are closed with it
        with contextlib.suppress(OSError):
            while True:
                content = client.recv(_LARGEST_DATAGRAM)
                self._carry_datagram(
                    content, "to_robot", lambda answer: listener.sendto(answer, address)
                )

    async def _change_address(self) -> None:
        for address, client in list(self._clients.items()):
            self._loop.remove_reader(client)
            self._clients[address] = self._new_client(address)
            client.close()

    async def _replay(self) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.connect(_address(self._target))
            for content in self._kept:
                with contextlib.suppress(OSError):  # nobody listens
                    stranger.send(content)


def _family(place: Place) -> socket.AddressFamily:
    return socket.AF_UNIX if isinstance(place, Path) else socket.AF_INET


def _address(place: Place) -> Any:
    return str(place) if isinstance(place, Path) else ("127.0.0.1", place)
