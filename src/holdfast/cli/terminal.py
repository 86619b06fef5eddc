"""What a person at a terminal sees of a run: how far it is, what it came to, where its files are.

Progress goes to the standard error, so that the standard output holds results alone.
"""

from __future__ import annotations

import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from holdfast.configuration import Configuration
    from holdfast.outcome import TrialResult
    from holdfast.recording.tables import RunSummary

__all__ = [
    "LiveDisplay",
    "PlainDisplay",
    "QuietDisplay",
    "RunDisplay",
    "counted",
    "duration",
    "print_files",
    "print_summary",
    "run_display",
]

_PLAIN_INTERVAL_S = 5.0
"""Without a terminal, at most one line of progress in this time: logs stay short."""


class RunDisplay(Protocol):
    """Shows how far a run is."""

    def start(self, finished: int, successes: int, directory: Path) -> None:
        """Begin, with what an earlier part of the run has finished."""
        ...

    def show(self, result: TrialResult) -> None:
        """Count one more finished trial."""
        ...

    def stop(self) -> None:
        """End, and leave the terminal as it was."""
        ...


def run_display(configuration: Configuration, *, quiet: bool) -> RunDisplay:
    """Return what suits the standard error: a moving line, a line now and then, or nothing.

    Parameters
    ----------
    configuration : Configuration
        Of the run.
    quiet : bool
        Whether to show nothing.
    """
    if quiet:
        return QuietDisplay()
    if sys.stderr.isatty():
        from rich.console import Console

        return LiveDisplay(configuration, Console(stderr=True))
    return PlainDisplay(configuration)


class QuietDisplay:
    """Shows nothing."""

    def start(self, finished: int, successes: int, directory: Path) -> None:
        """Begin, with what an earlier part of the run has finished."""
        del finished, successes, directory

    def show(self, result: TrialResult) -> None:
        """Count one more finished trial."""
        del result

    def stop(self) -> None:
        """Do nothing."""


class _Counter:
    """How many trials are finished, and how fast."""

    def __init__(self, configuration: Configuration) -> None:
        self.name = configuration.problem_name
        self.seed = configuration.simulator.seed
        self.total = configuration.simulator.num_trials
        self.finished = 0
        self.successes = 0
        self.finished_before = 0
        self.started = 0.0

    def start(self, finished: int, successes: int) -> None:
        self.finished = self.finished_before = finished
        self.successes = successes
        self.started = perf_counter()

    def count(self, result: TrialResult) -> None:
        self.finished += 1
        self.successes += result.success

    def title(self, directory: Path) -> str:
        text = f"{self.name}, {counted(self.total, 'trial')}, seed {self.seed}"
        if self.finished_before:
            text += f", {self.finished_before} finished before"
        return f"{text}; results in {directory}"

    def rate(self) -> float | None:
        elapsed_s = perf_counter() - self.started
        new = self.finished - self.finished_before
        return new / elapsed_s if new and elapsed_s > 0.0 else None

    def success_text(self) -> str:
        return f"{100.0 * self.successes / self.finished:.1f} %" if self.finished else "-"

    def rate_text(self) -> str:
        rate = self.rate()
        return "-" if rate is None else f"{rate:.3g} trials/s"


class PlainDisplay:
    """A line now and then, for logs."""

    def __init__(self, configuration: Configuration) -> None:
        self._counter = _Counter(configuration)
        self._last = 0.0

    def start(self, finished: int, successes: int, directory: Path) -> None:
        """Begin, with what an earlier part of the run has finished."""
        self._counter.start(finished, successes)
        self._last = perf_counter()
        sys.stderr.write(self._counter.title(directory) + "\n")
        sys.stderr.flush()

    def show(self, result: TrialResult) -> None:
        """Count one more finished trial."""
        counter = self._counter
        counter.count(result)
        now = perf_counter()
        if now - self._last < _PLAIN_INTERVAL_S or counter.finished == counter.total:
            return
        self._last = now
        rate = counter.rate()
        left = "" if rate is None else f", {duration((counter.total - counter.finished) / rate)}"
        sys.stderr.write(
            f"{counter.finished}/{counter.total} trials, success {counter.success_text()}, "
            f"{counter.rate_text()}{left} left\n"
        )
        sys.stderr.flush()

    def stop(self) -> None:
        """Do nothing."""


