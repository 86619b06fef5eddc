"""What implements a scheme of endpoints: ``tcp``, ``tls``, ``udp``, ``unix``.

Both ends make links through a :class:`Scheme`. The class itself is that of plain stream sockets. A
new transport is a subclass of it in a module of its own, and a line in
:data:`~holdfast.transport.endpoints.SCHEMES`, which names the class. It is imported only where an
endpoint uses it, because a service should start fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

from holdfast.transport.endpoints import SCHEMES, Role
from holdfast.transport.links import Link, LinkOwner

if TYPE_CHECKING:
    from holdfast.transport.link_settings import LinkSettings
    from holdfast.transport.tls import TlsStream


def load_scheme(name: str) -> Scheme:
    """Import and make the implementation of a scheme, for one end of a transport.

    Raises TransportError if it needs a package that is not installed.
    """
    module, _, class_name = SCHEMES[name].implementation.partition(":")
    made: Scheme = getattr(importlib.import_module(module), class_name)()
    return made


class Scheme:
    """Stream sockets: ``tcp``, ``tls`` and ``unix``."""

    def make_link(
        self,
        owner: LinkOwner,
        settings: LinkSettings,
        tls: TlsStream | None,
        *,
        role: Role,
    ) -> Link:
        """Make the link of a new connection, which the robot has opened."""
        return Link(owner, settings, speaks_first=role == "robot", tls=tls)

    def close(self) -> None:
        """Close what the links of this end share. May be repeated."""
