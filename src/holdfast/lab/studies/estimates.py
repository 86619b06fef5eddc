"""Which state should stand for a belief, and when its particles are drawn anew.

The policy is asked for one state. The mean is the best one where the belief is a heap about the
truth, and a bad one where it has several modes. So candidates are tried on problems of both kinds.
Those that are left after the trials for choosing are judged by more trials of another seed. One of
them becomes the default if it is better than the mean beyond noise over all problems together, and
worse in none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import pandas as pd

from holdfast.lab.studies import statistics
from holdfast.lab.studies.cases import CASES, Case
from holdfast.lab.studies.judged_study import (
    JudgedStudy,
    compared,
    outcome_cells,
    steps_and_success,
)
from holdfast.lab.studies.statistics import interval_in
from holdfast.lab.studies.study import CHOICE, CLAIM, TRIALS, Number, Report, Scale
from holdfast.lab.studies.tables import Cell
from holdfast.lab.studies.trial_batches import TrialSeries
from holdfast.planning.settings import ParticleFilterSettings, SelectorSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Estimates", "Variant", "variants"]

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
    (1, Case(name="corridor", problem="holdfast.lab.studies.corridor:Corridor",
             num_particles=300, max_steps=300)),
    (4, Case(name="westward", problem="holdfast.lab.studies.westward:Westward",
             num_particles=200, max_steps=200)),
)  # fmt: skip
"""The same of two more: one with several modes, one with an angle that wraps."""

_CASES: Mapping[str, tuple[int, Case]] = {
    **{case.name: (_INTERVALS[case.name], case) for case in CASES if case.name in _INTERVALS},
    **{case.name: (interval, case) for interval, case in _OTHERS},
}

_TOGETHER = "all problems (mean)"


class Variant(NamedTuple):
    """A candidate, and the effective size at which particles are drawn anew, as a share of them."""

    estimate: str = "mean"
    resampling: float = 1.0


def variants() -> list[Variant]:
    """Return all that is tried; the first one is the reference, the defaults of holdfast."""
    # By name: the candidates import the core, which the command should not.
    candidates = (
        "mean",
        "most_likely",
        "nearest_particle",
        "medoid",
        "densest_particle",
        "heaviest_mode",
        "action_medoid",
        "action_vote",
    )
    return [
        *(Variant(candidate) for candidate in candidates),
        Variant("mean", 0.5),
        Variant("most_likely", 0.5),
        Variant("heaviest_mode", 0.5),
        Variant("mean", 0.0),
    ]


_REFERENCE = Variant()

_JUDGED = (
    _REFERENCE,
    Variant("heaviest_mode"),
    Variant("most_likely"),
    Variant("mean", 0.5),
)
"""What is left, the other estimate that holdfast had, and the usual threshold."""

_Cell = tuple[str, Variant]
"""The name of a case, and a variant."""

_Tables = Mapping[_Cell, pd.DataFrame]


class EstimateSeries(TrialSeries, frozen=True, kw_only=True):
    """Trials with a candidate."""

    candidate: str = "mean"


class Estimates(JudgedStudy):
    """The study ``estimates``."""

    name = "estimates"
    title = "Which state stands for a belief, and when particles are drawn anew"
    columns = ("problem", "sensing_interval", "estimate", "resampling")
    kind = "estimates"
    num_trials: ClassVar = {CHOICE: 20, CLAIM: 100}

    def cells(self, scale: Scale) -> Iterator[_Cell]:
        """Return all cells, in the order of the tables."""
        del scale
        for case in _CASES:
            for variant in variants():
                yield case, variant

    def judged_cells(self, scale: Scale) -> Iterator[_Cell]:
        """Return the cells of what is judged."""
        del scale
        for case in _CASES:
            for variant in _JUDGED:
                yield case, variant

    def names(self, cell: _Cell) -> tuple[Cell, ...]:
        """Return a cell's values of the columns."""
        case, variant = cell
        return case, _CASES[case][0], *variant

    def series(self, cell: _Cell, purpose: str, scale: Scale, num_trials: int) -> TrialSeries:
        """Return the trials of a cell for a purpose."""
        name, variant = cell
        interval, case = _CASES[name]
        series = case.series(
            SelectorSettings(),
            interval,
            seed=scale.seed_of(purpose),
            num_trials=num_trials,
            particle_filter=ParticleFilterSettings(resampling_threshold=variant.resampling),
        )
        fields = {field: getattr(series, field) for field in series.__struct_fields__}
        return EstimateSeries(**fields, candidate=variant.estimate)

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


_P_VALUES = ("success_p_value", "steps_p_value")


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
    others = (summary["estimate"] != _REFERENCE.estimate) | (
        summary["resampling"] != _REFERENCE.resampling
    )
    statistics.add_adjusted(summary, *_P_VALUES, compared=others)
    return summary


def _paired(tables: _Tables, variant: Variant) -> dict[str, Cell]:
    """Return how a variant differs from the reference over all problems, of the same weight each.

    The number of a trial is the mean over the problems, of the trials that all have.
    """
    fewest = min(map(len, tables.values()))
    own, other = (
        steps_and_success(*(tables[case, each][:fewest] for case in _CASES))
        for each in (variant, _REFERENCE)
    )
    return {"trials": fewest, **compared(own, other)}


def _together(tables: _Tables) -> pd.DataFrame:
    """Return how variants differ over all problems."""
    varied = dict.fromkeys(variant for _, variant in tables)
    table = pd.DataFrame(
        {**variant._asdict(), **_paired(tables, variant)}
        for variant in varied
        if variant != _REFERENCE
    )
    statistics.add_adjusted(table, *_P_VALUES)
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
    from holdfast.lab.studies import plots

    figure, panels = plots.grid_of_panels(
        list(_CASES),
        columns=len(_CASES) // 2,
        title="Steps, against the mean (95 % intervals)",
        width=11.0,
        row_height=3.2,
        same_rows=True,
    )
    for name, panel in panels.items():
        rows = summary[summary["problem"] == name].iloc[1:]
        labels = [
            f"{row['estimate'].replace('_', ' ')}, at {row['resampling']:g} N"
            for row in rows.to_dict("records")
        ]
        plots.dot_rows(panel, labels, [plots.dots_of("", rows, "steps_ratio")])
    plots.ratio_axes(panels.values())
    plots.label_grid(figure, panels, "", "")
    figure.supxlabel("steps, relative to the mean")
    return figure
