"""The states of processes, and a SIGSTOP that has taken effect."""

import os
import signal
import time
from pathlib import Path

_PATIENCE_S = 30.0
"""Only a process that cannot be stopped takes so long."""


def state_of(process: int | Path) -> str:
    """Return the state of a process, or of a thread by its folder: ``T`` if stopped, "" if gone."""
    folder = process if isinstance(process, Path) else Path(f"/proc/{process}")
    try:
        # The name, in parentheses, may hold anything.
        return (folder / "stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return ""


def alive(pid: int) -> bool:
    """Tell whether a process has not ended; who should have waited for it may not have."""
    return state_of(pid) not in ("", "Z")


def stop(pid: int) -> None:
    """Stop a process; when this returns, all its threads stand still."""
    os.kill(pid, signal.SIGSTOP)
    deadline = time.monotonic() + _PATIENCE_S
    # The signal comes at once, but threads that run go on for a moment.
    while any(state_of(thread) not in ("", "T") for thread in Path(f"/proc/{pid}/task").iterdir()):
        assert time.monotonic() < deadline, f"process {pid} goes on after SIGSTOP"
        time.sleep(0.001)
