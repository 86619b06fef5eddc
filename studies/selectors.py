"""What is really best: twelve ways of choosing a sensing action, on eight problems.

All ways see the same worlds: trial i starts in the same state and meets the same noise, whatever is
sensed. So ways are compared trial by trial: by success, by steps (a failure counts as the limit)
and by reward. Steps are compared as ratios, so that a tenth fewer counts the same where a task
takes fifty or five hundred.

The mean over these eight problems says nothing about a ninth. For that, the problems are taken as a
sample of all problems (a random effect).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pandas as pd

from holdfast.planning.settings import Estimator, Method, SelectorSettings
from studies import statistics
from studies.cases import CASES, Case
from studies.judged_study import (
    MEASURES,
    JudgedStudy,
    Trials,
    compared,
    outcome_cells,
    over_problems,
    shown_as,
    steps_and_success,
)
from studies.statistics import cells_of, interval_in
from studies.study import CHOICE, CLAIM, TRIALS, Number, Report, Scale, drawn
from studies.tables import Cell
from studies.trial_batches import TrialSeries, problem_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


INTERVALS = (0, 4, 8, 14)
"""Steps between two sensing steps."""

LEVEL_OF_VERDICT = 0.05
"""Level of the tests whether a candidate is beaten."""


def _by(method: Method, estimator: Estimator | None = None) -> SelectorSettings:
    return SelectorSettings(method=method, estimator=estimator)


WAYS: Mapping[str, SelectorSettings] = {
    "random": _by("random"),
    "fixed": _by("fixed"),
    "state entropy, neighbours": _by("state_entropy", "nearest_neighbor"),
    "state entropy, mixture": _by("state_entropy", "gaussian_mixture_upper"),
    "action entropy, neighbours": _by("action_entropy", "nearest_neighbor"),
    "action entropy, neighbours, executed": SelectorSettings(
        method="action_entropy", estimator="nearest_neighbor", actions="executed"
    ),
    "action entropy, mixture": _by("action_entropy", "gaussian_mixture_upper"),
    "action entropy, mixture, executed": SelectorSettings(
        method="action_entropy", estimator="gaussian_mixture_upper", actions="executed"
    ),
    "action covariance": _by("action_covariance"),
    "path entropy, neighbours": _by("path_entropy", "nearest_neighbor"),
    "action entropy, prior neighbours": _by("action_entropy", "prior_neighbors"),
    "path entropy, prior neighbours": _by("path_entropy", "prior_neighbors"),
}
"""By their names in tables and figures. Actions are the commanded ones, unless named executed."""

BASELINE = "random"

DEFAULT = "path entropy, prior neighbours"
"""The project's default."""

_CANDIDATES = (
    "path entropy, neighbours",
    "action entropy, prior neighbours",
    "path entropy, prior neighbours",
)
"""Candidates for the default, of which the trials for choosing choose one."""

BEFORE = "action entropy, neighbours"
"""The default before."""

RIVALS = (BASELINE, BEFORE, "state entropy, neighbours", "action covariance")
"""With which the candidates are compared."""

_DISTRACTING = ("busy room", "passer-by")
"""Problems made so that state entropy and action entropy differ."""

GROUPS: Mapping[str, tuple[str, ...]] = {
    "all problems": tuple(case.name for case in CASES),
    "without distractions": tuple(case.name for case in CASES if case.name not in _DISTRACTING),
}
"""Problems that are taken together, each with the same weight."""

SHOWN = {
    "random": "random",
    "fixed": "fixed",
    "state entropy, neighbours": "state entropy",
    "action entropy, neighbours": "action entropy",
    "path entropy, prior neighbours": "path entropy",
}
"""Ways in the first figures, with their labels there."""

_CASES: Mapping[str, Case] = {case.name: case for case in CASES}

_EACH_AND_ALL: tuple[tuple[Cell, tuple[int, ...]], ...] = (
    *((interval, (interval,)) for interval in INTERVALS),
    ("mean", INTERVALS),
)
"""Each interval alone, and all of them together, with their names."""

_Cells = Mapping[tuple[str, int, str], pd.DataFrame]
"""Trials by case, interval and way."""

_Places = Mapping[tuple[str, str], Trials]
"""Trials by place and way. A place is a problem, or a group of problems."""


