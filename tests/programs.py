"""Programs that a test runs to their end."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any


def completed(
    command: Sequence[str | Path], timeout: float = 600.0, **more: Any
) -> subprocess.CompletedProcess[str]:
    """Return what a program has said, and its exit code, whatever that is."""
    return subprocess.run(
        command, capture_output=True, text=True, check=False, timeout=timeout, **more
    )


def said_by(program: str, *arguments: str, flags: Sequence[str] = ()) -> str:
    """Return what a Python program says in a process of its own, in which it does not fail."""
    done = completed([sys.executable, *flags, "-c", program, *arguments])
    assert done.returncode == 0, done.stderr
    return done.stdout
