"""Programs that a test runs to their end."""

from __future__ import annotations

import subprocess
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
