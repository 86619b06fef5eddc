"""The machine and the software of a measurement, by name: a time means something only with them."""

from __future__ import annotations

import hashlib
import re
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import holdfast
from holdfast import __version__, _kernel
from holdfast.config.source_digest import machines
from holdfast.runtime.machine import machine_of_here

_HERE = Path(holdfast.__file__).resolve().parent
_GIT_TIMEOUT_S = 10.0
_SOURCES = ("src", "cpp", "cmake", "CMakeLists.txt")


def describe() -> dict[str, str]:
    """Return the machine and the software, by name."""
    return {
        **machine_of_here(),
        "compiler of the kernel": _compiler(),
        "state machines": machines(),
        "holdfast": f"{__version__}, {commit()}",
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    }


def kernel_hash() -> str:
    """Return a short hash of the kernel's file, to notice that it was built again meanwhile."""
    return hashlib.blake2b(_kernel_bytes(), digest_size=6).hexdigest()


def _kernel_bytes() -> bytes:
    path = _kernel.__file__
    return Path(path).read_bytes() if path else b""


def _compiler() -> str:
    # Compilers leave their name in the file's comment section.
    found = re.findall(rb"GCC: \([^)]*\) [\d.]+|clang version [\d.]+", _kernel_bytes())
    return ", ".join(sorted({name.decode() for name in found})) or "unknown"


def commit() -> str:
    """Return the commit of the sources that run here, and whether they were changed since."""

    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments],
            cwd=_HERE,
            check=True,
            capture_output=True,
            text=True,
            timeout=_GIT_TIMEOUT_S,
        ).stdout.strip()

    try:
        top = Path(git("rev-parse", "--show-toplevel"))
        if not _HERE.is_relative_to(top / "src"):
            return "commit unknown"  # installed somewhere within another repository
        name = git("rev-parse", "--short", "HEAD")
        changed = git("status", "--porcelain", "--", *(str(top / each) for each in _SOURCES))
    except (OSError, subprocess.SubprocessError):
        return "commit unknown"
    return f"commit {name}" + (" with uncommitted changes" if changed else "")
