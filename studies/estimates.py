"""Which state should stand for a belief, and when its particles are drawn anew.

The policy is asked for one state. The mean is the best one where the belief is a heap about the
truth, and a bad one where it has several modes. So estimates are tried on problems of both kinds.
Those that are left after the trials for choosing are judged by more trials of another seed. One of
them becomes the default if it is better than the mean beyond noise over all problems together, and
worse in none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import pandas as pd

from holdfast.planning.settings import Estimate, ParticleFilterSettings, SelectorSettings
from studies import statistics
from studies.cases import CASES, Case
from studies.judged_study import (
    P_VALUES,
    JudgedStudy,
    compared,
    compared_together,
    outcome_cells,
    steps_and_success,
)
from studies.statistics import interval_in
from studies.study import CHOICE, CLAIM, TRIALS, Number, Report, Scale
from studies.tables import Cell
from studies.trial_batches import TrialSeries

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_INTERVALS: Mapping[str, int] = {
    "peg in hole": 8,
    "tight hole": 8,
    "three plates": 8,
    "capsule robot": 8,
    "peg in space": 4,
    "light and dark": 4,
}
"""Steps between two sensing actions, in problems of the other studies."""

_OTHERS = (
    (1, Case(name="corridor", problem="studies.two_ends:Corridor", model={"start": (0.0, 20.0)},
             num_particles=300, max_steps=300)),
    (4, Case(name="westward", problem="studies.two_ends:Westward",
             num_particles=200, max_steps=200)),
)  # fmt: skip
"""The same of two more: one with several modes, one with an angle that wraps."""

_CASES: Mapping[str, tuple[int, Case]] = {
    **{case.name: (_INTERVALS[case.name], case) for case in CASES if case.name in _INTERVALS},
    **{case.name: (interval, case) for interval, case in _OTHERS},
}


class Variant(NamedTuple):
    """An estimate, and the effective size at which particles are drawn anew, as a share of them."""

    estimate: Estimate = "mean"
    resampling: float = 1.0


_REFERENCE = Variant()

_JUDGED = (
    _REFERENCE,
    Variant("heaviest_mode"),
    Variant("most_likely"),
    Variant("mean", 0.5),
)

_VARIANTS = (
    _REFERENCE,
    Variant("most_likely"),
    Variant("heaviest_mode"),
    *(Variant(estimate, 0.5) for estimate in ("mean", "most_likely", "heaviest_mode")),
    Variant("mean", 0.0),
)

_Cell = tuple[str, Variant]
"""The name of a case, and a variant."""

_Tables = Mapping[_Cell, pd.DataFrame]


class Estimates(JudgedStudy):
    """The study ``estimates``."""

    name = "estimates"
    title = "Which state stands for a belief, and when particles are drawn anew"
    columns = ("problem", "sensing_interval", "estimate", "resampling")
    num_trials: ClassVar = {CHOICE: 20, CLAIM: 100}

    def cells(self, scale: Scale) -> Iterator[_Cell]:
        """Return all cells, in the order of the tables."""
        del scale
        return ((case, variant) for case in _CASES for variant in _VARIANTS)

    def judged_cells(self, scale: Scale) -> Iterator[_Cell]:
        """Return the cells of what is judged."""
        del scale
        return ((case, variant) for case in _CASES for variant in _JUDGED)

    def names(self, cell: _Cell) -> tuple[Cell, ...]:
        """Return a cell's values of the columns."""
        case, variant = cell
        return case, _CASES[case][0], *variant

    def series(self, cell: _Cell, purpose: str, scale: Scale, num_trials: int) -> TrialSeries:
        """Return the trials of a cell for a purpose."""
        name, variant = cell
        interval, case = _CASES[name]
        return case.series(
            SelectorSettings(),
            interval,
            seed=scale.seed_of(purpose),
            num_trials=num_trials,
            particle_filter=ParticleFilterSettings(
                estimate=variant.estimate, resampling_threshold=variant.resampling
            ),
        )

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""
        choosing, claim = self.by_cell(tables[TRIALS]).values()
        summary, together = _alone(claim), _together(claim)
        return Report(
            summary={
                "estimates": summary,
                "together": together,
                "choosing": _alone(choosing),
                "choosing_together": _together(choosing),
            },
            figures={"estimates": partial(_draw, summary)},
            numbers=_numbers(together),
        )


def _alone(tables: _Tables) -> pd.DataFrame:
    """Return how each variant differs from the reference in each problem."""
    summary = pd.DataFrame(
        {
            "problem": case,
            **variant._asdict(),
            **outcome_cells(table),
            **compared(steps_and_success(table), steps_and_success(tables[case, _REFERENCE])),
        }
        for (case, variant), table in tables.items()
    )
    others = [variant != _REFERENCE for _, variant in tables]
    statistics.add_adjusted(summary, *P_VALUES, compared=others)
    return summary


def _together(tables: _Tables) -> pd.DataFrame:
    """Return how variants differ over all problems."""
    table = pd.DataFrame(
        {**variant._asdict(), **compared_together(tables, variant, _REFERENCE)}
        for variant in dict.fromkeys(variant for _, variant in tables)
        if variant != _REFERENCE
    )
    statistics.add_adjusted(table, *P_VALUES)
    return table


def _numbers(together: pd.DataFrame) -> list[Number]:
    return [
        Number(
            f"{row['estimate']}, resampling at {row['resampling']:g} N against the mean, {what}",
            interval_in(row, measure, factor),
            unit,
            row["trials"],
        )
        for row in together.to_dict("records")
        for what, measure, factor, unit in (
            ("successes", "success_gain", 100.0, "points"),
            ("steps", "steps_ratio", 1.0, "times the steps"),
        )
    ]


def _draw(summary: pd.DataFrame) -> Figure:
    from studies import plots

    others = summary.drop(index=summary.groupby("problem").head(1).index)
    how = others["estimate"].str.replace("_", " ") + others["resampling"].map(", at {:g} N".format)
    return plots.ratio_grid(
        {case: others[others["problem"] == case] for case in _CASES},
        how,
        columns=len(_CASES) // 2,
        title="Steps, against the mean (95 % intervals)",
        width=11.0,
        row_height=3.2,
        label="steps, relative to the mean",
    )
