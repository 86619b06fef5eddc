"""``holdfast chaos``: real processes, real faults, and whether anything but time was lost."""

from __future__ import annotations

import contextlib
import io
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from holdfast.cli.exit_codes import EXIT_DIFFERENT, ended_by_signals, interrupted_by
from holdfast.config.validation import close_match
from holdfast.errors import HoldfastError, OptionError, RunError
from holdfast.printable import printable
from holdfast.runtime.command_line import (
    MAX_SEED,
    MAX_TRIALS,
    Options,
    flag,
    location,
    option,
    whole_number,
)

if TYPE_CHECKING:
    from rich.console import Console

    from holdfast.cli.terminal import ProgressLine
    from holdfast.lab.chaos.report import ChaosSummary
    from holdfast.lab.chaos.schedule import Wire
    from holdfast.lab.chaos.series import Series, SeriesPlan
    from holdfast.lab.chaos.trial import TrialOutcome
    from holdfast.lab.testbed.fault_times import Spread
    from holdfast.lab.testbed.faults import FaultKind

__all__ = ["main"]

_RUNS = Path("runs")
_MAX_TRIALS = 100_000
_DEFAULT_TRIALS = 20
_MAX_JOBS = 64
_TABLE_NAME = "table.txt"
_WIDE = 142
"""Characters that the whole table needs; on a narrower terminal a part of it is left out."""

_N_EXPLAINED = (
    "n: faults after which this was measured. After the others it did not come to it: the robot "
    "did not need what was struck, or its run was over."
)
_DASH_EXPLAINED = (
    "-: never measured. A robot cannot report its own death, and no robot returns to a local "
    "service; times of faults that overlap (combination) belong to none of them."
)


class ChaosOptions(Options):
    """Kill, stop, delay and cut real processes, and compare each run with one without faults.

    A trial is one robot (holdfast run) and one or two services (holdfast serve), with faults drawn
    from the seed and the trial's number. Afterwards every decision must be that of a run without
    faults, and the world, which keeps a list of its own, must have been acted on exactly once and
    in order.

    DIR gets table.txt, chaos.csv (a row for each fault), summary.json and trials.jsonl (a line for
    each trial, as it ends). The files of a trial that went wrong are kept.

    Ctrl-C ends all processes; the same command with --resume goes on.
    """

    exit_codes: ClassVar = {
        0: "every trial was identical with the run without faults",
        1: "a trial was not",
    }

    trials: int = option(
        metavar="N",
        read=whole_number(1, _MAX_TRIALS),
        default=_DEFAULT_TRIALS,
        help="Number of trials.",
    )
    seed: int = option(
        metavar="S",
        read=whole_number(0, MAX_SEED),
        default=0,
        help="Seed of all that happens.",
    )
    out: Path | None = option(
        "-o",
        metavar="DIR",
        read=location,
        help="Directory for the results (default: runs/chaos, numbered if taken).",
    )
    only: tuple[str, ...] = option(
        "--only",
        "--kind",
        metavar="KIND",
        many=True,
        help="Only trials of this kind, as --list names them (default: all that can be done here).",
    )
    wire: tuple[str, ...] = option(
        metavar="WIRE",
        many=True,
        help="Only trials over this wire: tcp, tls, unix or udp (default: all in turns).",
    )
    jobs: int = option(
        "-j",
        metavar="N",
        read=whole_number(1, _MAX_JOBS),
        default=1,
        help="Trials at the same time; each has four or five processes, so times get longer.",
    )
    first: int = option(
        metavar="T",
        read=whole_number(0, MAX_TRIALS),
        default=0,
        help="Number of the first trial.",
    )
    resume: bool = flag(help="Go on with the series in DIR.")
    keep: bool = flag(help="Keep the files of good trials as well.")
    list: bool = flag(help="List the kinds of fault, and which can be done here.")


def main(arguments: Sequence[str]) -> int:
    """Run the series and return the exit code."""
    options = ChaosOptions.parse("chaos", arguments)
    if options.list:
        _list_kinds()
        return 0
    with ended_by_signals(once=True):
        return 0 if _run(options) else EXIT_DIFFERENT


def _list_kinds() -> None:
    from holdfast.lab.testbed.faults import DESCRIPTIONS

    left_out = _impossible_kinds()
    for kind, description in DESCRIPTIONS.items():
        note = f" (not here: {left_out[kind]})" if kind in left_out else ""
        sys.stdout.write(f"{kind.value:24} {description}{note}\n")
    sys.stdout.flush()


def _impossible_kinds() -> dict[FaultKind, str]:
    """Return what this machine cannot do, and why."""
    from holdfast.lab.testbed.faults import NEEDS_NAMESPACE, FaultKind
    from holdfast.lab.testbed.namespace import why_no_namespace

    impossible = {}
    reason = why_no_namespace()
    if reason is not None:
        impossible = {kind: reason for kind in FaultKind if kind in NEEDS_NAMESPACE}
    if not Path("/proc/self/stat").exists():
        impossible[FaultKind.LOCAL_KILLED] = "the local service's process is found in /proc"
    return impossible


