"""The listening sockets of a service with several processes; they outlive each process.

Each process has its own listening socket at the same TCP port, and the system spreads connections
over them (``SO_REUSEPORT``). One more socket is bound but never listens: it reserves the port while
no process has one. A local socket is one file, so all processes share it.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from pathlib import Path

from holdfast.errors import TransportError
from holdfast.transport.endpoints import Endpoint, why_not_bound
from holdfast.transport.listener import BACKLOG, listen, remove_socket_file

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
        self._bound: list[socket.socket] = []
        self._files: list[tuple[Endpoint, os.stat_result]] = []
        self._listening: dict[int, list[socket.socket]] = {}
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

    def of(self, index: int) -> Sequence[socket.socket]:
        """Return the listening sockets of a process, one for each endpoint.

        Raises
        ------
        OSError
            If they were released and the system allows no more sockets.
        """
        if index not in self._listening:
            listening = self._listening[index] = []
            try:
                for endpoint, bound in zip(self.endpoints, self._bound, strict=True):
                    listening.append(bound if endpoint.is_local_socket else _listen(bound))
            except OSError:
                self.release(index)
                raise
        return self._listening[index]

    def release(self, index: int) -> None:
        """Close a process's own sockets, and so refuse the connections that wait there."""
        for listening in self._listening.pop(index, ()):
            if listening not in self._bound:
                listening.close()

    def close(self) -> None:
        """Close all sockets; may be repeated."""
        for index in list(self._listening):
            self.release(index)
        while self._files:
            remove_socket_file(*self._files.pop())
        for bound in self._bound:
            bound.close()

    def _bind(self, endpoint: Endpoint) -> Endpoint:
        if endpoint.is_local_socket:
            self._bound.append(listen(endpoint))
            self._files.append((endpoint, Path(endpoint.host).stat()))
            return endpoint
        family, *_, where = socket.getaddrinfo(
            endpoint.host, endpoint.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        bound = socket.socket(family)
        self._bound.append(bound)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        # First make sure that no other program has the port, then share it with our processes.
        bound.bind(where)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        return endpoint._replace(port=bound.getsockname()[1])


def _listen(bound: socket.socket) -> socket.socket:
    """Return another socket that listens where one is bound."""
    listening = socket.socket(bound.family)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
        listening.bind(bound.getsockname())
        listening.listen(BACKLOG)
    except OSError:
        listening.close()
        raise
    return listening
