"""Keys, liveliness tokens and attachments as rmw_zenoh writes them.

rmw_zenoh makes each ROS 2 service a Zenoh queryable. Its key names domain, service, type and the
type's hash. The payload is the message in CDR. An attachment holds the client's identity and the
request's number, and the answer repeats it. ``ros2 service list`` reads liveliness tokens, whose
keys hold the same names and the node's. (Source: the design document of ros2/rmw_zenoh.)
"""

from __future__ import annotations

import re
import struct
from typing import NamedTuple

from holdfast.errors import InvalidValueError
from holdfast.ros import messages

__all__ = [
    "GID_SIZE",
    "MAX_DOMAIN",
    "NO_HASH",
    "Attachment",
    "check_domain",
    "check_service_name",
    "graph_tokens",
    "service_key",
]

MAX_DOMAIN = 232

NO_HASH = "TypeHashNotSupported"
"""Humble writes this in place of a type's hash."""

GID_SIZE = 16
"""Bytes of a client's identity."""

_QUALITY_OF_SERVICE = "::,10:,:,:,,"
"""ROS 2's default for services: reliable, volatile, the last 10."""

_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")
_MAX_NAME = 200
_ATTACHMENT = struct.Struct("<qqB16s")


class Attachment(NamedTuple):
    """What goes with a request, and comes back with its answer.

    The client has a number for each request, from 0 up, and an identity of 16 bytes. The time is in
    nanoseconds since 1970.
    """

    sequence_number: int
    source_timestamp: int
    gid: bytes

    def encode(self) -> bytes:
        """Return its 33 bytes."""
        return _ATTACHMENT.pack(self.sequence_number, self.source_timestamp, GID_SIZE, self.gid)

    @classmethod
    def decode(cls, data: bytes) -> Attachment:
        """Read one.

        Raises InvalidValueError if the bytes are none.
        """
        if len(data) == _ATTACHMENT.size:
            number, timestamp, size, gid = _ATTACHMENT.unpack(data)
            if size == GID_SIZE and number >= 0 and timestamp >= 0:
                return cls(number, timestamp, gid)
        raise InvalidValueError(
            f"attachment of {len(data)} bytes: rmw_zenoh's has {_ATTACHMENT.size}, a sequence "
            f"number, a time and a GID of {GID_SIZE} bytes"
        )


def check_domain(domain: int, key: str = "domain") -> int:
    """Return a domain of ROS 2.

    Raises InvalidValueError if it is none; the message names ``key``.
    """
    if not 0 <= domain <= MAX_DOMAIN:
        raise InvalidValueError(f"{key} {domain}: ROS 2's domains are from 0 to {MAX_DOMAIN}")
    return domain


def check_service_name(name: str, key: str = "name") -> str:
    """Return a service's name without the slash that it may begin with.

    Raises InvalidValueError if ROS 2 would not allow it; the message names ``key``.
    """
    if not _NAME.fullmatch(name) or "__" in name or len(name) > _MAX_NAME:
        raise InvalidValueError(
            f"{key} {name!r:.210}: a service's name consists of letters, digits and single "
            f"underscores, with slashes between its parts, none of which begins with a digit, and "
            f"has {_MAX_NAME} characters at most"
        )
    return name.removeprefix("/")


def _dds_type() -> str:
    package, kind, name = messages.SERVICE.split("/")
    return f"{package}::{kind}::dds_::{name}_"


def service_key(domain: int, name: str, type_hash: str) -> str:
    """Return the key at which a service is asked."""
    return f"{domain}/{name}/{_dds_type()}/{type_hash}"


def graph_tokens(
    domain: int, session: str, name: str, node: str, *, serves: bool
) -> tuple[str, str]:
    """Return the keys of the tokens that show a node, and its service or its client of one.

    The node ``node`` of the root namespace offers the service, or with ``serves`` False asks it.
    ``session`` is Zenoh's identifier.
    """
    identity = f"@ros2_lv/{domain}/{session}/0"
    kind = "SS" if serves else "SC"
    service = f"%{name.replace('/', '%')}/{_dds_type()}/{messages.type_hash()}"
    return (
        f"{identity}/0/NN/%/%/{node}",
        f"{identity}/1/{kind}/%/%/{node}/{service}/{_QUALITY_OF_SERVICE}",
    )