def _chosen_kinds(
    only: Sequence[str], impossible: dict[FaultKind, str]
) -> tuple[tuple[FaultKind, ...], dict[FaultKind, str]]:
    """Return the kinds of a series, and those of the wanted ones that are left out."""
    from holdfast.lab.testbed.faults import FaultKind

    for name in only:
        if name not in list(FaultKind):
            hint = close_match(name.replace("-", "_"), list(FaultKind))
            raise OptionError(f"--only is {name!r}; allowed are {', '.join(FaultKind)}{hint}")
    wanted = [kind for kind in FaultKind if kind in only] if only else list(FaultKind)
    kinds = tuple(kind for kind in wanted if kind not in impossible)
    if not kinds:
        kind = wanted[0]
        raise OptionError(f"--only {kind.value} cannot be done here: {impossible[kind]}")
    return kinds, {kind: impossible[kind] for kind in wanted if kind in impossible}


def _chosen_wires(names: Sequence[str]) -> tuple[Wire, ...]:
    from holdfast.lab.chaos.schedule import WIRES

    for name in names:
        if name not in WIRES:
            hint = close_match(name, WIRES)
            raise OptionError(f"--wire is {name!r}; allowed are {', '.join(WIRES)}{hint}")
    return tuple(wire for wire in WIRES if not names or wire in names)


def _run(options: ChaosOptions) -> bool:
    from holdfast.cli.terminal import progress_line
    from holdfast.files import claim_directory
    from holdfast.lab.chaos.report import summarise, write_tables
    from holdfast.lab.chaos.schedule import kinds_over
    from holdfast.lab.chaos.series import Series, SeriesPlan
    from holdfast.lab.testbed.faults import FaultKind
    from holdfast.recording.machine import commit

    impossible = _impossible_kinds()
    kinds, left_out = _chosen_kinds(options.only, impossible)
    wires = _chosen_wires(options.wire)
    trials, jobs = options.trials, options.jobs
    over = tuple(wire for wire in wires if kinds_over(wire, kinds))
    if not over:
        raise OptionError(
            f"--only {kinds[0].value} cannot be done over {wires[0]}: choose another --wire"
        )
    if options.resume and options.out is None:
        raise OptionError("--resume needs --out: which series is to go on")
    possible = tuple(kind for kind in FaultKind if kind not in impossible)
    plan = SeriesPlan(
        seed=options.seed,
        first=options.first,
        wires=over,
        kinds=kinds,
        possible=possible,
        commit=commit().removeprefix("commit "),
    )
    directory = options.out
    if not options.resume or directory is None:
        directory = claim_directory(directory, _RUNS, "chaos")
    series = Series(directory, plan, resume=options.resume, keep=options.keep)
    show = _Show(progress_line(trials, quiet=False), plan, series, trials)
    show.start(directory, jobs, left_out)
    words = options.words("out", "resume")
    out = options.table()["out"].words(directory)
    again = shlex.join(["holdfast", "chaos", *words, *out, "--resume"])
    try:
        try:
            series.run(trials, jobs, show.started, show.ended)
        finally:
            # First of all the terminal; after SIGHUP there is none to write to.
            with contextlib.suppress(OSError):
                show.stop()
            summary = summarise(plan, series.outcomes, trials=trials, jobs=jobs, left_out=left_out)
            write_tables(directory, summary, series.outcomes)
            _write_table(summary, directory / _TABLE_NAME)
    except KeyboardInterrupt as interruption:
        how = interrupted_by(interruption)
        # Anew: a second signal may have come before the first summary was there.
        summary = summarise(plan, series.outcomes, trials=trials, jobs=jobs, left_out=left_out)
        sys.stderr.write(
            f"\n{how}; all processes are ended. "
            f"{summary.finished} of {trials} trials are finished\nGo on with: {printable(again)}\n"
        )
        raise
    except HoldfastError as error:
        raise RunError(error, again) from error
    show.conclude(summary, directory)
    return summary.identical == summary.finished


