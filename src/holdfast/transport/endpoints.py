"""Where a service is: which endpoints there are, and which of them would be unsafe.

An endpoint is a protocol and a place: ``tcp/127.0.0.1:7447``, ``tls/planner.example:7447``,
``udp/planner.example:7447``, ``unix//run/holdfast/robot.sock``, ``ros1/cloud_active_sensing``.
Every endpoint is read here before anything is opened, and what cannot work is refused with the
reason.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import ipaddress
import os
import re
import socket
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, Self

import msgspec

from holdfast.errors import TransportError

__all__ = [
    "AUTHORITY_FILE",
    "CERTIFICATE_FILE",
    "ENCRYPTED_PROTOCOLS",
    "KEY_FILE",
    "MAX_SOCKET_PATH_BYTES",
    "PROTOCOLS",
    "Endpoint",
    "PrivateSocket",
    "ServiceAddress",
    "TlsFiles",
    "check_credentials",
    "check_direction",
    "check_endpoint",
    "check_name",
    "host_and_port",
    "parse_endpoint",
    "parse_host",
    "system_words",
    "why_not_bound",
]

PROTOCOLS = ("tcp", "tls", "udp", "unix", "ros1")
"""What an endpoint may begin with."""

ENCRYPTED_PROTOCOLS = frozenset({"tls", "udp"})
"""Those in which both ends prove by a certificate who they are."""

MAX_SOCKET_PATH_BYTES = 107
"""Bound on the path of a local socket: the system's ``sockaddr_un`` has room for no more."""

AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE = "authority.pem", "certificate.pem", "key.pem"
"""Names of the credentials' files."""

_UNIX = "unix"
_ROS1 = "ros1"

_RENAMED = {
    "quic": "over UDP, services are at udp/HOST:PORT",
    "unixsock-stream": "a local socket is written unix/PATH",
}
"""Protocols of earlier releases, and what to write instead."""

_SOCKET, _LOCK = "s", "lock"
"""What a local socket's directory contains."""

_HOST_NAME = re.compile(
    r"(?=.{1,253}\Z)[A-Za-z0-9_]([A-Za-z0-9_-]*[A-Za-z0-9_])?(\.[A-Za-z0-9_-]+)*"
)
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}")
_MAX_LABEL = 63
_INTERFACE = re.compile(r"[!-~]{1,15}")
_NUMBERS = re.compile(r"[0-9.]+")


class TlsFiles(msgspec.Struct, frozen=True):
    """The credentials of one end, as files in PEM.

    Attributes
    ----------
    authority : Path
        Certificate of the authority by which the other end must be certified.
    certificate : Path
        This end's own certificate.
    key : Path
        The private key of that certificate.
    """

    authority: Path
    certificate: Path
    key: Path

    @classmethod
    def of(cls, directory: Path) -> TlsFiles:
        """Return the files of a robot's or a service's directory, which need not be there."""
        return cls(*(directory / name for name in (AUTHORITY_FILE, CERTIFICATE_FILE, KEY_FILE)))


