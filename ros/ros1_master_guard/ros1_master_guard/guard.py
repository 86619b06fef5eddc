"""A guard for the ROS 1 master: when the master dies, a prepared one takes its place at once.

The guard owns the listening socket, and each master inherits it. So calls to a master that has just
died are not refused: they wait in the kernel for the next one, which is already running and has
loaded all code. It is given what its predecessor had told the guard
(:mod:`ros1_master_guard.process`), without the nodes that have died meanwhile
(:mod:`ros1_master_guard.plan`), and answers. For a node this is one slow call.

A master survives its guard, and the next guard watches it. The guard also watches a foreign master,
such as ``roscore``'s. That one tells nothing by itself, so the guard asks it a few times a second.
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

from ros1_master_guard.errors import CallError, GoneError, GuardError, SilentError
from ros1_master_guard.events import EventLog
from ros1_master_guard.plan import gone_and_silent, process_of, snapshot, without
from ros1_master_guard.process import MasterState
from ros1_master_guard.ros1_calls import CALLER, Connection, call
from ros1_master_guard.roscore import ROSOUT, Rosout, how_it_ended, set_versions
from ros1_master_guard.saved_state import read_journal, write_journal
from ros1_master_guard.settings import GuardSettings, directory_for, guard_lock, listens_at
from ros1_master_guard.standby import MasterLink, MasterProcess

_PROBE_EVERY_S, _PROBE_S = 0.2, 1.0
_POLL_EVERY_S = 0.25
_POLL_SHARE = 0.1  # largest share of the time for what is done again and again
_SPARE_DELAY_S = 0.5  # the next master is loaded when the nodes have been served
_RESTART_S = 0.5
"""Pause before another start: after one that failed, or two masters that ended within _STEADY_S."""

_STEADY_S = 1.0
_LAST_WORDS_S = 1.0  # for reading what a master told before it ended
_BACKLOG = 1024


class MasterGuard:
    """Watches a master and replaces it when it dies."""

    def __init__(self, settings: GuardSettings, events: EventLog) -> None:
        self._settings = settings
        self._events = events
        self._uri = settings.address.own_uri
        self._port = settings.address.port
        self._listening = socket.socket(
            socket.AF_INET6 if ":" in settings.address.bind else socket.AF_INET
        )
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._spare: MasterProcess | None = None
        self._own: MasterProcess | None = None  # the master, if this guard has started it
        self._pid: int | None = None  # None while there is no master, or it has never answered
        self._link: MasterLink | None = None  # where a guarded master tells what changes
        self._known = MasterState()  # what the master knows
        self._saved: tuple[MasterState | None, int] = None, 0  # what the journal has
        self._is_failing = False  # whether the journal cannot be written
        self._rosout = Rosout(settings.address.uri, self._uri, events)

    async def run(self, ready: Callable[[str], None]) -> None:
        """Guard until cancelled, then end a master that was started here.

        ``ready`` is called once when a master answers, with ``started``, ``resumed`` or ``found``.
        """
        directory = directory_for(self._settings.directory)
        self._journal = directory / f"master-{self._port}.journal"
        with guard_lock(self._port):
            try:
                # Missing software is reported now, not when the master dies.
                await self._next_master().warm()
                how = await self._begin()
                ready(how)
                helpers = [self._keep_journal()]
                if self._settings.rosout:
                    helpers.append(self._rosout.keep())
                if how == "started":
                    helpers.append(set_versions(self._uri))
                with _running(*map(self._help, helpers)):
                    await self._watch()
            except Exception:
                # They continue without a guard, and the next one finds them.
                self._own = self._link = None
                self._rosout.release()
                raise
            finally:
                await self._close()

    async def _help(self, work: Coroutine[None, None, None]) -> None:
        """Do work besides watching: its failure is logged and changes nothing else."""
        try:
            await work
        except Exception as error:  # noqa: BLE001 (whatever it is, the master comes first)
            self._events.event("note", reason=error)

    async def _begin(self) -> str:
        """Find a master, or start one."""
        try:
            with contextlib.closing(Connection(self._uri)) as connection:
                await self._attach(connection, self._settings.silent_s)
        except GoneError:
            pass
        except SilentError as error:
            self._events.event("note", reason=error)
            self._known = self._read_journal()
            return "found"
        except CallError as error:
            raise GuardError(f"what is there is no ROS 1 master: {error}") from error
        else:
            return "found"
        known = self._read_journal()
        uris = known.nodes()
        gone, silent = await gone_and_silent(uris.values())
        others = {uri for node, uri in uris.items() if node != ROSOUT}
        resumes = bool(others - gone - silent)
        if not resumes:
            # No node of the old graph is left, so its parameters are obsolete.
            known.parameters = {"run_id": str(uuid.uuid1())}
            gone |= silent
        await self._start(known, gone, silent - gone)
        return "resumed" if resumes else "started"

    # -- watching ----------------------------------------------------------------------------------

    async def _watch(self) -> None:
        short_lives = 0
        while True:
            since = monotonic()
            reason = await self._lost()
            noticed_at = monotonic()
            self._events.event("master_lost", reason=reason)
            short_lives = short_lives + 1 if noticed_at - since < _STEADY_S else 0
            if short_lives > 1:
                await asyncio.sleep(_RESTART_S)
            await self._replace(noticed_at)

    async def _lost(self) -> str:
        """Wait for the master's end, and return the reason."""
        helpers = map(self._help, (self._load_spare_later(), self._follow()))
        with _running(self._unresponsive(), self._exited()) as reasons, _running(*helpers):
            await asyncio.wait(reasons, return_when=asyncio.FIRST_COMPLETED)
            reason: str = next(task.result() for task in reasons if task.done())
        if self._own is not None:
            await self._own.end(signal.SIGKILL)
        if self._link is not None and self._link.following is not None:
            await asyncio.wait((self._link.following,), timeout=_LAST_WORDS_S)
            self._link.close()
        self._own = self._link = self._pid = None
        return reason

    async def _exited(self) -> str:
        """Wait for the end of the master that was started here."""
        ended = asyncio.Future[int]() if self._own is None else self._own.ended
        return how_it_ended(await asyncio.shield(ended))

    async def _unresponsive(self) -> str:
        """Wait until the master answers no more, kill it if it is there, and return the reason."""
        silent_s = self._settings.silent_s
        failed, told = 0.0, False
        with contextlib.closing(Connection(self._uri)) as connection:
            while True:
                asked_at = monotonic()
                try:
                    await connection.call("getPid", within_s=min(_PROBE_S, silent_s))
                except GoneError:
                    if self._own is None:
                        return "nobody listens at its port"
                except CallError:
                    # Time actually waited counts, not the clock: this may have been stopped.
                    failed += monotonic() - asked_at
                else:
                    failed = 0.0
                reason = f"it did not answer for {silent_s:g} s"
                # Stopped, or too busy to be of use.
                if failed >= silent_s and self._signal(signal.SIGKILL):
                    return reason
                if failed >= silent_s and not told:
                    told = True
                    reason += "; it is none of this user's processes on this machine"
                    self._events.event("master_hangs", reason=f"{reason}, so it is left alone")
                await asyncio.sleep(0.01 if failed else _PROBE_EVERY_S)

    def _signal(self, number: signal.Signals) -> bool:
        """Signal the master, if it is a process of this user on this machine."""
        with contextlib.suppress(OSError):
            if self._pid is not None and listens_at(self._pid, self._port):
                os.kill(self._pid, number)
                return True
        return False

    # -- what the master knows ---------------------------------------------------------------------

    async def _attach(self, connection: Connection, within_s: float = _PROBE_S) -> None:
        """Learn what a master that was not started by this guard knows."""
        pid = await process_of(connection, within_s=within_s)
        # A stock master has no such call and answers so at once.
        (name,) = await connection.calls([("getGuardSocket", (CALLER,))], within_s=_PROBE_S)
        try:
            self._link = await MasterLink.to(name) if name else None
        except OSError as error:
            raise CallError(f"{self._uri}: {error}") from error
        self._known = await snapshot(connection) if self._link is None else self._link.state
        if self._pid != pid:
            self._pid = pid
            by = "somebody else" if self._link is None else "an earlier guard"
            uri = self._settings.address.uri
            self._events.event("guarding", service=uri, pid=pid, started_by=by)

    async def _follow(self) -> None:
        """Keep up with what the master knows, until cancelled."""
        with contextlib.closing(Connection(self._uri)) as connection:
            while True:
                if self._link is not None and self._link.following is not None:
                    await asyncio.wait((self._link.following,))
                asked_at = monotonic()
                with contextlib.suppress(CallError):
                    # One that was silent until now, or tells this guard no more.
                    if self._pid is None or self._link is not None:
                        await self._attach(connection)
                    elif (state := await snapshot(connection)) != self._known:
                        self._known = state
                await _pause(monotonic() - asked_at)

    async def _keep_journal(self) -> None:
        """Write what the master knows to the directory, whenever it has changed."""
        while True:
            began = monotonic()
            self._save()
            await _pause(monotonic() - began)

    def _save(self) -> None:
        known, changes = now = self._known, self._known.changes
        if self._saved[0] is known and self._saved[1] == changes and self._journal.exists():
            return
        try:
            write_journal(self._journal, known)
        except Exception as error:  # noqa: BLE001 - a parameter may have any type
            if not self._is_failing:
                reason = f"what the master knows cannot be written down: {_words_of(error)}"
                self._events.event("journal_failed", reason=f"{self._journal}: {reason}")
            self._is_failing = True
        else:
            if self._is_failing:
                self._events.event("journal_written", reason=f"{self._journal}: is whole again")
            self._saved, self._is_failing = now, False

    def _read_journal(self) -> MasterState:
        """Return what a master knew that ended with its guard."""
        try:
            return read_journal(self._journal) or MasterState()
        except (OSError, ValueError) as error:
            reason = f"{self._journal}: {_words_of(error)}; nothing is known of an earlier master"
            self._events.event("journal_failed", reason=reason)
            return MasterState()

    # -- replacing ---------------------------------------------------------------------------------

    async def _replace(self, noticed_at: float) -> None:
        """Start a new master in place of one that has ended."""
        while True:
            try:
                gone, silent = await gone_and_silent(self._known.nodes().values())
                await self._start(self._known, gone, silent, noticed_at)
            except _TakenError as error:
                # Another program was faster, such as a unit that restarts roscore.
                self._events.event("note", reason=error)
                return
            except (GuardError, OSError) as error:
                self._events.event("master_failed", reason=error)
                await self._drop_spare()
                await asyncio.sleep(_RESTART_S)
            else:
                return

    async def _start(
        self, known: MasterState, gone: set[str], silent: set[str], noticed_at: float | None = None
    ) -> None:
        begun_at = noticed_at or monotonic()
        self._bind()
        state = without(known, gone)
        master = self._next_master()
        self._spare = None
        try:
            await master.serve(state)
        except BaseException:
            await master.end(signal.SIGKILL)
            raise
        self._own, self._pid, self._link = master, master.pid, master.link
        self._known = master.link.state
        # Without nodes a master begins anew, and nothing is lost.
        lost = known.nodes().items() if state.nodes() else ()
        self._events.event(
            "master_started",
            service=self._settings.address.uri,
            pid=master.pid,
            nodes=len(state.nodes()),
            services=len(state.services),
            topics=len(state.publishers.keys() | state.subscribers.keys()),
            gone=[node for node, uri in lost if uri in gone] or None,
            silent=[node for node, uri in known.nodes().items() if uri in silent] or None,
            duration_ms=(monotonic() - begun_at) * 1e3,
        )

    def _next_master(self) -> MasterProcess:
        """Return the process that waits to be the master, or a new one."""
        if self._spare is None or self._spare.ended.done():
            self._spare = MasterProcess(self._settings, self._listening)
        return self._spare

    async def _load_spare_later(self) -> None:
        await asyncio.sleep(_SPARE_DELAY_S)
        # Without a spare the next start takes longer, and reports the error.
        with contextlib.suppress(GuardError):
            self._next_master()

    async def _drop_spare(self) -> None:
        spare, self._spare = self._spare, None
        if spare is not None:
            await spare.end(signal.SIGKILL)

    def _bind(self) -> None:
        """Bind the master's port; connections wait for a master from now on."""
        if self._listening.getsockname()[1]:
            return
        address = self._settings.address
        try:
            self._listening.bind((address.bind, address.port))
            self._listening.listen(_BACKLOG)
        except OSError as error:
            text = f"port {address.port} of {address.bind}: {error.strerror}"
            raise (_TakenError if error.errno == errno.EADDRINUSE else GuardError)(text) from error

    async def _close(self) -> None:
        await self._rosout.end()
        if self._link is not None:
            if self._own is None:
                # As the guard that started both would do.
                with contextlib.suppress(CallError):
                    uri = await call(self._uri, "lookupNode", ROSOUT, within_s=_PROBE_S)
                    await call(uri, "shutdown", "the guard ends", within_s=_PROBE_S)
                self._signal(signal.SIGTERM)
            else:
                await self._own.end()
            self._link.close()
        await self._drop_spare()
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


async def _pause(took_s: float) -> None:
    """Wait before something is done again that took so long."""
    await asyncio.sleep(max(_POLL_EVERY_S, took_s / _POLL_SHARE))


def _words_of(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or str(error)


class _TakenError(GuardError):
    """Another process listens at the port."""
