"""A guard for the ROS 1 master: when the master dies, the next one is there before anybody asks.

ROS 1 has one process that knows where everything is. While it is away nobody finds a service or a
topic; what stands already, goes on: topics and persistent services are connections between nodes.
When it comes back as stock ROS has it, it knows nothing, and no node tells it again.

The guard holds the port. The socket at which nodes connect belongs to it, and each master inherits
it, so calls to a master that has just died are not refused: they wait, in the kernel, for the next
one. That one has been waiting, too: a process that has loaded all it needs. It reads what the last
one had confirmed (:mod:`holdfast.ros.master_process`), leaves out what has died meanwhile
(:mod:`holdfast.ros.master_plan`), and answers. To a node the master's death is a call that took a
little longer.

A master lives on when the guard is killed, and the next guard watches it. A master that somebody
else started, as ``roscore`` does, is watched as well; it keeps no journal, so the guard asks it a
few times a second what it knows.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import os
import shutil
import signal
import socket
import stat
import subprocess
import uuid
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from time import monotonic
from typing import NamedTuple, Self
from urllib.parse import urlsplit

from holdfast.errors import HoldfastError
from holdfast.ros import master_process
from holdfast.ros.master_calls import CallError, Connection, GoneError, call, offers_service
from holdfast.ros.master_plan import (
    NodeAnswer,
    NodeReport,
    Reconciled,
    lookups_of,
    reconcile,
    state_of_snapshot,
)
from holdfast.ros.master_process import MasterState, read_journal, write_journal
from holdfast.runtime.logs import EventSink

__all__ = ["DEFAULT_PORT", "GuardError", "GuardSettings", "MasterAddress", "MasterGuard"]

DEFAULT_PORT = 11311

_ANSWER_S = 0.3
"""How long nodes and services are waited for while there is no master."""

_ANSWERS_S = 1.0
"""And for all of them together."""

_ASKED_AT_ONCE = 64
_PROBE_EVERY_S = 0.5
_PROBE_S = 1.0
_POLL_EVERY_S = 0.25
_POLL_SHARE = 0.1
"""Of a stock master's time, at most so much is spent on the guard's questions."""

_POLL_S = 5.0
_START_S = 30.0
_SPARE_DELAY_S = 0.5
"""The next master is loaded a little after this one began, when the nodes have what they need."""

_STEADY_S = 1.0
"""A master that ends earlier than this may have failed at its start."""

_FIRST_DELAY_S, _LAST_DELAY_S = 0.1, 1.0
_KEPT_S = 5.0
"""Calls are not kept waiting for a master longer than this; then they are refused."""

_BACKLOG = 1024
_END_S = 2.0
_ROSOUT = "/rosout"
_ROSOUT_EVERY_S = 1.0


class GuardError(HoldfastError):
    """The master cannot be guarded; the message says why."""


class MasterAddress(NamedTuple):
    """Where a master is.

    Attributes
    ----------
    host : str
        As nodes name it.
    port : int
    bind : str
        The address of this machine at which it listens.
    """

    host: str
    port: int
    bind: str

    @property
    def uri(self) -> str:
        """Return what nodes have in ``ROS_MASTER_URI``."""
        return f"http://{self.host}:{self.port}/"

    @property
    def own_uri(self) -> str:
        """Return how this machine reaches it."""
        near = {"0.0.0.0": "127.0.0.1", "::": "[::1]", "::1": "[::1]"}.get(self.bind, self.bind)
        return f"http://{near}:{self.port}/"

    @classmethod
    def of(cls, environment: Mapping[str, str], port: int | None = None) -> Self:
        """Return what ROS's variables say.

        Parameters
        ----------
        environment : mapping
            ``ROS_MASTER_URI``, ``ROS_HOSTNAME``, ``ROS_IP`` and ``ROS_IPV6`` count.
        port : int, optional
            Instead of that of the URI.

        Raises
        ------
        GuardError
            If the URI is none, or names another machine.
        """
        text = environment.get("ROS_MASTER_URI") or f"http://localhost:{DEFAULT_PORT}"
        try:
            parts = urlsplit(text)
            host, named = parts.hostname, parts.port
        except ValueError:
            host = named = None
        if parts.scheme != "http" or not host:
            raise GuardError(f"ROS_MASTER_URI is {text!r:.200}; expected http://HOST:PORT")
        # As rosgraph.network has it.
        own = environment.get("ROS_HOSTNAME") or environment.get("ROS_IP") or ""
        version_6 = environment.get("ROS_IPV6") == "on"
        if own == "localhost" or own.startswith("127.") or own == "::1":
            loopback = own if own.startswith("127.") else "127.0.0.1"
            bind = "::1" if version_6 else loopback
        else:
            bind = "::" if version_6 else "0.0.0.0"
        address = cls(host, port or named or DEFAULT_PORT, bind)
        if not _is_here(host):
            raise GuardError(
                f"ROS_MASTER_URI is {text!r:.200}: {host} is no address of this machine; a guard "
                "runs where its master runs"
            )
        return address


def _is_here(host: str) -> bool:
    """Tell whether a name is this machine's."""
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
    """How to guard a master.

    Attributes
    ----------
    address : MasterAddress
    python : str
        ROS's Python.
    directory : Path or None
        Where the journal is; None for one of this user that goes when the machine is started anew.
    silent_s : float
        A master that has not answered for so long is replaced.
    rosout : bool
        Whether ``/rosout`` is to run, too, as with ``roscore``.
    """

    address: MasterAddress
    python: str = "/usr/bin/python3"
    directory: Path | None = None
    silent_s: float = 3.0
    rosout: bool = True


