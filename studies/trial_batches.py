"""Batches of trials, run in process: what most studies are made of."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import msgspec

from holdfast.config.problem_builder import build_problem
from holdfast.config.registry import problem_class
from holdfast.errors import HoldfastError
from holdfast.planning.planner import Planner
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.robot.trial import run_trial
from studies.errors import TaskError
from studies.tasks import Task

if TYPE_CHECKING:
    import pandas as pd


COLUMNS = (
    "trial",
    "success",
    "steps",
    "reward",
    "sensing_decisions",
    "mean_sensing_ms",
    "unexplained_observations",
    "digest",
)
"""Columns of the table of a batch: a row for each trial.

The ``steps`` of a trial that fails are its limit, whenever that was.
"""

_DIGEST_CHARACTERS = 16
"""Enough to tell that two runs decided the same, at a quarter of the size."""


class TrialSeries(msgspec.Struct, frozen=True, kw_only=True):
    """Trials that differ in their number alone; ``model`` is the problem's section."""

    problem: str
    model: dict[str, Any] = msgspec.field(default_factory=dict)
    planning: PlanningSettings = msgspec.field(default_factory=PlanningSettings)
    max_steps: int = 500
    seed: int = 0
    num_trials: int = 1000


def trial_tasks(series: TrialSeries, trials_in_each: int, kind: str = "trials") -> Iterator[Task]:
    """Yield the tasks of a series, in the order of its trials.

    ``trials_in_each`` is lost when a process is killed, and done twice when a series is made
    longer. ``kind`` is that of a function with the parameters of :func:`run_trials_of`.
    """
    common = msgspec.to_builtins(series)
    del common["num_trials"]
    for first in range(0, series.num_trials, trials_in_each):
        count = min(trials_in_each, series.num_trials - first)
        parameters = {**common, "first_trial": first, "num_trials": count}
        yield Task(kind=kind, parameters=parameters, units=count)


def run_trials_of(first_trial: int, **series: Any) -> pd.DataFrame:
    """Run some trials of a series in this process; the function of tasks of the kind ``trials``.

    It gets the fields of :class:`TrialSeries`, and returns a table with the columns of
    :data:`COLUMNS`. All but the times are the same wherever it is run.
    """
    import pandas as pd  # here, so that problems and cases can be had without it

    wanted = msgspec.convert(series, TrialSeries)
    problem = problem_of(wanted.problem, wanted.model)
    rows = []
    for trial in range(first_trial, first_trial + wanted.num_trials):
        try:
            planner = Planner(problem, wanted.planning)
            result = run_trial(planner, wanted.seed, trial, max_steps=wanted.max_steps)
        except HoldfastError as error:
            raise TaskError(
                f"trial {trial} (seed {wanted.seed}) of {wanted.problem}: {error}"
            ) from error
        rows.append(
            (
                trial,
                result.success,
                wanted.max_steps if result.failed else result.steps,
                result.reward,
                result.sensing_decisions,
                result.mean_sensing_ms,
                result.unexplained_observations,
                result.digest[:_DIGEST_CHARACTERS],
            )
        )
    return pd.DataFrame(rows, columns=list(COLUMNS))


def problem_of(name: str, model: Mapping[str, Any] | None = None) -> Problem:
    """Build a problem from plain data; HoldfastError if there is none, or the data does not fit."""
    return build_problem(name, problem_class(name), model or {}, {})