class Endpoint(NamedTuple):
    """A protocol and a place, checked. ``str`` gives the text back.

    Attributes
    ----------
    protocol : str
        One of :data:`PROTOCOLS`.
    host : str
        Name or address, an IPv6 address without its brackets; for ``unix`` the path, for ``ros1``
        the name in ROS 1.
    port : int
        0 means any free port, where something listens; for ``unix`` and ``ros1`` always 0.
    """

    protocol: str
    host: str
    port: int

    def __str__(self) -> str:
        if self.protocol in (_UNIX, _ROS1):
            return f"{self.protocol}/{self.host}"
        return f"{self.protocol}/{host_and_port(self.host, self.port)}"

    @property
    def is_encrypted(self) -> bool:
        """Whether both ends prove who they are, and nobody between them can read or write."""
        return self.protocol in ENCRYPTED_PROTOCOLS

    @property
    def is_local_socket(self) -> bool:
        """Whether this is a file of this machine, not an address."""
        return self.protocol == _UNIX

    @property
    def is_ros1(self) -> bool:
        """Whether a ROS 1 master knows where it is."""
        return self.protocol == _ROS1

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach it.

        A host name other than ``localhost`` counts as reachable from outside, whatever it stands
        for today: what a name stands for can change without anybody here noticing.
        """
        if self.is_local_socket:
            return True
        if self.is_ros1:
            from holdfast.transport.tcpros import Surroundings

            return _is_loopback_address(ipaddress.ip_address(Surroundings.of().bind))
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

    def with_port(self, port: int) -> Endpoint:
        """Return the same endpoint with another port."""
        return self._replace(port=port)


class ServiceAddress(NamedTuple):
    """Where a robot finds a service, or where it lets a service find it.

    Attributes
    ----------
    endpoint : str
        See :func:`parse_endpoint`.
    listens : bool
        False: the service listens there and the robot connects. True: the robot listens there and
        the service connects, which a service that the robot itself launches does; it is then seen
        as soon as it is there, without waiting for the robot's next attempt.
    name : str or None
        The name that the service must have; None takes whichever is there.
    """

    endpoint: str
    listens: bool = False
    name: str | None = None


class PrivateSocket:
    """A local socket in a directory that no other user can enter.

    The permissions of the directory, not those of the socket, keep others out: a socket's own are
    set only after it can be connected to. Use it as a context, or call :meth:`remove`. What a
    process leaves that is killed before it can do that, the next one removes.

    Attributes
    ----------
    endpoint : str
        ``unix/PATH``.

    Raises
    ------
    TransportError
        If the directory for temporary files has too long a path for a socket.
    """

    def __init__(self) -> None:
        import tempfile  # only robots that launch services need it

        prefix = f"holdfast-{os.getuid()}-"
        _remove_abandoned(Path(tempfile.gettempdir()), prefix)
        self._lock = -1
        while self._lock < 0:
            self._directory = Path(tempfile.mkdtemp(prefix=prefix))  # made with mode 0700
            self._lock = _locked(self._directory)
        self.endpoint = f"{_UNIX}/{self._directory / _SOCKET}"
        try:
            parse_endpoint(self.endpoint)
        except TransportError as error:
            self.remove()
            raise TransportError(
                f"{error}; set TMPDIR to a directory for temporary files with a shorter path"
            ) from None

    def remove(self) -> None:
        """Remove the socket and its directory. May be repeated."""
        if self._lock >= 0:
            with contextlib.suppress(OSError), _opened(self._directory) as opened:
                _remove_directory(self._directory, opened)
            os.close(self._lock)
            self._lock = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.remove()


def _locked(directory: Path) -> int:
    """Show that a directory is in use until this process ends, however it does.

    Returns -1 if it was taken for an abandoned one before it could be locked.
    """
    lock = os.open(directory / _LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    fcntl.flock(lock, fcntl.LOCK_EX)
    if (directory / _LOCK).exists():
        return lock
    os.close(lock)
    return -1


@contextlib.contextmanager
def _opened(directory: Path) -> Iterator[int]:
    """Open a directory of ours, never one that somebody else's link leads to.

    Raises
    ------
    OSError
        If it is none, or others can enter it.
    """
    opened = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        found = os.fstat(opened)
        if found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) != 0o700:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM), str(directory))
        yield opened
    finally:
        os.close(opened)


def _remove_abandoned(parent: Path, prefix: str) -> None:
    """Remove the directories of sockets whose processes are gone."""
    for directory in parent.glob(f"{prefix}*"):
        # Of somebody else, just being made, or gone meanwhile: then it is not ours to remove.
        with contextlib.suppress(OSError), _opened(directory) as opened:
            lock = os.open(_LOCK, os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW, dir_fd=opened)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _remove_directory(directory, opened)
            finally:
                os.close(lock)


def _remove_directory(directory: Path, opened: int) -> None:
    for name in (_SOCKET, _LOCK):
        with contextlib.suppress(FileNotFoundError):
            os.unlink(name, dir_fd=opened)
    directory.rmdir()


def parse_endpoint(text: str) -> Endpoint:
    """Read an endpoint.

    Parameters
    ----------
    text : str
        ``PROTOCOL/HOST:PORT``, with an IPv6 address in brackets, ``unix/PATH`` or ``ros1/NAME``.

    Raises
    ------
    TransportError
        If it is none, or its protocol is none of :data:`PROTOCOLS`.
    """
    protocol, slash, place = text.partition("/")
    if protocol[:-1] in PROTOCOLS and protocol.endswith(":") and place.startswith("/"):
        raise TransportError(
            f"endpoint {text!r} is a URL: write {protocol[:-1]}/{place.removeprefix('/')}"
        )
    if not slash or not re.fullmatch(r"[a-z][a-z0-9_-]*", protocol):
        raise TransportError(
            f"endpoint {text!r} does not begin with a protocol: allowed are {_listed(PROTOCOLS)}, "
            f"as in tcp/127.0.0.1:7447"
        )
    if protocol not in PROTOCOLS:
        instead = _RENAMED.get(protocol)
        if instead is None:
            import difflib  # for a mistake alone

            close = difflib.get_close_matches(protocol, PROTOCOLS, n=1)
            instead = f"did you mean {close[0]}?" if close else None
        raise TransportError(
            f"endpoint {text!r}: protocol {protocol} is not allowed"
            + (f" ({instead})" if instead else "")
            + f"; allowed are {_listed(PROTOCOLS)}, as in tcp/127.0.0.1:7447"
        )
    if "?" in place or "#" in place:
        raise TransportError(
            f"endpoint {text!r}: options after '?' or '#' are not allowed; "
            f"give the place alone, as in tcp/127.0.0.1:7447"
        )
    if protocol == _UNIX:
        return _local_socket(text, place)
    if protocol == _ROS1:
        return _name_in_ros1(text, place)
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

    Parameters
    ----------
    host : str
    before : str
        What precedes the host in the examples of messages.

    Raises
    ------
    TransportError
        If it is none. The message does not name what the host is a part of.
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


def host_and_port(host: str, port: int) -> str:
    """Write HOST:PORT, an address of IPv6 in brackets: what :func:`parse_host` reads."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def system_words(number: int | None) -> str:
    """Write the system's own words for an error's number as the rest of a sentence."""
    text = os.strerror(number or 0)
    return text[:1].lower() + text[1:]