def _own_directory() -> Path:
    """Return a directory of this user alone, which does not outlive the machine's uptime."""
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    directory = Path(runtime) / "holdfast" if runtime else Path(f"/tmp/holdfast-{os.getuid()}")
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        found = directory.lstat()
    except OSError as error:
        raise GuardError(f"{directory}: cannot be made: {error.strerror}") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise GuardError(
            f"{directory}: is not a directory that you alone can write to; name another one: "
            "--directory"
        )
    return directory


class _Master:
    """A process that is a master, or waits to be one.

    Parameters
    ----------
    settings : GuardSettings
    listening : socket
        Which it inherits; need not be bound yet.
    journal : Path
    """

    def __init__(self, settings: GuardSettings, listening: socket.socket, journal: Path) -> None:
        self._settings = settings
        self._listening = listening
        self._journal = journal
        self._warm = False

    async def start(self) -> Self:
        """Start it, and return it."""
        own, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        own.setblocking(False)
        self._control = own
        script = str(Path(master_process.__file__).resolve())
        numbers = (str(self._listening.fileno()), str(its.fileno()))
        try:
            self.process = await asyncio.create_subprocess_exec(
                *(self._settings.python, script, *numbers, str(self._journal)),
                pass_fds=(self._listening.fileno(), its.fileno()),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # It outlives the guard, and Ctrl-C is for the guard alone.
                start_new_session=True,
                env={**os.environ, "ROS_MASTER_URI": self._settings.address.uri},
            )
        except OSError as error:
            own.close()
            raise GuardError(
                f"--python {self._settings.python}: cannot be run: {error.strerror}"
            ) from error
        finally:
            its.close()
        return self

    async def warm(self) -> None:
        """Wait until it has loaded what it needs.

        Raises
        ------
        GuardError
            If it cannot.
        """
        if self._warm:
            return
        said = await self._hear()
        if said != "warm":
            missing = said.removeprefix("missing ") or "it ended at once"
            raise GuardError(
                f"{self._settings.python} cannot run a ROS 1 master ({missing}); install ROS 1 "
                "(on Debian: apt-get install python3-rosmaster rosout), or name ROS's Python with "
                "--python"
            )
        self._warm = True

    async def serve(self) -> None:
        """Have it be the master from now on, with what the journal holds.

        Raises
        ------
        GuardError
            If it does not begin.
        """
        await self.warm()
        with contextlib.suppress(OSError):
            await asyncio.get_running_loop().sock_sendall(self._control, b"go")
        if (said := await self._hear()) != "serving":
            raise GuardError(f"the new master has not begun ({said or 'it ended'})")
        self._control.close()

    async def _hear(self) -> str:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(_START_S):
                return (await loop.sock_recv(self._control, 4096)).decode(errors="replace")
        except TimeoutError:
            return f"it said nothing for {_START_S:g} s"
        except OSError:
            return ""

    async def end(self, *, at_once: bool = False) -> None:
        """End it; may be repeated."""
        self._control.close()
        if at_once:
            _signal(self.process, signal.SIGKILL)
        await _ended(self.process, signal.SIGTERM)


