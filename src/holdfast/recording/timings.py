"""How long each decision of a run took, and who made it: a row for each, as it is made.

These times are for people and figures; nothing is decided by them. So a row is handed to the
operating system at once but not forced to the disk, and what a crash cuts off is cut off here too
when the run goes on.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from holdfast.files import OutputError
from holdfast.session.effects import Timing

__all__ = ["TIMING_COLUMNS", "TimingTable"]

TIMING_COLUMNS = (
    "trial",
    "step",
    "kind",
    "service",
    "status",
    "waited_ms",
    "round_trip_ms",
    "computed_ms",
    "time",
)


class TimingTable:
    """The file ``timings.csv`` of a run, open for more rows.

    The last column says when the decision was carried out, as ``events.jsonl`` writes times.

    Parameters
    ----------
    path : Path
        Appended to if it is there.
    clock : callable
        Returns nanoseconds since the epoch.

    Raises
    ------
    OutputError
        If it cannot be written.
    """

    def __init__(self, path: Path, *, clock: Callable[[], int] = time.time_ns) -> None:
        self._path = path
        self._clock = clock
        try:
            if path.exists():
                _cut_off_unfinished_line(path)
            self._file = path.open("a", buffering=1, encoding="utf-8", newline="")
            if self._file.tell() == 0:
                self._file.write(",".join(TIMING_COLUMNS) + "\n")
        except OSError as error:
            raise OutputError(f"{path}: cannot be written: {error.strerror}") from error

    def add(self, timing: Timing) -> None:
        """Add a row.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        service = timing.service.replace('"', '""')
        if any(character in service for character in ',"\n'):
            service = f'"{service}"'
        seconds, rest_ns = divmod(self._clock(), 1_000_000_000)
        moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))
        try:
            self._file.write(
                f"{timing.trial},{timing.step},{timing.kind},{service},{timing.status},"
                f"{timing.waited_ms:.3f},{timing.round_trip_ms:.3f},{timing.computed_ms:.3f},"
                f"{moment}.{rest_ns // 1000:06d}Z\n"
            )
        except OSError as error:
            raise OutputError(f"{self._path}: cannot be written: {error.strerror}") from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _cut_off_unfinished_line(path: Path) -> None:
    with path.open("rb+") as file:
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)
