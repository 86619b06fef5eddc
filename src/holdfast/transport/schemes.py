"""What implements a scheme of endpoints: ``tcp``, ``tls``, ``udp``, ``unix``, ``ros1``.

Both ends make links, listen and look up addresses through a :class:`Scheme`. The class itself is
that of plain stream sockets. A new transport is a subclass of it in a module of its own, and a line
in :data:`~holdfast.transport.endpoints.SCHEMES`, which names the class. It is imported only where
an endpoint uses it, because a service should start fast.
"""

from __future__ import annotations

import importlib
import socket
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, ClassVar

from holdfast.transport.endpoints import SCHEMES, Endpoint, Role
from holdfast.transport.links import Link, LinkOwner

if TYPE_CHECKING:
    from holdfast.transport.link_settings import LinkSettings
    from holdfast.transport.tls import TlsStream

__all__ = ["Scheme", "load_scheme"]


def load_scheme(name: str) -> Scheme:
    """Import and make the implementation of a scheme, for one end of a transport.

    Raises
    ------
    TransportError
        If it needs a package that is not installed.
    """
    module, _, class_name = SCHEMES[name].implementation.partition(":")
    made: Scheme = getattr(importlib.import_module(module), class_name)()
    return made


class Scheme:
    """Stream sockets: ``tcp``, ``tls`` and ``unix``."""

    lookup_interval_s: ClassVar[float] = 1.0
    """Between two look-ups of a host while no peer is reached."""

    def make_link(
        self,
        owner: LinkOwner,
        settings: LinkSettings,
        endpoint: Endpoint,
        tls: TlsStream | None,
        *,
        role: Role,
        dialled: bool,
    ) -> Link:
        """Make the link of a new connection; ``dialled`` if this end has opened it."""
        del endpoint
        speaks_first = dialled if tls is None else role == "robot"
        return Link(owner, settings, speaks_first=speaks_first, tls=tls)

    def look_up(self, endpoint: Endpoint) -> tuple[str, int, socket.AddressFamily]:
        """Return host, port and family to resolve; may block, and runs on a thread.

        Raises
        ------
        TransportError
            If they are not known; the message says why.
        """
        return endpoint.host, endpoint.port, socket.AF_UNSPEC

    def listening_endpoint(self, endpoint: Endpoint) -> Endpoint:
        """Return the endpoint at which a service opens its listening socket."""
        return endpoint

    def bound_endpoint(self, endpoint: Endpoint, listening: Endpoint) -> Endpoint:
        """Return where robots connect, once the socket listens at ``listening``."""
        del endpoint
        return listening

    async def announce(
        self,
        ports: Mapping[Endpoint, int],
        on_event: Callable[..., None] | None,
        on_shutdown: Callable[[str], None] | None,
    ) -> None:
        """Publish where a service's endpoints listen, if the scheme has a directory."""

    async def withdraw(self, timeout_s: float) -> None:
        """Take the announcement back, within this time."""

    def close(self) -> None:
        """Close what the links of this end share. May be repeated."""
