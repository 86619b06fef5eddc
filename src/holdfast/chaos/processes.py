"""Processes of holdfast's own commands, and what can be seen of them from outside.

Whoever shows that nothing is lost must not look into what it shows. A process is known here by what
it writes for everybody, and by its end.
"""

from __future__ import annotations

import contextlib
import csv
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import IO, NamedTuple

from holdfast.errors import HoldfastError

__all__ = [
    "CannotStartError",
    "ChildProcess",
    "Decision",
    "DecisionTable",
    "Ended",
    "Written",
    "end_marked_processes",
    "free_port",
    "local_services_of",
    "marked_processes",
    "time_of",
]

_SHOWN_CHARACTERS = 300
_LOOK_AGAIN_S = 0.008
_LAST_LINES = 20

_LOWEST_PORT = 20_000
_OUTGOING_PORTS = Path("/proc/sys/net/ipv4/ip_local_port_range")
_USUAL_FIRST_OUTGOING_PORT = 32_768
_PORT_ATTEMPTS = 1000


class CannotStartError(HoldfastError):
    """A process cannot be started."""


class Written(NamedTuple):
    """A process has written a line."""

    child: ChildProcess
    line: str


class Ended(NamedTuple):
    """A process has ended and all its lines are delivered; the code is negative after a signal."""

    child: ChildProcess
    code: int


class ChildProcess:
    """A holdfast command as a process of its own.

    Parameters
    ----------
    arguments : sequence of str
        What stands after ``holdfast``.
    log_path : Path
        All that it writes is appended to this file.
    environment : dict of str to str
    deliver : callable
        Gets each line that it writes, and its end; called from a thread.
    prefix : sequence of str
        A command that becomes this one, in another namespace say.

    Attributes
    ----------
    process : Popen
    spawned_at : float
        Seconds since the epoch.
    killed_at : float or None
        When :meth:`kill` was called.
    last_lines : deque of str

    Raises
    ------
    CannotStartError
        If it cannot be started.
    """

    def __init__(
        self,
        arguments: Sequence[str],
        log_path: Path,
        environment: dict[str, str],
        deliver: Callable[[Written | Ended], None],
        prefix: Sequence[str] = (),
    ) -> None:
        self._deliver = deliver
        self._log_path = log_path
        self.last_lines: deque[str] = deque(maxlen=_LAST_LINES)
        self.killed_at: float | None = None
        self.spawned_at = time.time()
        try:
            self.process: subprocess.Popen[bytes] = subprocess.Popen(
                [*prefix, sys.executable, "-m", "holdfast", *arguments],
                # Never written to: a service sees by its end that whoever started it has died.
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=environment,
                # Ctrl-C is answered by whoever started it, who then ends its processes in order. A
                # group and no session of its own: if this process is killed, the system itself
                # wakes those that are stopped and hangs up on them.
                process_group=0,
            )
        except OSError as error:
            raise CannotStartError(
                f"holdfast {arguments[0]} cannot be started: {error.strerror}"
            ) from error
        self._reader = threading.Thread(
            target=self._read, name=f"output-{self.process.pid}", daemon=True
        )
        self._reader.start()

    @property
    def killed(self) -> bool:
        """Whether :meth:`kill` was called."""
        return self.killed_at is not None

    def kill(self) -> float:
        """End it with SIGKILL; return when."""
        self.killed_at = time.time()
        self.process.kill()
        return self.killed_at

    def stop(self) -> float:
        """Let it stand still, with SIGSTOP; return when."""
        stopped_at = time.time()
        self.process.send_signal(signal.SIGSTOP)
        return stopped_at

    def resume(self) -> float:
        """Let it go on, with SIGCONT; return when."""
        resumed_at = time.time()
        self.process.send_signal(signal.SIGCONT)
        return resumed_at

    def terminate(self) -> None:
        """Ask it to end in order, if it has not ended."""
        self.process.terminate()

    def close(self, timeout_s: float) -> None:
        """Wait for its end, and if it does not come in time, make it; may be repeated."""
        try:
            self.process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            pass
        finally:
            self.process.kill()  # nothing, if it has ended
            self.process.wait()
            assert self.process.stdin is not None
            self.process.stdin.close()
            self._reader.join(1.0)

    def last_words(self) -> str:
        """Return the last line that it wrote; empty if there is none."""
        last = next((line for line in reversed(self.last_lines) if line.strip()), "")
        return last[:_SHOWN_CHARACTERS]

    def _read(self) -> None:
        assert self.process.stdout is not None
        with self.process.stdout as output, self._log_path.open("ab", buffering=0) as log:
            for line in output:
                # Without room for the log the story goes on.
                with contextlib.suppress(OSError):
                    log.write(line)
                text = line.decode(errors="replace").rstrip("\n")
                self.last_lines.append(text)
                self._deliver(Written(self, text))
        self._deliver(Ended(self, self.process.wait()))


