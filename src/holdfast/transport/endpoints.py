"""Endpoints: where a service is.

An endpoint is a protocol and a place: ``tcp/127.0.0.1:7447``, ``tls/planner.example:7447``,
``udp/planner.example:7447``, ``unix//run/holdfast/robot.sock``.
Endpoints are checked here before anything is opened, and errors give the reason.
"""

from __future__ import annotations

import ipaddress
import re
import socket
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from holdfast.errors import TransportError
from holdfast.printable import did_you_mean
from holdfast.runtime.addresses import host_and_port

Role: TypeAlias = Literal["robot", "service"]
"""What an end of a link is."""

MAX_SOCKET_PATH_BYTES = 107
"""Bound on the path of a local socket, from the system's ``sockaddr_un``."""

AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE = "authority.pem", "certificate.pem", "key.pem"
REVOKED_FILE = "revoked.pem"
"""Names of the credentials' files, and of the list of revoked certificates beside them."""

NEXT_KEY_FILE = "key.next.pem"
"""The key of the next certificate, while ``holdfast keys --rotate`` replaces both."""

_HOST_NAME = re.compile(
    r"(?=.{1,253}\Z)[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?(\.[A-Za-z0-9_-]+)*"
)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_MAX_LABEL = 63
_INTERFACE = re.compile(r"[!-~]{1,15}")
_NUMBERS = re.compile(r"[0-9.]+")

PROTOCOLS = "tcp", "tls", "udp", "unix"

_ALLOWED = "tcp, tls, udp and unix"


class TlsFiles(msgspec.Struct, frozen=True):
    """The credentials of one end, as files in PEM: a certificate and its key.

    The other end must be certified by the authority.
    """

    authority: Path
    certificate: Path
    key: Path

    @classmethod
    def of(cls, directory: Path) -> TlsFiles:
        """Return the files of a robot's or a service's directory, which need not be there."""
        return cls(*(directory / name for name in (AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE)))

    def versions(self) -> list[tuple[int, int, int] | None]:
        """Return inode, change time and size of each file and of the revocation list.

        Not the modification time: a copied file may keep that of its original.
        """
        found: list[tuple[int, int, int] | None] = []
        revoked = self.authority.with_name(REVOKED_FILE)
        for path in (self.authority, self.certificate, self.key, revoked):
            try:
                status = path.stat()
            except OSError:
                found.append(None)
            else:
                found.append((status.st_ino, status.st_ctime_ns, status.st_size))
        return found


