"""A master's address, and its guard's settings, directory and lock."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple, Self
from urllib.parse import urlsplit

from ros1_master_guard.errors import GuardError

DEFAULT_PORT = 11311


class MasterAddress(NamedTuple):
    """A master's address: ``host`` is what ``ROS_MASTER_URI`` names, ``bind`` where it listens."""

    host: str
    port: int
    bind: str

    @property
    def uri(self) -> str:
        """The nodes' ``ROS_MASTER_URI``."""
        return f"http://{self.host}:{self.port}/"

    @property
    def own_uri(self) -> str:
        """The URI for this machine."""
        near = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "::1": "[::1]"}.get(self.bind, self.bind)
        return f"http://{near}:{self.port}/"

    @classmethod
    def of(cls, environment: Mapping[str, str], port: int | None = None) -> Self:
        """Read ROS's variables; ``port`` replaces the URI's.

        Raises GuardError if the URI is none, or names another machine.
        """
        text = environment.get("ROS_MASTER_URI") or f"http://localhost:{DEFAULT_PORT}"
        try:
            parts = urlsplit(text)
            scheme, host, named = parts.scheme, parts.hostname, parts.port
        except ValueError:
            scheme, host, named = "", None, None
        if scheme != "http" or not host:
            raise GuardError(f"ROS_MASTER_URI is {text!r:.200}; expected http://HOST:PORT")
        if not _is_here(host):
            raise GuardError(
                f"ROS_MASTER_URI is {text!r:.200}: {host} is no address of this machine; a guard "
                "runs where its master runs"
            )
        # As rosgraph.network has it.
        own = environment.get("ROS_HOSTNAME") or environment.get("ROS_IP") or ""
        bind = "::" if (version_6 := environment.get("ROS_IPV6") == "on") else "0.0.0.0"
        if own in ("localhost", "::1") or own.startswith("127."):
            loopback = own if own.startswith("127.") else "127.0.0.1"
            bind = "::1" if version_6 else loopback
        return cls(host, port or named or DEFAULT_PORT, bind)


def _is_here(host: str) -> bool:
    """Return whether a name is this machine's."""
    try:
        found = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)
    except OSError:
        return False
    for family, kind, number, _, address in found:
        with contextlib.suppress(OSError), socket.socket(family, kind, number) as probe:
            probe.bind(address)
            return True
    return False


class GuardSettings(NamedTuple):
    """How to guard a master; the command's options say what each means."""

    address: MasterAddress
    python: str = "/usr/bin/python3"
    directory: Path | None = None
    silent_s: float = 3.0
    rosout: bool = True


def directory_for(named: Path | None) -> Path:
    """Return a directory that can be written to: the named one, or one of this user alone."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    name = "ros1_master_guard"
    own = Path(runtime) / name if runtime else Path(f"/tmp/{name}-{os.getuid()}")
    directory = own if named is None else named
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        found = directory.lstat()
    except OSError as error:
        raise GuardError(f"{directory}: cannot be made: {error.strerror}") from error
    is_own = found.st_uid == os.getuid() and not found.st_mode & 0o022
    if named is None and not (stat.S_ISDIR(found.st_mode) and is_own):
        problem = "is not a directory that you alone can write to"
    elif not os.access(directory, os.W_OK):
        problem = "cannot be written to"
    else:
        return directory
    raise GuardError(f"{directory}: {problem}; name another one: --directory")


@contextlib.contextmanager
def guard_lock(port: int) -> Iterator[None]:
    """Keep other guards of a master away, by a name in the kernel that ends with the process."""
    name = f"\0ros1_master_guard/{port}"
    with socket.socket(socket.AF_UNIX) as lock:
        try:
            lock.bind(name)
            lock.listen()
        except OSError:
            pid = "unknown"
            with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX) as asking:
                asking.connect(name)
                who = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 4)
                pid = str(int.from_bytes(who, sys.byteorder))
            reason = f"the master at port {port} has a guard already: process {pid}"
            raise GuardError(reason) from None
        yield


def listens_at(pid: int, port: int) -> bool:
    """Return whether a process of this user listens at a port of this machine.

    A master reports its process, but in a container process numbers differ.
    """
    sockets = set()
    for table in ("tcp", "tcp6"):
        with contextlib.suppress(OSError):
            for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == "0A" and int(fields[1].rpartition(":")[2], 16) == port:
                    sockets.add(f"socket:[{fields[9]}]")
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):  # it was just closed
                if str(descriptor.readlink()) in sockets:
                    return True
    return False
