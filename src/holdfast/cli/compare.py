"""``holdfast compare``: whether two runs decided the same, or which of several runs is better."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import ClassVar

from holdfast.cli.exit_codes import EXIT_DIFFERENT
from holdfast.errors import OptionError
from holdfast.printable import one_line, printable
from holdfast.runtime.command_line import Options, argument, flag, location
from holdfast.runtime.files import shown_path


class CompareOptions(Options):
    """Compare two runs, and show where they first differ.

    All trials are compared: each sensing action, each task action bit for bit, and the digests of
    the states.

    With --outcomes: show which run is better. Trials of one number are compared as pairs, because
    with the same problem and seed they are in the same world. The exit code is 0 whichever it is.
    """

    exit_codes: ClassVar = {
        0: "the decisions are the same",
        1: "they differ, or a trial of one run is missing or unfinished in the other",
    }
    needs_arguments = True

    runs: tuple[Path, ...] = argument(
        "RUN",
        "Directories of runs, or their journals. With --outcomes two or more: the first is the "
        "baseline.",
        location,
        many=True,
        least=2,
    )
    outcomes: bool = flag(
        help="Show which run is better: success, steps, rewards and decision times against the "
        "first run's, with intervals."
    )
    unpaired: bool = flag(
        help="With --outcomes: take the runs as independent samples, as of other seeds."
    )
    json: bool = flag(help="Print the finding as a JSON object.")


def main(arguments: Sequence[str]) -> int:
    """Compare runs and return the exit code."""
    options = CompareOptions.parse("compare", arguments)
    runs = [Path(shown_path(run)) for run in options.runs]  # as they were named: no code is run
    if len(runs) < 2 or (len(runs) > 2 and not options.outcomes):
        wanted = "two or more runs" if options.outcomes else "two runs (more with --outcomes)"
        raise OptionError(f"compare takes {wanted}, not {len(runs)}")
    if options.unpaired and not options.outcomes:
        raise OptionError("--unpaired says how to compare outcomes; give --outcomes as well")
    if options.outcomes:
        _compare_outcomes(runs, paired=not options.unpaired, json=options.json)
        return 0
    from holdfast.reports.compare import compare_runs

    found = compare_runs(*runs)
    sys.stdout.write(found.to_json() if options.json else f"{printable(found.describe())}\n")
    if not options.json:
        _print_notes(found.notes)
    return 0 if found.identical else EXIT_DIFFERENT


def _compare_outcomes(runs: Sequence[Path], *, paired: bool, json: bool) -> None:
    from holdfast.reports.outcome_comparison import compare_outcomes

    found = compare_outcomes(runs, paired=paired)
    sys.stdout.write(found.to_json() if json else f"{printable(found.describe())}\n")
    if not json:
        for run in found.runs:
            _print_notes(run.notes)


def _print_notes(notes: Iterable[str]) -> None:
    for note in notes:
        sys.stderr.write(f"note: {one_line(note)}\n")
