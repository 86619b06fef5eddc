"""A ROS 1 master that journals every change before it confirms it.

A stock master keeps publishers, subscribers, services and parameters in memory, and loses them when
it is killed. This one is the stock master (``rosmaster``, same code, same answers) with a journal:
every change is in the file before the node gets its answer. So a master started from the journal
knows all that the last one confirmed, even the subscribers of parameters, which no call returns.

The file reaches the page cache only. It survives the process but not the machine, like the nodes.
A journal that other programs removed or changed is written anew.

ROS's Python runs this file. It may be older than the guard's, so the file imports only the standard
library and, once it runs, ``rosmaster``. The guard imports :class:`MasterState` and the journal
from here.

Started as ``process.py SOCKET CONTROL STATE JOURNAL`` (three descriptors and a path) it loads all
that it needs, says ``warm`` on CONTROL, and waits. On ``go`` it reads what the guard has left in
STATE, takes the connections that come to SOCKET, and says ``serving``. If CONTROL ends before, it
ends; afterwards it needs nobody.
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
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, Dict, List, NoReturn, Tuple  # noqa: UP035 (older Python)
from zlib import crc32

__all__ = [
    "MasterJournal",
    "MasterState",
    "journal_of",
    "parameter_names",
    "read_journal",
    "touch",
    "write_journal",
]

Registrations = Dict[str, List[Tuple[str, str]]]  # noqa: UP006
"""Of each topic or parameter the nodes: name and URI of the node's XML-RPC server."""

_MAGIC = b"holdfast ROS 1 master 1\n"  # of the guard's first home: its files are still read
_HEAD = struct.Struct("<II")
_COMPACTED_AFTER_BYTES = 4 * 1024 * 1024
_LOOK_EVERY_S = 1.0
_TOUCHED_AFTER_S = 60.0
_WORKERS = 8
"""Threads that tell nodes of changes. One that a stopped node blocks is lost to the others; stock
masters have three."""


@dataclass
class MasterState:
    """A master's state.

    ``parameters`` is a tree, in which a namespace is a dict. Registrations are by topic, or by
    parameter. ``services`` has the node's name, the URI of its XML-RPC server, and the service's
    own URI; ``types`` has the type of each topic's messages.
    """

    parameters: dict[str, Any] = field(default_factory=dict)
    publishers: Registrations = field(default_factory=dict)
    subscribers: Registrations = field(default_factory=dict)
    services: dict[str, tuple[str, str, str]] = field(default_factory=dict)
    types: dict[str, str] = field(default_factory=dict)
    parameter_subscribers: Registrations = field(default_factory=dict)

    def apply(self, table: str, key: str | None, value: Any) -> None:
        """Set a key of a table, or with None all of it; the value None removes the key."""
        if table == "parameters":
            self._set_parameter(key or "/", value)
        elif key is None:
            setattr(self, table, value)
        elif value is None:
            getattr(self, table).pop(key, None)
        else:
            getattr(self, table)[key] = value

    def _set_parameter(self, key: str, value: Any) -> None:
        *spaces, last = [part for part in key.split("/") if part] or [""]
        if not last:
            self.parameters = value
            return
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


_TABLES = [table.name for table in fields(MasterState)]


def parameter_names(tree: dict[str, Any], space: str = "/") -> list[str]:
    """Return the names of all parameters in a tree."""
    names: list[str] = []
    for key, value in tree.items():
        if isinstance(value, dict):
            names += parameter_names(value, f"{space}{key}/")
        else:
            names.append(space + key)
    return names


# -- the journal -----------------------------------------------------------------------------------


