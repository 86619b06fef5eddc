"""A guard for the ROS 1 master: when the master dies, a prepared one takes its place at once.

The ROS 1 master is one process that knows where everything is. Without it no service or topic is
found; existing connections between nodes continue. A restarted stock master knows nothing, and
nodes do not register again.

The guard owns the listening socket, and each master inherits it. So calls to a master that has just
died are not refused: they wait in the kernel for the next one, which is already running and has
loaded all code. It reads what its predecessor had confirmed (:mod:`ros1_master_guard.process`),
drops what has died meanwhile (:mod:`ros1_master_guard.plan`), and answers. For a node this is one
slow call.

A master survives its guard, and the next guard watches it. The guard also watches a foreign master,
such as ``roscore``'s. That one keeps no journal, so the guard polls it a few times a second.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import signal
import socket
import uuid
from collections.abc import Callable, Coroutine, Iterator
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from ros1_master_guard.errors import CallError, GoneError, GuardError, SilentError
from ros1_master_guard.events import EventSink
from ros1_master_guard.plan import (
    NodeReport,
    Reconciled,
    ask_everyone,
    process_of,
    reconcile,
    snapshot,
    unregistrations,
)
from ros1_master_guard.process import (
    MasterState,
    parameter_names,
    read_journal,
    touch,
    write_journal,
)
from ros1_master_guard.ros1_calls import CALLER, Connection, call
from ros1_master_guard.roscore import (
    ROSOUT,
    STEADY_S,
    Rosout,
    how_it_ended,
    restart_delay_s,
    set_versions,
)
from ros1_master_guard.settings import GuardLock, GuardSettings, listens_at, own_directory
from ros1_master_guard.standby import MasterProcess

__all__ = ["MasterGuard"]

_PROBE_EVERY_S = 0.5
_PROBE_S = 1.0
_POLL_EVERY_S = 0.25
_POLL_SHARE = 0.1
"""Largest share of a stock master's time spent on the guard's polling."""

_SPARE_DELAY_S = 0.5
"""The next master is loaded this long after a start, when the nodes have been served."""

_SECOND_LOOK_S = 1.0
_KEPT_S = 5.0
"""Longest time that calls wait for a master; after it they are refused."""

_LOCKED_EVERY_S = 1.0
_BACKLOG = 1024


class MasterGuard:
    """Watches a master and replaces it when it dies."""

    def __init__(self, settings: GuardSettings, events: EventSink) -> None:
        self._settings = settings
        self._events = events
        self._uri = settings.address.own_uri
        self._listening: socket.socket | None = None
        self._is_bound = False
        self._spare: MasterProcess | None = None
        self._own: MasterProcess | None = None
        self._other_pid: int | None = None
        self._is_inherited = False
        """Whether an earlier guard started the other master."""
        self._followed: MasterState | None = None
        """The last known state of a master without a journal."""
        self._unwritten: str | None = None
        """Why that state is not in the journal."""
        self._held = -1
        """An open descriptor of a master's journal; readable even if the file is removed."""
        self._doubtful = MasterState()
        """Registrations of nodes that did not answer at the master's start."""
        self._rosout = Rosout(settings.address.uri, self._uri, events)

    async def run(self, ready: Callable[[str], None]) -> None:
        """Guard until cancelled, then end a master that was started here.

        ``ready`` is called once when a master answers, with ``started``, ``resumed`` or ``found``.

        Raises
        ------
        GuardError
            If nothing can be guarded.
        """
        directory = self._settings.directory or own_directory()
        port = self._settings.address.port
        self._journal = directory / f"master-{port}.journal"
        with (
            GuardLock(directory / f"master-{port}.lock", port) as lock,
            _running(_keep_lock(lock)),
        ):
            try:
                self._new_socket(0.0)
                # Missing software is reported now, not when the master dies.
                await self._next_master().warm()
                how = await self._begin()
                ready(how)
                helpers = [self._rosout.keep()] if self._settings.rosout else []
                if how == "started":
                    helpers.append(set_versions(self._uri))
                with _running(*map(self._help, helpers)):
                    await self._watch()
            except Exception:
                # They continue without a guard, and the next one finds them.
                self._own = None
                self._rosout.release()
                raise
            finally:
                await self._close()

    async def _help(self, work: Coroutine[None, None, None]) -> None:
        """Do optional work: its failure is logged and changes nothing else."""
        try:
            await work
        except Exception as error:  # noqa: BLE001 (whatever it is, the master comes first)
            self._events.event("note", reason=error)

    async def _begin(self) -> str:
        """Find a master, or start one."""
        try:
            with contextlib.closing(Connection(self._uri)) as connection:
                await connection.call("getPid", within_s=self._settings.silent_s)
                await self._recognise(connection)
        except GoneError:
            pass
        except SilentError as error:
            self._events.event("note", reason=str(error))
            return "found"
        except CallError as error:
            raise GuardError(f"what is there is no ROS 1 master: {error}") from error
        else:
            if self._unwritten is not None:
                raise GuardError(f"{self._unwritten}; name another --directory")
            return "found"
        known = self._known()
        nodes, services = await ask_everyone(known)
        others = {uri for node, uri in known.nodes().items() if node != ROSOUT}
        resumes = any(isinstance(nodes[uri], NodeReport) for uri in others)
        if not resumes:
            # No node of the old graph is left, so its parameters are obsolete.
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
            short_lives = short_lives + 1 if noticed_at - since < STEADY_S else 0
            if short_lives > 1:
                await asyncio.sleep(restart_delay_s(short_lives - 2))
            await self._replace(noticed_at)

    async def _watch_own(self, master: MasterProcess) -> str:
        """Wait for the end of the master that was started here, and return the reason."""
        looking = self._help(self._look_again())
        watching = (master.process.wait(), self._silent())
        with _running(self._load_spare_later(), looking), _running(*watching) as (ended, silent):
            await asyncio.wait((ended, silent), return_when=asyncio.FIRST_COMPLETED)
            if ended.done():
                reason = how_it_ended(ended.result())
            else:
                reason = silent.result()
                await master.end(at_once=True)
            self._own = None
            return reason

    async def _watch_other(self) -> str:
        """Wait for the end of a foreign master, and return the reason."""
        with _running(self._closed(), self._kill_silent(), self._follow()) as tasks:
            closed, killed, following = tasks
            while not closed.done():
                await asyncio.wait(
                    [task for task in tasks if not task.done()],
                    return_when=asyncio.FIRST_COMPLETED,
                )
                if following.done():
                    following.result()
            self._other_pid, self._is_inherited = None, False
            reason: str = (killed if killed.done() else closed).result()
            return reason

    async def _kill_silent(self) -> str:
        """Kill a foreign master that is silent for too long, and return the reason."""
        told = False
        while True:
            # Stopped, or too busy to be of use.
            reason = await self._silent()
            if self._signal_other(signal.SIGKILL):
                return reason
            if not told:
                self._events.event(
                    "master_hangs",
                    reason=f"{reason}; it is none of this user's processes on this machine, so it "
                    "is left alone",
                )
                told = True

    def _signal_other(self, number: signal.Signals) -> bool:
        """Signal a foreign master, if it is a process of this user on this machine."""
        pid = self._other_pid
        if pid is None or not listens_at(pid, self._settings.address.port):
            return False
        try:
            os.kill(pid, number)
        except OSError:
            return False
        return True

    async def _closed(self) -> str:
        """Wait until the master's port is closed.

        The system closes a killed process's connections, so one of them ends at once.
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
        """Wait until the master has been silent for too long."""
        probe_s = min(_PROBE_S, self._settings.silent_s)
        failed = 0.0
        with contextlib.closing(Connection(self._uri)) as connection:
            # Time actually waited counts, not the clock: the guard itself may have been stopped.
            while failed < self._settings.silent_s:
                self._hold_journal()
                asked_at = monotonic()
                try:
                    await connection.call("getPid", within_s=probe_s)
                except GoneError:
                    pass  # _closed() reports it
                except CallError:
                    failed += min(probe_s, monotonic() - asked_at)
                else:
                    failed = 0.0
                await asyncio.sleep(_PROBE_EVERY_S if not failed else 0.01)
        return f"it did not answer for {self._settings.silent_s:g} s"

    async def _follow(self) -> None:
        """Journal the state of a master that keeps no journal itself."""
        with contextlib.closing(Connection(self._uri)) as connection:
            while self._other_pid is None:
                with contextlib.suppress(CallError):
                    await self._recognise(connection)
                await asyncio.sleep(_PROBE_EVERY_S)
            while not self._is_inherited:
                asked_at = monotonic()
                with contextlib.suppress(CallError):
                    await self._write_down(connection)
                took = monotonic() - asked_at
                await asyncio.sleep(max(_POLL_EVERY_S, took / _POLL_SHARE))

    async def _recognise(self, connection: Connection) -> None:
        """Identify a foreign master."""
        pid = await process_of(connection, within_s=_PROBE_S)
        # A stock master has no such call and answers so at once.
        (journal,) = await connection.calls([("getJournal", (CALLER,))], within_s=_PROBE_S)
        inherited = journal == str(self._journal)
        self._followed = None
        if not inherited:
            # An existing journal belongs to another master.
            self._forget_journal()
            await self._write_down(connection)
        self._other_pid, self._is_inherited = pid, inherited
        self._events.event(
            "guarding",
            service=self._settings.address.uri,
            pid=pid,
            started_by="an earlier guard" if inherited else "somebody else",
        )

    async def _write_down(self, connection: Connection) -> None:
        """Journal a stock master's state, if it has changed."""
        state = await snapshot(connection)
        changed, self._followed = state != self._followed, state
        try:
            if changed or self._unwritten is not None or not self._has_journal():
                write_journal(self._journal, state)
        except Exception as error:  # noqa: BLE001 - a parameter may have any type
            before, self._unwritten = (
                self._unwritten,
                f"{self._journal}: what the master knows cannot be written down: "
                f"{_words_of(error)}",
            )
            if before is None:
                self._events.event("journal_failed", reason=self._unwritten)
        else:
            if self._unwritten is not None:
                self._events.event("journal_written", reason=f"{self._journal}: is whole again")
            self._unwritten = None

    def _has_journal(self) -> bool:
        try:
            touch(self._journal, self._journal.stat())
        except OSError:
            return False
        return True

    # -- the journal -------------------------------------------------------------------------------

    def _hold_journal(self) -> None:
        """Keep the master's journal open, so that it stays readable if it is removed."""
        if self._followed is not None:
            return
        with contextlib.suppress(OSError):
            if self._held < 0 or not os.path.samestat(self._journal.stat(), os.fstat(self._held)):
                held = os.open(self._journal, os.O_RDONLY | os.O_CLOEXEC)
                self._let_go()
                self._held = held

    def _let_go(self) -> None:
        if self._held >= 0:
            os.close(self._held)
            self._held = -1

    def _forget_journal(self) -> None:
        self._let_go()
        # It is written anew in a moment, and errors are reported then.
        with contextlib.suppress(OSError):
            self._journal.unlink(missing_ok=True)

    def _known(self) -> MasterState:
        """Return the last master's state."""
        if self._followed is not None:
            return self._followed
        wrong: Exception = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        try:
            known = read_journal(self._journal)
            if known is not None or self._held < 0:
                return known or MasterState()
        except (OSError, ValueError) as error:
            known, wrong = None, error
        reason = f"{self._journal}: {_words_of(wrong)}"
        try:
            known = read_journal(self._held)
            reason += "; it was still open here, and nothing is lost"
        except (OSError, ValueError):
            # The next master writes its own journal at this path.
            aside = self._journal.with_name(f"{self._journal.name}.unread")
            try:
                self._journal.replace(aside)
                reason += f"; it is kept as {aside}"
            except OSError as error:
                reason += f"; it cannot be put aside: {_words_of(error)}"
            reason += ", and the new master knows nothing of the last one"
        self._events.event("journal_failed", reason=reason)
        return known or MasterState()

    # -- replacing ---------------------------------------------------------------------------------

    async def _replace(self, noticed_at: float) -> None:
        """Start a new master in place of one that has ended."""
        failures = 0
        while True:
            try:
                known = self._known()
                reconciled = reconcile(known, *await ask_everyone(known))
                await self._start(reconciled, noticed_at)
            except _TakenError as error:
                # Another program was faster, such as a unit that restarts roscore.
                self._events.event("note", reason=str(error))
                return
            except (GuardError, OSError) as error:
                self._events.event("master_failed", reason=str(error))
                await self._drop_spare()
                self._new_socket(_KEPT_S - (monotonic() - noticed_at))
                await asyncio.sleep(restart_delay_s(failures))
                failures += 1
            else:
                return

    async def _start(self, reconciled: Reconciled, noticed_at: float | None = None) -> None:
        begun_at = monotonic() if noticed_at is None else noticed_at
        self._bind()
        state = reconciled.state
        master = self._next_master()
        self._spare = None
        try:
            await master.serve(state)
        except BaseException:
            await master.end(at_once=True)
            raise
        self._followed = self._unwritten = None
        self._let_go()
        self._hold_journal()
        self._own = master
        self._doubtful = reconciled.doubtful
        # Without nodes a master begins anew, and nothing is lost.
        begins_anew = not state.nodes()
        self._events.event(
            "master_started",
            service=self._settings.address.uri,
            pid=master.process.pid,
            nodes=len(state.nodes()),
            services=len(state.services),
            topics=len(state.publishers.keys() | state.subscribers.keys()),
            parameters=len(parameter_names(state.parameters)),
            gone=None if begins_anew else list(reconciled.gone) or None,
            silent=list(reconciled.silent) or None,
            lost_services=None if begins_anew else list(reconciled.lost_services) or None,
            duration_ms=(monotonic() - begun_at) * 1e3,
        )

    def _next_master(self) -> MasterProcess:
        """Return the process that waits to be the master, or a new one."""
        if self._spare is None or self._spare.process.ended.done():
            assert self._listening is not None
            self._spare = MasterProcess(self._settings, self._listening, self._journal)
        return self._spare

    async def _load_spare_later(self) -> None:
        await asyncio.sleep(_SPARE_DELAY_S)
        # Without a spare the next start takes longer, and reports the error.
        with contextlib.suppress(GuardError):
            self._next_master()

    async def _look_again(self) -> None:
        """Ask the silent nodes once more: one that died with the master may have seemed slow."""
        await asyncio.sleep(_SECOND_LOOK_S)
        before = self._doubtful
        found = reconcile(before, *await ask_everyone(before))
        if calls := unregistrations(before, found.state):
            with contextlib.closing(Connection(self._uri)) as connection:
                await connection.calls(calls, within_s=_PROBE_S)
            self._events.event(
                "nodes_gone",
                gone=list(found.gone) or None,
                lost_services=list(found.lost_services) or None,
            )

    async def _drop_spare(self) -> None:
        spare, self._spare = self._spare, None
        if spare is not None:
            await spare.end(at_once=True)

    def _new_socket(self, keep_s: float) -> None:
        """Replace the listening socket, unless calls may still wait at it."""
        if self._listening is not None:
            if keep_s > 0.0:
                return
            self._listening.close()
        family = socket.AF_INET6 if ":" in self._settings.address.bind else socket.AF_INET
        self._listening = socket.socket(family)
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._is_bound = False

    def _bind(self) -> None:
        """Bind the master's port; connections wait for a master from now on."""
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

    async def _close(self) -> None:
        await self._rosout.end()
        if self._is_inherited:
            # As the guard that started both would do.
            with contextlib.suppress(CallError):
                uri = await call(self._uri, "lookupNode", ROSOUT, within_s=_PROBE_S)
                await call(uri, "shutdown", "the guard ends", within_s=_PROBE_S)
            self._signal_other(signal.SIGTERM)
        if self._own is not None:
            await self._own.end()
        await self._drop_spare()
        self._let_go()
        if self._listening is not None:
            self._listening.close()


@contextlib.contextmanager
def _running(*works: Coroutine[Any, Any, Any]) -> Iterator[list[asyncio.Task[Any]]]:
    """Do works until the end of the block."""
    tasks = [asyncio.create_task(work) for work in works]
    try:
        yield tasks
    finally:
        for task in tasks:
            task.cancel()


async def _keep_lock(lock: GuardLock) -> None:
    while True:
        lock.keep()
        await asyncio.sleep(_LOCKED_EVERY_S)


def _words_of(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or str(error)


class _TakenError(GuardError):
    """Another process listens at the port."""
