"""Connects to an endpoint, again and again, until somebody is there.

A service that is started again is to be used at once, however far away it is. So a new attempt
begins every few hundredths of a second, and none waits for the one before, which may hang on a path
that is cut or on a process that stands still. The longer nobody is there, the longer the pauses:
in proportion, so that waiting for the next attempt adds two per cent to any outage.

Somebody who takes a connection and ends it soon again, hello or not, is asked less often: the pause
doubles with each such link, up to a fifth of a second. (It may be a proxy that accepts while its
service is being started.) A link that has brought an answer, or has lasted, makes it short again:
so a service that dies and is started again is found as fast as ever.

A name may stand for several addresses, at each of which there is another process. Each robot tries
them in an order of its own, so that robots spread over the processes, and one that loses a link
comes back to the process that knows it. An address that refuses leads to the next one at once.

Why attempts fail is told, for whoever has to mend it.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import ipaddress
import socket
import threading
from collections.abc import Callable
from typing import Any, Final, TypeAlias

from holdfast.errors import TransportError
from holdfast.transport.endpoints import Endpoint, system_words
from holdfast.transport.links import Link

__all__ = ["Dialer"]

_FIRST_PAUSE_S: Final = 0.02
_LAST_PAUSE_S: Final = 1.0
_SHARE_OF_OUTAGE: Final = 0.02

_LAST_PAUSE_AFTER_NOTHING_S: Final = 0.2
_LASTING_S: Final = 1.0
"""A link that ends sooner, and has brought no answer, has come to nothing."""

_CONNECT_TIMEOUT_S: Final = 2.0
"""For the answer to an attempt; the next ones have long begun."""

_NEXT_LINK_S: Final = 0.25
"""After a connection has come about, so long no second one is taken beside it."""

_REFUSED_PAUSE_S: Final = 1.0
"""After one of the ends did not want the other."""

_RESOLVE_AGAIN_S: Final = 1.0
"""After the last answer: while nobody is reached, a name may come to stand for somebody else."""

_LOOK_UP_AGAIN_S: Final = 0.1
"""After a ROS 1 master's last answer."""

_Address: TypeAlias = str | tuple[Any, ...]


