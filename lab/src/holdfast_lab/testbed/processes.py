"""Processes on this machine: started, watched by what they log, signalled, and all ended.

A :class:`Process` keeps every line and every event that its command writes. A thread reads them, so
a caller may wait for an event, or hand in a function that gets each event and the end.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import random
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path

from holdfast_lab.errors import CannotStartError, NoProgressError, ProcessEndedError
from holdfast_lab.testbed.records import LogEvent, log_event_of

HOLDFAST = (sys.executable, "-m", "holdfast")

_MARK = "HOLDFAST_TESTBED"
_SHOWN_CHARACTERS = 300
_POLL_S = 0.008
_READER_S = 30.0

_LOWEST_PORT = 20_000
_OUTGOING_PORTS = Path("/proc/sys/net/ipv4/ip_local_port_range")
_USUAL_FIRST_OUTGOING_PORT = 32_768


class Process:
    """A command as a process of its own, in its own process group.

    Its standard input stays open until :meth:`close`, so a service started with
    ``--until-stdin-closes`` ends with this process. Its output is appended to the log. ``changed``
    is notified of each line and of the end; several processes may share it. With ``own_session`` it
    leads a session, so that it may have a terminal of its own. Raises CannotStartError if it cannot
    be started.
    """

    def __init__(
        self,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
        *,
        directory: Path | None = None,
        log_path: Path | None = None,
        changed: threading.Condition | None = None,
        own_session: bool = False,
    ) -> None:
        self.log_path = log_path
        self._changed = changed or threading.Condition()
        self.lines: list[str] = []
        self.events: list[LogEvent] = []
        self.killed_at: float | None = None
        # Negative after a signal; None until it has ended and all its events are here.
        self.exit_code: int | None = None
        self.spawned_at = time.time()
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=None if environment is None else dict(environment),
                cwd=directory,
                # Ctrl-C reaches the parent alone, which ends its processes in order. In the same
                # session, stopped processes get SIGCONT and SIGHUP if the parent is killed.
                process_group=None if own_session else 0,
                start_new_session=own_session,
            )
        except OSError as error:
            raise CannotStartError(
                f"{' '.join(command[:5])} cannot be started: {error.strerror}"
            ) from error
        self._reader = threading.Thread(target=self._read, name=f"output-{self.pid}", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        """Its number."""
        return self.process.pid

    @property
    def killed(self) -> bool:
        """Whether :meth:`kill` was called."""
        return self.killed_at is not None

    def kill(self) -> float:
        """Send SIGKILL; return when."""
        self.killed_at = time.time()
        self.process.kill()
        return self.killed_at

    def stop(self) -> float:
        """Send SIGSTOP; return when."""
        stopped_at = time.time()
        self.process.send_signal(signal.SIGSTOP)
        return stopped_at

    def resume(self) -> float:
        """Send SIGCONT; return when."""
        resumed_at = time.time()
        self.process.send_signal(signal.SIGCONT)
        return resumed_at

    def close(self, timeout_s: float) -> int:
        """Wait for the end and return the exit code; kill what does not end in time. Repeatable."""
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            pass
        finally:
            self.process.kill()  # does nothing to a process that has ended
            code = self.process.wait()
            assert self.process.stdin is not None
            with contextlib.suppress(OSError):
                self.process.stdin.close()
            self._reader.join(_READER_S)
        return code

    def matching(self, name: str, **fields: object) -> list[LogEvent]:
        """Return its events with a name and these fields."""
        return [event for event in self.events.copy() if event.matches(name, **fields)]

    def wait_for(
        self, name: str, count: int = 1, *, timeout_s: float = 60.0, **fields: object
    ) -> LogEvent:
        """Wait for the n-th event with a name and these fields.

        Raises ProcessEndedError if the process ends before; NoProgressError if the event does not
        come in time.
        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while len(found := self.matching(name, **fields)) < count:
                awaited = f"event {name} {fields or ''} (number {count})"
                if self.exit_code is not None:
                    raise ProcessEndedError(f"no {awaited}: {self.account()}")
                left = deadline - time.monotonic()
                if left <= 0.0:
                    raise NoProgressError(f"no {awaited} in {timeout_s:g} s: {self.account()}")
                self._changed.wait(left)
        return found[count - 1]

    def account(self) -> str:
        """Return its exit code and all that it has written."""
        events = [f"{event.name} {dict(event.fields)}" for event in self.events.copy()]
        return "\n".join(
            [f"process {self.pid}, exit code {self.process.poll()}", *self.lines, *events]
        )

    def last_line(self) -> str:
        """Return the last line of its output, shortened; empty if there is none."""
        last = next((line for line in reversed(self.lines) if line.strip()), "")
        return last.rstrip()[:_SHOWN_CHARACTERS]

    def _read(self) -> None:
        assert self.process.stdout is not None
        log_path = self.log_path or Path(os.devnull)
        with self.process.stdout as output, log_path.open("ab", buffering=0) as log:
            for line in output:
                # A full disk must not stop the run.
                with contextlib.suppress(OSError):
                    log.write(line)
                self._take(line.decode(errors="replace"))
        code = self.process.wait()
        with self._changed:
            self.exit_code = code
            self._changed.notify_all()

    def _take(self, line: str) -> None:
        event = log_event_of(line)
        with self._changed:
            if event is None or event.name == "error":
                self.lines.append(line)
            if event is not None:
                self.events.append(event)
            self._changed.notify_all()