class LiveDisplay:
    """A line that moves, for people."""

    def __init__(self, configuration: Configuration, console: Console) -> None:
        self._counter = _Counter(configuration)
        self._console = console
        self._progress: Progress | None = None

    def start(self, finished: int, successes: int, directory: Path) -> None:
        """Begin, with what an earlier part of the run has finished."""
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        self._counter.start(finished, successes)
        self._console.print(self._counter.title(directory), highlight=False)
        self._progress = Progress(
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn("trials"),
            TextColumn("success {task.fields[success]}", style="green"),
            TextColumn("{task.fields[rate]}", style="cyan"),
            TimeElapsedColumn(),
            TextColumn("left", style="dim"),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
            expand=True,
        )
        self._task = self._progress.add_task(
            "trials",
            total=self._counter.total,
            completed=finished,
            success=self._counter.success_text(),
            rate="-",
        )
        self._progress.start()

    def show(self, result: TrialResult) -> None:
        """Count one more finished trial."""
        self._counter.count(result)
        if self._progress is not None:
            self._progress.update(
                self._task,
                completed=self._counter.finished,
                success=self._counter.success_text(),
                rate=self._counter.rate_text(),
            )

    def stop(self) -> None:
        """Take the line away."""
        if self._progress is not None:
            self._progress.stop()


def print_summary(summary: RunSummary) -> None:
    """Print what a run came to."""
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold")
    table.add_column()
    for label, value in _summary_rows(summary):
        table.add_row(label, value)
    console = Console(highlight=False)
    console.print(table)


def _summary_rows(summary: RunSummary) -> list[tuple[str, str]]:
    from holdfast.belief import UNEXPLAINED_DEVIATIONS_SQUARED
    from holdfast.runtime.own_planner import OWN_PLANNER

    rows = []
    if summary.success_rate is not None and summary.success_rate_interval_95 is not None:
        low, high = summary.success_rate_interval_95
        rows.append(
            (
                "success",
                f"{100 * summary.success_rate:.1f} %  ({summary.successes} of {summary.finished}; "
                f"95 % interval {100 * low:.1f} to {100 * high:.1f} %)",
            )
        )
    if summary.mean_reward is not None:
        value = f"{summary.mean_reward:.4g}"
        if summary.mean_reward_of_successes is not None:
            value += f"  (successful trials: {summary.mean_reward_of_successes:.4g})"
        rows.append(("mean reward", value))
    if summary.mean_steps is not None:
        rows.append(("mean steps", f"{summary.mean_steps:.4g}"))
    if summary.sensing_ms_median is not None:
        rows.append(
            (
                "sensing time",
                f"{summary.sensing_ms_median:.3g} ms median, {summary.sensing_ms_p99:.3g} ms p99  "
                f"({counted(summary.sensing_decisions, 'decision')})",
            )
        )
    if summary.unexplained_observations:
        deviations = f"{UNEXPLAINED_DEVIATIONS_SQUARED**0.5:g}"
        rows.append(
            (
                "unexplained",
                f"{summary.unexplained_observations:,} of "
                f"{counted(summary.sensing_decisions, 'observation')} over {deviations} sigma "
                "from every particle",
            )
        )
    by_service = summary.sensing_decisions_by_service
    if by_service and set(by_service) != {OWN_PLANNER}:
        shares = ", ".join(f"{service} {count:,}" for service, count in by_service.items())
        rows.append(("decided by", shares))
        if summary.longest_wait_ms is not None:
            wait_ms = summary.longest_wait_ms
            text = f"{wait_ms:,.0f}" if wait_ms >= 100.0 else f"{wait_ms:.3g}"
            rows.append(("longest wait", f"{text} ms for a decision"))
    rows.append(("wall time", duration(summary.wall_time_s)))
    rows.append(("digest", summary.digest[:16]))
    return rows


def print_files(directory: Path) -> None:
    """Print which files a run has left.

    Parameters
    ----------
    directory : Path
        Of the run.
    """
    from holdfast.recording.run_directory import output_names

    names = [name for name in output_names() if (directory / name).exists()]
    sys.stdout.write(f"\n{directory}/\n  {'  '.join(names)}\n")
    sys.stdout.flush()


def counted(count: int, noun: str) -> str:
    """Return a count with its noun: ``1 trial``, ``1,000 trials``."""
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def duration(seconds: float) -> str:
    """Return a time as a person says it: ``0.25 s``, ``3 min 05 s``."""
    if seconds < 60.0:
        return f"{seconds:.1f} s" if seconds >= 1.0 else f"{seconds:.2g} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"
