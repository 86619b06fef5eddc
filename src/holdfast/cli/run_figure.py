"""The figure of a run's first trial, drawn after the run.

A trial that ran elsewhere (in a worker, in an earlier process, as a robot's) is run again for the
figure. If it is then decided otherwise, the problem is not deterministic, or the service that had
decided was wrong.
"""

from __future__ import annotations

import contextlib
import csv
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from holdfast.cli.exit_codes import EXIT_WRONG_ANSWER
from holdfast.cli.terminal import duration
from holdfast.errors import DecidedOtherwiseError, HoldfastError, how_to_install

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.journal.journal_reader import JournalReader
    from holdfast.journal.run_directory import RunDirectory
    from holdfast.planning.outcome import TrialResult
    from holdfast.reports.recorder import Recorder


_LONGEST_REPETITION_S = 30.0
"""A trial that took longer is not run again for its figure."""


class Remark(NamedTuple):
    """A remark about the figure, and the exit code if something is wrong."""

    text: str
    exit_code: int = 0


def draw_figure(
    configuration: Configuration, directory: RunDirectory, recorder: Recorder
) -> Remark | None:
    """Draw the recorder's trial, which is finished, and return a remark if there is one.

    The trials are in the journal already, so whatever prevents a figure becomes a remark.
    """
    try:
        return _drawn(configuration, directory, recorder)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001 - matplotlib, the disk and the user's own code
        from holdfast.config.user_code import describe_problem_error

        why = describe_problem_error(configuration.problem_name, error)
        return Remark(f"no figure, because it cannot be drawn: {why}")


def _drawn(
    configuration: Configuration, directory: RunDirectory, recorder: Recorder
) -> Remark | None:
    from holdfast.journal.run_directory import FIGURE_NAME

    trial, path = recorder.trial, directory.path / FIGURE_NAME
    if recorder.record.result is None:
        if configuration.environment.object is not None and path.exists():
            return None
        result = next(each for each in directory.journal.results() if each.trial == trial)
        again_s = 1e-3 * sum(result.sensing_ms)
        if again_s > _LONGEST_REPETITION_S:
            return Remark(
                f"no figure, because trial {trial} would have to be run again for it, "
                f"with {duration(again_s)} of sensing decisions"
            )
    try:
        require_matplotlib()
    except HoldfastError as error:
        return Remark(f"no figure, because {error}")
    from holdfast.reports.figure import trial_figure
    from holdfast.runtime.files import write_atomically

    if recorder.record.result is None:
        kept = msgspec.structs.replace(result, decisions=directory.journal.decisions(trial))
        try:
            if not repeat(configuration, directory.journal, kept, recorder):
                return Remark(
                    f"no figure, because trial {trial} ended in an earlier part of the run, which "
                    "did not keep its observations"
                )
        except DecidedOtherwiseError as error:
            return _remark_on(error, configuration, directory)
        recorder.record.result = result  # it alone has the reward of the last step
    write_atomically(path, trial_figure(configuration, recorder.record))
    return None


def require_matplotlib() -> None:
    """Import what draws figures; raise HoldfastError if matplotlib is not installed."""
    try:
        with own_backend():
            import holdfast.reports.figure  # noqa: F401
    except ImportError as error:
        if error.name is None or error.name.split(".")[0] != "matplotlib":
            raise
        advice = how_to_install("matplotlib")
        raise HoldfastError(f"matplotlib is not installed: {advice}") from error


@contextlib.contextmanager
def own_backend() -> Iterator[None]:
    """Let matplotlib be imported whatever backend the environment names, which may not be there."""
    named = os.environ.pop("MPLBACKEND", None)
    try:
        yield
    finally:
        if named is not None:
            os.environ["MPLBACKEND"] = named


def _remark_on(
    error: DecidedOtherwiseError, configuration: Configuration, directory: RunDirectory
) -> Remark:
    """Name the cause of other decisions when a trial was run again."""
    from holdfast.journal.run_directory import TIMINGS_NAME

    service = service_that_decided(error, directory.path / TIMINGS_NAME)
    if service is None:
        return Remark(f"no figure, because {error}")
    return Remark(
        f"no figure, because trial {error.trial} was run again for it by the robot's own planner, "
        f"and came to other decisions: {service} answered with another {error.kind} action at step "
        f"{error.step}, or the problem {configuration.problem_name} is not deterministic",
        EXIT_WRONG_ANSWER,
    )


def repeat(
    configuration: Configuration, journal: JournalReader, result: TrialResult, recorder: Recorder
) -> bool:
    """Run a trial again with the planner in this process; return False if that is not possible.

    ``result`` has its decisions; another one raises DecidedOtherwiseError.
    """
    from holdfast.robot.recomputing import ComparedTrial, RecordedTrials

    trials = RecordedTrials(
        journal, configuration, world_is_simulated=configuration.environment.object is None
    )
    return trials.run(result, ComparedTrial(result, observer=recorder))


def service_that_decided(error: DecidedOtherwiseError, timings: Path) -> str | None:
    """Return the service whose decision differs, None if it was the robot's own."""
    from holdfast.journal.timings import read_timings
    from holdfast.protocol.question import OWN_PLANNER

    if error.kind is None:
        return None
    decided: dict[int, str] = {}
    with contextlib.suppress(OSError, csv.Error):
        # Of a decision that was requested again, the last row is the one that was used. An answer
        # has the task actions up to the next sensing step.
        decided = {
            step: service
            for (trial, step, kind, service, *_), *_ in read_timings(timings)
            if trial == error.trial and kind == error.kind and step <= error.step
        }
    service = decided[max(decided)] if decided else None
    return None if service == OWN_PLANNER else service
