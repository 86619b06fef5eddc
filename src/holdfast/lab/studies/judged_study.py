"""Studies of cells: settings that meet the same worlds, chosen by one seed and judged by another.

A *cell* is one setting in one problem. All cells of a problem see the same trials, so they are
compared pair by pair.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, TypeAlias

import numpy as np
import pandas as pd

from holdfast.arrays import FloatArray
from holdfast.lab.studies import statistics
from holdfast.lab.studies.statistics import cells_of
from holdfast.lab.studies.study import CHOICE, CLAIM, Report, Results, Scale
from holdfast.lab.studies.tables import Cell
from holdfast.lab.studies.tasks import Task
from holdfast.lab.studies.trial_batches import TrialSeries, trial_tasks
from holdfast.lab.studies.trial_files import kept_trials

__all__ = [
    "MEASURES",
    "JudgedStudy",
    "Trials",
    "compared",
    "outcome_cells",
    "over_problems",
    "steps_and_success",
]

_TRIALS_IN_EACH = 20

MEASURES = ("steps_ratio", "success_gain")
"""What is compared: the ratio of steps (geometric mean; a failure counts as the limit), and the
difference of success rates."""

Trials: TypeAlias = tuple[FloatArray, FloatArray]
"""The logarithm of steps and the success of each trial."""


class JudgedStudy(ABC):
    """Tasks and trials of such a study; :meth:`report_of` makes the rest."""

    name: ClassVar[str]
    title: ClassVar[str]
    num_trials: ClassVar[Mapping[str, int]]
    quick_trials: ClassVar[Mapping[str, int]] = {CHOICE: 2, CLAIM: 4}

    @abstractmethod
    def cells(self, scale: Scale) -> Iterable[Any]:
        """Return all cells, in the order of the tables."""

    @abstractmethod
    def names(self, cell: Any) -> dict[str, Cell]:
        """Return the columns that name a cell."""

    @abstractmethod
    def series(self, cell: Any, purpose: str, scale: Scale, num_trials: int) -> TrialSeries:
        """Return the trials of a cell for a purpose."""

    @abstractmethod
    def report_of(self, trials: pd.DataFrame) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all tasks, in the order in which to begin."""
        return [
            task
            for purpose in self.num_trials
            for cell in self.cells(scale)
            for task in self._tasks(cell, purpose, scale)
        ]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return the report on the results of all tasks."""
        cells = [(purpose, cell) for purpose in self.num_trials for cell in self.cells(scale)]
        tables = [results.of(self._tasks(cell, purpose, scale)) for purpose, cell in cells]
        names = pd.DataFrame(
            {"purpose": purpose, "seed": scale.seed_of(purpose), **self.names(cell)}
            for purpose, cell in cells
        )
        number = np.repeat(np.arange(len(cells)), [len(table) for table in tables])
        trials = kept_trials(pd.concat(tables, ignore_index=True), number)
        named = names.iloc[number].reset_index(drop=True)
        return self.report_of(pd.concat([named, trials], axis=1))

    def _tasks(self, cell: Any, purpose: str, scale: Scale) -> list[Task]:
        number = (self.quick_trials if scale.quick else self.num_trials)[purpose]
        return list(trial_tasks(self.series(cell, purpose, scale, number), _TRIALS_IN_EACH))


def steps_and_success(tables: Sequence[pd.DataFrame]) -> Trials:
    """Return the logarithm of steps, and success, of each trial: the mean over several tables.

    The tables have the same worlds; where they have different numbers of trials, the first ones
    that all have count. The successes of a single table are truth values.
    """
    fewest = min(map(len, tables))
    logs = [statistics.log_steps(table["steps"].to_numpy(float)[:fewest]) for table in tables]
    successes = [table["success"].to_numpy(bool)[:fewest] for table in tables]
    if len(tables) == 1:
        return logs[0], successes[0]
    return np.mean(logs, axis=0), np.mean(successes, axis=0)


def compared(own: Trials, other: Trials) -> dict[str, Cell]:
    """Return the cells of a comparison of :func:`steps_and_success`, trial by trial.

    Differences of rates of single trials have McNemar's p-value, all others Student's.
    """
    steps, steps_p_value = statistics.paired_difference(own[0], other[0])
    if own[1].dtype == bool:
        success, success_p_value = statistics.paired_rates(own[1] == 1.0, other[1] == 1.0)
    else:
        success, success_p_value = statistics.paired_difference(own[1], other[1])
    return {
        **cells_of("steps_ratio", statistics.ratio_of(steps)),
        "steps_p_value": steps_p_value,
        **cells_of("success_gain", success),
        "success_p_value": success_p_value,
    }


def over_problems(
    pairs: Sequence[tuple[dict[str, Cell], Sequence[tuple[Trials, Trials]]]], least_success: float
) -> pd.DataFrame:
    """Return how ways differ over these problems, and over all problems like them.

    Parameters
    ----------
    pairs : sequence of (dict, sequence)
        The names of a comparison, and in each problem the trials of one way and of the other.
    least_success : float
        The smallest difference of two trials' successes; that of steps is one in a hundred.
    """
    rows: list[dict[str, Cell]] = []
    for part, (measure, least) in enumerate(zip(MEASURES, (0.01, least_success), strict=True)):
        shown = {"shown": statistics.ratio_of} if measure == "steps_ratio" else {}
        for names, trials in pairs:
            both = [(own[part].astype(float), other[part].astype(float)) for own, other in trials]
            cells = statistics.cells_across_problems(both, least, **shown)
            rows.append({"measure": measure, **names, **cells})
    table = pd.DataFrame(rows)
    statistics.add_adjusted(table, "mean_p_value", "expected_p_value")
    return table


def outcome_cells(table: pd.DataFrame) -> dict[str, Cell]:
    """Return the cells of the success rate and the means of one cell's trials."""
    successes = int(table["success"].sum())
    return {
        "trials": len(table),
        **cells_of("success", statistics.rate_interval(successes, len(table))),
        **cells_of("mean_steps", statistics.mean_interval(table["steps"].to_numpy(float))),
        **cells_of("mean_reward", statistics.mean_interval(table["reward"].to_numpy(float))),
        "median_sensing_ms": float(table["median_sensing_ms"].iloc[0]),
    }
