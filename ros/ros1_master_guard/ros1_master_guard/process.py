"""A ROS 1 master that tells its guard of every change before it confirms it.

It is the stock master (``rosmaster``, same code, same answers), but each change is in the socket of
its guard before the node gets its answer. So the guard knows all that a master had confirmed, even
the subscribers of parameters, which no call returns.

ROS's Python runs this file. It may be older than the guard's, so the file imports only the standard
library and, once it runs, ``rosmaster``. The guard imports :class:`MasterState` and the messages'
form from here.

Started as ``process.py SOCKET GUARD`` (two descriptors) it loads all that it needs, says ``warm``
to GUARD, and waits for its state. Then it takes the connections that come to SOCKET, and sends the
whole state, followed by each change as (table, key, value). If GUARD ends before there is a state,
it ends; afterwards it needs nobody, and a later guard asks it for a socket by ``getGuardSocket``.
"""

from __future__ import annotations

import contextlib
import io
import os
import pickle
import socket
import struct
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Dict, List, NoReturn, Tuple  # noqa: UP035 (older Python)

Registrations = Dict[str, List[Tuple[str, str]]]  # noqa: UP006
"""Nodes of each topic or parameter: name and URI of the node's XML-RPC server."""

HEAD = struct.Struct("<Q")  # the size in bytes that precedes each message
_SEND_S, _SEND_STATE_S = 1.0, 10.0
"""A guard that takes longer to read a change, or the state, is told no more; it asks again."""

_WORKERS = 8
"""Threads that tell nodes of changes. One that a stopped node blocks is lost to the others; stock
masters have three."""


@dataclass
class MasterState:
    """A master's state: registrations by topic or parameter, and a tree of parameters."""

    parameters: dict[str, Any] = field(default_factory=dict)
    publishers: Registrations = field(default_factory=dict)
    subscribers: Registrations = field(default_factory=dict)
    # Of each service the node's name, the URI of the node's XML-RPC server, and the service's own.
    services: dict[str, tuple[str, str, str]] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)  # of topics
    parameter_subscribers: Registrations = field(default_factory=dict)
    changes: int = field(default=0, compare=False)

    def apply(self, table: str, key: str | None, value: Any) -> None:
        """Set a key of a table, or with None all of it; the value None removes the key."""
        self.changes += 1
        if table == "parameters":
            self._set_parameter(key or "/", value)
        elif key is None:
            setattr(self, table, value)
        elif value is None:
            getattr(self, table).pop(key, None)
        else:
            getattr(self, table)[key] = value

    def _set_parameter(self, key: str, value: Any) -> None:
        if not (parts := [part for part in key.split("/") if part]):
            self.parameters = value
            return
        *spaces, last = parts
        tree = self.parameters
        for space in spaces:
            inner = tree.get(space)
            # As in the master: a value gives way to a namespace.
            if not isinstance(inner, dict):
                inner = tree[space] = {}
            tree = inner
        if value is None:
            tree.pop(last, None)
        else:
            tree[last] = value

    def nodes(self) -> dict[str, str]:
        """Return the URI of the XML-RPC server of every node that has registered something."""
        found: dict[str, str] = {}
        for table in (self.publishers, self.subscribers, self.parameter_subscribers):
            for registered in table.values():
                found.update(registered)
        found.update((node, uri) for node, uri, _ in self.services.values())
        return found


# -- messages --------------------------------------------------------------------------------------


_CLASSES = "xmlrpc.client.Binary", "xmlrpc.client.DateTime", "datetime.datetime"


class _PlainData(pickle.Unpickler):
    """Reads what parameters can be, and no code."""

    def find_class(self, module: str, name: str) -> Any:
        if f"{module}.{name}" in _CLASSES:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is no parameter")


def encoded(message: Any) -> bytes:
    """Return plain data as a message, after its size."""
    data = pickle.dumps(message, protocol=4)
    return HEAD.pack(len(data)) + data


def decoded(data: bytes) -> Any:
    """Return what a message holds, without its size."""
    return _PlainData(io.BytesIO(data)).load()


# -- the master ------------------------------------------------------------------------------------