class Selectors(JudgedStudy):
    """The study ``selectors``."""

    name = "selectors"
    title = "What is really best: choosing what to sense, on eight problems"
    columns = ("problem", "sensing_interval", "way")
    num_trials: ClassVar = {CHOICE: 20, CLAIM: 120}

    def cells(self, scale: Scale) -> Iterator[tuple[str, int, str]]:
        """Return all cells, in the order of the tables."""
        del scale
        return ((case, interval, way) for case in _CASES for interval in INTERVALS for way in WAYS)

    def names(self, cell: tuple[str, int, str]) -> tuple[Cell, ...]:
        """Return a cell's values of the columns."""
        return cell

    def series(
        self, cell: tuple[str, int, str], purpose: str, scale: Scale, num_trials: int
    ) -> TrialSeries:
        """Return the trials of a cell for a purpose."""
        case, interval, way = cell
        return _CASES[case].series(
            WAYS[way],
            interval,
            seed=scale.seed_of(purpose),
            num_trials=num_trials,
        )

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""
        choosing, cells = self.by_cell(tables[TRIALS]).values()
        places = _over_intervals(cells)
        summary = _summary(cells)
        rivals = {measure: _rivals(places, measure, _pairs()) for measure in MEASURES}
        relative_steps = _rivals(
            places, "steps_ratio", [(way, BASELINE) for way in WAYS if way != BASELINE]
        ).drop(columns="rival")
        return Report(
            summary={
                "cases": _cases_table(cells, choosing),
                "selectors": summary,
                "relative_steps": relative_steps,
                "rivals": rivals["steps_ratio"],
                "rivals_in_success": rivals["success_gain"],
                "over_problems": _over_problems(places),
                "default_candidates": _default_candidates(_over_intervals(choosing), cells),
            },
            figures={
                "choice_of_sensing": drawn("selectors:choice_of_sensing", summary),
                "selectors": drawn("selectors:selectors", relative_steps),
            },
            numbers=_numbers(rivals),
        )


def _over_intervals(cells: _Cells) -> _Places:
    """Return steps and success: the mean over the intervals, trial by trial.

    Of a group of problems: their mean over the trials that all have.
    """
    found = {
        (case, way): steps_and_success(*(cells[case, interval, way] for interval in INTERVALS))
        for case in _CASES
        for way in WAYS
    }
    fewest = min(steps.size for steps, _ in found.values())
    for group, cases in GROUPS.items():
        for way in WAYS:
            steps, success = (
                np.mean([found[case, way][part][:fewest] for case in cases], axis=0)
                for part in (0, 1)
            )
            found[group, way] = steps, success
    return found


def _cases_table(cells: _Cells, choosing: _Cells) -> pd.DataFrame:
    """Return how each problem is posed, so that others can pose it."""
    rows: list[dict[str, Cell]] = []
    for name, case in _CASES.items():
        planning = case.series(WAYS[DEFAULT], INTERVALS[0], seed=0, num_trials=2).planning
        sensing = planning.active_sensing
        rows.append(
            {
                "problem": name,
                "class": case.problem,
                "model": ", ".join(f"{key} {value}" for key, value in case.model.items()),
                "particles": planning.particle_filter.num_particles,
                "resampling_threshold": planning.particle_filter.resampling_threshold,
                "M": sensing.num_observation_samples,
                "k": sensing.num_nearest_neighbors,
                "horizon": sensing.horizon,
                "resolution": _resolution(case),
                "max_steps": case.max_steps,
                "trials": len(cells[name, INTERVALS[0], DEFAULT]),
                "trials_for_choosing": len(choosing[name, INTERVALS[0], DEFAULT]),
            }
        )
    return pd.DataFrame(rows)


def _resolution(case: Case) -> Cell:
    """Return a problem's resolution, or as a text those of all coordinates."""
    own = problem_of(case.problem, case.model).resolution
    rounded = [f"{each:.4g}" for each in np.atleast_1d(own)]
    return float(rounded[0]) if isinstance(own, (int, float)) else ", ".join(rounded)


def _summary(cells: _Cells) -> pd.DataFrame:
    """Return a row for each cell, with its paired differences from the baseline."""
    rows: list[dict[str, Cell]] = []
    for (case, interval, way), table in cells.items():
        baseline = cells[case, interval, BASELINE]
        reward, p_value = statistics.paired_difference(
            table["reward"].to_numpy(), baseline["reward"].to_numpy()
        )
        rows.append(
            {
                "problem": case,
                "sensing_interval": interval,
                "way": way,
                **outcome_cells(table),
                **compared(steps_and_success(table), steps_and_success(baseline)),
                **cells_of("reward_gain", reward),
                "reward_p_value": p_value,
            }
        )
    summary = pd.DataFrame(rows)
    p_values = ("success_p_value", "reward_p_value", "steps_p_value")
    statistics.add_adjusted(summary, *p_values, compared=summary["way"] != BASELINE)
    return summary


def _pairs() -> list[tuple[str, str]]:
    """Return each way that chooses, with the baseline and with each such way before it."""
    choosing = [way for way in WAYS if WAYS[way].method not in ("random", "fixed")]
    return [
        (way, rival)
        for number, way in enumerate(choosing)
        for rival in (BASELINE, *choosing[:number])
    ]


