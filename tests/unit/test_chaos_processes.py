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
    end_marked_processes,
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


PARENT = """
import os, sys, time
from queue import SimpleQueue
from holdfast.chaos.processes import ChildProcess
from holdfast.runtime.leash import leash
from pathlib import Path
prefix = leash() if sys.argv[2] == "leashed" else ()
listen = ["--listen", sys.argv[3], "--log", "json"]
put = SimpleQueue().put
child = ChildProcess(["serve", *listen], Path(sys.argv[1]), {**os.environ}, put, prefix)
print(child.process.pid, flush=True)
time.sleep(600)
"""


@pytest.mark.parametrize("how", ["leashed", "free"])
def test_a_command_on_a_leash_ends_with_whoever_started_it(tmp_path: Path, how: str) -> None:
    listen = f"tcp/127.0.0.1:{free_port()}"
    log = tmp_path / "log"
    program = [sys.executable, "-c", PARENT, str(log), how, listen]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        deadline = time.monotonic() + PATIENCE_S
        while not (log.exists() and "ready" in log.read_text()):
            assert time.monotonic() < deadline
            time.sleep(0.01)
        parent.kill()
    try:
        if how == "free":
            time.sleep(0.5)
            assert Path(f"/proc/{pid}/exe").exists()
            return
        while _lives(pid):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        if _lives(pid):
            os.kill(pid, signal.SIGKILL)


def _lives(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


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

    def test_and_ended(self) -> None:
        name = "HOLDFAST_TEST_MARK"
        assert end_marked_processes(name, "nobody", 0.0) == []
        marked = self.start(**{name: "def"})
        other = self.start(**{name: "other"})
        assert end_marked_processes(name, "def", 0.0) == [marked.pid]
        self.end(marked)
        self.end(other)
        assert marked.returncode == -signal.SIGKILL
        assert other.returncode == 0

    def test_by_its_parent(self) -> None:
        local = self.start("--until-stdin-closes")
        other = self.start("--something")
        assert local_services_of(os.getpid()) == [local.pid]
        assert local_services_of(local.pid) == []
        self.end(local)
        self.end(other)
