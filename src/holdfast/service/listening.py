"""The addresses of a service with several processes, bound by their supervisor.

A TCP port is bound but nothing listens on that socket: it reserves the port. Each process opens a
listening socket of its own there, and the system spreads connections over them (``SO_REUSEPORT``),
so a process that dies takes no connections. A local socket is one file, so all processes share it.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from pathlib import Path

from holdfast.errors import TransportError
from holdfast.transport.endpoints import Endpoint, why_not_bound
from holdfast.transport.listener import listen, remove_socket_file

__all__ = ["SharedEndpoints"]


class SharedEndpoints:
    """Endpoints at which several processes listen.

    Attributes
    ----------
    endpoints : tuple of Endpoint
        With the ports that were free instead of 0.

    Raises
    ------
    TransportError
        If one of them is taken, or cannot be shared; the message names it.
    """

    def __init__(self, endpoints: Sequence[Endpoint]) -> None:
        self._sockets: list[socket.socket] = []
        self._files: list[tuple[Endpoint, os.stat_result]] = []
        bound = []
        for endpoint in endpoints:
            try:
                bound.append(self._bind(endpoint))
            except TransportError:
                self.close()
                raise
            except OSError as error:
                self.close()
                raise TransportError(
                    f"cannot listen on {endpoint}: {why_not_bound(error)}"
                ) from error
        self.endpoints = tuple(bound)

    @property
    def descriptors(self) -> list[int]:
        """The sockets that a process is to inherit, one for each endpoint."""
        return [each.fileno() for each in self._sockets]

    def close(self) -> None:
        """Close all sockets; may be repeated."""
        while self._files:
            remove_socket_file(*self._files.pop())
        for each in self._sockets:
            each.close()

    def _bind(self, endpoint: Endpoint) -> Endpoint:
        if endpoint.is_local_socket:
            self._sockets.append(listen(endpoint))
            self._files.append((endpoint, Path(endpoint.host).stat()))
            return endpoint
        family, *_, where = socket.getaddrinfo(
            endpoint.host, endpoint.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        bound = socket.socket(family)
        self._sockets.append(bound)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # First make sure that no other program has the port, then share it with our processes.
        bound.bind(where)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        return endpoint._replace(port=bound.getsockname()[1])