class Dialer:
    """Makes links to an endpoint while it is wanted to.

    Parameters
    ----------
    endpoint : Endpoint
    make_link : callable
        Makes the link of a new connection.
    on_failed : callable
        Is told why no connection comes about, each time that an attempt has failed and all of the
        endpoint's addresses have.
    identity : str
        Of this end: by it the addresses of a name are put into an order.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        make_link: Callable[[], Link],
        on_failed: Callable[[str], None] = lambda _: None,
        identity: str = "",
    ) -> None:
        self._endpoint = endpoint
        self._identity = identity
        self._make_link = make_link
        self._on_failed = on_failed
        # Since somebody was there, why the last attempt at each address came to nothing.
        self._failures: dict[_Address, str] = {}
        self._loop = asyncio.get_running_loop()
        self._attempts: dict[socket.socket, tuple[_Address, asyncio.TimerHandle]] = {}
        self._links: set[Link] = set()
        self._winner: Link | None = None
        self._least_pause_s = _FIRST_PAUSE_S
        self._next: asyncio.TimerHandle | None = None
        self._absent_since: float | None = None
        self._attempted_at = self._connected_at = float("-inf")
        self._turn = 0
        self._resolve_at = float("-inf")
        self._addresses: list[tuple[socket.AddressFamily, _Address]] = []
        if endpoint.is_local_socket:
            self._addresses = [(socket.AF_UNIX, endpoint.host)]
        elif endpoint.is_ros1:
            pass  # the master knows it
        elif "%" not in endpoint.host:  # the interface that it names may come later
            with contextlib.suppress(ValueError):
                version = ipaddress.ip_address(endpoint.host).version
                family = socket.AF_INET if version == 4 else socket.AF_INET6
                self._addresses = [(family, (endpoint.host, endpoint.port))]
        self._is_name = not self._addresses

    def start(self, *, refused: bool = False) -> None:
        """Begin to connect, or go on; after a refusal only after a while."""
        now = self._loop.time()
        if self._absent_since is None:
            self._absent_since = now
        if self._next is not None:
            if not refused:
                return
            self._next.cancel()
        self._connected_at = float("-inf")
        # A service that comes and goes is not reached more often than one that is not there.
        at = max(
            now + (_REFUSED_PAUSE_S if refused else 0.0), self._attempted_at + self._least_pause_s
        )
        self._next = self._loop.call_at(at, self._attempt)

    def won(self, winner: Link) -> None:
        """Connect no more, and end all links that were made but this one."""
        self.stop()
        for link in list(self._links):
            if link is not winner:
                link.end("was not needed: another connection was first", goodbye="")
        self._links.clear()
        self._winner = winner

    def stop(self) -> None:
        """Connect no more; the links that were made go on."""
        if self._next is not None:
            self._next.cancel()
            self._next = None
        for stream in list(self._attempts):
            self._forget(stream)
            stream.close()

    def succeeded(self) -> None:
        """Take note that somebody is there who is what was looked for."""
        self._absent_since = None
        self._failures.clear()

    def ended(self, link: Link) -> None:
        """Take note that a link has ended."""
        if link not in self._links and link is not self._winner:
            return  # it was not needed
        now = self._loop.time()
        if link.has_answered or now >= link.began_at + _LASTING_S:
            self._least_pause_s = _FIRST_PAUSE_S
        else:
            self._least_pause_s = min(2.0 * self._least_pause_s, _LAST_PAUSE_AFTER_NOTHING_S)
        if link in self._links:
            self._links.discard(link)
            if not self._links:
                self._connected_at = float("-inf")
        if self._next is not None:
            self._next.cancel()
            at = max(self._next.when(), self._attempted_at + self._least_pause_s)
            self._next = self._loop.call_at(at, self._attempt)

    # -- attempts --------------------------------------------------------------------------------

    def _attempt(self) -> None:
        now = self._loop.time()
        absent_s = 0.0 if self._absent_since is None else now - self._absent_since
        pause_s = min(max(self._least_pause_s, _SHARE_OF_OUTAGE * absent_s), _LAST_PAUSE_S)
        self._next = self._loop.call_later(pause_s, self._attempt)
        if self._is_name and now >= self._resolve_at:
            self._resolve_at = float("inf")
            # The search for an address can take many seconds and cannot be broken off.
            threading.Thread(target=self._resolve, name="holdfast-resolve", daemon=True).start()
        if not self._addresses or now < self._connected_at + _NEXT_LINK_S:
            return
        self._attempted_at = now
        family, address = self._addresses[self._turn % len(self._addresses)]
        self._turn += 1
        self._connect(family, address)

    # Without tasks: one that is begun while the loop ends would be complained of.

    def _connect(self, family: socket.AddressFamily, address: _Address) -> None:
        try:
            stream = socket.socket(family, socket.SOCK_STREAM)
        except OSError as error:  # no descriptor is free
            self._failed(address, error.errno)
            return
        stream.setblocking(False)
        number = stream.connect_ex(address)
        if number == errno.EINPROGRESS:
            timeout = self._loop.call_later(_CONNECT_TIMEOUT_S, self._give_up, stream)
            self._attempts[stream] = address, timeout
            self._loop.add_writer(stream, self._look, stream)
        else:
            self._connected_or_failed(stream, address, number)

    def _look(self, stream: socket.socket) -> None:
        number = stream.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        self._connected_or_failed(stream, self._forget(stream), number)

    def _connected_or_failed(self, stream: socket.socket, address: _Address, number: int) -> None:
        if number:
            stream.close()
            self._failed(address, number)
        else:
            self._connected(stream)

    def _connected(self, stream: socket.socket) -> None:
        now = self._loop.time()
        if now < self._connected_at + _NEXT_LINK_S:
            stream.close()
            return
        self._connected_at = now
        link = self._make_link()
        self._links.add(link)
        link.connecting = self._loop.create_task(link.connect(stream))

    def _give_up(self, stream: socket.socket) -> None:
        address = self._forget(stream)
        stream.close()
        self._failed(address, errno.ETIMEDOUT)

    def _forget(self, stream: socket.socket) -> _Address:
        address, timeout = self._attempts.pop(stream)
        timeout.cancel()
        self._loop.remove_writer(stream)
        return address

    def _failed(self, address: _Address, number: int | None) -> None:
        # A host may have addresses of two kinds, and be reached over one alone.
        failures = {**self._failures, address: _reason(number)}
        reasons = [failures.get(address) for _, address in self._addresses]
        # A name may lead to other addresses each time that it is looked up.
        self._failures = {each: failures[each] for _, each in self._addresses if each in failures}
        if None not in reasons:
            self._on_failed("; ".join(dict.fromkeys(filter(None, reasons))))
        elif self._next is not None and not self._links:
            self._next.cancel()
            self._next = self._loop.call_later(0.0, self._attempt)

    def _place_of(self, address: _Address) -> bytes:
        import hashlib  # most endpoints are no names

        return hashlib.blake2b(f"{self._identity} {address}".encode(), digest_size=8).digest()

    def _resolve(self) -> None:
        """Look up the host's addresses; on a thread of its own."""
        endpoint = self._endpoint
        host, port = endpoint.host, endpoint.port
        family, again_s = socket.AF_UNSPEC, _RESOLVE_AGAIN_S
        reason = ""
        found: list[Any] = []
        try:
            if endpoint.is_ros1:
                from holdfast.transport.ros1 import look_up

                # A service that is started again is at another port; and ROS 1 speaks IPv4.
                family, again_s = socket.AF_INET, _LOOK_UP_AGAIN_S
                host, port = look_up(endpoint)
            found = socket.getaddrinfo(host, port, family, type=socket.SOCK_STREAM)
        except TransportError as error:
            reason = str(error)
        except (OSError, UnicodeError):
            reason = f"host name not found: {host}"
        except Exception as error:  # noqa: BLE001 - else nobody would ever look again
            reason = f"{type(error).__name__}: {error}"
        addresses: list[tuple[socket.AddressFamily, _Address]] = [
            (entry[0], entry[4]) for entry in found
        ]
        # Of two kinds the system knows which is likelier to work.
        kinds = [family for family, _ in addresses]
        addresses.sort(key=lambda each: (kinds.index(each[0]), self._place_of(each[1])))

        def take() -> None:
            self._resolve_at = self._loop.time() + again_s
            # Without new ones, those of before may still be right.
            self._addresses = addresses or self._addresses
            if not self._addresses:
                self._on_failed(reason)
            elif self._next is not None and not self._attempts and not self._links:
                self._next.cancel()
                self._attempt()

        with contextlib.suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(take)


def _reason(number: int | None) -> str:
    """Write the system's own words as the rest of a sentence."""
    if number == errno.ETIMEDOUT:
        return "nothing answers"
    return system_words(number)
