"""The figure of a run's first trial, drawn after the run.

A trial that ran elsewhere (in a worker, in an earlier process, as a robot's) is run again for the
figure. If it is then decided otherwise, the problem is not deterministic, or the service that had
decided was wrong.
"""

from __future__ import annotations

import contextlib
import csv
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from holdfast.cli.exit_codes import EXIT_WRONG_ANSWER
from holdfast.cli.terminal import duration
from holdfast.errors import DecidedOtherwiseError

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.planning.outcome import TrialResult
    from holdfast.protocol.records import Record
    from holdfast.recording.recorder import Recorder
    from holdfast.recording.run_directory import RunDirectory

__all__ = [
    "Deviation",
    "Remark",
    "draw_figure",
    "own_backend",
    "repeat",
    "service_that_decided",
]

_LONGEST_REPETITION_S = 30.0
"""A trial that took longer is not run again for its figure."""


class Remark(NamedTuple):
    """A remark about the figure, and the exit code if something is wrong."""

    text: str
    exit_code: int = 0


class Deviation(NamedTuple):
    """The first decision of a repeated trial that differs.

    Attributes
    ----------
    kind : {"sensing", "task"} or None
        Of the decision; None if only the state after an observation differs, or the trial's end.
    error : DecidedOtherwiseError or None
        Raised by the recorded world, which has no answer to another action.
    """

    step: int | None
    kind: str | None
    error: DecidedOtherwiseError | None = None


def draw_figure(
    configuration: Configuration, directory: RunDirectory, recorder: Recorder
) -> Remark | None:
    """Draw the recorder's trial, which is finished, and return a remark if there is one.

    The trials are in the journal already, so whatever prevents a figure becomes a remark.
    """
    remarks: list[Remark] = []
    try:
        for remark in _drawn(configuration, directory, recorder):
            remarks.append(remark)  # noqa: PERF402 - what was found before an error is kept
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # noqa: BLE001 - matplotlib, the disk and the user's own code
        from holdfast.config.user_code import describe_problem_error

        why = describe_problem_error(configuration.problem_name, error)
        remarks.append(Remark(f"no figure, because it cannot be drawn: {why}"))
    # What was found of a service comes first.
    return max(remarks, key=lambda each: each.exit_code, default=None)


def _drawn(
    configuration: Configuration, directory: RunDirectory, recorder: Recorder
) -> Iterator[Remark]:
    """Draw, and yield remarks as they come."""
    from holdfast.recording.run_directory import FIGURE_NAME

    trial, path = recorder.trial, directory.path / FIGURE_NAME
    records = None
    if recorder.record.result is None:
        result = next(each for each in directory.journal.results() if each.trial == trial)
        if configuration.environment.object is not None:
            if path.exists():
                return
            records = directory.journal.kept_steps(trial) if result.steps else []
            if records is None:
                yield Remark(
                    f"no figure, because trial {trial} ended in an earlier part of the run, which "
                    "did not keep its observations"
                )
                return
        again_s = 1e-3 * result.mean_sensing_ms * result.sensing_decisions
        if again_s > _LONGEST_REPETITION_S:
            yield Remark(
                f"no figure, because trial {trial} would have to be run again for it, "
                f"with {duration(again_s)} of sensing decisions"
            )
            return
    try:
        with own_backend():
            from holdfast.recording.figure import trial_figure
    except ImportError as error:
        if error.name is None or error.name.split(".")[0] != "matplotlib":
            raise
        yield Remark("no figure, because matplotlib is not installed: pip install matplotlib")
        return

    if recorder.record.result is None:
        kept = directory.journal.decisions(trial)
        whole = msgspec.structs.replace(result, decisions=kept)
        deviation = repeat(configuration, whole, records, recorder)
        if deviation is not None:
            yield _remark_on(deviation, configuration, directory, trial)
            if deviation.error is not None:
                return
        if records is not None:
            recorder.record.result = result  # it alone has the reward of the last step
    trial_figure(configuration, recorder.record, path)


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
    deviation: Deviation, configuration: Configuration, directory: RunDirectory, trial: int
) -> Remark:
    """Name the cause of other decisions when a trial was run again."""
    from holdfast.recording.run_directory import TIMINGS_NAME

    service = service_that_decided(deviation, directory.path / TIMINGS_NAME, trial)
    missing = "the figure: " if deviation.error is None else "no figure, because "
    if service is not None:
        return Remark(
            f"{missing}trial {trial} was run again for it by the robot's own planner, and came to "
            f"other decisions: {service} answered with another {deviation.kind} action at step "
            f"{deviation.step}, or the problem {configuration.problem_name} is not deterministic",
            EXIT_WRONG_ANSWER,
        )
    if deviation.error is not None:
        return Remark(f"no figure, because {deviation.error}")
    return Remark(
        f"trial {trial} decided otherwise when it was run again for the figure, "
        f"so the problem {configuration.problem_name} is not deterministic"
    )


def repeat(
    configuration: Configuration,
    result: TrialResult,
    records: Sequence[Record] | None,
    recorder: Recorder,
) -> Deviation | None:
    """Run a trial again with the planner in this process, and return where it first differs.

    ``result`` has its decisions; the ``records`` are None for a simulated world.
    """
    from holdfast.planning.planner import Planner
    from holdfast.recording.compare import difference_of_decisions
    from holdfast.robot.recorded_trial import run_recorded_trial
    from holdfast.robot.trial import run_trial

    planner = Planner(configuration.problem, configuration.planning)
    seed, trial, kept = configuration.simulator.seed, result.trial, result.decisions
    assert kept is not None
    try:
        again = (
            run_trial(
                planner,
                seed,
                trial,
                max_steps=configuration.simulator.max_steps,
                observer=recorder,
                reinitialised_after=kept.reinitialised_after(),
            )
            if records is None
            else run_recorded_trial(planner, seed, trial, records, recorder, result)
        )
    except DecidedOtherwiseError as error:
        return Deviation(error.step, error.kind, error)
    assert again is not None
    assert again.decisions is not None
    found = difference_of_decisions(kept, again.decisions, trial)
    if found is None:
        return None
    kind = found.what.partition(" action")[0]
    return Deviation(found.step, kind if kind in ("sensing", "task") else None)


def service_that_decided(deviation: Deviation, timings: Path, trial: int) -> str | None:
    """Return the service whose decision differs, None if it was the robot's own."""
    from holdfast.protocol.question import OWN_PLANNER
    from holdfast.recording.timings import read_timings

    step, kind, _ = deviation
    if step is None or kind is None:
        return None
    decided: dict[int, str] = {}
    with contextlib.suppress(OSError, csv.Error):
        # Of a decision that was requested again, the last row is the one that was used. An answer
        # has the task actions up to the next sensing step.
        decided = {
            row.step: row.service
            for row in read_timings(timings)
            if row.trial == trial and row.kind == kind and row.step <= step
        }
    service = decided[max(decided)] if decided else None
    return None if service == OWN_PLANNER else service
