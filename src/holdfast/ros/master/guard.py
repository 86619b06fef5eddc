"""A guard for the ROS 1 master: when the master dies, the next one is there before anybody asks.

ROS 1 has one process that knows where everything is. While it is away nobody finds a service or a
topic; what stands already, goes on: topics and persistent services are connections between nodes.
When it comes back as stock ROS has it, it knows nothing, and no node tells it again.

The guard holds the port. The socket at which nodes connect belongs to it, and each master inherits
it, so calls to a master that has just died are not refused: they wait, in the kernel, for the next
one. That one has been waiting, too: a process that has loaded all it needs. It reads what the last
one had confirmed (:mod:`holdfast.ros.master.process`), leaves out what has died meanwhile
(:mod:`holdfast.ros.master.plan`), and answers. To a node the master's death is a call that took a
little longer.

A master lives on when the guard is killed, and the next guard watches it. A master that somebody
else started, as ``roscore`` does, is watched as well; it keeps no journal, so the guard asks it a
few times a second what it knows.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import shutil
import signal
import socket
import subprocess
import uuid
from collections.abc import Callable, Coroutine
from time import monotonic
from urllib.parse import urlsplit

from holdfast.ros.master.plan import NodeReport, Reconciled, reconcile, unregistrations
from holdfast.ros.master.process import (
    MasterState,
    parameter_names,
    read_journal,
    touch,
    write_journal,
)
from holdfast.ros.master.settings import (
    GuardError,
    GuardLock,
    GuardSettings,
    listens_at,
    own_directory,
)
from holdfast.ros.master.standby import ChildProcess, MasterProcess
from holdfast.ros.master.survey import ask_everyone, snapshot
from holdfast.runtime.logs import EventSink
from holdfast.transport.ros1_calls import (
    CALLER,
    CallError,
    Connection,
    GoneError,
    SilentError,
    call,
)

__all__ = ["MasterGuard"]

_PROBE_EVERY_S = 0.5
_PROBE_S = 1.0
_POLL_EVERY_S = 0.25
_POLL_SHARE = 0.1
"""Of a stock master's time, at most so much is spent on the guard's questions."""

_SPARE_DELAY_S = 0.5
"""The next master is loaded a little after this one began, when the nodes have what they need."""

_SECOND_LOOK_S = 1.0
_STEADY_S = 1.0
"""A master that ends earlier than this may have failed at its start."""

_FIRST_DELAY_S, _LAST_DELAY_S = 0.1, 1.0
_KEPT_S = 5.0
"""Calls are not kept waiting for a master longer than this; then they are refused."""

_LOCKED_EVERY_S = 1.0
_BACKLOG = 1024
_ROSOUT = "/rosout"
_ROSOUT_EVERY_S = 1.0
_VERSION_S = 30.0


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
        self._spare: MasterProcess | None = None
        self._own: MasterProcess | None = None
        self._other_pid: int | None = None
        self._is_inherited = False
        """Whether the other master is one that an earlier guard has started."""
        self._followed: MasterState | None = None
        """What a master that keeps no journal knew last."""
        self._unwritten: str | None = None
        """Why that is not written down."""
        self._held = -1
        """The journal of a master that keeps one; it can be read even if it was removed."""
        self._doubtful = MasterState()
        """Who did not answer when the master began."""
        self._rosout: ChildProcess | None = None

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
        directory = self._settings.directory or own_directory()
        port = self._settings.address.port
        self._journal = directory / f"master-{port}.journal"
        with GuardLock(directory / f"master-{port}.lock", port) as lock:
            helpers = [asyncio.create_task(_keep_lock(lock))]
            try:
                self._new_socket(0.0)
                # Whatever is missing is said now, not when the master dies.
                await self._next_master().warm()
                how = await self._begin()
                ready(how)
                if self._settings.rosout:
                    helpers.append(asyncio.create_task(self._help(self._keep_rosout())))
                if how == "started":
                    helpers.append(asyncio.create_task(self._help(self._set_versions())))
                await self._watch()
            except Exception:
                # The next guard finds them; nobody gains by a master that ends with its guard.
                self._own = self._rosout = None
                raise
            finally:
                for helper in helpers:
                    helper.cancel()
                await self._close()

    async def _help(self, work: Coroutine[None, None, None]) -> None:
        """Do what a master is guarded without, too."""
        try:
            await work
        except Exception as error:  # noqa: BLE001 (whatever it is, the master comes first)
            self._events.event("note", reason=error)

    async def _begin(self) -> str:
        """Find a master, or start one."""
        connection = Connection(self._uri)
        try:
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
        finally:
            connection.close()
        known = self._known()
        nodes, services = await ask_everyone(known)
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

    async def _watch_own(self, master: MasterProcess) -> str:
        """Wait until the master that was started here is no more; say why."""
        loading = asyncio.create_task(self._load_spare_later())
        looking = asyncio.create_task(self._help(self._look_again()))
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
            for task in (loading, looking, ended, silent):
                task.cancel()

    async def _watch_other(self) -> str:
        """Wait until a master that somebody else started is no more; say why."""
        watching = [asyncio.create_task(self._closed()), asyncio.create_task(self._silent())]
        following = asyncio.create_task(self._follow())
        told = False
        try:
            while True:
                closed, silent = watching
                unfinished = {closed, silent, *(() if following.done() else (following,))}
                await asyncio.wait(unfinished, return_when=asyncio.FIRST_COMPLETED)
                if closed.done():
                    self._forget_other()
                    return closed.result()
                if following.done():
                    following.result()
                if not silent.done():
                    continue
                # Stopped, or so busy that it is of no use to anybody.
                if self._signal_other(signal.SIGKILL):
                    await closed
                    self._forget_other()
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

    def _forget_other(self) -> None:
        self._other_pid, self._is_inherited = None, False

    def _signal_other(self, number: signal.Signals) -> bool:
        """Signal the master that somebody else started, if it is this user's, and here."""
        pid = self._other_pid
        if pid is None or not listens_at(pid, self._settings.address.port):
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
                self._hold_journal()
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
        """Of a master that keeps no journal, keep one of what it answers."""
        connection = Connection(self._uri)
        try:
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
        finally:
            connection.close()

    async def _recognise(self, connection: Connection) -> None:
        """Find out which master somebody else has started."""
        pid = int(await connection.call("getPid", within_s=_PROBE_S))
        # A stock master answers at once that it has no such call.
        (journal,) = await connection.calls([("getJournal", (CALLER,))], within_s=_PROBE_S)
        inherited = journal == str(self._journal)
        self._followed = None
        if not inherited:
            # That of another master is not its.
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
        """Write down what a stock master knows, if that has changed."""
        try:
            state = await snapshot(connection)
        except (TypeError, ValueError) as error:
            raise CallError(f"{self._uri}: cannot be understood: {error}") from error
        changed, self._followed = state != self._followed, state
        try:
            if changed or self._unwritten is not None or not self._has_journal():
                write_journal(self._journal, state)
        except (OSError, TypeError, ValueError) as error:
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
        """Keep the journal that a master writes now open, so that it can be removed by nobody."""
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
        # It is written anew in a moment; whatever is wrong is said then.
        with contextlib.suppress(OSError):
            self._journal.unlink(missing_ok=True)

    def _known(self) -> MasterState:
        """Return what the last master knew."""
        if self._followed is not None:
            return self._followed
        known, wrong = None, None
        try:
            known = read_journal(self._journal)
        except (OSError, ValueError) as error:
            wrong = error
        if known is None and self._held >= 0:
            with contextlib.suppress(OSError, ValueError):
                known = read_journal(self._held)
            if known is not None and wrong is None:
                wrong = FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT))
        if wrong is not None:
            reason = f"{self._journal}: {_words_of(wrong)}"
            if known is not None:
                reason += "; it was still open here, and nothing is lost"
            else:
                # The next master would write its own there. Where this is not possible, it cannot.
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
        """Put a new master at the place of one that is no more."""
        failures = 0
        while True:
            try:
                known = self._known()
                reconciled = reconcile(known, *await ask_everyone(known))
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
        master = self._next_master()
        self._spare = None
        try:
            await master.warm()
            try:
                master.hand_over(state)
            except (OSError, TypeError, ValueError) as error:
                # What the journal holds lists the dead, too, but is better than no master.
                self._events.event("note", reason=f"the new master's state: {_words_of(error)}")
            await master.serve()
        except BaseException:
            await master.end(at_once=True)
            raise
        self._followed = self._unwritten = None
        self._let_go()
        self._hold_journal()
        self._own = master
        self._doubtful = reconciled.doubtful
        # Where nobody is left a master begins anew, and nothing is missed.
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
        # Without one, the next master takes a little longer, and says what is wrong.
        with contextlib.suppress(GuardError):
            self._next_master()

    async def _look_again(self) -> None:
        """Ask those once more who did not answer when the master began.

        A node that died along with the master may have been about to.
        """
        await asyncio.sleep(_SECOND_LOOK_S)
        before = self._doubtful
        found = reconcile(before, *await ask_everyone(before))
        if calls := unregistrations(before, found.state):
            connection = Connection(self._uri)
            try:
                await connection.calls(calls, within_s=_PROBE_S)
            finally:
                connection.close()
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
                self._rosout = ChildProcess(
                    (rosrun, "rosout", "rosout", "__name:=rosout"),
                    {"ROS_MASTER_URI": self._settings.address.uri, "ROS_NAMESPACE": "/"},
                    errors=subprocess.DEVNULL,
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
                    said, _ = await asyncio.wait_for(process.communicate(), _VERSION_S)
                finally:
                    if process.returncode is None:
                        process.kill()
                if said and process.returncode == 0:
                    value = said.decode(errors="replace")
                    await call(self._uri, "setParam", f"/{name}", value, within_s=_PROBE_S)

    async def _close(self) -> None:
        if self._rosout is not None:
            await self._rosout.end(signal.SIGINT)
        if self._is_inherited:
            # As the guard that started both would have done.
            with contextlib.suppress(CallError):
                uri = await call(self._uri, "lookupNode", _ROSOUT, within_s=_PROBE_S)
                await call(uri, "shutdown", "the guard ends", within_s=_PROBE_S)
            self._signal_other(signal.SIGTERM)
        if self._own is not None:
            await self._own.end()
        await self._drop_spare()
        self._let_go()
        if self._listening is not None:
            self._listening.close()


async def _keep_lock(lock: GuardLock) -> None:
    while True:
        lock.keep()
        await asyncio.sleep(_LOCKED_EVERY_S)


def _words_of(error: Exception) -> str:
    return (isinstance(error, OSError) and error.strerror) or str(error)


class _TakenError(GuardError):
    """Somebody else listens at the port."""


def _delay(failures: int) -> float:
    return float(min(_LAST_DELAY_S, _FIRST_DELAY_S * 2 ** min(failures, 16)))


def _how_it_ended(code: int) -> str:
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"it was ended by {signal.Signals(-code).name}"
    return f"it ended with exit code {code}"
