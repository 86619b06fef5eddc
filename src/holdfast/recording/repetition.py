"""Running a trial again, and which service was wrong if it is decided otherwise.

If this process decides the same twice, and not what the service decided, the problem is
deterministic and the service was wrong, because it has the same code. If this process decides
otherwise each time, the problem is not deterministic, and nothing is known about the service.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

from holdfast.config.loader import Configuration
from holdfast.errors import DecidedOtherwiseError
from holdfast.outcome import Decisions, SensingDecision, TrialResult
from holdfast.planning import Planner
from holdfast.protocol.question import OWN_PLANNER
from holdfast.recording.recorded_environment import RecordedEnvironment
from holdfast.recording.timings import deciders
from holdfast.robot.trial import NULL_OBSERVER, TrialObserver, run_trial

__all__ = ["Deviation", "Repetition", "repeat", "wrong_service"]


class Deviation(NamedTuple):
    """The first decision of a repeated trial that differs.

    Attributes
    ----------
    kind : {"sensing", "task"} or None
        Of the decision; None if only the state after an observation differs, or the trial's end.
    """

    step: int
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


def repeat(
    configuration: Configuration,
    kept: Decisions,
    trial: int,
    recorded: RecordedEnvironment | None,
    *,
    anew: bool = False,
    observer: TrialObserver = NULL_OBSERVER,
) -> Repetition:
    """Run a trial again with the planner in this process.

    ``kept`` are its decisions as they were, ``recorded`` its world from the beginning (None for a
    simulated one). ``anew`` builds the problem anew, as a service does.
    """
    problem = configuration.problem
    if anew:
        problem = Configuration.from_plain(configuration.plain()).problem
    try:
        result: TrialResult = run_trial(
            Planner(problem, configuration.planning),
            configuration.simulator.seed,
            trial,
            max_steps=configuration.simulator.max_steps,
            environment=recorded,
            observer=observer,
        )
    except DecidedOtherwiseError as error:
        return Repetition(None, Deviation(error.step, error.kind), error)
    assert result.decisions is not None
    return Repetition(result.decisions, _deviation(kept, result.decisions))


def _deviation(kept: Decisions, again: Decisions) -> Deviation | None:
    if kept.log == again.log:
        return None
    step = 0
    for one, other in zip_longest(kept, again):
        known = one if one is not None else other
        step = known.step
        if one == other:
            continue
        if one is None or other is None:
            return Deviation(step, None)
        if isinstance(one, SensingDecision):
            same = isinstance(other, SensingDecision) and one[:2] == other[:2]
            return Deviation(step, None if same else "sensing")
        return Deviation(step, "task")
    return Deviation(step, None)


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
    assert first.deviation is not None
    step, kind = first.deviation
    decided = {at: service for (at, of), service in deciders(timings, trial).items() if of == kind}
    # An answer has the task actions up to the next sensing step.
    at = max((at for at in decided if at <= step), default=None)
    service = None if at is None else decided[at]
    if service in (None, OWN_PLANNER):
        return None
    second = again()
    same = (second.decisions, second.deviation) == (first.decisions, first.deviation)
    return service if same else None
