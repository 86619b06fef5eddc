"""Studies of cells: settings that meet the same worlds, chosen by one seed and judged by another.

A *cell* is one setting in one problem. All cells of a problem see the same trials, so they are
compared pair by pair.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, ClassVar, TypeAlias

import numpy as np
import pandas as pd

from holdfast.errors import InvalidValueError
from holdfast.numerics.arrays import FloatArray
from studies import statistics
from studies.statistics import Interval, cells_of
from studies.study import CHOICE, CLAIM, Part, Scale, TrialStudy
from studies.tables import Cell
from studies.trial_batches import TrialSeries, trial_tasks
from studies.trial_files import rounded

_TRIALS_IN_EACH = 20

_PURPOSE = ("purpose", "seed")
_KEPT = ("trial", "success", "steps", "reward", "sensing_decisions")

MEASURES = ("steps_ratio", "success_gain")
"""What is compared: the ratio of steps (geometric mean; a failure counts as the limit), and the
difference of success rates."""

P_VALUES = ("success_p_value", "steps_p_value")

Trials: TypeAlias = tuple[FloatArray, FloatArray]
"""The logarithm of steps and the success of each trial."""


class JudgedStudy(TrialStudy):
    """A study whose trials are those of cells."""

    columns: ClassVar[tuple[str, ...]]
    """Those that name a cell."""
    num_trials: ClassVar[Mapping[str, int]]
    kind: ClassVar[str] = "trials"
    """Kind of the tasks."""
    quick_trials: ClassVar[Mapping[str, int]] = {CHOICE: 2, CLAIM: 4}

    @abstractmethod
    def cells(self, scale: Scale) -> Iterable[Any]:
        """Return all cells, in the order of the tables."""

    def judged_cells(self, scale: Scale) -> Iterable[Any]:
        """Return the cells that are judged: all, unless a study judges only what it chose."""
        return self.cells(scale)

    @abstractmethod
    def names(self, cell: Any) -> tuple[Cell, ...]:
        """Return a cell's values of the columns."""

    @abstractmethod
    def series(self, cell: Any, purpose: str, scale: Scale, num_trials: int) -> TrialSeries:
        """Return the trials of a cell for a purpose."""

    def parts(self, scale: Scale) -> Iterator[Part]:
        """Yield the trials of each cell, by purpose."""
        for purpose, number in (self.quick_trials if scale.quick else self.num_trials).items():
            for cell in self._cells_for(purpose, scale):
                names = (purpose, scale.seed_of(purpose), *self.names(cell))
                series = self.series(cell, purpose, scale, number)
                yield Part(
                    dict(zip((*_PURPOSE, *self.columns), names, strict=True)),
                    list(trial_tasks(series, _TRIALS_IN_EACH, self.kind)),
                )

    def _cells_for(self, purpose: str, scale: Scale) -> Iterable[Any]:
        return self.judged_cells(scale) if purpose == CLAIM else self.cells(scale)

    def kept(self, trials: pd.DataFrame) -> pd.DataFrame:
        """Return what is kept; of times, which differ from run to run, the median of each cell."""
        names = [*_PURPOSE, *self.columns]
        times = trials["mean_sensing_ms"].where(trials["sensing_decisions"] > 0)
        medians = times.groupby([trials[name] for name in names]).transform("median")
        return trials[[*names, *_KEPT]].assign(
            reward=rounded(trials["reward"]),
            median_sensing_ms=rounded(medians),
        )

    def by_cell(self, trials: pd.DataFrame) -> dict[str, dict[Any, pd.DataFrame]]:
        """Return the trials of each cell, by purpose; a quick run may have fewer cells.

        InvalidValueError if they are not those of this study.
        """
        names = ("purpose", *self.columns)
        missing = [name for name in (*names, *_KEPT) if name not in trials.columns]
        if missing:
            raise InvalidValueError(f"trials without the columns {', '.join(missing)}")
        found = {
            key: table.drop(columns=list(names)).reset_index(drop=True)
            for key, table in trials.groupby(list(names), sort=False)
        }
        whole, few = (
            {
                (purpose, *self.names(cell)): (purpose, cell)
                for purpose in self.num_trials
                for cell in self._cells_for(purpose, Scale(quick=quick))
            }
            for quick in (False, True)
        )
        expected = few if few.keys() == found.keys() else whole
        for key in [*expected, *found]:
            if (key in expected) != (key in found):
                what = "there are no trials" if key in expected else "knows nothing"
                raise InvalidValueError(f"{self.name}: {what} of {', '.join(map(str, key))}")
        tables: dict[str, dict[Any, pd.DataFrame]] = {purpose: {} for purpose in self.num_trials}
        for key, (purpose, cell) in expected.items():
            tables[purpose][cell] = found[key]
        return tables


def steps_and_success(*tables: pd.DataFrame) -> Trials:
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


def shown_as(measure: str, difference: Interval) -> Interval:
    """Return a difference as tables show it: of steps, the ratio."""
    return statistics.ratio_of(difference) if measure == "steps_ratio" else difference


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


def compared_together(
    tables: Mapping[tuple[str, Any], pd.DataFrame], own: Any, other: Any
) -> dict[str, Cell]:
    """Return the cells of a comparison over all problems, each with the same weight.

    Tables are by problem and way. The number of a trial is the mean over the problems, of the
    trials that all have.
    """
    fewest = min(map(len, tables.values()))
    problems = dict.fromkeys(problem for problem, _ in tables)
    found = (
        steps_and_success(*(tables[problem, way][:fewest] for problem in problems))
        for way in (own, other)
    )
    return {"trials": fewest, **compared(*found)}


def over_problems(
    pairs: Sequence[tuple[dict[str, Cell], Sequence[tuple[Trials, Trials]]]], least_success: float
) -> pd.DataFrame:
    """Return how ways differ over these problems, and over all problems like them.

    Columns: ``mean``, over these problems, of the trials that all have; ``expected``, over all such
    problems; ``new_problem``, in one more; ``deviation_between_problems`` as a difference. Each of
    ``pairs`` names a comparison, with the trials of one way and of the other in each problem;
    ``least_success`` is the smallest difference of two trials' successes.
    """
    rows: list[dict[str, Cell]] = []
    for part, (measure, least) in enumerate(zip(MEASURES, (0.01, least_success), strict=True)):
        for names, trials in pairs:
            both = [(own[part].astype(float), other[part].astype(float)) for own, other in trials]
            fewest = min(own.size for own, _ in both)
            own, other = (
                np.mean([pair[which][:fewest] for pair in both], axis=0) for which in (0, 1)
            )
            mean, p_value = statistics.paired_difference(own, other)
            found = statistics.across_problems(both, least)
            _, new_low, new_high = shown_as(measure, found.new_problem)
            rows.append(
                {
                    "measure": measure,
                    **names,
                    "trials": fewest,
                    **cells_of("mean", shown_as(measure, mean)),
                    "mean_p_value": p_value,
                    "problems": len(both),
                    **cells_of("expected", shown_as(measure, found.mean)),
                    "expected_p_value": found.p_value,
                    "deviation_between_problems": found.deviation,
                    "new_problem_low": new_low,
                    "new_problem_high": new_high,
                }
            )
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
