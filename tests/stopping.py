"""SIGSTOP that has taken effect: until then, threads that run go on for a moment."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

__all__ = ["stop"]

_PATIENCE_S = 30.0
"""Only a process that cannot be stopped takes so long."""


def stop(pid: int) -> None:
    """Stop a process; when this returns, all its threads stand still."""
    os.kill(pid, signal.SIGSTOP)
    deadline = time.monotonic() + _PATIENCE_S
    while not all(_stands_still(thread) for thread in Path(f"/proc/{pid}/task").iterdir()):
        assert time.monotonic() < deadline, f"process {pid} goes on after SIGSTOP"
        time.sleep(0.001)


def _stands_still(thread: Path) -> bool:
    try:
        status = (thread / "stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True  # it has ended
    return status.rpartition(")")[2].split()[0] == "T"
