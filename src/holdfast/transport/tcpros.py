"""TCPROS, the protocol of ROS 1 over TCP, as bytes: no socket here.

A connection begins with a header from each end: fields NAME=VALUE that name the service or topic
and the MD5 digest of its type. Then a caller sends requests, each after its length, and receives a
response to each in the same order: a byte for success, then a message or an error text. A topic's
connection carries messages only.
"""

from __future__ import annotations

import os
import re
import socket
import struct
from collections.abc import Mapping
from typing import NamedTuple, Self
from urllib.parse import urlsplit

from holdfast.errors import TransportError

__all__ = [
    "ANY_TYPE",
    "MAX_HEADER_BYTES",
    "RosEnvironment",
    "ServiceType",
    "decode_header",
    "encode_answer",
    "encode_header",
    "encode_message",
    "encode_refusal",
    "header_of_service",
    "host_and_port_of",
    "place_of_service",
]

MAX_HEADER_BYTES = 64 * 1024
"""Bound on a connection header; a topic's contains the whole definition of its type."""

_MAX_FIELDS = 64
"""Bound on its fields; ROS has eight."""

ANY_TYPE = "*"
"""The digest that matches any type."""

_LENGTH = struct.Struct("<I")
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_MAX_NAME = 200


class ServiceType(NamedTuple):
    """A service's type: its name, as in ``std_srvs/Trigger``, and its MD5 digest."""

    name: str
    digest: str


def encode_header(fields: Mapping[str, str]) -> bytes:
    """Encode a connection header."""
    parts = []
    for name, value in fields.items():
        field = f"{name}={value}".encode()
        parts += [_LENGTH.pack(len(field)), field]
    return encode_message(b"".join(parts))


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


def decode_header(data: bytes) -> dict[str, str]:
    """Decode a connection header, without its length.

    Raises
    ------
    TransportError
        If it is malformed; the message continues a sentence about its sender.
    """
    fields: dict[str, str] = {}
    place = 0
    while place < len(data):
        if len(fields) >= _MAX_FIELDS:
            raise TransportError(f"has sent a connection header of more than {_MAX_FIELDS} fields")
        if place + 4 > len(data):
            raise TransportError("has sent a connection header that is cut off")
        (size,) = _LENGTH.unpack_from(data, place)
        field = data[place + 4 : place + 4 + size]
        name, equals, value = field.decode(errors="replace").partition("=")
        if len(field) != size or not equals:
            raise TransportError("has sent no connection header of ROS 1")
        fields[name] = value
        place += 4 + size
    return fields


def encode_message(payload: bytes) -> bytes:
    """Encode a request, or a message of a topic."""
    return _LENGTH.pack(len(payload)) + payload


def encode_answer(payload: bytes) -> bytes:
    """Encode a response."""
    return b"\x01" + encode_message(payload)


def encode_refusal(reason: str) -> bytes:
    """Encode a response that reports an error."""
    return b"\x00" + encode_message(reason.encode())


def host_and_port_of(uri: str, scheme: str | None = None) -> tuple[str, int] | None:
    """Return host and port of a URI; None if one is missing or the scheme is another."""
    try:
        parts = urlsplit(uri)
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    return (host, port) if host and port and scheme in (None, parts.scheme) else None


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
