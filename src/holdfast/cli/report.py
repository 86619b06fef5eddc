"""``holdfast report``: a run, a comparison or a tuning as one HTML file to send."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from holdfast.cli.exit_codes import ended_by_signals
from holdfast.cli.export import print_written, problem_directory_option, user_errors_told
from holdfast.cli.terminal import progress_line
from holdfast.runtime.command_line import Options, argument, flag, location, option, whole_number
from holdfast.runtime.files import require_free, shown_path, write_atomically

_MOST_TRIALS = 12


class ReportOptions(Options):
    """Write one HTML file to send: it opens in any browser, without a network (extra report).

    Of a run: success with its interval, the worst trials step by step, who decided when, faults and
    pauses, settings, and how to repeat it. Click a step to see its belief and scores. Several runs
    are compared with the first one. The directory of a tuning, a sweep or a study may be named
    instead.

    Beliefs are not recorded, but computed again, and every decision must be the recorded one.
    """

    needs_arguments = True

    runs: tuple[Path, ...] = argument(
        "RUN",
        "Directories of runs, or their journals; or one of holdfast tune, of holdfast sweep or of "
        "a study.",
        location,
        many=True,
        least=1,
    )
    out: Path | None = option(
        "-o",
        metavar="FILE",
        read=location,
        help="The file (default: RUN-report.html); an earlier report there is replaced.",
    )
    worst: int = option(
        metavar="N",
        read=whole_number(0, _MOST_TRIALS),
        default=3,
        help="How many trials are shown step by step, the worst first.",
    )
    problem_directory: Path | None = problem_directory_option()
    quiet: bool = flag("-q", help="Show no progress.")


def main(arguments: Sequence[str]) -> int:
    """Write the report and return the exit code."""
    options = ReportOptions.parse("report", arguments)
    from holdfast.reports.html_page import GENERATOR, require_vega

    require_vega()
    first = options.runs[0].absolute()
    name = first.parent.name if first.is_file() else first.name
    out = options.out or Path(f"{name}-report.html")
    require_free(out, "--out", directory=False, ours=GENERATOR)
    with ended_by_signals():
        content, notes = _page(options)
        require_free(out, "--out", directory=False, ours=GENERATOR)  # it may have come meanwhile
        write_atomically(out, content)
    print_written([] if options.quiet else notes, out)
    return 0


def _page(options: ReportOptions) -> tuple[bytes, list[str]]:
    from holdfast.reports.html_report import comparison_page, is_run, results_page, run_page

    runs = [Path(shown_path(run)) for run in options.runs]  # as they were named
    if len(runs) > 1:
        return comparison_page(runs)
    if not is_run(options.runs[0]):
        return results_page(options.runs[0])
    line = progress_line(options.worst, quiet=options.quiet)
    line.start(f"report of {runs[0]}", 0, "computed again")
    try:
        with user_errors_told("the problem of the run"):
            return run_page(
                options.runs[0],
                worst=options.worst,
                problem_directory=options.problem_directory,
                on_trial=lambda number: line.show(number, "computed again"),
            )
    finally:
        line.stop()