def _rivals(places: _Places, measure: str, pairs: Iterable[tuple[str, str]]) -> pd.DataFrame:
    """Return how the first way of each pair differs from the second, everywhere."""
    part = MEASURES.index(measure)
    rows: list[dict[str, Cell]] = []
    for place in (*_CASES, *GROUPS):
        for way, rival in pairs:
            own, other = places[place, way][part], places[place, rival][part]
            difference, p_value = statistics.paired_difference(own, other)
            rows.append(
                {
                    "problem": place,
                    "way": way,
                    "rival": rival,
                    "trials": int(np.count_nonzero(~np.isnan(own))),
                    **cells_of(measure, shown_as(measure, difference)),
                    "p_value": p_value,
                }
            )
    table = pd.DataFrame(rows)
    statistics.add_adjusted(table, "p_value")
    return table


def _over_problems(places: _Places) -> pd.DataFrame:
    """Return how ways differ over these problems, and over all problems like them."""
    return over_problems(
        [
            (
                {"way": way, "rival": rival},
                [(places[case, way], places[case, rival]) for case in _CASES],
            )
            for way, rival in _pairs()
        ],
        least_success=1.0 / len(INTERVALS),  # of means over the intervals
    )


def _default_candidates(chosen_by: _Places, cells: _Cells) -> pd.DataFrame:
    """Return the comparisons that decide whether a candidate becomes the default.

    It does not if a rival beats it beyond noise, in steps or success, in any row. The p-values of a
    candidate are adjusted for all its comparisons of both measures.
    """
    everywhere = next(iter(GROUPS))
    chosen = min(_CANDIDATES, key=lambda way: float(chosen_by[everywhere, way][0].mean()))
    return pd.concat(
        [verdict_on(way, cells).assign(chosen=way == chosen) for way in _CANDIDATES],
        ignore_index=True,
    )


def verdict_on(candidate: str, cells: _Cells, rivals: Sequence[str] = RIVALS) -> pd.DataFrame:
    """Return a candidate's comparisons with its rivals by the study's rule."""
    table = pd.DataFrame(
        {
            "candidate": candidate,
            "problem": case,
            "sensing_interval": name,
            "rival": rival,
            "trials": len(cells[case, INTERVALS[0], candidate]),
            **compared(
                *(
                    steps_and_success(*(cells[case, each, way] for each in intervals))
                    for way in (candidate, rival)
                )
            ),
        }
        for case in _CASES
        for name, intervals in _EACH_AND_ALL
        for rival in rivals
    )
    levels = statistics.holm(np.concatenate([table["steps_p_value"], table["success_p_value"]]))
    table["steps_adjusted_p_value"], table["success_adjusted_p_value"] = np.split(levels, 2)
    slower = (table["steps_ratio"] > 1.0) & (table["steps_adjusted_p_value"] < LEVEL_OF_VERDICT)
    worse = (table["success_gain"] < 0.0) & (table["success_adjusted_p_value"] < LEVEL_OF_VERDICT)
    table["beaten_in"] = [
        " and ".join(name for name, so in (("steps", a), ("success", b)) if so)
        for a, b in zip(slower, worse, strict=True)
    ]
    return table


def _numbers(rivals: Mapping[str, pd.DataFrame]) -> list[Number]:
    """Return how the default compares with random sensing, everywhere."""
    units = {"steps_ratio": (1.0, "times the steps"), "success_gain": (100.0, "points of success")}
    return [
        Number(
            f"{row['problem']}, the default against random",
            interval_in(row, measure, factor),
            unit,
            row["trials"],
        )
        for measure, (factor, unit) in units.items()
        for row in rivals[measure].to_dict("records")
        if (row["way"], row["rival"]) == (DEFAULT, BASELINE)
    ]


def choice_of_sensing(summary: pd.DataFrame) -> Figure:
    """Draw steps by the interval between two sensing actions."""
    from studies import plots

    rows = dict(list(summary.groupby(["problem", "way"])))
    lines = {
        case: [
            (INTERVALS, plots.dots_of(label, rows[case, way], "mean_steps"))
            for way, label in SHOWN.items()
        ]
        for case in _CASES
    }
    figure, panels = plots.line_grid(
        lines,
        columns=4,
        title="What choosing the sensing action gains (means, 95 % intervals)",
        labels=(
            "steps between two sensing actions",
            "steps (mean; failures count as the limit)",
        ),
        offset=0.2,
    )
    for panel in panels.values():
        panel.set_xticks(INTERVALS)
        panel.set_ylim(0.0, 1.1 * panel.dataLim.y1)
    return figure


def selectors(relative_steps: pd.DataFrame) -> Figure:
    """Draw the steps of all ways, relative to random sensing."""
    from studies import plots

    problem = relative_steps["problem"]
    return plots.ratio_grid(
        {name: relative_steps[problem == name] for name in (*_CASES, *GROUPS)},
        relative_steps["way"],
        columns=5,
        title="Steps relative to random sensing (geometric mean, 95 % intervals)",
        width=12.0,
        label="steps, relative to random",
    )
