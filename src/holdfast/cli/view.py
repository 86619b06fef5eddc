"""``holdfast view``: a recorded run in Rerun's viewer, or as a file for it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from holdfast.cli import export
from holdfast.cli.exit_codes import ended_by_signals
from holdfast.errors import InvalidValueError, OptionError
from holdfast.printable import brief
from holdfast.reports.view_target import ViewTarget, require_rerun, viewer_url
from holdfast.runtime.command_line import Options, argument, flag, location, option
from holdfast.runtime.files import directory_beside, move_into_place, require_free


class ViewOptions(Options):
    """Show a recorded run in Rerun's viewer (extra view); the run is not changed.

    Beliefs are not recorded, but computed again from the recorded seed and observations. Every
    decision on the way must be the recorded one, bit for bit.

    A viewer is started on this machine if none is there. With --save there is none, unless --viewer
    names one; rerun FILE opens the file, here or elsewhere.
    """

    needs_arguments = True

    run: Path = argument("RUN", "Directory of a run, or its journal.", location)
    trials: range | None = export.trials_option()
    save: Path | None = option(
        metavar="FILE", read=location, help="Write FILE (.rrd) instead of showing it."
    )
    viewer: str | None = option(
        metavar="HOST:PORT", help="Show it in the viewer that listens there; Rerun's port is 9876."
    )
    problem_directory: Path | None = export.problem_directory_option()
    quiet: bool = flag("-q", help="Show no progress.")


def main(arguments: Sequence[str]) -> int:
    """Show what the options ask for and return the exit code."""
    options = ViewOptions.parse("view", arguments)
    with ended_by_signals():
        _view(options)
    return 0


def _view(options: ViewOptions) -> None:
    save = options.save
    url = "" if save is None else None
    if options.viewer is not None:
        try:
            url = viewer_url(options.viewer)
        except InvalidValueError as error:
            raise OptionError(
                f"--viewer is {brief(options.viewer)}; allowed are {error}"
            ) from error
    require_rerun(ViewTarget(url))
    if save is not None:
        require_free(save, "--save", directory=False)
    from holdfast.reports.replay import RecordedRun
    from holdfast.reports.rerun_sink import RerunSink

    own = options.problem_directory
    with RecordedRun(options.run, "view", problem_directory=own) as recorded, ExitStack() as stack:
        trials = export.chosen_trials(recorded, options.trials)
        notes = export.notes_about(recorded)
        made = None
        if save is not None:
            made = stack.enter_context(directory_beside(save)) / save.name
        target = ViewTarget(url, None if made is None else str(made))
        with RerunSink(
            recorded.configuration, target, has_times=recorded.has_times, live=False
        ) as sink:
            export.replay_trials(recorded, trials, [sink], quiet=options.quiet)
        if save is not None and made is not None:
            move_into_place([(made, save)])
    export.print_written([] if options.quiet else notes, save)
