"""What a command as a process of its own can be made to do, and how it is found."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from holdfast_lab.errors import CannotStartError, NoProgressError, ProcessEndedError
from holdfast_lab.testbed.processes import (
    HOLDFAST,
    Process,
    ProcessGroup,
    local_services_of,
    marked_processes,
)

PATIENCE_S = 30.0


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
