"""``holdfast export``: a recorded run as an MCAP file of ROS 2 messages, or as tables."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.cli.exit_codes import ended_by_signals
from holdfast.cli.terminal import counted, progress_line
from holdfast.config.user_code import account_of_user_error
from holdfast.errors import HoldfastError, OptionError, OutputError
from holdfast.printable import printable
from holdfast.runtime.command_line import (
    MAX_TRIALS,
    Options,
    argument,
    bad_value,
    flag,
    location,
    option,
)
from holdfast.runtime.files import directory_beside, move_into_place, require_free, shown_path

if TYPE_CHECKING:
    from holdfast.reports.facts import FactSink
    from holdfast.reports.replay import RecordedRun


_NOTE = "decided as recorded"
"""The note of the progress bar."""

_RANGE = re.compile(r"(\d{1,9})(?::(\d{1,9}))?")
_PICTURES = (".pdf", ".png", ".svg")


def trial_range(text: str) -> range:
    """Read ``A:B``, or ``N`` for one trial."""
    match = _RANGE.fullmatch(text)
    begin = int(match[1]) if match else 0
    end = int(match[2] or begin + 1) if match else MAX_TRIALS + 1
    if end > MAX_TRIALS:
        raise bad_value(text, f"one trial N, or A:B from 0 to {MAX_TRIALS}, such as 7 or 0:5")
    if begin >= end:
        raise bad_value(text, "A:B with B above A: 0:5 are the first five trials")
    return range(begin, end)


def picture(text: str) -> Path:
    """Read the path of a picture, whose name says its format."""
    path = location(text)
    if path.suffix.lower() not in _PICTURES:
        raise bad_value(text, f"names that end with {', '.join(_PICTURES)}")
    return path


def trials_option() -> Any:
    """Declare which trials are meant."""
    return option(
        metavar="A:B",
        read=trial_range,
        help="Only the trials from A up to, but without, B, or the one trial N (default: all).",
    )


def problem_directory_option() -> Any:
    """Declare where the module of a run's own problem lies."""
    return option(
        metavar="DIR",
        read=location,
        help="Where the module of the run's problem lies, if that is module:Class: its code is "
        "run. Code that a record names is not run without.",
    )


class ExportOptions(Options):
    """Write a recorded run as other programs read it; the run is not changed.

    Beliefs are not recorded, but computed again from the recorded seed and observations. Every
    decision on the way must be the recorded one, bit for bit; otherwise nothing is written.

    Times are the robot's own where the run has them (timings.csv), otherwise steps of 0.1 s.
    """

    needs_arguments = True

    run: Path = argument("RUN", "Directory of a run, or its journal.", location)
    mcap: Path | None = option(
        metavar="FILE",
        read=location,
        help="Write FILE: standard ROS 2 messages, for RViz, Foxglove, PlotJuggler and ros2 bag "
        "(extra mcap).",
    )
    tables: Path | None = option(
        "--csv",
        metavar="DIR",
        read=location,
        help="Write DIR: trials.csv, steps.csv, beliefs.csv and events.csv.",
    )
    figure: Path | None = option(
        metavar="FILE",
        read=picture,
        help="Write FILE (.pdf, .png or .svg): trial.png's figure of another trial, the first of "
        "--trials (extra figures).",
    )
    trials: range | None = trials_option()
    problem_directory: Path | None = problem_directory_option()
    quiet: bool = flag("-q", help="Show no progress.")


def main(arguments: Sequence[str]) -> int:
    """Write what the options ask for and return the exit code."""
    options = ExportOptions.parse("export", arguments)
    if options.mcap is None and options.tables is None and options.figure is None:
        raise OptionError("nothing to write: give --mcap FILE, --csv DIR or --figure FILE")
    with ended_by_signals():
        _export(options)
    return 0


def _export(options: ExportOptions) -> None:
    path, mcap, tables, wanted = options.run, options.mcap, options.tables, options.trials
    if mcap is not None:
        from holdfast.reports.mcap_export import require_rosbags

        require_rosbags()
        require_free(mcap, "--mcap", directory=False)
    if tables is not None:
        require_free(tables, "--csv", directory=True)
        if mcap == tables:
            raise OptionError(f"--mcap and --csv are both {shown_path(mcap)}; give two places")
    if options.figure is not None:
        from holdfast.cli.run_figure import require_matplotlib

        require_matplotlib()
        require_free(options.figure, "--figure", directory=False)
        if mcap == options.figure or tables == options.figure:
            raise OptionError(f"{shown_path(options.figure)} is given twice; give two places")
    from holdfast.reports.replay import RecordedRun

    with RecordedRun(path, problem_directory=options.problem_directory) as recorded:
        trials = chosen_trials(recorded, wanted)
        if mcap is None and tables is None:
            trials = trials[:1]  # the figure needs no other
        notes = _write(recorded, trials, options)
    print_written([] if options.quiet else notes, mcap, tables, options.figure)


def chosen_trials(recorded: RecordedRun, wanted: range | None) -> list[int]:
    """Return those of ``--trials`` that are recorded; OutputError if there is none."""
    trials = [trial for trial in recorded.trials if wanted is None or trial in wanted]
    if trials:
        return trials
    if not recorded.trials:
        why = "no trial of that run is finished or begun, so there is nothing to show"
    else:
        assert wanted is not None
        first, last = recorded.trials[0], recorded.trials[-1]
        asked = f"from {wanted.start} to {wanted.stop - 1}" if len(wanted) > 1 else wanted.start
        why = (
            f"has no trial {asked} (--trials); it has "
            f"{counted(len(recorded.trials), 'trial')} from {first} to {last}"
        )
    raise OutputError(f"{recorded.path}: {why}")