class _Guards:
    """The guards that are told of changes, by any thread."""

    def __init__(self) -> None:
        self._sockets: list[socket.socket] = []
        self._lock = threading.Lock()

    def add(self, guard: socket.socket, state: dict[str, Any]) -> None:
        """Tell a guard the whole state, and from now on every change."""
        with self._lock:
            self._sockets.append(guard)
            guard.settimeout(_SEND_STATE_S)
            self._send(guard, encoded(state))

    def tell(self, *change: Any) -> None:
        """Tell of a change: table, key and value."""
        try:
            message = encoded(change)
        except Exception as error:  # noqa: BLE001 (whatever it is, the node gets its answer)
            sys.stderr.write(f"{change[0]} {change[1]}: the guard cannot be told: {error}\n")
            return
        with self._lock:
            for guard in list(self._sockets):
                self._send(guard, message)

    def _send(self, guard: socket.socket, message: bytes) -> None:
        try:
            guard.sendall(message)
            guard.settimeout(_SEND_S)
        except OSError:
            self._sockets.remove(guard)
            guard.close()


def _load() -> Any:
    """Import the stock master, and return the class of a guarded one."""
    import rosmaster.master_api
    import rosmaster.paramserver
    import rosmaster.registrations

    guards = _Guards()

    class GuardedRegistrations(rosmaster.registrations.RegistrationManager):  # type: ignore[misc, name-defined, unused-ignore]
        """Tells what a registration has changed; the master holds its lock meanwhile."""

        def tables(self) -> dict[str, Any]:
            return {
                "publishers": self.publishers,
                "subscribers": self.subscribers,
                "services": self.services,
                "parameter_subscribers": self.param_subscribers,
            }

        def value(self, registrations: Any, key: str) -> Any:
            registered = registrations.map.get(key)
            if not registered:
                return None
            if registrations is self.services:
                return (*registered[0], registrations.get_service_api(key))
            return list(registered)

        def values(self, registrations: Any) -> dict[str, Any]:
            return {key: self.value(registrations, key) for key in registrations.map}

        def _register(
            self, r: Any, key: str, caller_id: str, caller_api: str, service_api: Any = None
        ) -> None:
            before = self.nodes.get(caller_id)
            super()._register(r, key, caller_id, caller_api, service_api)
            if before is not None and before.api != caller_api:
                # It was started again, and all that it had registered before is gone.
                for table, registrations in self.tables().items():
                    guards.tell(table, None, self.values(registrations))
            else:
                self._tell(r, key)

        def _unregister(
            self, r: Any, key: str, caller_id: str, caller_api: str, service_api: Any = None
        ) -> Any:
            answer = super()._unregister(r, key, caller_id, caller_api, service_api)
            self._tell(r, key)
            return answer

        def _tell(self, changed: Any, key: str) -> None:
            for table, registrations in self.tables().items():
                if registrations is changed:
                    guards.tell(table, key, self.value(registrations, key))

    class GuardedParameters(rosmaster.paramserver.ParamDictionary):  # type: ignore[misc, name-defined, unused-ignore]
        """Tells of parameters in the order in which they are set."""

        def set_param(
            self, key: str, value: Any, notify_task: Any = None, caller_id: Any = None
        ) -> None:
            with self.lock:
                super().set_param(key, value, notify_task, caller_id)
                guards.tell("parameters", key, value)

        def delete_param(self, key: str, notify_task: Any = None) -> None:
            with self.lock:
                super().delete_param(key, notify_task)
                guards.tell("parameters", key, None)

    class GuardedTypes(Dict[str, str]):  # noqa: UP006
        """Tells of a topic's type."""

        def __setitem__(self, topic: str, kind: str) -> None:
            changed = self.get(topic) != kind
            super().__setitem__(topic, kind)
            if changed:
                guards.tell("types", topic, kind)

    class GuardedMaster(rosmaster.master_api.ROSMasterHandler):  # type: ignore[misc, name-defined, unused-ignore]
        """The stock master's calls, and one more."""

        def __init__(self, state: MasterState) -> None:
            super().__init__(_WORKERS)
            manager = self.reg_manager = GuardedRegistrations(self.thread_pool)
            self.publishers = manager.publishers
            self.subscribers = manager.subscribers
            self.services = manager.services
            self.param_subscribers = manager.param_subscribers
            self.param_server = GuardedParameters(manager)
            self.param_server.parameters = state.parameters
            self.topics_types = GuardedTypes(state.types)
            for table, registrations in manager.tables().items():
                for key, registered in getattr(state, table).items():
                    # Of a service there is one, with its own URI.
                    for each in [registered] if table == "services" else registered:
                        manager._register(registrations, key, *each)
            self.listening = socket.socket(socket.AF_UNIX)
            self.listening.bind("")  # the kernel finds a name, which is no file
            self.listening.listen()

        def add_guard(self, guard: socket.socket) -> None:
            """Tell a guard the state, and from now on every change."""
            with self.ps_lock, self.param_server.lock:
                manager = self.reg_manager
                state = {name: manager.values(table) for name, table in manager.tables().items()}
                state["parameters"] = self.param_server.parameters
                guards.add(guard, {**state, "types": dict(self.topics_types)})

        def take_guards(self) -> None:
            """Take later guards."""
            while True:
                self.add_guard(self.listening.accept()[0])

        def tell_subscribers(self) -> None:
            """Tell every subscriber of the publishers there are, all at once.

            A roscpp node gives up the publishers that it is not told of, so it must never be told
            of a part.
            """
            with self.ps_lock:
                for topic in list(self.subscribers.map):
                    publishers = self.publishers.get_apis(topic)
                    subscribers = self.subscribers.get_apis(topic)
                    self._notify_topic_subscribers(topic, publishers, subscribers)

        def getGuardSocket(self, caller_id: str) -> Tuple[int, str, str]:  # noqa: N802, UP006
            """Return where a guard is told of all; a stock master has no such call."""
            del caller_id
            return 1, "abstract socket", self.listening.getsockname()[1:].decode()

    return GuardedMaster