class ProcessGroup:
    """Processes, and all that they start: a variable, which children inherit, marks them.

    ``changed`` is notified when one of them writes a line, or has ended.
    """

    def __init__(self) -> None:
        self._mark = secrets.token_hex(16)
        self.processes: list[Process] = []
        self.changed = threading.Condition()

    def environment(self, variables: Mapping[str, str]) -> dict[str, str]:
        """Return the environment of a process of this group."""
        return {**os.environ, _MARK: self._mark, **variables}

    def living(self) -> list[int]:
        """Return all of them that have not ended, whoever started them."""
        return marked_processes(_MARK, self._mark)

    def close(self, patience_s: float, orderly_end_s: float = 0.0) -> list[int]:
        """End all of them, and return those that had to be killed although nobody knew them.

        After SIGTERM they have ``orderly_end_s``; at 0, or by an exception, they are killed at
        once. What they have started has ``patience_s`` to end by itself, after them.
        """
        try:
            if orderly_end_s > 0.0:
                for process in self.processes:
                    process.process.terminate()
                for process in self.processes:
                    process.close(orderly_end_s)
        finally:
            for process in self.processes:
                process.process.kill()
            for process in self.processes:
                process.close(0.0)
            deadline = time.monotonic() + patience_s
            while (left := self.living()) and time.monotonic() <= deadline:
                time.sleep(_POLL_S)
            for pid in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
        return left


class Ports:
    """A range of ports, taken one after another from a random one on: none is taken again soon."""

    def __init__(self, first: int, end: int) -> None:
        self._first = first
        self._size = end - first
        # A run that begins when another one has just ended begins elsewhere.
        self._numbers = itertools.count(random.SystemRandom().randrange(self._size))

    def free(self, host: str = "127.0.0.1") -> int:
        """Return a port that is free for streams and datagrams.

        Raises CannotStartError if there is none.
        """
        for number in itertools.islice(self._numbers, self._size):
            port = self._first + number % self._size
            with contextlib.suppress(OSError):
                for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
                    with socket.socket(type=kind) as probe:
                        probe.bind((host, port))
                return port
        end = self._first + self._size - 1
        raise CannotStartError(f"no port of {host} from {self._first} to {end} is free")


@cache
def _own_ports() -> Ports:
    """Return those below the range from which the system takes ports for outgoing connections.

    From within it a connection attempt to a service that is away could get the service's own port
    and connect to itself.
    """
    try:
        end = int(_OUTGOING_PORTS.read_text().split()[0])
    except (OSError, ValueError, IndexError):
        end = _USUAL_FIRST_OUTGOING_PORT
    return Ports(_LOWEST_PORT, end if end > _LOWEST_PORT else _USUAL_FIRST_OUTGOING_PORT)


def free_port() -> int:
    """Return a port of this machine that is free for streams and datagrams."""
    return _own_ports().free()


def local_services_of(robot: int) -> list[int]:
    """Return the processes of the local services that a robot's process has launched (Linux)."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            state, parent = _state_and_parent(folder)
            if parent == robot and state != "Z":
                arguments = (folder / "cmdline").read_bytes().split(b"\0")
                if b"--until-stdin-closes" in arguments:
                    found.append(int(folder.name))
    return found


def marked_processes(name: str, value: str) -> list[int]:
    """Return the living processes with an environment variable, which children inherit (Linux)."""
    needle = os.fsencode(f"{name}={value}")
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if needle in (folder / "environ").read_bytes().split(b"\0"):
                state, _ = _state_and_parent(folder)
                if state != "Z":
                    found.append(int(folder.name))
    return found


def _state_and_parent(folder: Path) -> tuple[str, int]:
    # The name, in parentheses, may hold anything.
    fields = (folder / "stat").read_text().rpartition(")")[2].split()
    return fields[0], int(fields[1])