def why_not_bound(error: OSError) -> str:
    """Write why the system does not let a socket be bound to an address, and what can be done."""
    number = error.errno or 0  # of a name that is not found it is below 0
    # asyncio's own text names the address again.
    reason = os.strerror(number) if number > 0 else error.strerror or str(error)
    if number == errno.EADDRNOTAVAIL:
        reason += ": this machine has no such address (0.0.0.0 is all that it has)"
    return reason


def check_endpoint(text: str, *, listens: bool) -> Endpoint:
    """Read the endpoint of one end of a link.

    Raises
    ------
    TransportError
        If it is none, or is to be connected to and has port 0.
    """
    endpoint = parse_endpoint(text)
    has_port = not (endpoint.is_local_socket or endpoint.is_ros1)
    if not listens and endpoint.port == 0 and has_port:
        raise TransportError(
            f"endpoint {endpoint}: port 0 is for listening; to connect, give the port, "
            f"as in {endpoint.with_port(7447)}"
        )
    return endpoint


def check_direction(endpoint: Endpoint, *, service_listens: bool) -> None:
    """Check that the end that listens is the one that can, with this protocol.

    Raises
    ------
    TransportError
        If robots are to be called over ``udp`` or ``ros1``.
    """
    if endpoint.is_ros1 and not service_listens:
        raise TransportError(
            f"endpoint {endpoint}: in ROS 1 it is the service that is offered and the robot that "
            f"calls it"
        )
    if endpoint.protocol == "udp" and not service_listens:
        raise TransportError(
            f"endpoint {endpoint}: over udp it is the service that listens and the robot that "
            f"connects; write tls/... where a robot listens"
        )


def check_name(what: str, name: str) -> None:
    """Check that a name can be told to the other end.

    Raises
    ------
    TransportError
        If it cannot; the message says what it is the name of.
    """
    if not _NAME.fullmatch(name):
        raise TransportError(
            f"{what} {name!r}: allowed are 1 to 100 letters, digits, '_', '-' and '.', "
            f"beginning with a letter or digit"
        )


def check_credentials(endpoint: Endpoint, tls: TlsFiles | None) -> None:
    """Check that an endpoint has the credentials that its protocol needs, and no others.

    Raises
    ------
    TransportError
        If an encrypted endpoint has none, a plain one has some that would not be used, or one of
        the files cannot be read.
    """
    if endpoint.is_encrypted and tls is None:
        raise TransportError(
            f"endpoint {endpoint}: {endpoint.protocol} needs credentials (--tls DIR; "
            f"'holdfast keys DIR' makes them)"
        )
    if tls is None:
        return
    if not endpoint.is_encrypted and not endpoint.is_local_socket:
        raise TransportError(
            f"endpoint {endpoint}: {endpoint.protocol} does not use the credentials that were "
            f"given (--tls); write tls/... or udp/..., or leave them out"
        )
    if endpoint.is_encrypted:
        for file in (tls.authority, tls.certificate, tls.key):
            try:
                with file.open("rb") as opened:
                    opened.read(1)
            except OSError as error:
                raise TransportError(
                    f"endpoint {endpoint}: credentials {file} cannot be read: {error.strerror}"
                ) from error


def _local_socket(text: str, path: str) -> Endpoint:
    if not path.strip("/"):
        raise TransportError(
            f"endpoint {text!r} has no path: write {_UNIX}/PATH, as in {_UNIX}//run/holdfast/s"
        )
    size = len(path.encode("utf-8", "surrogateescape"))
    if size > MAX_SOCKET_PATH_BYTES:
        raise TransportError(
            f"endpoint {text!r}: a path of {size} bytes; a local socket's has at most "
            f"{MAX_SOCKET_PATH_BYTES}"
        )
    return Endpoint(_UNIX, path, 0)


def _name_in_ros1(text: str, name: str) -> Endpoint:
    from holdfast.transport.tcpros import Surroundings

    try:
        Surroundings.of().resolved(name)
    except TransportError as error:
        raise TransportError(f"endpoint {text!r}: {error}") from error
    return Endpoint(_ROS1, name, 0)


def _address_of(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host)
    except ValueError:
        return None


def _is_loopback_address(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback


def _listed(names: tuple[str, ...]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"
