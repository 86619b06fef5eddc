"""Services as processes of their own, what they use of the machine, and what crosses their wire."""

from __future__ import annotations

import contextlib
import os
import socket
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from holdfast.lab.testbed.driver import ServiceCommand
from holdfast.lab.testbed.processes import HOLDFAST, Process, free_port

__all__ = [
    "CountingProxy",
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
        super().__init__(self._started, f"{protocol}/127.0.0.1:{free_port()}")

    @property
    def process_ids(self) -> list[int]:
        """Of it and of the processes that it has started."""
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


class CountingProxy:
    """Passes a TCP connection on, and counts its bytes.

    Parameters
    ----------
    endpoint : str
        To which connections are passed on.

    Attributes
    ----------
    port : int
        Where it listens itself.
    to_service, to_robot : int
        Bytes so far: what TCP carries, without the headers of TCP and below.
    """

    def __init__(self, endpoint: str) -> None:
        self._target = int(endpoint.rpartition(":")[2])
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self.to_service = self.to_robot = 0
        self._sockets: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def endpoint(self) -> str:
        """Where robots find it."""
        return f"tcp/127.0.0.1:{self.port}"

    @property
    def total(self) -> int:
        """Bytes both ways."""
        return self.to_service + self.to_robot

    def __enter__(self) -> CountingProxy:
        return self

    def __exit__(self, *_: object) -> None:
        for each in self._sockets:
            # The pumps are in a call of these sockets; this lets them go.
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                robot, _ = self._listener.accept()
                service = socket.create_connection(("127.0.0.1", self._target))
                for each in (robot, service):
                    each.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                    self._sockets.append(each)
                for ends in ((robot, service, True), (service, robot, False)):
                    threading.Thread(target=self._pump, args=ends, daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, upwards: bool) -> None:
        with contextlib.suppress(OSError):
            for data in _pieces(source):
                if upwards:
                    self.to_service += len(data)
                else:
                    self.to_robot += len(data)
                sink.sendall(data)
        with contextlib.suppress(OSError):
            sink.shutdown(socket.SHUT_RDWR)


def _pieces(source: socket.socket) -> Iterator[bytes]:
    while data := source.recv(65536):
        yield data
