"""The command line: options in, a run, and what a person at a terminal wants to see of it.

Nothing below this module prints or exits. Here an error that holdfast raises on purpose, or that a
problem's own code raises, becomes one message and exit code 2; Ctrl-C, SIGTERM and a terminal that
is closed end a run in order, with 128 and the signal's number; and anything else is a defect and
keeps its traceback.

Libraries that take long to import are imported where they are used, so that ``--help`` and a
mistyped option answer at once.
"""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated, Protocol

import typer

from holdfast import __version__
from holdfast.errors import HoldfastError
from holdfast.user_code import account_of_user_error

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress

    from holdfast.configuration import Configuration
    from holdfast.outcome import TrialResult
    from holdfast.recording.recorder import Recorder, TrialRecord
    from holdfast.recording.run_directory import RunDirectory
    from holdfast.recording.tables import RunSummary

__all__ = ["app", "main"]

EXIT_ERROR = 2
EXIT_SIGNAL = 128
"""Added to the number of the signal that ended a run, as shells do it."""

_RUNS = Path("runs")
_PLAIN_INTERVAL_S = 5.0
"""Without a terminal, at most one line of progress in this time: logs stay short."""

app = typer.Typer(
    name="holdfast",
    help=(
        "Action-entropy active sensing: choose what to sense by how much it decides what to do, "
        "and decide the same, bit for bit, on every machine."
    ),
    epilog="Start with: holdfast run examples/peg_in_hole_2d.yaml",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # its tables give flags a value and take a third of the columns
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line and exit."""
    first = sys.argv[1] if len(sys.argv) > 1 else ""
    if first.endswith((".yaml", ".yml")):
        command = shlex.join(["holdfast", "run", *sys.argv[1:]])
        sys.stderr.write(f"holdfast: error: {first} is no command; did you mean: {command}\n")
        sys.exit(EXIT_ERROR)
    try:
        app(prog_name="holdfast")
    except HoldfastError as error:
        sys.stderr.write(f"holdfast: error: {error}\n")
        sys.exit(EXIT_ERROR)
    except KeyboardInterrupt:
        sys.exit(EXIT_SIGNAL + signal.SIGINT)


class _EndedBySignal(KeyboardInterrupt):
    """A signal other than Ctrl-C's ended the run."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.signal = signal.Signals(number)


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end what is inside as Ctrl-C does, and exit with their numbers."""

    def end(number: int, frame: object) -> None:
        del frame
        # One is enough: another would cut short what the first one began.
        for handled in saved:
            signal.signal(handled, signal.SIG_IGN)
        raise _EndedBySignal(number)

    # What is ignored from the start stays so: nohup asks for that.
    saved = {
        number: before
        for number in (signal.SIGTERM, signal.SIGHUP)
        if (before := signal.getsignal(number)) is not signal.SIG_IGN
    }
    try:
        for number in saved:
            signal.signal(number, end)
        yield
    except KeyboardInterrupt as interruption:
        raise typer.Exit(EXIT_SIGNAL + _signal_of(interruption)) from None
    finally:
        for number, before in saved.items():
            signal.signal(number, before)


def _signal_of(interruption: KeyboardInterrupt) -> signal.Signals:
    if isinstance(interruption, _EndedBySignal):
        return interruption.signal
    return signal.SIGINT


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"holdfast {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool,
        typer.Option(
            "--version",
            callback=_print_version,
            is_eager=True,
            help="Show the version and exit.",
        ),
    ] = False,
) -> None:
    del version


@app.command(no_args_is_help=True, short_help="Run the trials of a configuration.")
def run(
    configuration_path: Annotated[
        Path,
        typer.Argument(
            metavar="CONFIG", show_default=False, help="Configuration file (YAML) of the run."
        ),
    ],
    trials: Annotated[
        int | None,
        typer.Option(
            "--trials", metavar="N", min=1, help="Number of trials, instead of the file's."
        ),
    ] = None,
    seed: Annotated[
        int | None,
        typer.Option(
            "--seed", metavar="S", min=0, help="Seed of all random draws, instead of the file's."
        ),
    ] = None,
    problem: Annotated[
        str | None,
        typer.Option(
            "--problem",
            metavar="NAME",
            help="Problem to run, instead of the file's: a registered name or module:Class.",
        ),
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            "-j",
            metavar="N",
            min=1,
            max=1024,
            help=(
                "Largest number of processes (default: one for each core). It changes time only, "
                "never a result."
            ),
            show_default=False,
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            help="Directory for the results (default: runs/CONFIG-seedS, numbered if taken).",
            show_default=False,
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help=(
                "Go on with the run in DIR (default: the latest) and run the missing trials; with "
                "a larger --trials, more than it had."
            ),
        ),
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet",
            "-q",
            help="Show no progress and no summary: only errors. The files are the same.",
        ),
    ] = False,
) -> None:
    """Run the trials of CONFIG and write what they come to into a directory.

    DIR gets trials.csv (a row for each trial), summary.json, config.yaml
    (with all defaults filled in; it can be run again), journal.sqlite (every
    decision of every trial) and trial.png (a figure of trial 0).

    Ctrl-C loses no finished trial: the same command with --resume goes on.
    """
    with _ended_by_signals():
        _run(configuration_path, trials, seed, problem, jobs, out, resume=resume, quiet=quiet)


def _run(
    configuration_path: Path,
    trials: int | None,
    seed: int | None,
    problem: str | None,
    jobs: int | None,
    out: Path | None,
    *,
    resume: bool,
    quiet: bool,
) -> None:
    from holdfast.configuration import load
    from holdfast.recording.recorder import Recorder
    from holdfast.recording.run_directory import (
        RunDirectory,
        claim_default_directory,
        latest_default_directory,
    )
    from holdfast.runtime.trials import available_cores, run_trials

    configuration = load(configuration_path, problem=problem, num_trials=trials, seed=seed)
    if resume:
        directory_path = out or latest_default_directory(configuration, _RUNS)
        directory = RunDirectory.resume(directory_path, configuration)
    else:
        directory_path = out or claim_default_directory(configuration, _RUNS)
        directory = RunDirectory.create(directory_path, configuration)
    with directory:
        earlier = directory.journal.tally()
        display = _display(configuration, quiet=quiet)
        recorder = Recorder(trial=0)
        started = perf_counter()

        def on_result(result: TrialResult) -> None:
            directory.add(result)
            display.show(result)

        try:
            display.start(earlier.finished, earlier.successes, directory_path)
            try:
                run_trials(
                    configuration,
                    jobs or available_cores(),
                    directory.journal.finished(),
                    on_result,
                    recorder,
                )
            except BaseException:
                # After SIGHUP there is no terminal to write to.
                with contextlib.suppress(OSError):
                    display.stop()
                # Tables of what is finished; if the disk is the trouble, the first error says so.
                with contextlib.suppress(HoldfastError):
                    directory.write_tables(perf_counter() - started)
                raise
            display.stop()
            summary = directory.write_tables(perf_counter() - started)
            if not quiet:
                _print_summary(summary)
            notes = _draw_figure(configuration, directory, recorder)
        except KeyboardInterrupt as interruption:
            command = _resume_command(
                configuration_path, trials, seed, problem, jobs, directory_path
            )
            finished = directory.journal.tally().finished
            ended = _signal_of(interruption)
            how = "Interrupted" if ended == signal.SIGINT else f"Ended by {ended.name}"
            with contextlib.suppress(OSError):
                sys.stderr.write(
                    f"\n{how}. {finished} of {configuration.simulator.num_trials} trials are "
                    f"finished and kept in {directory_path}\nGo on with: {command}\n"
                )
            raise
        if not quiet:
            _print_files(directory_path, notes)


def _resume_command(
    configuration_path: Path,
    trials: int | None,
    seed: int | None,
    problem: str | None,
    jobs: int | None,
    directory: Path,
) -> str:
    words = ["holdfast", "run", str(configuration_path)]
    options = (("--trials", trials), ("--seed", seed), ("--problem", problem), ("--jobs", jobs))
    for option, value in options:
        if value is not None:
            words += [option, str(value)]
    return shlex.join([*words, "--out", str(directory), "--resume"])


def _draw_figure(
    configuration: Configuration, directory: RunDirectory, recorder: Recorder
) -> str | None:
    """Draw trial 0 and return None, or what is to be said about it."""
    try:
        from holdfast.recording.figure import trial_figure
    except ImportError as error:
        if error.name is None or error.name.split(".")[0] != "matplotlib":
            raise
        return "no figure, because matplotlib is not installed: pip install matplotlib"

    try:
        note = _draw_trial(configuration, directory, recorder, trial_figure)
    except HoldfastError:
        raise
    except Exception as error:
        account = account_of_user_error(error, configuration.problem_name)
        if account is None:
            raise
        raise HoldfastError(f"the figure of trial {recorder.trial}: {account}") from error
    return note


def _draw_trial(
    configuration: Configuration,
    directory: RunDirectory,
    recorder: Recorder,
    draw: Callable[[Configuration, TrialRecord, Path], None],
) -> str | None:
    from holdfast.recording.run_directory import FIGURE_NAME
    from holdfast.runtime.trial import run_trial

    if recorder.record.result is None:
        # It ran in a worker or in an earlier part of the run; a trial can always be run again.
        run_trial(
            configuration.problem,
            configuration.planning,
            configuration.simulator,
            recorder.trial,
            observer=recorder,
        )
    record: TrialRecord = recorder.record
    note = None
    if record.result is not None and record.result.decisions is not None:
        kept = directory.journal.decisions(recorder.trial)
        if kept.log != record.result.decisions.log:
            note = (
                f"trial {recorder.trial} decided otherwise when it was run again for the figure, "
                f"so the problem {configuration.problem_name} is not deterministic"
            )
    draw(configuration, record, directory.path / FIGURE_NAME)
    return note


# ---------------------------------------------------------------------------------------------
# The terminal
# ---------------------------------------------------------------------------------------------


class _Display(Protocol):
    """Shows how far a run is."""

    def start(self, finished: int, successes: int, directory: Path) -> None: ...

    def show(self, result: TrialResult) -> None: ...

    def stop(self) -> None: ...


def _display(configuration: Configuration, *, quiet: bool) -> _Display:
    if quiet:
        return _NoDisplay()
    if sys.stderr.isatty():
        from rich.console import Console

        return _LiveDisplay(configuration, Console(stderr=True))
    return _PlainDisplay(configuration)


class _NoDisplay:
    """Shows nothing."""

    def start(self, finished: int, successes: int, directory: Path) -> None:
        del finished, successes, directory

    def show(self, result: TrialResult) -> None:
        del result

    def stop(self) -> None:
        pass


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
        text = f"{self.name}, {_counted(self.total, 'trial')}, seed {self.seed}"
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


class _PlainDisplay:
    """A line now and then, for logs."""

    def __init__(self, configuration: Configuration) -> None:
        self._counter = _Counter(configuration)
        self._last = 0.0

    def start(self, finished: int, successes: int, directory: Path) -> None:
        self._counter.start(finished, successes)
        self._last = perf_counter()
        sys.stderr.write(self._counter.title(directory) + "\n")
        sys.stderr.flush()

    def show(self, result: TrialResult) -> None:
        counter = self._counter
        counter.count(result)
        now = perf_counter()
        if now - self._last < _PLAIN_INTERVAL_S or counter.finished == counter.total:
            return
        self._last = now
        rate = counter.rate()
        left = "" if rate is None else f", {_duration((counter.total - counter.finished) / rate)}"
        sys.stderr.write(
            f"{counter.finished}/{counter.total} trials, success {counter.success_text()}, "
            f"{counter.rate_text()}{left} left\n"
        )
        sys.stderr.flush()

    def stop(self) -> None:
        pass


class _LiveDisplay:
    """A line that moves, for people."""

    def __init__(self, configuration: Configuration, console: Console) -> None:
        self._counter = _Counter(configuration)
        self._console = console
        self._progress: Progress | None = None

    def start(self, finished: int, successes: int, directory: Path) -> None:
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
        self._counter.count(result)
        if self._progress is not None:
            self._progress.update(
                self._task,
                completed=self._counter.finished,
                success=self._counter.success_text(),
                rate=self._counter.rate_text(),
            )

    def stop(self) -> None:
        if self._progress is not None:
            self._progress.stop()


def _print_summary(summary: RunSummary) -> None:
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
                f"({_counted(summary.sensing_decisions, 'decision')})",
            )
        )
    if summary.unexplained_observations:
        deviations = f"{UNEXPLAINED_DEVIATIONS_SQUARED**0.5:g}"
        rows.append(
            (
                "surprises",
                f"{summary.unexplained_observations:,} of "
                f"{_counted(summary.sensing_decisions, 'observation')} over {deviations} sigma "
                "from every particle",
            )
        )
    rows.append(("wall time", _duration(summary.wall_time_s)))
    rows.append(("digest", summary.digest[:16]))
    return rows


def _print_files(directory: Path, note: str | None) -> None:
    from holdfast.recording.run_directory import output_names

    names = [name for name in output_names() if (directory / name).exists()]
    typer.echo(f"\n{directory}/\n  {'  '.join(names)}")
    if note is not None:
        typer.echo(f"note: {note}", err=True)


def _counted(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _duration(seconds: float) -> str:
    if seconds < 60.0:
        return f"{seconds:.1f} s" if seconds >= 1.0 else f"{seconds:.2g} s"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min" if hours else f"{minutes} min {rest:02d} s"
