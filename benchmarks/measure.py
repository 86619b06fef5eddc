"""Clocks and care: how a time is taken here so that it means something on a shared machine.

A machine that others use has fast and slow minutes. What is to be compared is therefore run in
turns, A B A B, within one process where that is possible, and every ratio is the median of the
ratios of neighbouring turns. Times are medians, with the minimum and the 99th percentile beside
them.
"""

from __future__ import annotations

import gc
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from holdfast.numerics.arrays import FloatArray

__all__ = [
    "OtherLoad",
    "alternate",
    "fitted_exponent",
    "peak_memory_bytes",
    "ratio_of_turns",
    "without_collection",
]


@contextmanager
def without_collection() -> Iterator[None]:
    """Keep Python's garbage collector out of what is timed."""
    enabled = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def alternate(
    calls: Mapping[str, Callable[[], object]],
    turns: int,
    repetitions: int | Mapping[str, int] = 1,
) -> dict[str, FloatArray]:
    """Time calls in turns.

    Parameters
    ----------
    calls : mapping
        What to time, by name. Each is called once before, untimed.
    turns : int
        How often all of them have their turn.
    repetitions : int or mapping
        How often a call is repeated in its turn.

    Returns
    -------
    dict of array of shape (turns, repetitions)
        Seconds of every single call.
    """
    often = {
        name: repetitions if isinstance(repetitions, int) else repetitions[name] for name in calls
    }
    seconds = {name: np.empty((turns, often[name])) for name in calls}
    for call in calls.values():
        call()
    clock = time.perf_counter
    with without_collection():
        for turn in range(turns):
            for name, call in calls.items():
                row = seconds[name][turn]
                for i in range(often[name]):
                    start = clock()
                    call()
                    row[i] = clock() - start
    return seconds


def ratio_of_turns(slow: FloatArray, fast: FloatArray) -> float:
    """Return the median over the turns of the ratio of a turn's medians."""
    return float(np.median(np.median(slow, axis=1) / np.median(fast, axis=1)))


def fitted_exponent(sizes: list[int], seconds: list[float]) -> float:
    """Return the b of the least-squares fit of ``a size**b``."""
    slope, _ = np.polyfit(np.log(sizes), np.log(seconds), 1)
    return float(slope)


def peak_memory_bytes() -> int:
    """Return the largest resident size that this process has had.

    ``ru_maxrss`` is no use here: Linux starts it at the size of the process that started this one.
    """
    status = Path("/proc/self/status")
    if status.exists():
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    import resource
    import sys

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


class OtherLoad:
    """How much of the machine's processors others used meanwhile (Linux).

    Counts all processor time that is neither idle nor that of this process and of the children
    that it has waited for.
    """

    def __init__(self) -> None:
        self._start = self._busy()
        self._wall = time.monotonic()

    def cores(self) -> float | None:
        """Return the mean number of cores that others kept busy, or None where unknown."""
        now = self._busy()
        wall = time.monotonic() - self._wall
        if now is None or self._start is None or wall <= 0.0:
            return None
        return max(0.0, (now - self._start) / wall)

    @staticmethod
    def _busy() -> float | None:
        try:
            fields = Path("/proc/stat").read_text().splitlines()[0].split()[1:]
        except OSError:
            return None
        ticks = [int(field) for field in fields]
        idle = ticks[3] + ticks[4]
        total = sum(ticks[:8])  # guests are counted in user and nice already
        own = os.times()
        mine = own.user + own.system + own.children_user + own.children_system
        return (total - idle) / os.sysconf("SC_CLK_TCK") - mine
