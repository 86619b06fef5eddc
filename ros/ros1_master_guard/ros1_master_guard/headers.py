"""Headers of TCPROS connections, and places in URIs, as ROS 1 writes them.

A connection begins with a header from each end: fields NAME=VALUE that name the service or topic
and the MD5 digest of its type. A header, like any message of TCPROS, comes after its length.
"""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import urlsplit

from ros1_master_guard.errors import ProtocolError

MAX_HEADER_BYTES = 64 * 1024
"""Bound on a connection header; a topic's contains the whole definition of its type."""

ANY_TYPE = "*"  # the digest that matches any type


def encode_header(fields: Mapping[str, str]) -> bytes:
    """Encode a connection header."""
    written = (f"{name}={value}".encode() for name, value in fields.items())
    return encode_message(b"".join(map(encode_message, written)))


def encode_message(payload: bytes) -> bytes:
    """Encode a request, or a message of a topic."""
    return len(payload).to_bytes(4, "little") + payload


def decode_header(data: bytes) -> dict[str, str]:
    """Decode a connection header, without its length; raise ProtocolError if it is malformed."""
    fields: dict[str, str] = {}
    place = 0
    while place < len(data):
        size = int.from_bytes(data[place : place + 4], "little")
        field = data[place + 4 : place + 4 + size]
        place += 4 + size
        name, equals, value = field.decode(errors="replace").partition("=")
        if len(field) != size or not equals:
            raise ProtocolError("has sent no connection header of ROS 1")
        fields[name] = value
    return fields


def host_and_port_of(uri: str, scheme: str | None = None) -> tuple[str, int] | None:
    """Return host and port of a URI; None if one is missing or the scheme is another."""
    try:
        parts = urlsplit(uri)
        host, port = parts.hostname, parts.port
    except ValueError:
        return None
    return (host, port) if host and port and scheme in (None, parts.scheme) else None
