"""What a person at a terminal sees of a run: its progress, its summary and its files.

Progress goes to the standard error, so that the standard output holds results alone.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterable
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING

from holdfast.printable import printable
from holdfast.runtime.files import shown_path

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from holdfast.config.loader import Configuration
    from holdfast.journal.tables import RunSummary
    from holdfast.planning.outcome import TrialResult


_PLAIN_INTERVAL_S = 5.0
"""Without a terminal, at most one line of progress in this time: logs stay short."""


class ProgressLine:
    """Shows how many trials are finished, how fast, and how long the rest will take.

    This one shows nothing.
    """

    def __init__(self, total: int, noun: str, *, speed: bool) -> None:
        self._total = total
        self._noun = noun
        self._shows_speed = speed
        self._finished_before = 0
        self._started = perf_counter()

    def start(self, title: str, finished: int, note: str) -> None:
        """Begin, with what an earlier part has finished."""
        del note
        self._finished_before = finished
        self._started = perf_counter()
        self.say(title)

    def show(self, finished: int, note: str) -> None:
        """Show how many are finished now, with a note."""

    def say(self, text: str) -> None:
        """Show a line that stays."""

    def stop(self) -> None:
        """End, and leave the terminal as it was."""

    def _rate(self, finished: int) -> float | None:
        """Return how many are finished in a second."""
        elapsed_s = perf_counter() - self._started
        new = finished - self._finished_before
        return new / elapsed_s if new and elapsed_s > 0.0 else None

    def _speed(self, rate: float | None) -> str:
        if not self._shows_speed:
            return ""
        return "-" if rate is None else f"{rate:.3g} {self._noun}s/s"


def progress_line(
    total: int, *, quiet: bool, noun: str = "trial", speed: bool = True
) -> ProgressLine:
    """Return what suits the standard error: a moving line, a line now and then, or nothing."""
    if quiet:
        return ProgressLine(total, noun, speed=speed)
    return (_Live if sys.stderr.isatty() else _Plain)(total, noun, speed=speed)


class _Plain(ProgressLine):
    """A line now and then, for logs."""

    _last = 0.0

    def start(self, title: str, finished: int, note: str) -> None:
        super().start(title, finished, note)
        self._last = self._started

    def show(self, finished: int, note: str) -> None:
        now = perf_counter()
        if now - self._last < _PLAIN_INTERVAL_S or finished == self._total:
            return
        self._last = now
        rate = self._rate(finished)
        left = "" if rate is None else f"{duration((self._total - finished) / rate)} left"
        parts = (f"{finished}/{self._total} {self._noun}s", note, self._speed(rate), left)
        self.say(", ".join(filter(None, parts)))

    def say(self, text: str) -> None:
        sys.stderr.write(f"{printable(text)}\n")
        sys.stderr.flush()


class _Live(ProgressLine):
    """A line that moves, for people at a terminal."""

    _progress: Progress | None = None

    def start(self, title: str, finished: int, note: str) -> None:
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
            TimeRemainingColumn,
        )

        super().start(title, finished, note)
        self._progress = Progress(
            BarColumn(bar_width=None),
            MofNCompleteColumn(),
            TextColumn(f"{self._noun}s"),
            TextColumn("{task.fields[note]}", style="green"),
            TextColumn("{task.fields[rate]}", style="cyan"),
            TimeElapsedColumn(),
            TextColumn("left", style="dim"),
            TimeRemainingColumn(),
            console=self._console,
            transient=True,
            expand=True,
        )
        self._task = self._progress.add_task(
            "trials", total=self._total, completed=finished, note=note, rate="-"
        )
        self._progress.start()

    def show(self, finished: int, note: str) -> None:
        if self._progress is not None:
            rate = self._speed(self._rate(finished))
            self._progress.update(self._task, completed=finished, note=note, rate=rate)

    def say(self, text: str) -> None:
        self._console.print(printable(text), highlight=False, markup=False, soft_wrap=True)

    def stop(self) -> None:
        if self._progress is not None:
            self._progress.stop()

    @functools.cached_property
    def _console(self) -> Console:
        from rich.console import Console

        return Console(stderr=True)


class RunDisplay:
    """Shows how far a run is; ``earlier`` are the results of an earlier part of it."""

    def __init__(
        self, configuration: Configuration, earlier: Iterable[TrialResult], *, quiet: bool
    ) -> None:
        self._configuration = configuration
        self._line = progress_line(configuration.simulator.num_trials, quiet=quiet)
        self._finished = 0
        self._successes = 0
        self._failures = 0
        for result in earlier:
            self._count(result)

    def start(self, directory: Path) -> None:
        """Begin."""
        simulator = self._configuration.simulator
        title = (
            f"{self._configuration.problem_name}, {counted(simulator.num_trials, 'trial')}, "
            f"seed {simulator.seed}"
        )
        if self._finished:
            title += f", {self._finished} finished before"
        self._line.start(
            f"{title}; results in {shown_path(directory)}", self._finished, self._note()
        )

    def show(self, result: TrialResult) -> None:
        """Count one more finished trial."""
        self._count(result)
        self._line.show(self._finished, self._note())

    def stop(self) -> None:
        """End, and leave the terminal as it was."""
        self._line.stop()

    def _count(self, result: TrialResult) -> None:
        self._finished += 1
        self._successes += result.success
        self._failures += result.failed

    def _note(self) -> str:
        share = f"{100.0 * self._successes / self._finished:.1f} %" if self._finished else "-"
        return f"success {share}" + (f", {self._failures:,} failed" if self._failures else "")


class RecomputingDisplay:
    """Shows how many recorded decisions were computed again; nothing if none is to be."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._line: ProgressLine | None = None

    def show(self, done: int, total: int) -> None:
        """Show how many were, and of how many."""
        if self._line is None:
            self._line = progress_line(total, quiet=self._quiet, noun="decision")
            self._line.start("another version began this run: its decisions, again", 0, "the same")
        self._line.show(done, "the same")

    def close(self) -> None:
        """End, and leave the terminal as it was."""
        if self._line is not None:
            self._line.stop()


