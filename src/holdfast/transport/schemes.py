"""The links of each protocol: streams, for ``udp`` with datagrams beside them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from holdfast.transport.endpoints import Role
from holdfast.transport.links import Link


def link_maker(protocol: str, role: Role) -> Callable[..., Link]:
    """Return what makes the links of new connections: ``make(owner, settings, tls=stream)``.

    The robot opens the connections. Raises TransportError if a package is missing.
    """
    if protocol != "udp":
        return partial(Link, speaks_first=role == "robot")
    # Imported only where an endpoint uses it, because a service should start fast.
    from holdfast.transport.datagram_cipher import require_cryptography
    from holdfast.transport.datagram_links import RobotDatagramLink, ServiceDatagramLink

    require_cryptography()
    if role == "robot":
        return RobotDatagramLink
    # One socket at each address that robots have called: the reply of a socket bound to all
    # addresses might come from another one, and the robot would ignore it.
    return partial(ServiceDatagramLink, sockets={})
