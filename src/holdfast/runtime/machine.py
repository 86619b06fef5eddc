"""The machine and what runs on it, by name: a time means something only with them."""

from __future__ import annotations

import os
import platform
import re
from pathlib import Path

import numpy as np

from holdfast import _kernel


def machine_of_here() -> dict[str, str]:
    """Return the machine and what the kernel runs on, by name."""
    return {
        "processor": _processor(),
        "cores": f"{available_cores()} of {os.cpu_count()} usable",
        "memory": _memory(),
        "system": f"{platform.system()} {_major_version(platform.release())}, {platform.machine()}",
        "Python": f"{platform.python_implementation()} {platform.python_version()}",
        "NumPy": np.__version__,
        "instruction set": _kernel.simd(),
    }


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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


def _major_version(release: str) -> str:
    return ".".join(release.split(".")[:2])
