"""What a process holds, from outside: memory, descriptors, threads, over time."""

import statistics
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

_MOST_GROWTH = 0.05
_MOST_GROWTH_BYTES = 8 << 20


class Held(NamedTuple):
    """What a process holds at a moment."""

    at_s: float
    memory_bytes: int
    descriptors: int
    threads: int


def held_by(pid: int, began_s: float) -> Held | None:
    """Measure a process; None if it has ended."""
    folder = Path(f"/proc/{pid}")
    try:
        status = dict(
            line.split(":", 1) for line in (folder / "status").read_text().splitlines() if line
        )
        descriptors = sum(1 for _ in (folder / "fd").iterdir())
    except OSError:
        return None
    if "VmRSS" not in status:
        return None
    memory_bytes = 1024 * int(status["VmRSS"].split()[0])
    return Held(time.monotonic() - began_s, memory_bytes, descriptors, int(status["Threads"]))


class Watch:
    """Measures a process at intervals, from a thread of its own."""

    def __init__(self, pid: int, interval_s: float = 0.5) -> None:
        self._pid = pid
        self._interval_s = interval_s
        self._began_s = time.monotonic()
        self._stopped = threading.Event()
        self.samples: list[Held] = []
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> list[Held]:
        """Measure no more; return what was measured."""
        self._stopped.set()
        self._thread.join()
        return self.samples

    def _run(self) -> None:
        while not self._stopped.wait(self._interval_s):
            held = held_by(self._pid, self._began_s)
            if held is not None:
                self.samples.append(held)


def flatness(samples: Sequence[Held]) -> tuple[dict[str, object], list[str]]:
    """Tell whether a process holds no more at the end than in the middle.

    In the first third tables fill up to their bounds (sessions, epochs, threads that send) and
    allocators find their size; after that nothing may grow. So the median of the last third is
    compared with that of the second. The allowance, the larger of 5 % and 8 MB, is what was seen
    to come and go by itself as states of different sizes are held: a leak of ten bytes a message
    shows beyond it in a million messages.
    """
    third = len(samples) // 3
    assert third >= 3, f"only {len(samples)} samples"
    parts = (samples[:third], samples[third : 2 * third], samples[2 * third :])
    memory = [statistics.median(each.memory_bytes for each in part) for part in parts]
    descriptors = [max(each.descriptors for each in part) for part in parts]
    threads = [max(each.threads for each in part) for part in parts]
    figures: dict[str, object] = {
        "seconds": round(samples[-1].at_s),
        "median_memory_mb_by_thirds": [round(each / 2**20, 1) for each in memory],
        "most_memory_mb": round(max(each.memory_bytes for each in samples) / 2**20, 1),
        "most_descriptors_by_thirds": descriptors,
        "most_threads_by_thirds": threads,
        "last_descriptors": samples[-1].descriptors,
    }
    faults = []
    allowed = max(_MOST_GROWTH * memory[1], _MOST_GROWTH_BYTES)
    if memory[2] > memory[1] + allowed:
        faults.append(f"memory grew from {memory[1]:.0f} to {memory[2]:.0f} bytes")
    if descriptors[2] > max(descriptors[:2]) + 20:
        faults.append(f"descriptors grew: {descriptors}")
    if threads[2] > max(threads[:2]) + 4:
        faults.append(f"threads grew: {threads}")
    return figures, faults
