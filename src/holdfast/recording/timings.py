"""How long each decision of a run took, and who made it: a row for each, as it is made.

These times are for people and figures; nothing is decided by them. So a row is handed to the
operating system at once but not forced to the disk, and what a crash cuts off is cut off here too
when the run goes on. (The times in the tables of the trials come from the journal.)
"""

from __future__ import annotations

import csv
import time
from collections import Counter
from collections.abc import Callable, Container
from pathlib import Path
from typing import NamedTuple

from holdfast.files import OutputError
from holdfast.session.effects import Timing

__all__ = ["TIMING_COLUMNS", "AnswerCounts", "TimingTable", "count_answers"]

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


class AnswerCounts(NamedTuple):
    """Who made the decisions of a run.

    Attributes
    ----------
    sensing, task : dict of str to int
        Sensing decisions, and answers with task actions, of each service; the busiest first.
    longest_wait_ms : float or None
        The longest time that the robot stood still for a decision; None if there was none.
    """

    sensing: dict[str, int]
    task: dict[str, int]
    longest_wait_ms: float | None


def count_answers(path: Path, trials: Container[int]) -> AnswerCounts | None:
    """Count the rows of a run's ``timings.csv``.

    Parameters
    ----------
    path : Path
    trials : container of int
        Those that count.

    Returns
    -------
    AnswerCounts or None
        None if there is no such table. A row that is damaged does not count. A decision that was
        asked for again, because the robot was killed before it could use it, counts once: as what
        it came to at last.
    """
    sensing: Counter[str] = Counter()
    task: Counter[str] = Counter()
    longest_ms: float | None = None
    current: int | None = None
    decided: dict[tuple[int, str], str] = {}  # of one trial: they are run one after another

    def settle() -> None:
        for (_, kind), service in decided.items():
            (sensing if kind == "sensing" else task)[service] += 1
        decided.clear()

    try:
        with path.open(encoding="utf-8", errors="replace", newline="") as file:
            for row in csv.reader(line.replace("\0", "") for line in file):
                try:
                    trial, step, kind, service, _, waited_ms = row[:6]
                    number, key, wait_ms = int(trial), (int(step), kind), float(waited_ms)
                except ValueError:
                    continue  # the head, or a row that a power cut has spoilt
                if number not in trials:
                    continue
                if number != current:
                    settle()
                    current = number
                decided[key] = service
                longest_ms = wait_ms if longest_ms is None else max(longest_ms, wait_ms)
    except (OSError, csv.Error):
        return None
    settle()
    return AnswerCounts(dict(sensing.most_common()), dict(task.most_common()), longest_ms)


def _cut_off_unfinished_line(path: Path) -> None:
    with path.open("rb+") as file:
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)