class Endpoint(NamedTuple):
    """A protocol and a place, checked. ``str`` gives the text back.

    The host is a name or address, an IPv6 address without its brackets; for ``unix`` the path.
    Port 0 means any free port, where something listens; for ``unix`` it is always 0.
    """

    protocol: str
    host: str
    port: int

    def __str__(self) -> str:
        if self.is_local_socket:
            return f"{self.protocol}/{self.host}"
        return f"{self.protocol}/{host_and_port(self.host, self.port)}"

    @property
    def is_encrypted(self) -> bool:
        """Whether both ends are authenticated and the link is encrypted."""
        return self.protocol in ("tls", "udp")

    @property
    def is_local_socket(self) -> bool:
        """Whether this is a local socket."""
        return self.protocol == "unix"

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it.

        A host name other than ``localhost`` counts as reachable from outside, because its address
        can change.
        """
        if self.is_local_socket:
            return True
        address = _address_of(self.host)
        if address is not None:
            return _is_loopback_address(address)
        if self.host.lower().rstrip(".") != "localhost":
            return False
        try:
            found = socket.getaddrinfo(self.host, None)
        except OSError:
            return False
        addresses = [_address_of(str(entry[4][0])) for entry in found]
        return all(each is not None and _is_loopback_address(each) for each in addresses)


def parse_endpoint(text: str) -> Endpoint:
    """Read ``PROTOCOL/HOST:PORT``, with an IPv6 address in brackets, or another endpoint.

    Raises TransportError if it is none, or its protocol is not in :data:`PROTOCOLS`.
    """
    protocol, slash, place = text.partition("/")
    if protocol[:-1] in PROTOCOLS and protocol.endswith(":") and place.startswith("/"):
        raise TransportError(
            f"endpoint {text!r} is a URL: write {protocol[:-1]}/{place.removeprefix('/')}"
        )
    if not slash or not re.fullmatch(r"[a-z][a-z0-9_-]*", protocol):
        raise TransportError(
            f"endpoint {text!r} does not begin with a protocol: allowed are {_ALLOWED}, "
            f"as in tcp/127.0.0.1:7447"
        )
    if protocol not in PROTOCOLS:
        instead = did_you_mean(protocol, PROTOCOLS).removeprefix("; ")
        raise TransportError(
            f"endpoint {text!r}: protocol {protocol} is not allowed"
            + (f" ({instead})" if instead else "")
            + f"; allowed are {_ALLOWED}, as in tcp/127.0.0.1:7447"
        )
    if protocol == "unix":
        return _local_socket(text, place)
    host, colon, port_text = place.rpartition(":")
    if not colon or place.endswith("]"):
        raise TransportError(
            f"endpoint {text!r} has no port: write {protocol}/HOST:PORT, "
            f"as in {protocol}/127.0.0.1:7447"
        )
    if not re.fullmatch(r"[0-9]{1,5}", port_text) or int(port_text) > 65535:
        raise TransportError(
            f"endpoint {text!r}: port {port_text!r} is not a number from 0 to 65535, "
            f"as in {protocol}/127.0.0.1:7447"
        )
    try:
        return Endpoint(protocol, parse_host(host, f"{protocol}/"), int(port_text))
    except TransportError as error:
        raise TransportError(f"endpoint {text!r}: {error}") from None


def parse_host(host: str, before: str = "") -> str:
    """Read a host: a name or an address, one of IPv6 in brackets; return it without them.

    ``before`` precedes the host in the examples of error messages.

    Raises TransportError if it is malformed.
    """
    if host.startswith("[") and host.endswith("]"):
        inner = host[1:-1]
        if not isinstance(_address_of(inner), ipaddress.IPv6Address):
            raise TransportError(f"{inner!r} is no IPv6 address, as in {before}[::1]:7447")
        _, percent, interface = inner.partition("%")
        if percent and not _INTERFACE.fullmatch(interface):
            raise TransportError(
                f"{interface!r} is no name of a network interface, which has at most 15 "
                f"characters of ASCII, as in {before}[fe80::1%eth0]:7447"
            )
        return inner
    if ":" in host:
        raise TransportError(
            f"{host!r}: an IPv6 address stands in brackets, as in {before}[::1]:7447"
        )
    long = max(host.split("."), key=len)
    if len(long) > _MAX_LABEL:
        raise TransportError(
            f"{long!r}: a host name has at most {_MAX_LABEL} characters between its dots"
        )
    numeric = _NUMBERS.fullmatch(host) is not None
    if (numeric and _address_of(host) is None) or not _HOST_NAME.fullmatch(host):
        raise TransportError(f"{host!r} is no host name or address, as in {before}127.0.0.1:7447")
    return host


def check_endpoint(text: str, role: Role) -> Endpoint:
    """Read the endpoint at which a service listens, or to which a robot connects.

    Raises TransportError if it is malformed, or has port 0 to connect to.
    """
    endpoint = parse_endpoint(text)
    if role == "robot" and endpoint.port == 0 and not endpoint.is_local_socket:
        raise TransportError(
            f"endpoint {endpoint}: port 0 is for listening; to connect, give the port, "
            f"as in {endpoint._replace(port=7447)}"
        )
    return endpoint


def check_name(what: str, name: str) -> None:
    """Raise TransportError, about ``what``, if a name cannot be sent to the peer."""
    if not _NAME.fullmatch(name):
        raise TransportError(
            f"{what} {name!r}: allowed are 1 to 100 letters, digits, '_', '-' and '.', "
            f"beginning with a letter or digit"
        )


def check_credentials(endpoint: Endpoint, tls: TlsFiles | None) -> None:
    """Check that there are credentials exactly where the protocol needs them.

    Raises TransportError if they are missing, or would not be used.
    """
    if endpoint.is_encrypted and tls is None:
        raise TransportError(
            f"endpoint {endpoint}: {endpoint.protocol} needs credentials (--tls KEYS/NAME; "
            f"'holdfast keys KEYS' makes them)"
        )
    if tls is not None and not endpoint.is_encrypted and not endpoint.is_local_socket:
        raise TransportError(
            f"endpoint {endpoint}: {endpoint.protocol} does not use the credentials that were "
            f"given (--tls); write tls/... or udp/..., or leave them out"
        )


def _local_socket(text: str, path: str) -> Endpoint:
    if not path.strip("/"):
        raise TransportError(
            f"endpoint {text!r} has no path: write unix/PATH, as in unix//run/holdfast/s"
        )
    size = len(path.encode("utf-8", "surrogateescape"))
    if size > MAX_SOCKET_PATH_BYTES:
        raise TransportError(
            f"endpoint {text!r}: a path of {size} bytes; a local socket's has at most "
            f"{MAX_SOCKET_PATH_BYTES}"
        )
    return Endpoint("unix", path, 0)


def _address_of(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _is_loopback_address(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback
