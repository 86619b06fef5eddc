"""A real Ray cluster on this machine: a head that computes nothing, and workers of a core each."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import monotonic, sleep
from typing import Self

from holdfast.runtime.parent_death import parent_death_prefix
from holdfast_lab.testbed.processes import free_port

_ROOT = Path(__file__).parents[2]

_START_S = 90.0
_END_S = 20.0
_JOIN_ATTEMPTS = 4
_OBJECT_STORE_BYTES = 80_000_000  # about the least that Ray takes
_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    # Its client server forks between gRPC's threads.
    "GRPC_ENABLE_FORK_SUPPORT": "0",
    "PYTHONPATH": str(_ROOT),  # where the studies are
}


class _Node:
    """A node, that is all processes of its session."""

    def __init__(self, arguments: Sequence[str], log: Path) -> None:
        self._log = log
        # Its processes end with it, and it ends with this one.
        command = [
            *parent_death_prefix(),
            sys.executable,
            "-m",
            "ray.scripts.scripts",
            "start",
            "--block",
        ]
        command += ["--min-worker-port", "0", "--max-worker-port", "0"]
        command += ["--object-store-memory", str(_OBJECT_STORE_BYTES), *arguments]
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **_ENVIRONMENT},
                start_new_session=True,
            )

    def wait_for_start(self) -> None:
        began = monotonic()
        while b"runtime started" not in self._log.read_bytes():
            if self._process.poll() is not None or monotonic() > began + _START_S:
                raise RuntimeError(f"a node did not start: {self._log.read_text()}")
            sleep(0.1)

    def busy(self) -> list[int]:
        """Return the processes that compute a task of an executor."""
        return [
            number
            for number in self._processes()
            if _command_line(number).startswith(b"ray::compute_encoded")
        ]

    def kill(self) -> None:
        """End all of it at once."""
        began = monotonic()
        while (left := self._processes()) and monotonic() < began + _END_S:
            for number in left:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(number, signal.SIGKILL)
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(0.1)
        self._process.wait(_END_S)

    def close(self) -> None:
        """Ask it to end; then it is killed."""
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_END_S)
        self.kill()

    def _processes(self) -> list[int]:
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                # The name, in parentheses, may hold anything.
                fields = (folder / "stat").read_text().rpartition(")")[2].split()
                if int(fields[3]) == self._process.pid and fields[0] != "Z":
                    found.append(int(folder.name))
        return found


def _command_line(process: int) -> bytes:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/cmdline").read_bytes()
    return b""


class RayCluster:
    """A head and some workers, each a node of its own."""

    def __init__(self, num_workers: int) -> None:
        # The paths of its sockets have little room.
        self._directory = Path(tempfile.mkdtemp(prefix="hf-ray-"))
        self._nodes: list[_Node] = []
        port, client_port = free_port(), free_port()
        self.address = f"ray://127.0.0.1:{client_port}"
        self.native_address = f"127.0.0.1:{port}"
        head = ["--head", "--num-cpus", "0", "--port", str(port), "--include-dashboard=false"]
        head += ["--ray-client-server-port", str(client_port)]
        head += ["--node-ip-address", "127.0.0.1", "--temp-dir", str(self._directory / "r")]
        try:
            # One after the other: together they would take each other's ports.
            self._start(head)
            for _ in range(num_workers):
                self._start(["--address", self.native_address, "--num-cpus", "1"])
            _wait_for_port(client_port)
            self._wait_for_client_server()
        except BaseException:
            self.close()
            raise

    def _start(self, arguments: Sequence[str]) -> None:
        node = _Node(arguments, self._directory / f"{len(self._nodes)}.log")
        self._nodes.append(node)
        node.wait_for_start()

    def _wait_for_client_server(self) -> None:
        """Join once: the first server that it starts for a client may fail, and is not repeated."""
        program = f"import ray; ray.init({self.address!r}, log_to_driver=False); ray.shutdown()"
        for _ in range(_JOIN_ATTEMPTS):
            joined = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
            if joined.returncode == 0:
                return
        raise RuntimeError(f"the client server starts nothing: {joined.stderr}")

    def busy(self) -> list[int]:
        """Return the processes that compute a task."""
        return [process for node in self._nodes for process in node.busy()]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End all of it."""
        for node in reversed(self._nodes):
            node.close()
        shutil.rmtree(self._directory, ignore_errors=True)


def _wait_for_port(port: int) -> None:
    began = monotonic()
    while True:
        try:
            socket.create_connection(("127.0.0.1", port), 1.0).close()
        except OSError:
            if monotonic() > began + _START_S:
                raise
            sleep(0.1)
        else:
            return
