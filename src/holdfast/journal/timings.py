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
from collections.abc import Callable, Container, Iterable, Iterator
from datetime import datetime
from pathlib import Path
from typing import NamedTuple

from holdfast.errors import OutputError
from holdfast.journal.run_clock import Stamp, read_clocks
from holdfast.printable import cell
from holdfast.protocol.robot_events import Timing, VerificationNoted
from holdfast.runtime.files import bounded_lines


class EventTable:
    """A table with a row for each event of a kind, open for more.

    Its columns are the event's fields, and the times as ``events.jsonl`` has them: the wall
    clock's, which boot of the machine this is, and how long it lasts. ``kind`` is Timing for
    ``timings.csv``, VerificationNoted for ``verification.csv``; ``clock`` returns nanoseconds since
    1970. Raises OutputError if it cannot be written; so does :meth:`add`.
    """

    def __init__(
        self,
        path: Path,
        kind: type[Timing | VerificationNoted],
        *,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._path = path
        self._clock = clock
        try:
            if path.exists():
                _cut_off_unfinished_line(path)
            self._file = path.open("a", buffering=1, encoding="utf-8", newline="")
            self._writer = csv.writer(self._file, lineterminator="\n")
            if self._file.tell() == 0:
                self._writer.writerow([*kind._fields, "time", "boot", "uptime_s"])
        except OSError as error:
            raise self._unwritable(error) from error

    def add(self, event: Timing | VerificationNoted) -> None:
        """Add a row."""
        now_ns, stamp = read_clocks(self._clock)
        seconds, rest_ns = divmod(now_ns, 1_000_000_000)
        moment = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(seconds))
        cells = [f"{each:.3f}" if isinstance(each, float) else cell(each) for each in event]
        try:
            self._writer.writerow(
                [*cells, f"{moment}.{rest_ns // 1000:06d}Z", stamp.boot, stamp.uptime_s]
            )
        except OSError as error:
            raise self._unwritable(error) from error

    def _unwritable(self, error: OSError) -> OutputError:
        return OutputError(f"{self._path}: cannot be written: {error.strerror}")

    def close(self) -> None:
        """Close the file; OutputError if what a full disk has left over cannot be written now."""
        try:
            self._file.close()
        except OSError as error:
            raise self._unwritable(error) from error


def _cut_off_unfinished_line(path: Path) -> None:
    with path.open("rb+") as file:
        content = file.read()
        file.truncate(content.rfind(b"\n") + 1)


class VerificationCounts(NamedTuple):
    """How many answers of services were computed again."""

    verified_answers: int  # decisions that were compared
    # By service: those that differ from the decision of the robot's own planner.
    wrong_answers: dict[str, int]
    not_deterministic: int  # those for which the robot's own planner came to two decisions
    # Requests that the robot's own planner was to compute as well and did not: it failed, too many
    # were waiting, or the process ended before.
    unverified_answers: int


def count_verified(path: Path) -> VerificationCounts | None:
    """Count the rows of a run's ``verification.csv``, without damaged ones; None without it."""
    verdicts: Counter[str] = Counter()
    wrong: Counter[str] = Counter()
    asked: set[tuple[str, str]] = set()
    answered: set[tuple[str, str]] = set()
    try:
        for trial, step, service, _, verdict, *_ in _rows(bounded_lines(path), 6):
            verdicts[verdict] += 1
            if verdict in ("asked", "left_out"):
                asked.add((trial, step))
            elif verdict in ("same", "different", "not_deterministic"):
                answered.add((trial, step))
            if verdict == "different":
                wrong[service] += 1
    except (OSError, csv.Error):
        return None
    return VerificationCounts(
        verdicts["same"] + verdicts["different"],
        dict(wrong.most_common()),
        verdicts["not_deterministic"],
        len(asked - answered),
    )


