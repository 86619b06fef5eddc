"""What a command as a process of its own can be made to do, and how it is found."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from tests.process_states import alive

from holdfast_lab.errors import CannotStartError, NoProgressError, ProcessEndedError
from holdfast_lab.testbed.processes import (
    HOLDFAST,
    Process,
    ProcessGroup,
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


def test_output_and_end(tmp_path: Path) -> None:
    command = ("env", "-u", "HOLDFAST_SIMD", *HOLDFAST, "--version")
    log_path = tmp_path / "log"
    process = Process(command, log_path=log_path)
    assert process.close(PATIENCE_S) == 0
    assert process.exit_code == 0
    assert process.last_line().startswith("holdfast ")
    assert log_path.read_text() == f"{process.last_line()}\n"
    with pytest.raises(CannotStartError, match="absent cannot be started: No such file"):
        Process(("absent",))


EVENTS = """
import sys
for name in ("one", "two", "two"):
    print('{"time": "2026-01-01T00:00:00+00:00", "event": "%s"}' % name, flush=True)
print("a word", flush=True)
if sys.argv[1] == "stays":
    sys.stdin.read()
"""


def test_events_are_awaited() -> None:
    process = Process((sys.executable, "-c", EVENTS, "stays"))
    try:
        assert process.wait_for("two", 2).matches("two")
        with pytest.raises(NoProgressError, match=r"no event three .* in 0.1 s"):
            process.wait_for("three", timeout_s=0.1)
    finally:
        process.kill()
        process.close(PATIENCE_S)
    process = Process((sys.executable, "-c", EVENTS, "ends"))
    with pytest.raises(ProcessEndedError, match=r"(?s)no event three .*a word"):
        process.wait_for("three")
    assert process.close(PATIENCE_S) == 0
    assert [event.name for event in process.events] == ["one", "two", "two"]


PARENT = """
import sys, time
from holdfast_lab.testbed.processes import HOLDFAST, Process
from holdfast.runtime.parent_death import parent_death_prefix
from pathlib import Path
prefix = parent_death_prefix() if sys.argv[2] == "leashed" else ()
command = [*prefix, *HOLDFAST, "serve", "--listen", sys.argv[3], "--log", "json"]
print(Process(command, log_path=Path(sys.argv[1])).pid, flush=True)
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
        while alive(pid):
            assert time.monotonic() < deadline
            time.sleep(0.01)
    finally:
        if alive(pid):
            os.kill(pid, signal.SIGKILL)


def test_a_command_is_stopped_and_resumed() -> None:
    listen = f"tcp/127.0.0.1:{free_port()}"
    service = Process((*HOLDFAST, "serve", "--listen", listen, "--log", "json"))
    try:
        service.wait_for("ready")
        service.stop()
        os.waitid(os.P_PID, service.pid, os.WSTOPPED)
        service.process.terminate()
        assert service.process.poll() is None
        service.resume()
        assert service.process.wait(PATIENCE_S) == 0
    finally:
        service.close(0.0)


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
        group, others = ProcessGroup(), ProcessGroup()
        assert group.close(0.0) == []
        marked = self.start(**group.environment({}))
        other = self.start(**others.environment({}))
        assert group.living() == [marked.pid]
        assert group.close(0.0) == [marked.pid]
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