def _write(recorded: RecordedRun, trials: Sequence[int], options: ExportOptions) -> list[str]:
    """Write all of it beside its places, and move it there when all is whole; return notes."""
    from holdfast.reports.csv_export import CsvSink

    mcap, tables = options.mcap, options.tables
    notes = notes_about(recorded)
    with contextlib.ExitStack() as stack:
        made: list[tuple[Path, Path]] = []
        sinks: list[FactSink] = []
        # What closes the files stands on a stack of its own: it comes before they are moved.
        with contextlib.ExitStack() as files:
            if mcap is not None:
                from holdfast.reports.mcap_export import McapSink

                bag = stack.enter_context(directory_beside(mcap)) / mcap.stem
                about = _about(recorded)
                sink = files.enter_context(McapSink(bag, recorded.configuration, about))
                if not sink.has_poses:
                    notes.append(
                        f"{recorded.configuration.problem_name} does not say which coordinates of "
                        'its state are a pose (pose = ("x", "y", "yaw")), so there are no poses; '
                        "/holdfast/belief has the states"
                    )
                sinks.append(sink)
                made.append((sink.file, mcap))
            if tables is not None:
                directory = stack.enter_context(directory_beside(tables)) / "tables"
                directory.mkdir()
                sinks.append(
                    files.enter_context(CsvSink(directory, recorded.configuration.problem))
                )
                made.append((directory, tables))
            if options.figure is not None:
                from holdfast.planning.planner import Planner
                from holdfast.reports.recorder import Recorder

                planner = Planner(recorded.configuration.problem, recorded.configuration.planning)
                recorded.observer = first = Recorder(trials[0], planner)
            replay_trials(recorded, trials, sinks, quiet=options.quiet)
        if options.figure is not None:
            from holdfast.reports.figure import trial_figure

            kind = options.figure.suffix[1:].lower()
            picture = trial_figure(recorded.configuration, first.record, kind)
            file = stack.enter_context(directory_beside(options.figure)) / "figure"
            file.write_bytes(picture)
            made.append((file, options.figure))
        move_into_place(made)
    return notes


def replay_trials(
    recorded: RecordedRun, trials: Sequence[int], sinks: Sequence[FactSink], *, quiet: bool
) -> None:
    """Write the facts of trials to sinks, and show the progress."""
    line = progress_line(len(trials), quiet=quiet)
    line.start(f"{counted(len(trials), 'trial')} of {shown_path(recorded.path)}", 0, _NOTE)
    try:
        with user_errors_told(recorded.configuration.problem_name):
            for finished, _ in enumerate(recorded.replay(trials, sinks), start=1):
                line.show(finished, _NOTE)
    finally:
        with contextlib.suppress(OSError):
            line.stop()


@contextlib.contextmanager
def user_errors_told(problem: str) -> Iterator[None]:
    """Turn an exception of the user's own code into a HoldfastError with its place."""
    try:
        yield
    except (HoldfastError, KeyboardInterrupt):
        raise
    except BaseException as error:
        account = account_of_user_error(error, problem)
        if account is None:
            raise
        raise HoldfastError(account) from error


def notes_about(recorded: RecordedRun) -> list[str]:
    """Return what a reader of the facts should know."""
    from holdfast.journal.run_directory import TIMINGS_NAME
    from holdfast.reports.step_times import UNTIMED_STEP_S

    notes = []
    if not recorded.has_times:
        why = "the run was recorded without times"
        if untimed := recorded.untimed:
            lacking = counted(len(untimed), "trial")
            why = f"{TIMINGS_NAME} lacks {lacking} from {untimed[0]} on; all have one clock"
        notes.append(f"{why}, so every step takes {UNTIMED_STEP_S:g} s")
    else:
        notes += recorded.clock_notes
    asked_for = recorded.configuration.simulator.num_trials
    finished = len(recorded.trials) - (recorded.unfinished is not None)
    if finished < asked_for:
        notes.append(f"the run is not finished: {finished:,} of {asked_for:,} trials are")
    return notes


def _about(recorded: RecordedRun) -> dict[str, str]:
    """Return the metadata of a file about its run."""
    from holdfast.config.source_digest import core_version
    from holdfast.reports.step_times import UNTIMED_STEP_S

    configuration = recorded.configuration
    times = "recorded" if recorded.has_times else f"{1.0 / UNTIMED_STEP_S:g} steps a second"
    return {
        "holdfast_problem": configuration.problem_name,
        "holdfast_seed": str(configuration.simulator.seed),
        "holdfast_version": core_version(),
        "holdfast_times": times,
    }


def print_written(notes: Sequence[str], *places: Path | None) -> None:
    """Print notes, and the places that were written with their sizes."""
    for note in notes:
        sys.stderr.write(f"note: {printable(note)}\n")
    for place in filter(None, places):
        sys.stdout.write(printable(f"{shown_path(place)}  {_size_of(place)}\n"))
    sys.stdout.flush()


def _size_of(place: Path) -> str:
    """Return the size of a file or directory, for people."""
    files = sorted(place.iterdir()) if place.is_dir() else [place]
    size = sum(file.stat().st_size for file in files)
    return f"{size / 2**20:.1f} MiB" if size >= 2**20 else f"{size / 2**10:.1f} KiB"