class AnswerCounts(NamedTuple):
    """Who made the decisions of a run."""

    # An answer with task actions holds those up to the next sensing step. The busiest service comes
    # first.
    sensing_decisions_by_service: dict[str, int]
    task_answers_by_service: dict[str, int]
    # The longest time that the robot stood still for a decision; None if there was none.
    longest_wait_ms: float | None


def count_answers(path: Path, trials: Container[int]) -> AnswerCounts | None:
    """Count the rows of some trials in a run's ``timings.csv``; None without it.

    A decision that was requested again, because the robot was killed before it could use it, counts
    once: as the answer that was used.
    """
    counts: dict[str, Counter[str]] = {"sensing": Counter(), "task": Counter()}
    longest_ms: float | None = None
    current: int | None = None
    decided: dict[tuple[int, str], str] = {}  # of one trial: they are run one after another

    def count() -> None:
        for (_, kind), service in decided.items():
            counts["sensing" if kind == "sensing" else "task"][service] += 1
        decided.clear()

    try:
        for row in read_timings(path):
            trial, step, kind, service, _, waited_ms, *_ = row.timing
            if trial not in trials:
                continue
            if trial != current:
                count()
                current = trial
            decided[step, kind] = service
            longest_ms = waited_ms if longest_ms is None else max(longest_ms, waited_ms)
    except (OSError, csv.Error):
        return None
    count()
    sensing, task = (dict(each.most_common()) for each in counts.values())
    return AnswerCounts(sensing, task, longest_ms)


class TimingRow(NamedTuple):
    """A row of ``timings.csv``, and when it was written; one that is cut short does not say."""

    timing: Timing
    time_ns: int = 0
    stamp: Stamp | None = None


def rows_by_trial(path: Path) -> dict[int, dict[tuple[int, str], TimingRow]]:
    """Return the rows that have a time, by trial, step and kind; empty if there is no table.

    Of a decision that was requested again it is the last row, whose answer was used. Raises
    OutputError if the table cannot be read.
    """
    rows: dict[int, dict[tuple[int, str], TimingRow]] = {}
    try:
        for row in read_timings(path):
            if row.time_ns > 0:
                trial, step, kind, *_ = row.timing
                rows.setdefault(trial, {})[step, kind] = row
    except FileNotFoundError:
        return {}
    except (OSError, csv.Error) as error:
        raise OutputError(f"{path}: cannot be read: {error}") from error
    return rows


def read_timings(path: Path) -> Iterator[TimingRow]:
    """Yield the rows of a run's ``timings.csv``, without the head and damaged rows."""
    return timings_of(bounded_lines(path))


def timings_of(lines: Iterable[str]) -> Iterator[TimingRow]:
    """Yield what lines of ``timings.csv`` say."""
    for trial, step, kind, service, status, waited_ms, *rest in _rows(lines, 6):
        try:
            place = int(trial), int(step), kind
            timing = Timing(*place, service, status, float(waited_ms), math.nan, math.nan)
        except ValueError:
            continue
        row = TimingRow(timing)
        with contextlib.suppress(ValueError):
            round_trip_ms, computed_ms, moment, *uptime = rest
            row = TimingRow(
                timing._replace(round_trip_ms=float(round_trip_ms), computed_ms=float(computed_ms)),
                nanoseconds(moment),
                Stamp.of(*uptime) if len(uptime) == 2 else None,
            )
        yield row


def nanoseconds(moment: str) -> int:
    """Return nanoseconds since 1970 of a time in one of our files.

    Raises ValueError if it is none, or has no time zone.
    """
    parsed = datetime.fromisoformat(moment)
    if parsed.tzinfo is None:
        raise ValueError(moment)
    seconds = int(parsed.replace(microsecond=0).timestamp())
    return 1_000_000_000 * seconds + 1000 * parsed.microsecond


def _rows(lines: Iterable[str], least: int) -> Iterator[list[str]]:
    """Yield the rows of a table that have enough columns."""
    for row in csv.reader(line.replace("\0", "") for line in lines):
        if len(row) >= least:
            yield row
