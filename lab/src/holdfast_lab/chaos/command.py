"""``holdfast chaos``: real processes, real faults, and whether anything but time was lost."""

from __future__ import annotations

import contextlib
import shlex
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from holdfast.cli.exit_codes import EXIT_DIFFERENT, ended_by_signals, interrupted_by
from holdfast.errors import OptionError
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
    from collections.abc import Iterable

    from holdfast_lab.chaos.series import Series, SeriesPlan
    from holdfast_lab.chaos.trial import TrialOutcome
    from holdfast_lab.testbed.faults import FaultKind


SUMMARY = "Inject real faults into real runs, and compare them."
"""Its line in ``holdfast --help``."""

_RUNS = Path("runs")
_MAX_TRIALS = 100_000
_DEFAULT_TRIALS = 20
_MAX_JOBS = 64


class ChaosOptions(Options):
    """Kill, stop, delay and cut real processes, and compare each run with one without faults.

    A trial is one robot (holdfast run) and one or two services (holdfast serve), with faults drawn
    from the seed and the trial's number. Afterwards every decision must be that of a run without
    faults, and the world, which keeps a list of its own, must have been acted on exactly once and
    in order.

    DIR gets table.txt, summary.json and trials.jsonl (a line for each trial, as it ends, with the
    times of its faults). The files of a trial that went wrong are kept.

    Ctrl-C ends all processes, and says how to go on (--first).
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
    from holdfast_lab.testbed.faults import DESCRIPTIONS

    left_out = _impossible_kinds()
    for kind, description in DESCRIPTIONS.items():
        note = f" (not here: {left_out[kind]})" if kind in left_out else ""
        sys.stdout.write(f"{kind.value:24} {description}{note}\n")
    sys.stdout.flush()


def _impossible_kinds() -> dict[FaultKind, str]:
    """Return what this machine cannot do, and why."""
    from holdfast_lab.testbed.faults import NEEDS_NAMESPACE, FaultKind
    from holdfast_lab.testbed.namespace import why_no_namespace

    reason = why_no_namespace()
    return {kind: reason for kind in FaultKind if reason is not None and kind in NEEDS_NAMESPACE}


def _chosen(option: str, names: Sequence[str], known: Iterable[str]) -> list[str]:
    """Return those that were named, or all."""
    known = list(known)
    for name in names:
        if name not in known:
            from holdfast.validation import close_match

            hint = close_match(name.replace("-", "_"), known)
            raise OptionError(f"{option} is {name!r}; allowed are {', '.join(known)}{hint}")
    return [each for each in known if not names or each in names]


def _plan_of(options: ChaosOptions) -> tuple[SeriesPlan, dict[FaultKind, str]]:
    """Return the plan of a series, and which of the wanted kinds are left out, and why."""
    from holdfast_lab.chaos.schedule import WIRES, kinds_over
    from holdfast_lab.chaos.series import SeriesPlan
    from holdfast_lab.testbed.faults import FaultKind

    impossible = _impossible_kinds()
    wanted = [FaultKind(name) for name in _chosen("--only", options.only, FaultKind)]
    kinds = tuple(kind for kind in wanted if kind not in impossible)
    if not kinds:
        raise OptionError(f"--only {wanted[0]} cannot be done here: {impossible[wanted[0]]}")
    chosen = _chosen("--wire", options.wire, WIRES)
    wires = tuple(wire for wire in WIRES if wire in chosen and kinds_over(wire, kinds))
    if not wires:
        raise OptionError(
            f"--only {kinds[0]} cannot be done over {chosen[0]}: choose another --wire"
        )
    possible = tuple(kind for kind in FaultKind if kind not in impossible)
    plan = SeriesPlan(options.seed, wires, kinds, possible)
    return plan, {kind: impossible[kind] for kind in wanted if kind in impossible}


def _run(options: ChaosOptions) -> bool:
    from holdfast.cli.terminal import counted, progress_line
    from holdfast.runtime.output_directory import claim_directory
    from holdfast_lab.chaos.report import WIDE, summarise, text_of, write_report
    from holdfast_lab.chaos.series import Series

    plan, left_out = _plan_of(options)
    trials = range(options.first, options.first + options.trials)
    directory = claim_directory(options.out, _RUNS, "chaos")
    series = Series(directory, plan, keep=options.keep)
    line = progress_line(options.trials, quiet=False)

    def show(outcome: TrialOutcome) -> None:
        line.show(len(series.outcomes), f"{len(series.wrong)} wrong")
        if outcome in series.wrong:
            line.say(_account(series, outcome))

    title = f"chaos, {counted(options.trials, 'trial')}, seed {options.seed}"
    if options.jobs > 1:
        title += f", {options.jobs} at a time"
    line.start(f"{title}; results in {directory}", 0, "0 wrong")
    if left_out:
        line.say(f"left out: {', '.join(left_out)}: {next(iter(left_out.values()))}")
    try:
        try:
            series.run(trials, options.jobs, show)
        finally:
            # First of all the terminal; after SIGHUP there is none to write to.
            with contextlib.suppress(OSError):
                line.stop()
            summary = summarise(series.outcomes, trials, plan.seed, options.jobs, left_out)
            write_report(directory, summary)
    except KeyboardInterrupt as interruption:
        finished = {outcome.trial for outcome in series.outcomes}
        first = min(set(trials) - finished, default=trials.stop)
        words = [*options.words("out", "trials", "first"), "--first", str(first)]
        again = shlex.join(["holdfast", "chaos", "--trials", str(trials.stop - first), *words])
        sys.stderr.write(
            f"\n{interrupted_by(interruption)}; all processes are ended. "
            f"{len(finished)} of {options.trials} trials are finished\n"
            f"Go on with: {printable(again)}\n"
        )
        raise

    width = shutil.get_terminal_size().columns if sys.stdout.isatty() else WIDE
    accounts = "".join(f"\n{_account(series, outcome)}\n" for outcome in series.wrong)
    names = sorted(path.name for path in directory.iterdir() if path.is_file())
    files = f"{directory}/\n  {'  '.join(names)}\n"
    sys.stdout.write(f"\n{text_of(summary, width)}{printable(accounts)}\n{files}")
    sys.stdout.flush()
    return not series.wrong


def _account(series: Series, outcome: TrialOutcome) -> str:
    """Say what went wrong, where its files are, and how to do it again."""
    return (
        f"trial {outcome.trial} ({outcome.kind.value} over {outcome.wire}): "
        f"{outcome.verdict}: {outcome.reason}\n"
        f"  its files: {series.directory_of(outcome.trial)}\n"
        f"  again: holdfast chaos --trials 1 --first {outcome.trial} --seed {series.plan.seed} "
        f"--only {outcome.kind.value} --wire {outcome.wire} --keep"
    )
