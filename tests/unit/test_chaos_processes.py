"""What a command as a process of its own can be made to do, and how it is found."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from queue import SimpleQueue

import pytest

from holdfast.chaos.processes import (
    CannotStartError,
    ChildProcess,
    Ended,
    Written,
    free_port,
    local_services_of,
    marked_processes,
)

PATIENCE_S = 30.0


def test_ports_are_free_and_not_given_to_connections() -> None:
    first_outgoing = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    for _ in range(20):
        port = free_port()
        assert port < first_outgoing
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", port))


def test_a_command_becomes_another_one(tmp_path: Path) -> None:
    happened: SimpleQueue[Written | Ended] = SimpleQueue()
    child = ChildProcess(
        ["--version"],
        tmp_path / "log",
        {**os.environ},
        happened.put,
        prefix=("env", "-u", "HOLDFAST_SIMD"),
    )
    first, second = (happened.get(timeout=PATIENCE_S) for _ in range(2))
    child.close(PATIENCE_S)
    assert isinstance(first, Written)
    assert first.line.startswith("holdfast ")
    assert isinstance(second, Ended)
    assert second.code == 0
    assert (tmp_path / "log").read_text() == f"{first.line}\n"
    with pytest.raises(CannotStartError, match="serve cannot be started: No such file"):
        ChildProcess(["serve"], tmp_path / "log", {}, happened.put, prefix=("absent-command",))


def test_a_command_stands_still_and_goes_on(tmp_path: Path) -> None:
    happened: SimpleQueue[Written | Ended] = SimpleQueue()
    listen = f"tcp/127.0.0.1:{free_port()}"
    child = ChildProcess(
        ["serve", "--listen", listen, "--log", "json"],
        tmp_path / "log",
        {**os.environ},
        happened.put,
    )
    try:
        ready = happened.get(timeout=PATIENCE_S)
        assert isinstance(ready, Written)
        assert '"ready"' in ready.line
        child.stop()
        os.waitid(os.P_PID, child.process.pid, os.WSTOPPED)
        child.terminate()
        assert child.process.poll() is None
        child.resume()
        assert child.process.wait(PATIENCE_S) == 0
    finally:
        child.close(0.0)


class TestFound:
    @staticmethod
    def start(*words: str, **variables: str) -> subprocess.Popen[bytes]:
        program = "import sys; print('up', flush=True); sys.stdin.read()"
        process = subprocess.Popen(
            [sys.executable, "-c", program, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **variables},
        )
        assert process.stdout is not None
        process.stdout.readline()
        return process

    @staticmethod
    def end(process: subprocess.Popen[bytes]) -> None:
        process.communicate(timeout=PATIENCE_S)

    def test_by_its_mark(self) -> None:
        name = "HOLDFAST_TEST_MARK"
        marked = self.start(**{name: "abc"})
        other = self.start(**{name: "abcd"})
        assert marked_processes(name, "abc") == [marked.pid]
        marked.kill()
        deadline = time.monotonic() + PATIENCE_S
        while marked_processes(name, "abc"):  # from here on it waits to be asked for its end
            assert time.monotonic() < deadline
        self.end(marked)
        self.end(other)
        assert marked.returncode == -signal.SIGKILL

    def test_by_its_parent(self) -> None:
        local = self.start("--until-stdin-closes")
        other = self.start("--something")
        assert local_services_of(os.getpid()) == [local.pid]
        assert local_services_of(local.pid) == []
        self.end(local)
        self.end(other)
