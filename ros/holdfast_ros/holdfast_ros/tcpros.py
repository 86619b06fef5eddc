"""TCPROS, the protocol of ROS 1 over TCP, as bytes: no socket here.

A connection begins with a header from each end (:mod:`ros1_master_guard.headers`). Then a caller
sends requests, each after its length, and receives a response to each in the same order: a byte for
success, then a message or an error text. A topic's connection carries messages only.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Mapping
from typing import NamedTuple, Self

from holdfast.errors import TransportError
from ros1_master_guard.headers import encode_message, host_and_port_of

__all__ = [
    "RosEnvironment",
    "ServiceType",
    "encode_answer",
    "encode_refusal",
    "header_of_service",
    "place_of_service",
]

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_MAX_NAME = 200


class ServiceType(NamedTuple):
    """A service's type: its name, as in ``std_srvs/Trigger``, and its MD5 digest."""

    name: str
    digest: str


def header_of_service(node: str, service: str, type_: ServiceType) -> dict[str, str]:
    """Return the fields with which a service answers a caller's header."""
    return {
        "callerid": node,
        "service": service,
        "type": type_.name,
        "md5sum": type_.digest,
        "request_type": f"{type_.name}Request",
        "response_type": f"{type_.name}Response",
    }


def encode_answer(payload: bytes) -> bytes:
    """Encode a response."""
    return b"\x01" + encode_message(payload)


def encode_refusal(reason: str) -> bytes:
    """Encode a response that reports an error."""
    return b"\x00" + encode_message(reason.encode())


def place_of_service(uri: object) -> tuple[str, int]:
    """Return host and port of a service's URI, ``rosrpc://HOST:PORT``.

    Raises
    ------
    TransportError
        If it has another form.
    """
    place = host_and_port_of(str(uri), "rosrpc")
    if place is None:
        raise TransportError(f"the master says that it is at {uri!r:.200}, which is no place")
    return place


class RosEnvironment(NamedTuple):
    """The settings of ROS 1 for this process.

    Attributes
    ----------
    master : str
        URI of the master.
    host : str
        Name or address of this machine for other nodes.
    bind : str
        The address at which to listen.
    namespace : str
        Prefix of names that do not begin with a slash; ends with one.
    """

    master: str
    host: str
    bind: str
    namespace: str

    @classmethod
    def of(cls, environment: Mapping[str, str] = os.environ) -> Self:
        """Read ``ROS_MASTER_URI``, ``ROS_HOSTNAME``, ``ROS_IP`` and ``ROS_NAMESPACE``.

        Raises
        ------
        TransportError
            If the master's URI is malformed.
        """
        master = environment.get("ROS_MASTER_URI") or "http://localhost:11311"
        if host_and_port_of(master, "http") is None:
            raise TransportError(f"ROS_MASTER_URI is {master!r:.200}; expected http://HOST:PORT")
        own = environment.get("ROS_HOSTNAME") or environment.get("ROS_IP") or ""
        is_local = own == "localhost" or own.startswith("127.")
        namespace = environment.get("ROS_NAMESPACE", "").strip("/")
        return cls(
            master,
            own or socket.gethostname(),
            "127.0.0.1" if is_local else "0.0.0.0",
            f"/{namespace}/" if namespace else "/",
        )

    def resolved(self, name: str) -> str:
        """Return the absolute name; raise TransportError if it is malformed."""
        if len(name) > _MAX_NAME or not _NAME.fullmatch(name.removeprefix("/")):
            raise TransportError(
                f"{name!r:.220} is no name in ROS 1: words of letters, digits and '_', each "
                f"beginning with a letter, with '/' between them, {_MAX_NAME} characters at most"
            )
        return name if name.startswith("/") else self.namespace + name