def _signal(process: asyncio.subprocess.Process, number: int) -> None:
    with contextlib.suppress(ProcessLookupError):
        process.send_signal(number)


async def _ended(process: asyncio.subprocess.Process, number: int) -> None:
    """End a process, politely at first."""
    if process.returncode is None:
        _signal(process, number)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(process.wait(), _END_S)
            return
        _signal(process, signal.SIGKILL)
    await process.wait()


class MasterGuard:
    """Watches a master and replaces it when it dies.

    Parameters
    ----------
    settings : GuardSettings
    events : EventSink
    """

    def __init__(self, settings: GuardSettings, events: EventSink) -> None:
        self._settings = settings
        self._events = events
        self._uri = settings.address.own_uri
        self._listening: socket.socket | None = None
        self._is_bound = False
        self._spare: asyncio.Task[_Master] | None = None
        self._own: _Master | None = None
        self._other_pid: int | None = None
        self._is_inherited = False
        """Whether the other master is one that an earlier guard has started."""
        self._rosout: asyncio.subprocess.Process | None = None

    async def run(self, ready: Callable[[str], None]) -> None:
        """Guard until cancelled; a master that was started here is ended then, too.

        Parameters
        ----------
        ready : callable
            Is called once, when a master answers, with what was found or done: ``started``,
            ``resumed`` or ``found``.

        Raises
        ------
        GuardError
            If nothing can be guarded.
        """
        directory = self._settings.directory or _own_directory()
        port = self._settings.address.port
        self._journal = directory / f"master-{port}.journal"
        with _lock(directory / f"master-{port}.lock", port):
            helpers: list[asyncio.Task[None]] = []
            try:
                self._new_socket(0.0)
                # Whatever is missing is said now, not when the master dies.
                await (await self._next_master()).warm()
                how = await self._begin()
                ready(how)
                if self._settings.rosout:
                    helpers.append(asyncio.create_task(self._keep_rosout()))
                if how == "started":
                    helpers.append(asyncio.create_task(self._set_versions()))
                await self._watch()
            finally:
                for helper in helpers:
                    helper.cancel()
                await self._close()

    async def _begin(self) -> str:
        """Find a master, or start one."""
        try:
            await Connection(self._uri).call("getPid", within_s=self._settings.silent_s)
        except GoneError:
            pass
        except CallError as error:
            self._events.event("note", reason=f"what is at {self._uri} does not answer: {error}")
            return "found"
        else:
            return "found"
        known = read_journal(self._journal) or MasterState()
        nodes, services = await _ask(known)
        others = {uri for node, uri in known.nodes().items() if node != _ROSOUT}
        resumes = any(isinstance(nodes[uri], NodeReport) for uri in others)
        if not resumes:
            # Nobody is there to whom the parameters matter: they are of another day.
            known.parameters = {"run_id": str(uuid.uuid1())}
            nodes = {uri: answer or "gone" for uri, answer in nodes.items()}
            services = {service: bool(offered) for service, offered in services.items()}
        await self._start(reconcile(known, nodes, services))
        return "resumed" if resumes else "started"

    # -- watching ----------------------------------------------------------------------------------

    async def _watch(self) -> None:
        short_lives = 0
        while True:
            since = monotonic()
            if self._own is not None:
                reason = await self._watch_own(self._own)
            else:
                reason = await self._watch_other()
            noticed_at = monotonic()
            self._events.event("master_lost", reason=reason)
            short_lives = short_lives + 1 if noticed_at - since < _STEADY_S else 0
            if short_lives > 1:
                await asyncio.sleep(_delay(short_lives - 2))
            await self._replace(noticed_at)

    async def _watch_own(self, master: _Master) -> str:
        """Wait until the master that was started here is no more; say why."""
        loading = asyncio.create_task(self._load_spare_later())
        ended = asyncio.create_task(master.process.wait())
        silent = asyncio.create_task(self._silent())
        try:
            await asyncio.wait((ended, silent), return_when=asyncio.FIRST_COMPLETED)
            if ended.done():
                reason = _how_it_ended(ended.result())
            else:
                reason = silent.result()
                await master.end(at_once=True)
            self._own = None
            return reason
        finally:
            for task in (loading, ended, silent):
                task.cancel()

    async def _watch_other(self) -> str:
        """Wait until a master that somebody else started is no more; say why."""
        self._other_pid, self._is_inherited = None, False
        watching = [asyncio.create_task(self._closed()), asyncio.create_task(self._silent())]
        following = asyncio.create_task(self._follow())
        told = False
        try:
            while True:
                closed, silent = watching
                unfinished = {closed, silent, *(() if following.done() else (following,))}
                await asyncio.wait(unfinished, return_when=asyncio.FIRST_COMPLETED)
                if closed.done():
                    return closed.result()
                if following.done():
                    following.result()
                if not silent.done():
                    continue
                # Stopped, or so busy that it is of no use to anybody.
                if self._signal_other(signal.SIGKILL):
                    await closed
                    return silent.result()
                if not told:
                    self._events.event(
                        "master_hangs",
                        reason=f"{silent.result()}; it is none of this user's processes on this "
                        "machine, so it is left alone",
                    )
                    told = True
                watching[1] = asyncio.create_task(self._silent())
        finally:
            for task in (*watching, following):
                task.cancel()

    def _signal_other(self, number: signal.Signals) -> bool:
        """Signal the master that somebody else started, if it is this user's, and here."""
        pid = self._other_pid
        if pid is None or not _listens_at(pid, self._settings.address.port):
            return False
        try:
            os.kill(pid, number)
        except OSError:
            return False
        return True

    async def _closed(self) -> str:
        """Wait until nobody listens at the master's port any more.

        The system closes a killed process's connections, so the end of one tells at once.
        """
        place = urlsplit(self._uri)
        while True:
            try:
                reader, writer = await asyncio.open_connection(place.hostname, place.port)
            except OSError:
                return "nobody listens at its port"
            try:
                with contextlib.suppress(OSError):
                    await reader.read(1)
            finally:
                writer.close()
            # It may have closed this connection alone.
            try:
                await call(self._uri, "getPid", within_s=_PROBE_S)
            except GoneError:
                return "it ended"
            except CallError:
                await asyncio.sleep(_PROBE_EVERY_S)

    async def _silent(self) -> str:
        """Wait until the master has not answered for too long."""
        connection = Connection(self._uri)
        probe_s = min(_PROBE_S, self._settings.silent_s)
        failed = 0.0
        try:
            # What counts is what was waited, not the clock: the guard may have been stopped itself.
            while failed < self._settings.silent_s:
                asked_at = monotonic()
                try:
                    await connection.call("getPid", within_s=probe_s)
                except GoneError:
                    pass  # for others to find out
                except CallError:
                    failed += min(probe_s, monotonic() - asked_at)
                else:
                    failed = 0.0
                await asyncio.sleep(_PROBE_EVERY_S if not failed else 0.01)
            return f"it did not answer for {self._settings.silent_s:g} s"
        finally:
            connection.close()

    async def _follow(self) -> None:
        """Find out which master it is; if it keeps no journal, keep one of what it answers."""
        connection = Connection(self._uri)
        try:
            self._other_pid, journal = await self._identify(connection)
            self._is_inherited = journal == str(self._journal)
            self._events.event(
                "guarding",
                service=self._settings.address.uri,
                pid=self._other_pid,
                journal=self._is_inherited,
            )
            if not self._is_inherited:
                # That of another master is not its.
                self._journal.unlink(missing_ok=True)
                await self._poll(connection)
        finally:
            connection.close()

    async def _identify(self, connection: Connection) -> tuple[int, str | None]:
        """Return the master's process, and where its journal is."""
        while True:
            with contextlib.suppress(CallError):
                pid = await connection.call("getPid", within_s=_PROBE_S)
                # A stock master answers at once that it has no such call.
                (journal,) = await connection.calls([("getJournal", ())], within_s=_PROBE_S)
                return int(pid), journal
            await asyncio.sleep(_PROBE_EVERY_S)

    async def _poll(self, connection: Connection) -> None:
        """Ask a stock master again and again what it knows, and write that down."""
        last = None
        while True:
            asked_at = monotonic()
            with contextlib.suppress(CallError, OSError, ValueError, TypeError):
                state = await _snapshot(connection)
                if state != last:
                    write_journal(self._journal, state)
                    last = state
            took = monotonic() - asked_at
            await asyncio.sleep(max(_POLL_EVERY_S, took / _POLL_SHARE))

    # -- replacing ---------------------------------------------------------------------------------

    async def _replace(self, noticed_at: float) -> None:
        """Put a new master at the place of one that is no more."""
        failures = 0
        while True:
            try:
                known = read_journal(self._journal) or MasterState()
                reconciled = reconcile(known, *await _ask(known))
                await self._start(reconciled, noticed_at)
            except _TakenError as error:
                # Somebody was faster, as a unit that starts roscore again.
                self._events.event("note", reason=str(error))
                return
            except (GuardError, OSError) as error:
                self._events.event("master_failed", reason=str(error))
                await self._drop_spare()
                self._new_socket(_KEPT_S - (monotonic() - noticed_at))
                await asyncio.sleep(_delay(failures))
                failures += 1
            else:
                return

    async def _start(self, reconciled: Reconciled, noticed_at: float | None = None) -> None:
        begun_at = monotonic() if noticed_at is None else noticed_at
        self._bind()
        state = reconciled.state
        write_journal(self._journal, state)
        master = await self._next_master()
        self._spare = None
        try:
            await master.serve()
        except BaseException:
            await master.end(at_once=True)
            raise
        self._own, self._is_inherited = master, False
        self._events.event(
            "master_started",
            service=self._settings.address.uri,
            pid=master.process.pid,
            nodes=len(state.nodes()),
            services=len(state.services),
            topics=len(state.publishers.keys() | state.subscribers.keys()),
            parameters=len(master_process.parameter_names(state.parameters)),
            gone=list(reconciled.gone) or None,
            silent=list(reconciled.silent) or None,
            lost_services=list(reconciled.lost_services) or None,
            duration_ms=(monotonic() - begun_at) * 1e3,
        )

    async def _next_master(self) -> _Master:
        """Return the process that waits to be the master, or a new one."""
        if self._spare is None:
            self._load_spare()
        assert self._spare is not None
        spare = await asyncio.shield(self._spare)
        if spare.process.returncode is not None:
            self._load_spare()
            spare = await asyncio.shield(self._spare)
        return spare

    def _load_spare(self) -> None:
        assert self._listening is not None
        master = _Master(self._settings, self._listening, self._journal)
        self._spare = asyncio.create_task(master.start())

    async def _load_spare_later(self) -> None:
        await asyncio.sleep(_SPARE_DELAY_S)
        if self._spare is None:
            self._load_spare()

    async def _drop_spare(self) -> None:
        spare, self._spare = self._spare, None
        if spare is not None:
            with contextlib.suppress(GuardError):
                await (await spare).end(at_once=True)

    def _new_socket(self, keep_s: float) -> None:
        """Make the socket anew at which masters listen, unless calls may still wait at it."""
        if self._listening is not None:
            if keep_s > 0.0:
                return
            self._listening.close()
        family = socket.AF_INET6 if ":" in self._settings.address.bind else socket.AF_INET
        self._listening = socket.socket(family)
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._is_bound = False

    def _bind(self) -> None:
        """Take the master's port; what connects from now on waits for a master."""
        if self._is_bound:
            return
        assert self._listening is not None
        address = self._settings.address
        try:
            self._listening.bind((address.bind, address.port))
            self._listening.listen(_BACKLOG)
        except OSError as error:
            text = f"port {address.port} of {address.bind}: {error.strerror}"
            if error.errno == errno.EADDRINUSE:
                raise _TakenError(text) from error
            raise GuardError(text) from error
        self._is_bound = True

    # -- what belongs to a master ------------------------------------------------------------------

    async def _keep_rosout(self) -> None:
        """Have ``/rosout`` run, as ``roscore`` does."""
        failures = 0
        while True:
            if self._rosout is None and not await self._has_rosout():
                rosrun = shutil.which("rosrun")
                if rosrun is None:
                    self._events.event("note", reason="no rosrun here, so no /rosout")
                    return
                begun_at = monotonic()
                self._rosout = await asyncio.create_subprocess_exec(
                    *(rosrun, "rosout", "rosout", "__name:=rosout"),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                    start_new_session=True,
                    env={
                        **os.environ,
                        "ROS_MASTER_URI": self._settings.address.uri,
                        "ROS_NAMESPACE": "/",
                    },
                )
                code = await self._rosout.wait()
                self._rosout = None
                self._events.event("rosout_ended", reason=_how_it_ended(code))
                failures = failures + 1 if monotonic() - begun_at < _STEADY_S else 0
                await asyncio.sleep(_delay(failures))
            await asyncio.sleep(_ROSOUT_EVERY_S)

    async def _has_rosout(self) -> bool:
        """Tell whether there is one, if only one whose master is just away."""
        try:
            uri = await call(self._uri, "lookupNode", _ROSOUT, within_s=_PROBE_S)
            await call(uri, "getPid", within_s=_PROBE_S)
        except GoneError:
            return False
        except CallError as error:
            return "unknown node" not in str(error)
        return True

    async def _set_versions(self) -> None:
        """Set the parameters that ``roscore`` sets."""
        for name, words in (("rosversion", ("roslaunch",)), ("rosdistro", ("-d",))):
            with contextlib.suppress(OSError, CallError, TimeoutError):
                process = await asyncio.create_subprocess_exec(
                    *("rosversion", *words),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.DEVNULL,
                )
                try:
                    said, _ = await asyncio.wait_for(process.communicate(), _START_S)
                finally:
                    if process.returncode is None:
                        _signal(process, signal.SIGKILL)
                if said and process.returncode == 0:
                    value = said.decode(errors="replace")
                    await call(self._uri, "setParam", f"/{name}", value, within_s=_PROBE_S)

    async def _close(self) -> None:
        if self._rosout is not None:
            await _ended(self._rosout, signal.SIGINT)
        if self._is_inherited:
            # As the guard that started both would have done.
            with contextlib.suppress(CallError):
                uri = await call(self._uri, "lookupNode", _ROSOUT, within_s=_PROBE_S)
                await call(uri, "shutdown", "the guard ends", within_s=_PROBE_S)
            self._signal_other(signal.SIGTERM)
        if self._own is not None:
            await self._own.end()
        await self._drop_spare()
        if self._listening is not None:
            self._listening.close()


