"""What a node of ROS 1 is told by its surroundings: the master, its own address, names."""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Mapping
from typing import NamedTuple, Self

from holdfast.errors import TransportError
from holdfast.printable import brief
from ros1_master_guard.headers import host_and_port_of

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*)*")
_MAX_NAME = 200


class RosType(NamedTuple):
    """A type by its name, as in ``std_srvs/Trigger``, and MD5 digest; a topic's is defined, too."""

    name: str
    digest: str
    definition: str = ""


class RosEnvironment(NamedTuple):
    """The master's URI, this machine's name for other nodes, and the address at which to listen.

    ``namespace`` precedes names that do not begin with a slash, and ends with one.
    """

    master: str
    host: str
    bind: str
    namespace: str

    @classmethod
    def of(cls, environment: Mapping[str, str] = os.environ) -> Self:
        """Read ``ROS_MASTER_URI``, ``ROS_HOSTNAME``, ``ROS_IP`` and ``ROS_NAMESPACE``.

        Raises TransportError if the master's URI is malformed.
        """
        master = environment.get("ROS_MASTER_URI") or "http://localhost:11311"
        if host_and_port_of(master, "http") is None:
            raise TransportError(f"ROS_MASTER_URI is {brief(master)}; expected http://HOST:PORT")
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
                f"{brief(name)} is no name in ROS 1: words of letters, digits and '_', each "
                f"beginning with a letter, with '/' between them, {_MAX_NAME} characters at most"
            )
        return name if name.startswith("/") else self.namespace + name