class _PlainData(pickle.Unpickler):
    """Reads what parameters can be, and no code."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in {
            ("xmlrpc.client", "Binary"),
            ("xmlrpc.client", "DateTime"),
            ("datetime", "datetime"),
        }:
            return super().find_class(module, name)
        raise pickle.UnpicklingError(f"{module}.{name} is no parameter")


def _encoded(table: str, key: str | None, value: Any) -> bytes:
    data = pickle.dumps((table, key, value), protocol=4)
    return _HEAD.pack(len(data), crc32(data)) + data


def _decoded(data: bytes) -> tuple[str, str | None, Any]:
    table, key, value = _PlainData(io.BytesIO(data)).load()
    return table, key, value


def journal_of(state: MasterState) -> bytes:
    """Return the content of a journal that holds a state."""
    return _MAGIC + b"".join(_encoded(table, None, getattr(state, table)) for table in _TABLES)


def read_journal(journal: Path | int) -> MasterState | None:
    """Return what a journal holds; None if there is none.

    A last record that is not whole is left out: nobody was told that it is there.

    A descriptor stays open; while it is, the file is readable even if it is removed.

    Raises OSError if it cannot be read, and ValueError if what is there is no journal.
    """
    try:
        with open(journal, "rb", closefd=not isinstance(journal, int)) as file:
            file.seek(0)
            content = file.read()
    except FileNotFoundError:
        return None
    return _state_in(content)


def _state_in(content: bytes) -> MasterState:
    if not content.startswith(_MAGIC):
        raise ValueError("is no journal of a ROS 1 master")
    state = MasterState()
    place = len(_MAGIC)
    while place + _HEAD.size <= len(content):
        size, checksum = _HEAD.unpack_from(content, place)
        place += _HEAD.size
        data = content[place : place + size]
        place += size
        if len(data) < size or crc32(data) != checksum:
            break
        try:
            state.apply(*_decoded(data))
        except (pickle.UnpicklingError, EOFError, TypeError, AttributeError, ValueError):
            break
    return state


def write_journal(path: Path, state: MasterState) -> int:
    """Write a journal anew, in one piece, and return its size in bytes.

    Its directory is made if it is gone. If it cannot be written (OSError), the one before is still
    there.
    """
    content = journal_of(state)
    new = path.with_name(f"{path.name}.new")
    with contextlib.suppress(FileExistsError):
        path.parent.mkdir(mode=0o700)
    with contextlib.suppress(FileNotFoundError):
        new.unlink()
    # Never through a link that somebody else has put there.
    descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with open(descriptor, "wb") as file:  # noqa: PTH123 (a descriptor)
            file.write(content)
        new.replace(path)
    except OSError:
        with contextlib.suppress(OSError):
            new.unlink()
        raise
    return len(content)


def touch(path: Path, found: os.stat_result) -> None:
    """Keep a file young for cleaners that remove old files, as in ``/tmp``."""
    if time.time() - found.st_mtime > _TOUCHED_AFTER_S:
        with contextlib.suppress(OSError):
            os.utime(path)


class MasterJournal:
    """A running master's journal; any thread may write.

    It has its own copy of the state, so that it can write a shorter file at any time. If the disk
    is full, the master continues, and every change tries to write the journal anew. The same holds
    if the file is not the one that was written here.

    It keeps ``state``, the master's at its start.
    """

    def __init__(self, path: Path, state: MasterState) -> None:
        self._path = path
        self._state = state
        self._lock = threading.Lock()
        self._descriptor = -1
        self._size = self._limit = 0
        self._failed = False
        try:
            self._write_anew()
        except OSError as error:
            self._give_up(error)

    def look(self) -> None:
        """Write it anew if it is not there as it was left; never raises."""
        with self._lock:
            try:
                if self._is_there():
                    touch(self._path, os.fstat(self._descriptor))
                else:
                    self._write_anew()
            except OSError as error:
                self._give_up(error)

    def write(self, table: str, key: str | None, value: Any) -> None:
        """Write down one change; never raises."""
        try:
            record = _encoded(table, key, value)
            # A copy, since the master goes on changing what it has; and proof that it can be read.
            change = _decoded(record[_HEAD.size :])
        except Exception as error:  # noqa: BLE001 (whatever it is, the node gets its answer)
            sys.stderr.write(f"{table} {key}: cannot be written down: {error}\n")
            return
        with self._lock:
            self._state.apply(*change)
            try:
                if self._size > self._limit or not self._is_there():
                    self._write_anew()
                    return
                self._append(record)
            except OSError as error:
                self._give_up(error)

    def _is_there(self) -> bool:
        """Tell whether the file at the path is the one that is open, and as long as it was."""
        if self._descriptor < 0:
            return False
        try:
            found = self._path.lstat()
        except OSError:
            return False
        return os.path.samestat(found, os.fstat(self._descriptor)) and found.st_size == self._size

    def _give_up(self, error: OSError) -> None:
        if not self._failed:
            sys.stderr.write(f"{self._path}: changes are not written down: {error}\n")
        self._failed = True
        self.close()

    def _append(self, record: bytes) -> None:
        if os.write(self._descriptor, record) < len(record):
            raise OSError("there is no room for a whole record")
        self._size += len(record)

    def _write_anew(self) -> None:
        self.close()
        self._size = write_journal(self._path, self._state)
        self._limit = 2 * self._size + _COMPACTED_AFTER_BYTES
        self._descriptor = os.open(self._path, os.O_WRONLY | os.O_APPEND | os.O_CLOEXEC)
        if self._failed:
            sys.stderr.write(f"{self._path}: all is written down again\n")
        self._failed = False

    def close(self) -> None:
        """Give the file up; a change that is written down opens it anew."""
        if self._descriptor >= 0:
            os.close(self._descriptor)
            self._descriptor = -1


# -- the master ------------------------------------------------------------------------------------


def _load() -> Any:
    """Import the stock master, and return a function that makes one with a journal."""
    import rosmaster.master_api
    import rosmaster.paramserver
    import rosmaster.registrations

    class JournalledRegistrations(rosmaster.registrations.RegistrationManager):  # type: ignore[misc, name-defined, unused-ignore]
        """Writes down what a registration has changed; the master holds its lock meanwhile."""

        journal: MasterJournal

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

        def register_again(
            self, r: Any, key: str, node: str, uri: str, service_uri: Any = None
        ) -> None:
            """Register what is written down already."""
            super()._register(r, key, node, uri, service_uri)

        def _register(
            self, r: Any, key: str, caller_id: str, caller_api: str, service_api: Any = None
        ) -> None:
            before = self.nodes.get(caller_id)
            super()._register(r, key, caller_id, caller_api, service_api)
            if before is not None and before.api != caller_api:
                # It was started again, and all that it had registered before is gone.
                for table, registrations in self.tables().items():
                    everything = {key: self.value(registrations, key) for key in registrations.map}
                    self.journal.write(table, None, everything)
            else:
                self._write(r, key)

        def _unregister(
            self, r: Any, key: str, caller_id: str, caller_api: str, service_api: Any = None
        ) -> Any:
            answer = super()._unregister(r, key, caller_id, caller_api, service_api)
            self._write(r, key)
            return answer

        def _write(self, changed: Any, key: str) -> None:
            for table, registrations in self.tables().items():
                if registrations is changed:
                    self.journal.write(table, key, self.value(registrations, key))

    class JournalledParameters(rosmaster.paramserver.ParamDictionary):  # type: ignore[misc, name-defined, unused-ignore]
        """Writes down parameters in the order in which they are set."""

        journal: MasterJournal

        def set_param(
            self, key: str, value: Any, notify_task: Any = None, caller_id: Any = None
        ) -> None:
            with self.lock:
                super().set_param(key, value, notify_task, caller_id)
                self.journal.write("parameters", key, value)

        def delete_param(self, key: str, notify_task: Any = None) -> None:
            with self.lock:
                super().delete_param(key, notify_task)
                self.journal.write("parameters", key, None)

    class JournalledTypes(Dict[str, str]):  # noqa: UP006
        """Writes down a topic's type."""

        journal: MasterJournal

        def __setitem__(self, topic: str, kind: str) -> None:
            changed = self.get(topic) != kind
            super().__setitem__(topic, kind)
            if changed:
                self.journal.write("types", topic, kind)

    class JournalledMaster(rosmaster.master_api.ROSMasterHandler):  # type: ignore[misc, name-defined, unused-ignore]
        """The stock master's calls, and one more."""

        def __init__(self, path: Path, content: bytes) -> None:
            super().__init__(_WORKERS)
            # Twice, since what is written down shares nothing with what the master changes.
            state, written = _state_in(content), _state_in(content)
            manager = self.reg_manager = JournalledRegistrations(self.thread_pool)
            self.publishers = manager.publishers
            self.subscribers = manager.subscribers
            self.services = manager.services
            self.param_subscribers = manager.param_subscribers
            self.param_server = JournalledParameters(manager)
            self.topics_types = JournalledTypes(state.types)
            self.restore(manager, state)
            # A file of its own from here on.
            self.journal = MasterJournal(path, written)
            self.topics_types.journal = manager.journal = self.journal
            self.param_server.journal = self.journal
            self.path = str(path)

        def restore(self, manager: Any, state: MasterState) -> None:
            for table, registrations in manager.tables().items():
                for key, registered in getattr(state, table).items():
                    # Of a service there is one, with its own URI.
                    for each in [registered] if table == "services" else registered:
                        manager.register_again(registrations, key, *each)
            self.param_server.parameters = state.parameters

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

        def getJournal(self, caller_id: str) -> Tuple[int, str, str]:  # noqa: N802, UP006
            """Return where the journal is; a stock master has no such call."""
            del caller_id
            return 1, "journal", self.path

    return JournalledMaster