def _serve(listening: socket.socket, master: Any, guard: socket.socket) -> None:
    """Answer calls until one asks for the end."""
    import socketserver
    from xmlrpc.server import SimpleXMLRPCServer

    from rosgraph.network import create_local_xmlrpc_uri
    from rosgraph.xmlrpc import SilenceableXMLRPCRequestHandler

    class Server(socketserver.ThreadingMixIn, SimpleXMLRPCServer):
        """Each connection has a thread, as in the stock master."""

        daemon_threads = True

        def _marshaled_dispatch(self, data: Any, *more: Any) -> Any:
            # Nested entities make millions of elements of a few hundred bytes. ROS sends no
            # document type, and no other encoding than UTF-8, which could hide it.
            if b"<!DOCTYPE" in data or b"\0" in data:
                data = b""
            return super()._marshaled_dispatch(data, *more)

        def handle_error(self, request: Any, client_address: Any) -> None:
            """Forget connections that broke."""

    server = Server(
        listening.getsockname(),
        SilenceableXMLRPCRequestHandler,
        logRequests=False,
        bind_and_activate=False,
    )
    server.socket.close()
    server.socket = listening
    server.register_multicall_functions()
    server.register_instance(master)
    master._ready(create_local_xmlrpc_uri(listening.getsockname()[1]))
    for work in (server.serve_forever, master.take_guards):
        threading.Thread(target=work, daemon=True).start()
    master.add_guard(guard)
    master.tell_subscribers()
    while master._ok():
        time.sleep(0.1)


def main() -> NoReturn:
    """Be a master; see the top of this file."""
    # The guard binds it, which may be later.
    listening, guard = (socket.socket(fileno=int(each)) for each in sys.argv[1:3])
    try:
        make = _load()
    except ImportError as error:
        guard.sendall(encoded(f"missing {error}"))
        sys.exit(1)
    with contextlib.suppress(Exception):
        # Without a log, there is still a master.
        import logging

        from rosgraph.roslogging import configure_logging

        configure_logging("rosmaster", logging.INFO, filename="master.log")
    try:
        guard.sendall(encoded("warm"))
        with guard.makefile("rb") as told:
            (size,) = HEAD.unpack(told.read(HEAD.size))
            state = MasterState(**decoded(told.read(size)))
    except (OSError, EOFError, struct.error, pickle.UnpicklingError):
        sys.exit(0)  # the guard is no more
    _serve(listening, make(state), guard)
    # Threads of calls that hang must not keep it.
    os._exit(0)


if __name__ == "__main__":
    # What stands beside this file is not for ROS's Python.
    sys.path[:] = [place for place in sys.path if Path(place or ".") != Path(__file__).parent]
    main()
