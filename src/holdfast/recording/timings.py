"""How long each decision of a run took, who made it, and whether it was right: rows as they come.

These tables are for people and figures; nothing is decided by them. So a row is handed to the
operating system at once but not forced to the disk, and what a crash cuts off is cut off here too
when the run goes on. (The times in the tables of the trials come from the journal.)
"""

from __future__ import annotations

import csv
import time
from collections import Counter
from collections.abc import Callable, Container, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from holdfast.files import OutputError
from holdfast.session.effects import Timing, Verified

__all__ = [
    "TIMING_COLUMNS",
    "VERIFICATION_COLUMNS",
    "AnswerCounts",
    "TimingTable",
    "VerificationCounts",
    "VerificationTable",
    "count_answers",
    "count_verified",
    "deciders",
]

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


VERIFICATION_COLUMNS = ("trial", "step", "service", "kind", "verdict", "time")


class _Table:
    """A file of rows, open for more; its last column says when, as ``events.jsonl`` writes times.

    Parameters
    ----------
    path : Path
        Appended to if it is there.
    columns : sequence of str
    clock : callable
        Returns nanoseconds since the epoch.

    Raises
    ------
    OutputError
        If it cannot be written.
    """

    def __init__(self, path: Path, columns: Sequence[str], clock: Callable[[], int]) -> None:
        self._path = path
        self._clock = clock
        try:
            if path.exists():
                _cut_off_unfinished_line(path)
            self._file = path.open("a", buffering=1, encoding="utf-8", newline="")
            if self._file.tell() == 0:
                self._file.write(",".join(columns) + "\n")
        except OSError as error:
            raise self._unwritable(error) from error

    def _write(self, *values: object) -> None:
        seconds, rest_ns = divmod(self._clock(), 1_000_000_000)
        moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))
        try:
            self._file.write(f"{','.join(map(str, values))},{moment}.{rest_ns // 1000:06d}Z\n")
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> OutputError:
        return OutputError(f"{self._path}: cannot be written: {error.strerror}")

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class TimingTable(_Table):
    """The file ``timings.csv`` of a run: a row for each answer that was used.

    Parameters
    ----------
    path : Path
    clock : callable

    Raises
    ------
    OutputError
        If it cannot be written.
    """

    def __init__(self, path: Path, *, clock: Callable[[], int] = time.time_ns) -> None:
        super().__init__(path, TIMING_COLUMNS, clock)

    def add(self, timing: Timing) -> None:
        """Add a row.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        self._write(
            timing.trial,
            timing.step,
            timing.kind,
            _quoted(timing.service),
            timing.status,
            f"{timing.waited_ms:.3f}",
            f"{timing.round_trip_ms:.3f}",
            f"{timing.computed_ms:.3f}",
        )


class VerificationTable(_Table):
    """The file ``verification.csv`` of a run: a row for each answer that was computed again.

    Parameters
    ----------
    path : Path
    clock : callable

    Raises
    ------
    OutputError
        If it cannot be written.
    """

    def __init__(self, path: Path, *, clock: Callable[[], int] = time.time_ns) -> None:
        super().__init__(path, VERIFICATION_COLUMNS, clock)

    def add(self, verified: Verified) -> None:
        """Add a row.

        Raises
        ------
        OutputError
            If it cannot be written.
        """
        self._write(
            verified.trial,
            verified.step,
            _quoted(verified.service),
            verified.kind,
            verified.verdict,
        )


class VerificationCounts(NamedTuple):
    """How many answers of a run's services were computed again.

    Attributes
    ----------
    verified : int
        Parts of answers that were compared.
    wrong : dict of str to int
        By service: those that are not what the robot's own planner decides.
    not_deterministic : int
        Those of which nothing can be said, because the robot's own planner came to two decisions.
    unverified : int
        Questions that were to be answered by the robot's own planner and were not: it failed, too
        many waited, or the process ended before.
    """

    verified: int
    wrong: dict[str, int]
    not_deterministic: int
    unverified: int


def count_verified(path: Path) -> VerificationCounts | None:
    """Count the rows of a run's ``verification.csv``.

    Parameters
    ----------
    path : Path

    Returns
    -------
    VerificationCounts or None
        None if there is no such table. A row that is damaged does not count.
    """
    verified = not_deterministic = 0
    wrong: Counter[str] = Counter()
    asked: set[tuple[str, str]] = set()
    answered: set[tuple[str, str]] = set()
    try:
        for trial, step, service, _, verdict, *_ in _rows(path, len(VERIFICATION_COLUMNS)):
            if verdict in ("asked", "left_out"):
                asked.add((trial, step))
            elif verdict in ("same", "different", "not_deterministic"):
                answered.add((trial, step))
            verified += verdict in ("same", "different")
            not_deterministic += verdict == "not_deterministic"
            if verdict == "different":
                wrong[service] += 1
    except (OSError, csv.Error):
        return None
    unverified = len(asked - answered)
    return VerificationCounts(verified, dict(wrong.most_common()), not_deterministic, unverified)


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
        for row in _rows(path, 6):
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


def deciders(path: Path, trial: int) -> dict[tuple[int, str], str]:
    """Return who made the decisions of a trial, by step and kind, from ``timings.csv``.

    Parameters
    ----------
    path : Path
    trial : int

    Returns
    -------
    dict
        Empty if there is no such table; of a decision that was asked for again, whose was used.
    """
    decided: dict[tuple[int, str], str] = {}
    try:
        for number, step, kind, service, *_ in _rows(path, 6):
            if number == str(trial) and step.isdigit():
                decided[int(step), kind] = service
    except (OSError, csv.Error):
        return {}
    return decided


def _rows(path: Path, least: int) -> Iterator[list[str]]:
    """Yield the rows of a table, as far as they have enough columns."""
    with path.open(encoding="utf-8", errors="replace", newline="") as file:
        for row in csv.reader(line.replace("\0", "") for line in file):
            if len(row) >= least:
                yield row


def _quoted(service: str) -> str:
    quoted = service.replace('"', '""')
    return f'"{quoted}"' if any(character in quoted for character in ',"\n') else quoted


def _cut_off_unfinished_line(path: Path) -> None:
    with path.open("rb+") as file:
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)
