"""A command as a process of its own, and all processes that come from it.

They inherit a mark in their environment, so a test finds them without asking the command.
"""

import os
import signal
import subprocess
import sys
import time
import uuid
from pathlib import Path

from holdfast_lab.testbed.processes import marked_processes

MARK = "HOLDFAST_TEST_MARK"
PATIENCE_S = 240.0


class MarkedCommand:
    """A command of holdfast without a terminal, the leader of nothing but itself."""

    def __init__(self, directory: Path, name: str, *arguments: str, **variables: str) -> None:
        self.out = directory / "out"
        self._mark = uuid.uuid4().hex
        self.process = subprocess.Popen(
            [sys.executable, "-m", "holdfast", name, "--out", str(self.out), *arguments],
            cwd=directory,
            env={**os.environ, MARK: self._mark, **variables},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def others(self) -> dict[int, str]:
        """Return the processes that live and came from it, by what they were asked to do."""
        found = marked_processes(MARK, self._mark)
        return {pid: _command_of(pid) for pid in found if pid != self.process.pid}

    def wait_until(self, what: str, *, present: bool) -> None:
        """Wait until a command line has something in it, or none has; "" is in all of them."""
        deadline = time.monotonic() + PATIENCE_S
        while any(what in command for command in self.others().values()) != present:
            assert time.monotonic() < deadline, f"{what}: {self.others()}"
            time.sleep(0.02)

    def end(self) -> tuple[str, str]:
        return self.process.communicate(timeout=PATIENCE_S)

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        for pid in self.others():
            os.kill(pid, signal.SIGKILL)


def _command_of(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().replace(b"\0", b" ").decode()
    except OSError:
        return ""