class _TakenError(GuardError):
    """Somebody else listens at the port."""


def _delay(failures: int) -> float:
    return float(min(_LAST_DELAY_S, _FIRST_DELAY_S * 2 ** min(failures, 16)))


def _how_it_ended(code: int) -> str:
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"it was ended by {signal.Signals(-code).name}"
    return f"it ended with exit code {code}"


class _lock:  # noqa: N801 (used as a function)
    """Keeps a second guard of the same master away.

    Parameters
    ----------
    path : Path
    port : int

    Raises
    ------
    GuardError
        If there is one already.
    """

    def __init__(self, path: Path, port: int) -> None:
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise GuardError(f"{path}: cannot be written: {error.strerror}") from error
        try:
            fcntl.flock(self._descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            who = os.pread(self._descriptor, 20, 0).decode(errors="replace").strip()
            os.close(self._descriptor)
            raise GuardError(
                f"the master at port {port} has a guard already: process {who or 'unknown'}"
            ) from error
        os.ftruncate(self._descriptor, 0)
        os.pwrite(self._descriptor, f"{os.getpid()}\n".encode(), 0)

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)


# -- questions -------------------------------------------------------------------------------------


async def _ask(
    known: MasterState,
) -> tuple[dict[str, NodeAnswer], dict[str, bool | None]]:
    """Ask all nodes and services of a master that is no more whether they are there, at once."""
    nodes: dict[str, NodeAnswer] = dict.fromkeys(known.nodes().values())
    services: dict[str, bool | None] = dict.fromkeys(known.services)
    few = asyncio.Semaphore(_ASKED_AT_ONCE)

    async def ask_node(uri: str) -> None:
        async with few:
            nodes[uri] = await _report_of(uri)

    async def ask_services(uri: str, names: list[str]) -> None:
        # One after another: a rospy node lets five wait, and the sixth connects a second later.
        async with few:
            for name in names:
                services[name] = await offers_service(uri, name, within_s=_ANSWER_S)
                if services[name] is None:
                    return

    by_address: dict[str, list[str]] = {}
    for service, (_, _, uri) in known.services.items():
        by_address.setdefault(uri, []).append(service)
    questions: list[Awaitable[None]] = [ask_node(uri) for uri in nodes]
    questions += [ask_services(uri, names) for uri, names in by_address.items()]
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(_ANSWERS_S):
            await asyncio.gather(*questions)
    return nodes, services


