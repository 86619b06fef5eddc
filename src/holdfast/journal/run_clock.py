"""One clock for a run: that of the machine since its boot, which nobody sets.

The wall clock of a robot may be set while it runs: by a time server, or on a board that starts in
1970. Durations and orders then come out wrong, by an hour or by half a century. So each time in
``events.jsonl`` and ``timings.csv`` has beside it how long the machine has been up, and which boot
that was. Within a boot the wall clock says only when it was, by its last reading, which is the one
that was set right; what came before is shifted with it. Between two boots there is no other clock
than the wall's. Where even that goes back, or was never set, a boot is put right before the next.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable
from itertools import pairwise
from typing import NamedTuple

from holdfast.journal.journal_file import boot_id

_NS_PER_S = 1_000_000_000

_STEP_NS = _NS_PER_S // 2
"""Between two readings, from which on the wall clock was set; a slow correction is less."""

_LEAST_WALL_NS = 1_577_836_800 * _NS_PER_S
"""The year 2020: a clock that is behind this was not set yet."""

_BETWEEN_BOOTS_NS = _NS_PER_S

_CLOSE_NS = 1_000_000
_MOST_READINGS = 5
"""A reading of both clocks takes a microsecond."""

_UPTIME = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # the first counts suspended time

_BOOT = (boot_id() or os.urandom(4).hex())[:8]


class Stamp(NamedTuple):
    """How long a machine has been up since a boot."""

    boot: str
    uptime_ns: int

    @classmethod
    def of(cls, boot: object, uptime_s: object) -> Stamp | None:
        """Read what a file has of it; None if that is damaged or not there."""
        try:
            uptime_ns = round(float(uptime_s) * 1e6) * 1000  # type: ignore[arg-type]
        except (TypeError, ValueError, OverflowError):
            return None
        # Nothing is up for a thousand years: a number that is too large for an array.
        valid = isinstance(boot, str) and boot and 0 <= uptime_ns < 2**62
        return cls(boot, uptime_ns) if valid else None  # type: ignore[arg-type]

    @property
    def uptime_s(self) -> str:
        """The time as files have it."""
        return f"{self.uptime_ns // _NS_PER_S}.{self.uptime_ns % _NS_PER_S // 1000:06d}"


def read_clocks(wall: Callable[[], int] = time.time_ns) -> tuple[int, Stamp]:
    """Return nanoseconds since 1970, and the time since the boot of this machine at that moment."""
    for _ in range(_MOST_READINGS):
        before, now, after = _uptime_ns(), wall(), _uptime_ns()
        if after - before < _CLOSE_NS:
            break  # else the process has stood still between them
    return now, Stamp(_BOOT, (before + after) // 2)


def _uptime_ns() -> int:
    return time.clock_gettime_ns(_UPTIME)


class RunClock:
    """Says when something was, from its stamp and the reading of the wall clock at the time.

    ``readings`` are all that there are, with nanoseconds since 1970; of two boots the earlier one
    comes first. ``notes`` say how the wall clock was set.
    """

    def __init__(self, readings: Iterable[tuple[Stamp | None, int]]) -> None:
        boots: dict[str, list[tuple[int, int]]] = {}
        for stamp, wall_ns in readings:
            if stamp is not None:
                boots.setdefault(stamp.boot, []).append((stamp.uptime_ns, wall_ns))
        notes: list[str] = []
        self._offsets: dict[str, int] = {}
        next_ns: int | None = None
        for boot, read in reversed(boots.items()):
            read.sort()
            offsets = [wall_ns - uptime_ns for uptime_ns, wall_ns in read]
            steps_ns = [later - earlier for earlier, later in pairwise(offsets)]
            set_ns = sum(step_ns for step_ns in steps_ns if abs(step_ns) >= _STEP_NS)
            if set_ns:
                notes.append(
                    f"the robot's clock was set by {set_ns / _NS_PER_S:+,.1f} s while it ran; "
                    "times before are shifted by that"
                )
            offset, last_ns = offsets[-1], read[-1][0] + offsets[-1]
            if next_ns is not None and not _LEAST_WALL_NS <= last_ns <= next_ns:
                offset += next_ns - _BETWEEN_BOOTS_NS - last_ns
                notes.append(
                    "the robot's clock was behind before it was started again: how long that took "
                    "is not known, and one second is shown"
                )
            self._offsets[boot] = offset
            next_ns = read[0][0] + offset
        self.notes = tuple(reversed(notes))

    def time_ns(self, stamp: Stamp | None, wall_ns: int) -> int:
        """Return nanoseconds since 1970; those of the wall clock where there is no stamp."""
        if stamp is None or stamp.boot not in self._offsets:
            return wall_ns
        return stamp.uptime_ns + self._offsets[stamp.boot]