def print_summary(summary: RunSummary) -> None:
    """Print the summary of a run."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold")
    table.add_column()
    for label, value in _summary_rows(summary):
        # Not as markup: tcp/[fe80::1]:7447 is no style.
        table.add_row(label, Text(printable(value)))
    console = Console(highlight=False)
    console.print(table)


def _verified_text(summary: RunSummary) -> str:
    parts = [f"{counted(summary.verified_answers or 0, 'answer')} computed again on the robot"]
    wrong = summary.wrong_answers or {}
    if wrong:
        found = ", ".join(f"{count:,} of {service}" for service, count in wrong.items())
        parts[0] += f": WRONG: {found}"
    elif summary.verified_answers:
        parts[0] += ": all the same"
    if summary.not_deterministic:
        parts.append(f"{summary.not_deterministic:,} not deterministic")
    if summary.unverified_answers:
        parts.append(f"{summary.unverified_answers:,} not verified")
    return "; ".join(parts)


def _summary_rows(summary: RunSummary) -> list[tuple[str, str]]:
    from holdfast.planning.belief import VALIDATION_GATE_SQUARED
    from holdfast.planning.lost import MAX_OUTSIDE
    from holdfast.protocol.question import OWN_PLANNER

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
    if summary.failures:
        truncated = summary.finished - summary.successes - summary.failures
        others = f" ({truncated:,} truncated)" if truncated else ""
        failed = f"{summary.failures:,} of {counted(summary.finished, 'trial')}{others}"
        rows.append(("failed", failed))
    if summary.mean_reward is not None:
        value = f"{summary.mean_reward:.4g}"
        if summary.mean_reward_of_successes is not None:
            value += f"  (successful trials: {summary.mean_reward_of_successes:.4g})"
        rows.append(("mean reward", value))
    if summary.mean_steps is not None:
        rows.append(("mean steps", f"{summary.mean_steps:.4g}  (of the steps made)"))
    if summary.sensing_ms_median is not None:
        rows.append(
            (
                "sensing time",
                f"{summary.sensing_ms_median:.3g} ms median, {summary.sensing_ms_p99:.3g} ms p99  "
                f"({counted(summary.sensing_decisions, 'decision')})",
            )
        )
    if summary.missing_observations:
        shown = f"{summary.missing_observations:,} of {counted(summary.sensing_decisions, 'look')}"
        rows.append(("no reading", f"{shown} had no observation"))
    if summary.unexplained_observations:
        deviations = f"{VALIDATION_GATE_SQUARED**0.5:g}"
        number = summary.unexplained_observations
        looks = summary.sensing_decisions - summary.missing_observations
        # Of the moves that have shown something there is no number here.
        shown = counted(looks, "observation") if number <= looks else "the looks and moves"
        far = f"{number:,} of {shown} over {deviations} sigma from every particle"
        rows.append(("unexplained", far))
        if number > MAX_OUTSIDE * looks:  # more than the test of a lost robot allows for
            remedy = "take more particles (particle_filter.num_particles), or check the model"
            rows.append(("", remedy))
    if summary.lost or summary.suspect_sensors:
        suspects = counted(summary.suspect_sensors, "suspect sensor")
        rows.append(("lost", f"{counted(summary.lost, 'time')}, {suspects} (see trials.csv)"))
    by_service = summary.sensing_decisions_by_service
    if by_service and set(by_service) != {OWN_PLANNER}:
        shares = ", ".join(f"{service} {count:,}" for service, count in by_service.items())
        rows.append(("decided by", shares))
        if summary.longest_wait_ms is not None:
            wait_ms = summary.longest_wait_ms
            text = f"{wait_ms:,.0f}" if wait_ms >= 100.0 else f"{wait_ms:.3g}"
            rows.append(("longest wait", f"{text} ms for a decision"))
    if summary.verified_answers or summary.unverified_answers:
        rows.append(("verified", _verified_text(summary)))
    rows.append(("wall time", duration(summary.wall_time_s)))
    rows.append(("digest", summary.digest[:16]))
    return rows


def print_files(directory: Path) -> None:
    """Print which files a run has left in its directory."""
    from holdfast.journal.run_directory import OUTPUT_NAMES

    names = [name for name in OUTPUT_NAMES if (directory / name).exists()]
    sys.stdout.write(printable(f"\n{shown_path(directory)}/\n  {'  '.join(names)}\n"))
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