class Decision(NamedTuple):
    """A row of a robot's ``timings.csv``.

    Attributes
    ----------
    at : float
        When it was carried out, in seconds since the epoch.
    trial, step : int
    kind : str
        ``sensing`` or ``task``.
    service : str
        Who decided.
    status : str
        Of the robot.
    waited_ms : float
        How long the robot stood still for it.
    round_trip_ms : float
        From the question until the answer.
    computed_ms : float
        The service's own part of that.
    """

    at: float
    trial: int
    step: int
    kind: str
    service: str
    status: str
    waited_ms: float
    round_trip_ms: float = 0.0
    computed_ms: float = 0.0


class DecisionTable:
    """A robot's ``timings.csv``, read while it grows.

    Parameters
    ----------
    path : Path
        It need not be there yet.

    Attributes
    ----------
    rows : list of Decision
        As far as they have been read.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[bytes] | None = None
        self._columns: list[str] = []
        self.rows: list[Decision] = []

    def read(self) -> None:
        """Read what is new; a line that is not whole yet is left for later."""
        if self._file is None:
            try:
                self._file = self._path.open("rb")
            except FileNotFoundError:
                return
        start = self._file.tell()
        content = self._file.read()
        whole = content.rfind(b"\n") + 1
        self._file.seek(start + whole)
        for fields in csv.reader(content[:whole].decode().splitlines()):
            if not self._columns:
                self._columns = fields
                continue
            row = dict(zip(self._columns, fields, strict=True))
            self.rows.append(
                Decision(
                    time_of(row["time"]),
                    int(row["trial"]),
                    int(row["step"]),
                    row["kind"],
                    row["service"],
                    row["status"],
                    float(row["waited_ms"]),
                    float(row["round_trip_ms"]),
                    float(row["computed_ms"]),
                )
            )

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


def time_of(text: str) -> float:
    """Return the seconds since the epoch of a time as events and tables have it."""
    return datetime.fromisoformat(text).timestamp()


def free_port() -> int:
    """Return a port of this machine that nobody uses at the moment.

    It is none of those that the system gives to connections: while a service is away, the next
    attempt to reach it could be given its port, and so be connected to itself.

    Raises
    ------
    CannotStartError
        If there is none.
    """
    try:
        end = int(_OUTGOING_PORTS.read_text().split()[0])
    except (OSError, ValueError, IndexError):
        end = _USUAL_FIRST_OUTGOING_PORT
    if end <= _LOWEST_PORT:
        end = _USUAL_FIRST_OUTGOING_PORT
    chance = random.SystemRandom()
    for _ in range(_PORT_ATTEMPTS):
        port = chance.randrange(_LOWEST_PORT, end)
        with contextlib.suppress(OSError), socket.socket() as probe:
            probe.bind(("127.0.0.1", port))
            return port
    raise CannotStartError(f"no port of 127.0.0.1 from {_LOWEST_PORT} to {end - 1} is free")


def local_services_of(robot: int) -> list[int]:
    """Return the processes of the local services that a robot has launched (Linux).

    Parameters
    ----------
    robot : int
        The robot's process.
    """
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            # The name, in parentheses, may hold anything.
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[1]) == robot and fields[0] != "Z":
                arguments = (folder / "cmdline").read_bytes().split(b"\0")
                if b"--until-stdin-closes" in arguments:
                    found.append(int(folder.name))
    return found


def marked_processes(name: str, value: str) -> list[int]:
    """Return all processes with a variable in their environment that have not ended (Linux).

    Parameters
    ----------
    name, value : str
        Of the variable. What a marked process starts is marked as well.
    """
    needle = os.fsencode(f"{name}={value}")
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            if needle in (folder / "environ").read_bytes().split(b"\0"):
                state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
                if state != "Z":
                    found.append(int(folder.name))
    return found


def end_marked_processes(name: str, value: str, patience_s: float) -> list[int]:
    """Wait until all processes with a variable in their environment have ended, and end the rest.

    Parameters
    ----------
    name, value : str
        Of the variable; see :func:`marked_processes`.
    patience_s : float
        How long to wait before the rest gets SIGKILL.

    Returns
    -------
    list of int
        The rest.
    """
    deadline = time.monotonic() + patience_s
    while left := marked_processes(name, value):
        if time.monotonic() > deadline:
            for pid in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
            break
        time.sleep(_LOOK_AGAIN_S)
    return left