def _serve(listening: socket.socket, master: Any, serving: Any) -> None:
    """Answer calls until one asks for the end."""
    import socketserver
    from xmlrpc.server import SimpleXMLRPCServer

    from rosgraph.network import create_local_xmlrpc_uri
    from rosgraph.xmlrpc import SilenceableXMLRPCRequestHandler

    class Server(socketserver.ThreadingMixIn, SimpleXMLRPCServer):
        """Each connection has a thread, as in the stock master."""

        daemon_threads = True

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
    threading.Thread(target=server.serve_forever, daemon=True).start()
    serving()
    master.tell_subscribers()
    looked_at = time.monotonic()
    while master._ok():
        time.sleep(0.1)
        if time.monotonic() - looked_at > _LOOK_EVERY_S:
            master.journal.look()
            looked_at = time.monotonic()


def main() -> NoReturn:
    """Be a master; see the top of this file."""
    descriptor, control_descriptor, state_descriptor, journal = sys.argv[1:5]
    control = socket.socket(fileno=int(control_descriptor))
    # The guard binds it, which may be later.
    listening = socket.socket(fileno=int(descriptor))
    try:
        make = _load()
    except ImportError as error:
        with contextlib.suppress(OSError):
            control.sendall(f"missing {error}".encode())
        sys.exit(1)
    with contextlib.suppress(Exception):
        # Without a log, there is still a master.
        import logging

        from rosgraph.roslogging import configure_logging

        configure_logging("rosmaster", logging.INFO, filename="master.log")
    try:
        control.sendall(b"warm")
        told = control.recv(16)
    except OSError:
        # The guard is no more.
        told = b""
    if told != b"go":
        sys.exit(0)
    with open(int(state_descriptor), "rb") as file:  # noqa: PTH123 (a descriptor)
        file.seek(0)
        content = file.read()
    # What a stock master prints, it prints for nobody here.
    with open(os.devnull, "wb") as nowhere:  # noqa: PTH123
        os.dup2(nowhere.fileno(), 1)

    def serving() -> None:
        with contextlib.suppress(OSError):
            control.sendall(b"serving")
        control.close()

    _serve(listening, make(Path(journal), content), serving)
    # Threads of calls that hang must not keep it.
    os._exit(0)


if __name__ == "__main__":
    # What stands beside this file is not for ROS's Python.
    sys.path[:] = [place for place in sys.path if Path(place or ".") != Path(__file__).parent]
    main()