class _Show:
    """Shows a series."""

    def __init__(self, line: ProgressLine, plan: SeriesPlan, series: Series, trials: int) -> None:
        self._line = line
        self._plan = plan
        self._series = series
        self._trials = trials
        self._going_on: dict[int, FaultKind] = {}

    def start(self, directory: Path, jobs: int, left_out: dict[FaultKind, str]) -> None:
        from holdfast.cli.terminal import counted

        finished = len(self._series.outcomes)
        title = f"chaos, {counted(self._trials, 'trial')}, seed {self._plan.seed}"
        if jobs > 1:
            title += f", {jobs} at a time"
        if finished:
            title += f", {finished} finished before"
        self._line.start(f"{title}; results in {directory}", finished, self._note())
        for reason in dict.fromkeys(left_out.values()):
            kinds = ", ".join(kind.value for kind, why in left_out.items() if why == reason)
            self._line.say(f"left out: {kinds}: {reason}")

    def started(self, trial: int, kind: FaultKind) -> None:
        self._going_on[trial] = kind
        self._line.show(len(self._series.outcomes), self._note())

    def ended(self, outcome: TrialOutcome) -> None:
        self._going_on.pop(outcome.trial, None)
        self._line.show(len(self._series.outcomes), self._note())
        if outcome.verdict != "identical":
            self._line.say(self._account(outcome))

    def stop(self) -> None:
        self._line.stop()

    def conclude(self, summary: ChaosSummary, directory: Path) -> None:
        self._print_table(summary)
        wrong = [outcome for outcome in self._series.outcomes if outcome.verdict != "identical"]
        for outcome in sorted(wrong, key=lambda outcome: outcome.trial):
            sys.stdout.write(printable(f"\n{self._account(outcome)}\n"))
        names = sorted(path.name for path in directory.iterdir() if path.is_file())
        sys.stdout.write(f"\n{directory}/\n  {'  '.join(names)}\n")
        sys.stdout.flush()

    @staticmethod
    def _print_table(summary: ChaosSummary) -> None:
        from rich.console import Console

        console = Console(highlight=False)
        if not console.is_terminal:
            console = Console(highlight=False, width=_WIDE)
        console.print()
        _print_table(summary, console)

    def _note(self) -> str:
        wrong = sum(outcome.verdict != "identical" for outcome in self._series.outcomes)
        note = f"{wrong} wrong"
        if self._going_on:
            note += f", now {', '.join(kind.value for kind in self._going_on.values())}"
        return note

    def _account(self, outcome: TrialOutcome) -> str:
        """Say what went wrong, where its files are, and how to do it again."""
        return (
            f"trial {outcome.trial} ({outcome.kind.value} over {outcome.wire}): "
            f"{outcome.verdict}: {outcome.reason}\n"
            f"  its files: {self._series.directory_of(outcome.trial)}\n"
            f"  again: holdfast chaos --trials 1 --first {outcome.trial} --seed {self._plan.seed} "
            f"--only {outcome.kind.value} --wire {outcome.wire} --keep"
        )


def _write_table(summary: ChaosSummary, path: Path) -> None:
    """Write the table as it is printed where there is room for it."""
    from rich.console import Console

    from holdfast.files import write_atomically

    console = Console(file=io.StringIO(), width=_WIDE, highlight=False, color_system=None)
    with console.capture() as capture:
        _print_table(summary, console)
    write_atomically(path, capture.get())


def _print_table(summary: ChaosSummary, console: Console) -> None:
    from rich.table import Table
    from rich.text import Text

    from holdfast.cli.terminal import counted

    wide = console.width >= _WIDE
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False)
    table.add_column("kind of trial", no_wrap=True)
    for name in ("trials", "faults", "wrong") if wide else ("trials", "wrong"):
        table.add_column(name, justify="right")
    for name in ("detection", "recovery", "launch", "failback"):
        head = f"{name}, ms\n   n median   p95   max" if wide else f"{name}\nmedian max"
        table.add_column(head, justify="right", no_wrap=True)
    for row in summary.kinds:
        wrong = Text(str(row.wrong), style="bold red" if row.wrong else "")
        counts = [str(row.trials), str(row.faults)] if wide else [str(row.trials)]
        spreads = (row.detection, row.recovery, row.launch, row.failback)
        cells = (_cell(spread, wide=wide) for spread in spreads)
        table.add_row(row.kind.value, *counts, wrong, *cells)
    console.print(table)
    console.print()
    if wide:
        console.print(_N_EXPLAINED)
    console.print(_DASH_EXPLAINED)
    bad = summary.finished - summary.identical
    if bad:
        verdict = (
            f"{bad} of {counted(summary.finished, 'trial')} went wrong ({summary.diverged} "
            f"diverged, {summary.failed} failed, {summary.timed_out} timed out)"
        )
    else:
        trials = counted(summary.identical, "trial")
        verdict = f"no divergence: {trials} with {counted(summary.faults, 'fault')}"
    units = "" if wide else "Times in milliseconds. "
    console.print(
        f"\n{units}{verdict}, over {_counted_wires(summary.wires)}; {summary.steps:,} task actions "
        f"and {summary.sensing_actions:,} sensing actions are those of the runs without faults",
        style="bold red" if bad else "",
    )


def _counted_wires(wires: dict[str, int]) -> str:
    return ", ".join(f"{wire} ({number})" for wire, number in sorted(wires.items())) or "no wire"


def _cell(spread: Spread | None, *, wide: bool) -> str:
    if spread is None:
        return "-"
    if wide:
        times = f"{spread.median_ms:6.0f} {spread.p95_ms:5.0f} {spread.max_ms:5.0f}"
        return f"{spread.count:4} {times}"
    return f"{spread.median_ms:.0f} {spread.max_ms:5.0f}"
