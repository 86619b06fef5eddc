"""How long each decision of a run took, who made it, and whether it was right: ``timings.csv``.

These tables are for people and figures; no decision depends on them. So a row is handed to the
operating system at once but not forced to the disk, and a row that a crash cut short is removed
when the run goes on. (The times in ``trials.csv`` come from the journal.)
"""

from __future__ import annotations

import contextlib
import csv
import math
import time
from collections import Counter
from collections.abc import Callable, Container, Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from holdfast.errors import OutputError
from holdfast.protocol.events import Timing, VerificationNoted

__all__ = [
    "TIMING_COLUMNS",
    "VERIFICATION_COLUMNS",
    "AnswerCounts",
    "TimingRow",
    "TimingTable",
    "VerificationCounts",
    "VerificationTable",
    "count_answers",
    "count_verified",
    "deciders",
    "nanoseconds",
    "read_timings",
    "rows_by_trial",
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

    Raises
    ------
    OutputError
        If it cannot be written.
    """

    def __init__(self, path: Path, *, clock: Callable[[], int] = time.time_ns) -> None:
        super().__init__(path, VERIFICATION_COLUMNS, clock)

    def add(self, verified: VerificationNoted) -> None:
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
    """How many answers of services were computed again.

    Attributes
    ----------
    verified : int
        Decisions that were compared.
    wrong : dict of str to int
        By service: those that differ from the decision of the robot's own planner.
    not_deterministic : int
        Those for which the robot's own planner came to two decisions.
    unverified : int
        Requests that the robot's own planner was to compute as well and did not: it failed, too
        many were waiting, or the process ended before.
    """

    verified: int
    wrong: dict[str, int]
    not_deterministic: int
    unverified: int


def count_verified(path: Path) -> VerificationCounts | None:
    """Count the rows of a run's ``verification.csv``.

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

    Returns
    -------
    AnswerCounts or None
        None if there is no such table. A decision that was requested again, because the robot was
        killed before it could use it, counts once: as the answer that was used.
    """
    sensing: Counter[str] = Counter()
    task: Counter[str] = Counter()
    longest_ms: float | None = None
    current: int | None = None
    decided: dict[tuple[int, str], str] = {}  # of one trial: they are run one after another

    def count() -> None:
        for (_, kind), service in decided.items():
            (sensing if kind == "sensing" else task)[service] += 1
        decided.clear()

    try:
        for row in read_timings(path):
            if row.trial not in trials:
                continue
            if row.trial != current:
                count()
                current = row.trial
            decided[row.step, row.kind] = row.service
            longest_ms = row.waited_ms if longest_ms is None else max(longest_ms, row.waited_ms)
    except (OSError, csv.Error):
        return None
    count()
    return AnswerCounts(dict(sensing.most_common()), dict(task.most_common()), longest_ms)


def deciders(path: Path, trial: int) -> dict[tuple[int, str], str]:
    """Return which service made each decision of a trial, by step and kind; empty if unknown."""
    try:
        # Of a decision that was requested again, the last row is the one that was used.
        return {
            (row.step, row.kind): row.service for row in read_timings(path) if row.trial == trial
        }
    except (OSError, csv.Error):
        return {}


def rows_by_trial(path: Path) -> dict[int, dict[tuple[int, str], TimingRow]]:
    """Return the rows that have a time, by trial, step and kind; empty if there is no table.

    Raises
    ------
    OutputError
        If the table cannot be read.
    """
    rows: dict[int, dict[tuple[int, str], TimingRow]] = {}
    try:
        for row in read_timings(path):
            if row.is_whole:
                rows.setdefault(row.trial, {})[row.step, row.kind] = row
    except FileNotFoundError:
        return {}
    except (OSError, csv.Error) as error:
        raise OutputError(f"{path}: cannot be read: {error}") from error
    return rows


class TimingRow(NamedTuple):
    """A row of ``timings.csv``; one that is cut short has no times but the first."""

    trial: int
    step: int
    kind: str
    service: str
    status: str
    waited_ms: float
    round_trip_ms: float = math.nan
    computed_ms: float = math.nan
    time_ns: int = 0

    @property
    def is_whole(self) -> bool:
        """Whether no column is missing."""
        return self.time_ns > 0


def read_timings(path: Path) -> Iterator[TimingRow]:
    """Yield the rows of a run's ``timings.csv``, without the head and damaged rows."""
    for row in _rows(path, 6):
        try:
            trial, step, kind, service, status, waited_ms = row[:6]
            read = TimingRow(int(trial), int(step), kind, service, status, float(waited_ms))
        except ValueError:
            continue
        if len(row) == len(TIMING_COLUMNS):
            with contextlib.suppress(ValueError):
                read = read._replace(
                    round_trip_ms=float(row[6]),
                    computed_ms=float(row[7]),
                    time_ns=nanoseconds(row[8]),
                )
        yield read


def nanoseconds(moment: str) -> int:
    """Return nanoseconds since 1970 of a time in one of our files.

    Raises
    ------
    ValueError
        If it is none, or has no time zone.
    """
    parsed = datetime.fromisoformat(moment)
    if parsed.tzinfo is None:
        raise ValueError(moment)
    seconds = int(parsed.replace(microsecond=0).timestamp())
    return 1_000_000_000 * seconds + 1000 * parsed.microsecond


def _rows(path: Path, least: int) -> Iterator[list[str]]:
    """Yield the rows of a table that have enough columns."""
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
