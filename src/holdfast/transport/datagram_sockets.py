"""Sockets for datagrams: a service's, which the links of many robots share, and a robot's own."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import socket
import struct
from collections.abc import Callable, Iterator
from typing import Any, Final

from holdfast.transport.datagram_cipher import AssociationKeys

LARGEST_DATAGRAM: Final = 2048
DATAGRAMS_AT_ONCE: Final = 64
"""Read before the event loop serves other sockets."""

_RECEIVE_BUFFER_BYTES: Final = 1 << 20
"""Asked of the system, so that a burst of one robot does not push out datagrams of others."""

_REPORTS_ERRORS: Final = {
    socket.AF_INET: (socket.IPPROTO_IP, 11),
    socket.AF_INET6: (socket.IPPROTO_IPV6, 25),
}
"""Linux's IP_RECVERR and IPV6_RECVERR: ICMP errors are queued with the datagram they quote."""

_ERROR: Final = struct.Struct("=I")
_ERROR_BYTES: Final = 512

QUOTED_BYTES: Final = 32
"""Bytes of a datagram that an ICMP error quotes and that are compared: eight can be guessed, 24 are
encrypted. None of ours is shorter."""


def connected_socket(address: Any) -> socket.socket | None:
    """Open a socket that gets datagrams of one peer only, and its ICMP errors; None if it fails."""
    family = socket.AF_INET6 if len(address) == 4 else socket.AF_INET
    opened = socket.socket(family, socket.SOCK_DGRAM)
    try:
        opened.setblocking(False)
        opened.connect(address)
        opened.setsockopt(*_REPORTS_ERRORS[family], 1)
    except OSError:
        opened.close()
        return None
    return opened


def reported_errors(opened: socket.socket) -> Iterator[tuple[bytes, bool]]:
    """Yield what each queued ICMP error quotes of a datagram, and whether its port is closed."""
    for _ in range(DATAGRAMS_AT_ONCE):
        try:
            quoted, errors, _, _ = opened.recvmsg(QUOTED_BYTES, _ERROR_BYTES, socket.MSG_ERRQUEUE)
        except OSError:
            return
        yield quoted, any(_ERROR.unpack_from(each)[0] == errno.ECONNREFUSED for *_, each in errors)


class DatagramSocket:
    """A socket at one address, on the port of the stream if that is free.

    Raises OSError if the system has none left.
    """

    def __init__(self, address: Any) -> None:
        self.address = address
        self._loop = asyncio.get_running_loop()
        self._takers: dict[int, Callable[[bytes, Any], None]] = {}
        family = socket.AF_INET6 if len(address) == 4 else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        try:
            self._socket.setblocking(False)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
            try:
                self._socket.bind(address)
            except OSError:
                self._socket.bind((address[0], 0, *address[2:]))
        except BaseException:
            self._socket.close()
            raise
        self.port: int = self._socket.getsockname()[1]
        self._loop.add_reader(self._socket, self._readable)

    def add(self, take: Callable[[bytes, Any], None]) -> AssociationKeys:
        """Draw keys for a link, which takes its datagrams and where they come from."""
        # Random: an attacker that sees no datagram cannot guess one.
        while (association := int.from_bytes(os.urandom(4))) in self._takers:
            pass
        self._takers[association] = take
        return AssociationKeys.draw(association)

    def remove(self, association: int) -> None:
        """Take no more datagrams of an association."""
        self._takers.pop(association, None)

    @property
    def is_idle(self) -> bool:
        """Whether no link uses it."""
        return not self._takers

    def send(self, datagram: bytes, address: Any) -> None:
        """Send a datagram; it may be lost here as well as anywhere."""
        with contextlib.suppress(OSError):
            self._socket.sendto(datagram, address)

    def close(self) -> None:
        """Close the socket. May be repeated."""
        if self._socket.fileno() >= 0:
            self._loop.remove_reader(self._socket)
            self._socket.close()

    def _readable(self) -> None:
        for _ in range(DATAGRAMS_AT_ONCE):
            try:
                datagram, address = self._socket.recvfrom(LARGEST_DATAGRAM)
            except (BlockingIOError, InterruptedError):
                return
            except OSError:
                continue  # a robot is gone
            take = self._takers.get(int.from_bytes(datagram[:4]))  # by the association
            if take is not None:
                take(datagram, address)
