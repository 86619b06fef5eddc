"""The figure of a run's first trial, drawn after the run.

A trial that ran elsewhere (in a worker, in an earlier process, as a robot's) is run again for the
figure. If it is then decided otherwise, something is wrong, and it is run once more. If this
process decides the same twice, and not what the service decided, the problem is deterministic and
the service was wrong, because it has the same code. If this process decides otherwise each time,
the problem is not deterministic, and nothing is known about the service.
"""

from __future__ import annotations

import contextlib
import csv
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from holdfast.cli.exit_codes import EXIT_WRONG_ANSWER
from holdfast.cli.terminal import duration
from holdfast.errors import DecidedOtherwiseError

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.planning.outcome import Decisions, TrialResult
    from holdfast.recording.recorder import Recorder
    from holdfast.recording.run_directory import RunDirectory
    from holdfast.robot.environment import Environment

__all__ = [
    "Deviation",
    "Remark",
    "Repetition",
    "draw_figure",
    "own_backend",
    "repeat",
    "wrong_service",
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
    """

    step: int | None
    kind: str | None


class Repetition(NamedTuple):
    """The result of running a trial again.

    Attributes
    ----------
    decisions : Decisions or None
        None if another action was performed than its world has recorded.
    deviation : Deviation or None
        From the trial as it was; None if there is none.
    error : DecidedOtherwiseError or None
        Raised by the recorded world.
    """

    decisions: Decisions | None
    deviation: Deviation | None
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
    make_world = None
    if recorder.record.result is None:
        result = next(each for each in directory.journal.results() if each.trial == trial)
        if configuration.environment.object is not None:
            if path.exists():
                return
            make_world = _recorded_world(directory, result)
            if make_world is None:
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
        world = None if make_world is None else make_world()
        found = repeat(configuration, kept, trial, world, recorder=recorder)
        if found.deviation is not None:
            yield _remark_on(found, configuration, directory, kept, trial, make_world)
        if found.error is not None:
            return
        if make_world is not None:
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


def _recorded_world(
    directory: RunDirectory, result: TrialResult
) -> Callable[[], Environment] | None:
    """Return what makes the world of the user's as it was in a trial, None if that is not known."""
    from holdfast.recording.recorded_environment import RecordedEnvironment

    records = directory.journal.kept_steps(result.trial)
    if records is None and result.steps:
        return None
    return lambda: RecordedEnvironment(result.trial, records or [], result)


def _remark_on(
    found: Repetition,
    configuration: Configuration,
    directory: RunDirectory,
    kept: Decisions,
    trial: int,
    make_world: Callable[[], Environment] | None,
) -> Remark:
    """Name the cause of other decisions when a trial was run again."""
    from holdfast.recording.run_directory import TIMINGS_NAME

    def again() -> Repetition:
        world = None if make_world is None else make_world()
        return repeat(configuration, kept, trial, world, anew=True)

    assert found.deviation is not None
    service = wrong_service(found, again, directory.path / TIMINGS_NAME, trial)
    missing = "the figure: " if found.error is None else "no figure, because "
    if service is not None:
        return Remark(
            f"{missing}trial {trial} was run again for it by the robot's own planner, twice, and "
            f"came to other decisions, both times to the same: {service} answered with another "
            f"{found.deviation.kind} action at step {found.deviation.step}",
            EXIT_WRONG_ANSWER,
        )
    if found.error is not None:
        return Remark(f"no figure, because {found.error}")
    return Remark(
        f"trial {trial} decided otherwise when it was run again for the figure, "
        f"so the problem {configuration.problem_name} is not deterministic"
    )


def repeat(
    configuration: Configuration,
    kept: Decisions,
    trial: int,
    world: Environment | None,
    *,
    anew: bool = False,
    recorder: Recorder | None = None,
) -> Repetition:
    """Run a trial again with the planner in this process.

    Parameters
    ----------
    kept : Decisions
        As they were.
    world : Environment or None
        The recorded one; None for a simulated one.
    anew : bool
        Whether to build the problem anew, as a service does.
    """
    from holdfast.planning.planner import Planner
    from holdfast.recording.compare import difference_of_decisions
    from holdfast.robot.trial import NULL_OBSERVER, run_trial

    if anew:
        configuration = type(configuration).from_plain(configuration.plain())
    try:
        decisions = run_trial(
            Planner(configuration.problem, configuration.planning),
            configuration.simulator.seed,
            trial,
            max_steps=configuration.simulator.max_steps,
            environment=world,
            observer=NULL_OBSERVER if recorder is None else recorder,
            reinitialised_after=kept.reinitialised_after(),
        ).decisions
    except DecidedOtherwiseError as error:
        return Repetition(None, Deviation(error.step, error.kind), error)
    assert decisions is not None
    found = difference_of_decisions(kept, decisions, trial)
    if found is None:
        return Repetition(decisions, None)
    kind = found.what.partition(" action")[0]
    return Repetition(
        decisions, Deviation(found.step, kind if kind in ("sensing", "task") else None)
    )


def wrong_service(
    first: Repetition, again: Callable[[], Repetition], timings: Path, trial: int
) -> str | None:
    """Return the service that decided otherwise than this process does, if one certainly did.

    ``again`` runs the trial once more; it is not called where no service decided.

    Returns
    -------
    str or None
        None if the decision was the robot's own, or the trial comes out otherwise each time.
    """
    from holdfast.protocol.question import OWN_PLANNER
    from holdfast.recording.timings import read_timings

    assert first.deviation is not None
    step, kind = first.deviation
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
    if service in (None, OWN_PLANNER):
        return None
    second = again()
    same = (second.decisions, second.deviation) == (first.decisions, first.deviation)
    return service if same else None
