"""The addresses of a service with several processes, bound by their supervisor.

A TCP port is bound but nothing listens on that socket: it reserves the port. Each process opens a
listening socket of its own there, and the system spreads connections over them (``SO_REUSEPORT``),
so a process that dies takes no connections. A local socket is one file, so all processes share it.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Sequence
from pathlib import Path

from holdfast.errors import TransportError
from holdfast.runtime.addresses import why_not_bound
from holdfast.transport.endpoints import Endpoint
from holdfast.transport.listener import listen, remove_socket_file


class SharedEndpoints:
    """Endpoints at which several processes listen.

    Raises TransportError if one of them is taken, or cannot be shared; the message names it.
    """

    def __init__(self, endpoints: Sequence[Endpoint]) -> None:
        # The sockets that a process is to inherit, one for each endpoint.
        self.descriptors: list[int] = []
        with contextlib.ExitStack() as stack:
            # With the ports that were free instead of 0.
            self.endpoints = tuple([self._bind(endpoint, stack) for endpoint in endpoints])
            self._bound = stack.pop_all()

    def close(self) -> None:
        """Close all sockets; may be repeated."""
        self._bound.close()

    def _bind(self, endpoint: Endpoint, stack: contextlib.ExitStack) -> Endpoint:
        try:
            if endpoint.is_local_socket:
                bound = stack.enter_context(listen(endpoint))
                stack.callback(remove_socket_file, endpoint, Path(endpoint.host).stat())
            else:
                family, *_, where = socket.getaddrinfo(
                    endpoint.host, endpoint.port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
                )[0]
                bound = stack.enter_context(socket.socket(family))
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                # First make sure that no other program has the port, then share it with our
                # processes.
                bound.bind(where)
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
                endpoint = endpoint._replace(port=bound.getsockname()[1])
        except OSError as error:
            raise TransportError(f"cannot listen on {endpoint}: {why_not_bound(error)}") from error
        self.descriptors.append(bound.fileno())
        return endpoint
