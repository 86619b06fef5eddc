"""Services as processes of their own, what they use of the machine, and what crosses their wire."""

from __future__ import annotations

import contextlib
import json
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

__all__ = [
    "CountingProxy",
    "EchoProcess",
    "ServiceProcess",
    "Usage",
    "free_tcp_port",
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
    resident_bytes : int
    threads : int
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


def free_tcp_port() -> int:
    """Return a port on which nothing listens now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class ServiceProcess:
    """``holdfast serve`` on loopback.

    Parameters
    ----------
    port : int, optional
        Where it listens; a free one by default.
    options : str
        Further ones.
    protocol : str, optional
        Of its endpoint.

    Attributes
    ----------
    started_at, ready_at : float
        Of :func:`time.monotonic`: just before it was started, and when its ready line came.
    """

    def __init__(self, *options: str, port: int | None = None, protocol: str = "tcp") -> None:
        self.port = free_tcp_port() if port is None else port
        self._protocol = protocol
        self._options = options
        self._process: subprocess.Popen[str] | None = None
        self._ready = threading.Event()
        self.started_at = self.ready_at = 0.0

    @property
    def endpoint(self) -> str:
        """Where robots find it."""
        return f"{self._protocol}/127.0.0.1:{self.port}"

    @property
    def process_id(self) -> int:
        """Of the process that runs."""
        assert self._process is not None
        return self._process.pid

    @property
    def process_ids(self) -> list[int]:
        """Of it and of the processes that it has started."""
        own = self.process_id
        children = Path(f"/proc/{own}/task/{own}/children").read_text()
        return [own, *map(int, children.split())]

    def start(self) -> None:
        """Start it; returns at once."""
        command = [sys.executable, "-m", "holdfast", "serve", "--listen", self.endpoint]
        self._ready = threading.Event()
        self.started_at = time.monotonic()
        self._process = subprocess.Popen(
            [*command, "--log", "json", *self._options],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        threading.Thread(target=self._await_line, args=(self._process,), daemon=True).start()

    def wait_ready(self) -> None:
        """Wait for its ready line."""
        if not self._ready.wait(_READY_TIMEOUT_S) or self.ready_at == 0.0:
            raise RuntimeError(f"the service at {self.endpoint} did not become ready")

    def kill(self) -> float:
        """Kill it as ``kill -9`` does; return when."""
        assert self._process is not None
        at = time.monotonic()
        self._process.kill()
        return at

    def close(self) -> None:
        """End it, and wait for that."""
        process, self._process = self._process, None
        if process is not None:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()

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

    def _await_line(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        line = process.stdout.readline()
        at = time.monotonic()
        self.ready_at = at if line and json.loads(line)["event"] == "ready" else 0.0
        self._ready.set()


class EchoProcess:
    """A bare echo: see echo.py.

    Attributes
    ----------
    port : int
    """

    def __init__(self) -> None:
        self.port = free_tcp_port()
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
    port : int
        On loopback, to which connections are passed on.

    Attributes
    ----------
    port : int
        Where it listens itself.
    to_service, to_robot : int
        Bytes so far: what TCP carries, without the headers of TCP and below.
    """

    def __init__(self, port: int) -> None:
        self._target = port
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
