"""Services as processes of their own, and what they use of the machine."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

from holdfast_lab.testbed.driver import ServiceCommand
from holdfast_lab.testbed.processes import HOLDFAST, Process, free_port

__all__ = [
    "EchoProcess",
    "ServiceProcess",
    "Usage",
    "pipe_round_trip_s",
    "usage_of",
]

_ECHO = Path(__file__).with_name("echo.py")
_READY_TIMEOUT_S = 30.0
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Usage(NamedTuple):
    """What a process has used of the machine.

    Attributes
    ----------
    cpu_s : float
        Processor time, in steps of the system's ticks (10 ms).
    """

    cpu_s: float
    resident_bytes: int
    threads: int


def usage_of(process_id: int) -> Usage:
    """Return what a process has used so far (Linux)."""
    # The name may hold anything, so the fields are counted from its end.
    fields = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()
    status = Path(f"/proc/{process_id}/status").read_text()
    resident = next(line for line in status.splitlines() if line.startswith("VmRSS:"))
    return Usage(
        (int(fields[11]) + int(fields[12])) * _TICK_S,
        int(resident.split()[1]) * 1024,
        int(fields[17]),
    )


_PONG = """
import os, sys
os.sched_setaffinity(0, {int(sys.argv[1])})
while byte := os.read(0, 1):
    os.write(1, byte)
"""


def pipe_round_trip_s(number: int = 500) -> float:
    """Return how long a byte takes to a process on another core and back, through pipes.

    It is the machine's own share of every exchange between two processes: a core that sleeps is
    woken, twice. In virtual machines that can take ten times as long as elsewhere.
    """
    cores = sorted(os.sched_getaffinity(0))
    seconds = []
    with subprocess.Popen(
        [sys.executable, "-c", _PONG, str(cores[-1])],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        bufsize=0,
    ) as process:
        assert process.stdin is not None and process.stdout is not None
        os.sched_setaffinity(0, {cores[0]})
        try:
            for _ in range(number):
                time.sleep(0.0005)
                start = time.perf_counter()
                process.stdin.write(b".")
                process.stdout.read(1)
                seconds.append(time.perf_counter() - start)
        finally:
            os.sched_setaffinity(0, set(cores))
        process.stdin.close()
    return statistics.median(seconds)


class ServiceProcess(ServiceCommand):
    """``holdfast serve`` on loopback; ready within a ``with`` statement, killed at its end.

    Parameters
    ----------
    options : str
        Further ones.
    protocol : str, optional
        Of its endpoint.
    """

    def __init__(self, *options: str, protocol: str = "tcp") -> None:
        self._options = options
        port = free_port()
        super().__init__(self._started, f"{protocol}/127.0.0.1:{port}", port)

    @property
    def process_ids(self) -> list[int]:
        """Return its process id and those of the processes that it has started."""
        own = self.process.pid
        children = Path(f"/proc/{own}/task/{own}/children").read_text()
        return [own, *map(int, children.split())]

    def wait_ready(self) -> float:
        """Wait until it is ready; return since when."""
        return self.process.wait_for("ready", timeout_s=_READY_TIMEOUT_S).at

    def close(self) -> None:
        """End it, and wait for that."""
        self.process.kill()
        self.process.close(_READY_TIMEOUT_S)

    def __enter__(self) -> ServiceProcess:
        self.start()
        try:
            self.wait_ready()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _started(self) -> Process:
        return Process(
            (*HOLDFAST, "serve", "--listen", self.endpoint, "--log", "json", *self._options)
        )


class EchoProcess:
    """A bare echo: see echo.py."""

    def __init__(self) -> None:
        self.port = free_port()
        self._process = subprocess.Popen(
            [sys.executable, str(_ECHO), str(self.port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        assert self._process.stdout is not None
        self._process.stdout.readline()

    def __enter__(self) -> EchoProcess:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()