async def _report_of(uri: str) -> NodeAnswer:
    try:
        publications, subscriptions = await asyncio.gather(
            call(uri, "getPublications", within_s=_ANSWER_S),
            call(uri, "getSubscriptions", within_s=_ANSWER_S),
        )
        return NodeReport(
            {str(topic): str(kind) for topic, kind in publications},
            {str(topic): str(kind) for topic, kind in subscriptions},
        )
    except GoneError:
        return "gone"
    except (CallError, TypeError, ValueError):
        return None


async def _snapshot(connection: Connection) -> MasterState:
    """Return what a stock master knows."""
    system_state, types, parameters = await connection.calls(
        [("getSystemState", ()), ("getTopicTypes", ()), ("getParam", ("/",))], within_s=_POLL_S
    )
    names, services = lookups_of(system_state)
    uris = await connection.calls(
        [
            *(("lookupNode", (name,)) for name in names),
            *(("lookupService", (service,)) for service in services),
        ],
        within_s=_POLL_S,
    )
    return state_of_snapshot(
        system_state,
        types,
        parameters,
        dict(zip(names, uris, strict=False)),
        dict(zip(services, uris[len(names) :], strict=True)),
    )


def _listens_at(pid: int, port: int) -> bool:
    """Tell whether a process, which this user may look into, listens at a port of this machine.

    A master names its process, but a container has numbers of its own.
    """
    sockets = set()
    for table in ("tcp", "tcp6"):
        with contextlib.suppress(OSError):
            for line in Path(f"/proc/self/net/{table}").read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == "0A" and int(fields[1].rpartition(":")[2], 16) == port:
                    sockets.add(f"socket:[{fields[9]}]")
    try:
        descriptors = list(Path(f"/proc/{pid}/fd").iterdir())
    except OSError:
        return False
    for descriptor in descriptors:
        with contextlib.suppress(OSError):
            if str(descriptor.readlink()) in sockets:
                return True
    return False
