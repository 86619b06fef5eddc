"""What the numbers were measured on."""

from __future__ import annotations

import hashlib
import os
import platform
import re
import subprocess
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import scipy

import holdfast
from holdfast import _kernel
from holdfast.runtime.trials import available_cores

__all__ = ["describe", "kernel_hash"]

ROOT = Path(__file__).resolve().parents[1]


def describe() -> dict[str, str]:
    """Return the machine and the software, by name."""
    return {
        "processor": _processor(),
        "cores": f"{available_cores()} of {os.cpu_count()} usable",
        "memory": _memory(),
        "system": f"{platform.system()} {_major_version(platform.release())}, {platform.machine()}",
        "Python": f"{platform.python_implementation()} {platform.python_version()}",
        "NumPy, SciPy": f"{np.__version__}, {scipy.__version__}",
        "compiler of the kernel": _compiler(),
        "instruction set": _kernel.simd(),
        "holdfast": f"{holdfast.__version__}, {_commit()}",
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    }


def kernel_hash() -> str:
    """Return a short hash of the kernel's file, to notice that it was built again meanwhile."""
    return hashlib.blake2b(_kernel_bytes(), digest_size=6).hexdigest()


def _kernel_bytes() -> bytes:
    path = _kernel.__file__
    return Path(path).read_bytes() if path else b""


def _processor() -> str:
    try:
        content = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or "unknown"
    fields: dict[str, str] = dict(re.findall(r"^([\w ]+?)\s*: (.*)$", content, re.MULTILINE))
    name = fields.get("model name", platform.machine())
    if {"cpu family", "model"} <= fields.keys():
        name += f" (family {fields['cpu family']}, model {fields['model']})"
    return name


def _memory() -> str:
    try:
        size = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError):
        return "unknown"
    return f"{size / 2**30:.1f} GiB"


def _compiler() -> str:
    # Compilers leave their name in the file's comment section.
    found = re.findall(rb"GCC: \([^)]*\) [\d.]+|clang version [\d.]+", _kernel_bytes())
    return ", ".join(sorted({name.decode() for name in found})) or "unknown"


def _commit() -> str:
    def git(*arguments: str) -> str:
        return subprocess.run(
            ["git", *arguments], cwd=ROOT, check=True, capture_output=True, text=True
        ).stdout.strip()

    try:
        commit = git("rev-parse", "--short", "HEAD")
        changed = git("status", "--porcelain", "--", "src", "cpp", "CMakeLists.txt")
    except (OSError, subprocess.CalledProcessError):
        return "commit unknown"
    return f"commit {commit}" + (" with uncommitted changes" if changed else "")


def _major_version(release: str) -> str:
    return ".".join(release.split(".")[:2])
