"""``holdfast sweep``: runs of a grid of settings, compared on the same worlds."""

from __future__ import annotations

import contextlib
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from holdfast.cli.exit_codes import (
    EXIT_CAN_GO_ON,
    ended_by_signals,
    goes_on,
    interrupted_by,
    say_interrupted,
)
from holdfast.cli.overrides import combined, overrides_of, parse_assignment, parse_values
from holdfast.cli.terminal import counted, progress_line
from holdfast.errors import HoldfastError, InvalidValueError, RunError
from holdfast.printable import printable
from holdfast.runtime import command_line
from holdfast.runtime.files import shown_path
from holdfast.runtime.output_directory import claim_directory

if TYPE_CHECKING:
    from holdfast.planning.outcome import TrialResult
    from holdfast.tuning.sweep import SweptArm


_RUNS = Path("runs")


class SweepOptions(command_line.Options):
    """Run all combinations of values on the same worlds, and compare them.

    Each --set names the values of a key; a key with one value is set in all combinations. Each
    combination gets a directory in DIR as holdfast run makes it. DIR itself gets trials.csv (a row
    for each trial of each) and the comparison: table.md, table.tex and table.csv. Effects are
    paired, with 95 % intervals, against the first combination or --baseline.

    Ctrl-C or a crash loses no finished trial: the same command with --resume goes on.
    """

    exit_codes: ClassVar = {4: None}
    needs_arguments = True

    configuration: Path = command_line.argument(
        "CONFIG", "Configuration file (YAML) of the runs.", command_line.location
    )
    assignments: tuple[str, ...] = command_line.option(
        "--set",
        metavar="SECTION.KEY=A,B,...",
        many=True,
        help="Values of a key, as YAML: selector.method=path_entropy,random. May be given for "
        "several keys; the last varies fastest.",
    )
    baseline: tuple[str, ...] = command_line.option(
        metavar="SECTION.KEY=A",
        many=True,
        help="Compare with the first combination that has this value (default: the first of all).",
    )
    problem_directory: Path | None = command_line.module_option()
    trials: int | None = command_line.option(
        metavar="N",
        read=command_line.whole_number(2, command_line.MAX_TRIALS),
        key="simulator.num_trials",
        help="Number of trials of each combination, instead of the file's.",
    )
    seed: int | None = command_line.seed_option()
    jobs: int | None = command_line.jobs_option()
    out: Path | None = command_line.out_option("sweep-CONFIG")
    resume: bool = command_line.flag(
        help="Go on with the sweep in DIR, perhaps with more values or trials; needs --out."
    )
    quiet: bool = command_line.flag("-q", help="Show no progress: only the table and errors.")

    def arms(self) -> list[SweptArm]:
        """Return the combinations."""
        from holdfast.config.loader import load
        from holdfast.tuning.sweep import arms_of

        axes, given = [*map(parse_values, self.assignments)], overrides_of(self)
        combined(axes + given)
        path, fixed = shown_path(self.configuration), combined(given)
        return arms_of(combined(axes), lambda values: load(path, overrides={**fixed, **values}))


@ended_by_signals()
def main(arguments: Sequence[str]) -> int:
    """Run the sweep and return the exit code."""
    options = SweepOptions.parse("sweep", arguments)
    if not options.assignments:
        raise InvalidValueError("--set is missing: which values of which key shall be compared?")
    if options.resume and options.out is None:
        raise InvalidValueError("--resume needs --out, the directory of the sweep that goes on")
    from holdfast.runtime.machine import available_cores
    from holdfast.tuning.sweep import Sweep

    runs = _RUNS.absolute()  # before the user's code, which may change the current directory
    with goes_on(options if options.resume else None, "sweep"):
        arms = options.arms()
    baseline = _baseline_of(options, arms)
    if len(arms) == 1:
        raise InvalidValueError(
            f"{options.assignments[0]!r} makes one combination; a sweep compares at least two"
        )
    directory = options.out
    if directory is None or not options.resume:
        directory = claim_directory(options.out, runs, f"sweep-{options.configuration.stem}")
    again = options.command_to_resume("sweep", directory)
    with Sweep(directory, arms) as sweep:
        line = progress_line(sweep.total, quiet=options.quiet)
        finished = sweep.finished
        note = counted(len(arms), "combination")

        def show(_: TrialResult) -> None:
            nonlocal finished
            finished += 1
            line.show(finished, note)

        try:
            title = f"{arms[0].configuration.problem_name}, {note}, {counted(sweep.total, 'trial')}"
            before = f", {finished:,} finished before" if finished else ""
            if sweep.new:
                before += f"; the sweep is extended by {'; '.join(sweep.new)}"
            where = shown_path(directory)
            line.start(f"{title}{before}; results in {where}", finished, note)
            try:
                sweep.run(options.jobs or available_cores(), show)
            finally:
                with contextlib.suppress(OSError):  # after SIGHUP there is no terminal
                    line.stop()
            comparison = sweep.comparison(baseline)
            names = sweep.write_tables(comparison)
        except KeyboardInterrupt as interruption:
            kept = f"{finished:,} of {sweep.total:,} trials are finished and kept in {where}"
            say_interrupted(interrupted_by(interruption), kept, again)
            raise
        except HoldfastError as error:
            raise RunError(error, again, EXIT_CAN_GO_ON) from error
    table = str(comparison)
    if sys.stdout.isatty():
        table = comparison.fitting(shutil.get_terminal_size().columns)
    sys.stdout.write(printable(f"{table}\n\n{where}/\n  {'  '.join(names)}\n"))
    return 0


def _baseline_of(options: SweepOptions, arms: Sequence[SweptArm]) -> int:
    """Return the first combination that has the values of ``--baseline``."""
    wanted = combined(map(parse_assignment, options.baseline))
    for number, arm in enumerate(arms):
        if all(
            key in arm.values and repr(arm.values[key]) == repr(value)
            for key, value in wanted.items()
        ):
            return number
    raise InvalidValueError(
        f"--baseline {' --baseline '.join(options.baseline)}: no combination has that; they are "
        f"{'; '.join(arm.label for arm in arms)}"
    )
