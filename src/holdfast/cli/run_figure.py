"""The figure of a run's first trial, drawn after the run.

A trial that ran elsewhere (in a worker, in an earlier process, as a robot's) is run again for the
figure. If it then decides otherwise, something is wrong, and the remark says who: a service or the
problem itself.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from holdfast.cli.exit_codes import EXIT_WRONG_ANSWER
from holdfast.cli.terminal import duration
from holdfast.errors import HoldfastError

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.recording.recorded_environment import RecordedEnvironment
    from holdfast.recording.recorder import Recorder, TrialRecord
    from holdfast.recording.repetition import Repetition
    from holdfast.recording.run_directory import RunDirectory

__all__ = ["Remark", "draw_figure"]

_LONGEST_REPETITION_S = 30.0
"""A trial that took longer is not run again for its figure."""


class Remark(NamedTuple):
    """A remark about the figure, and the exit code if something is wrong."""

    text: str
    exit_code: int = 0


def draw_figure(
    configuration: Configuration,
    directory: RunDirectory,
    recorder: Recorder,
    recorded: RecordedEnvironment | None,
) -> Remark | None:
    """Draw trial 0, and return a remark if there is one."""
    from holdfast.recording.run_directory import FIGURE_NAME

    if configuration.environment.object is not None and recorded is None:
        if (directory.path / FIGURE_NAME).exists():
            return None
        recorded = _world_of(directory, recorder.trial)
        if recorded is None:
            return Remark(
                f"no figure, because trial {recorder.trial} ended in an earlier part of the run, "
                "which did not keep its observations"
            )
    if recorder.record.result is None:
        again_s = _time_of_sensing(directory, recorder.trial)
        if again_s > _LONGEST_REPETITION_S:
            return Remark(
                f"no figure, because trial {recorder.trial} would have to be run again for it, "
                f"with {duration(again_s)} of sensing decisions"
            )
    try:
        from holdfast.recording.figure import trial_figure
    except ImportError as error:
        if error.name is None or error.name.split(".")[0] != "matplotlib":
            raise
        return Remark("no figure, because matplotlib is not installed: pip install matplotlib")

    try:
        return _draw_trial(configuration, directory, recorder, recorded, trial_figure)
    except (HoldfastError, KeyboardInterrupt):
        raise
    except BaseException as error:
        from holdfast.config.user_code import account_of_user_error

        account = account_of_user_error(error, configuration.problem_name)
        if account is None:
            raise
        raise HoldfastError(f"the figure of trial {recorder.trial}: {account}") from error


def _world_of(directory: RunDirectory, trial: int) -> RecordedEnvironment | None:
    from holdfast.recording.recorded_environment import RecordedEnvironment

    records = directory.journal.kept_steps(trial)
    if records is None:
        return None
    result = next(each for each in directory.journal.results() if each.trial == trial)
    return RecordedEnvironment(trial, records, result)


def _time_of_sensing(directory: RunDirectory, trial: int) -> float:
    for result in directory.journal.results():
        if result.trial == trial:
            return 1e-3 * result.mean_sensing_ms * result.sensing_decisions
    return 0.0


def _draw_trial(
    configuration: Configuration,
    directory: RunDirectory,
    recorder: Recorder,
    recorded: RecordedEnvironment | None,
    draw: Callable[[Configuration, TrialRecord, Path], None],
) -> Remark | None:
    from holdfast.recording.repetition import repeat
    from holdfast.recording.run_directory import FIGURE_NAME

    trial = recorder.trial
    remark = None
    if recorder.record.result is None:
        # It ran in a worker, in an earlier part of the run, or as a robot's: it is run again. A
        # world of the user's answers what it has answered.
        kept = directory.journal.decisions(trial)
        found = repeat(configuration, kept, trial, recorded, observer=recorder)
        if found.deviation is not None:
            remark = _remark_on(found, configuration, directory, trial, recorded)
        if found.error is not None:
            return remark
    record: TrialRecord = recorder.record
    if recorded is not None:
        record.result = recorded.result  # the reward of its last step is there alone
    draw(configuration, record, directory.path / FIGURE_NAME)
    return remark


def _remark_on(
    found: Repetition,
    configuration: Configuration,
    directory: RunDirectory,
    trial: int,
    recorded: RecordedEnvironment | None,
) -> Remark:
    """Name the cause of other decisions when a trial was run again."""
    from holdfast.recording.repetition import repeat, wrong_service
    from holdfast.recording.run_directory import TIMINGS_NAME

    def again() -> Repetition:
        world = None if recorded is None else recorded.from_the_beginning()
        kept = directory.journal.decisions(trial)
        return repeat(configuration, kept, trial, world, anew=True)

    assert found.deviation is not None
    step, kind = found.deviation
    service = wrong_service(found, again, directory.path / TIMINGS_NAME, trial)
    missing = "the figure: " if found.error is None else "no figure, because "
    if service is not None:
        return Remark(
            f"{missing}trial {trial} was run again for it by the robot's own planner, twice, and "
            f"came to other decisions, both times to the same: {service} answered with another "
            f"{kind} action at step {step}",
            EXIT_WRONG_ANSWER,
        )
    if found.error is not None:
        return Remark(f"no figure, because {found.error}")
    return Remark(
        f"trial {trial} decided otherwise when it was run again for the figure, "
        f"so the problem {configuration.problem_name} is not deterministic"
    )
