"""What is really best: twelve ways of choosing a sensing action, on eight problems.

All ways see the same worlds: trial i starts in the same state and meets the same noise, whatever is
sensed. So ways are compared trial by trial: by success, by steps (a failure counts as the limit)
and by reward. Steps are compared as ratios, so that a tenth fewer counts the same where a task
takes fifty or five hundred.

Some trials are cut off at the limit. Those of the main ways are continued, to tell the slow from
the stuck.

The mean over these eight problems says nothing about a ninth. For that, the problems are taken as a
sample of all problems (a random effect).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import ClassVar

import numpy as np
import pandas as pd

from holdfast.numerics.arrays import BoolArray, FloatArray
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
from studies.statistics import Interval, cells_of, interval_in
from studies.study import CHOICE, CLAIM, TRIALS, Number, Report, Scale, drawn
from studies.tables import Cell
from studies.trial_batches import TrialSeries, problem_of

__all__ = ["COSTS", "GROUPS", "INTERVALS", "SHOWN", "WAYS", "Selectors"]

INTERVALS = (0, 4, 8, 14)
"""Steps between two sensing steps."""

LEVEL = 0.01
"""Of a family of tests: the probability of claiming any difference where there is none."""

LEVEL_OF_VERDICT = 0.05
"""Of the tests whether a candidate is beaten: less strict, to the candidate's disadvantage."""


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

_CONTINUED = tuple(way for way in SHOWN if way != "fixed")
"""Ways whose trials are continued where they are cut off."""

_CONTINUED_TRIALS = 60
"""Of these, at each interval: a stuck trial takes twenty times as long as one that is cut off."""

COSTS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Of a sensing action, in units of reward (the length of the way, in most problems)."""

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
            continued_trials=_CONTINUED_TRIALS if purpose == CLAIM and way in _CONTINUED else 0,
        )

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""
        choosing, cells = self.by_cell(tables[TRIALS]).values()
        places = _over_intervals(cells)
        summary, costs = _summary(cells), _costs(choosing, cells)
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
                "stuck": _stuck(cells),
                "costs_of_looks": costs,
            },
            figures={
                "choice_of_sensing": drawn("selectors_figures:choice_of_sensing", summary),
                "selectors": drawn("selectors_figures:selectors", relative_steps),
                "costs_of_looks": drawn("selectors_figures:costs_of_looks", costs),
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
        [_candidate(way, cells).assign(chosen=way == chosen) for way in _CANDIDATES],
        ignore_index=True,
    )


def _candidate(candidate: str, cells: _Cells) -> pd.DataFrame:
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
        for rival in RIVALS
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


def _stuck(cells: _Cells) -> pd.DataFrame:
    """Return how many trials were cut off, and how many of these never reached the goal."""
    rows: list[dict[str, Cell]] = []
    for name, case in _CASES.items():
        for label, intervals in _EACH_AND_ALL:
            found = {
                way: [_continued(cells[name, each, way]) for each in intervals]
                for way in _CONTINUED
            }
            stuck = {
                way: np.array([table["steps_to_goal"].isna() for table in tables])
                for way, tables in found.items()
            }
            for way, own in stuck.items():
                cut = np.array([~table["success"].to_numpy(bool) for table in found[way]])
                if len(intervals) == 1:
                    beyond, p_value = statistics.paired_rates(own[0], stuck[BASELINE][0])
                else:
                    beyond, p_value = statistics.paired_difference(
                        own.mean(axis=0), stuck[BASELINE].mean(axis=0)
                    )
                rows.append(
                    {
                        "problem": name,
                        "sensing_interval": label,
                        "way": way,
                        "trials": own.size,
                        "max_steps": case.max_steps,
                        "cut_off": int(cut.sum()),
                        "continued_to": int(found[way][0]["step_limit"].iloc[0]),
                        "stuck": int(own.sum()),
                        **cells_of("cut_off_share", _share(cut)),
                        **cells_of("stuck_share", _share(own)),
                        **cells_of("stuck_beyond_random", beyond),
                        "p_value": p_value,
                    }
                )
    table = pd.DataFrame(rows)
    statistics.add_adjusted(table, "p_value", compared=table["way"] != BASELINE)
    return table


def _share(trials: BoolArray) -> Interval:
    """Return the share of trials, shape (intervals, worlds), in which something is so.

    The trials of one world are not independent: over several intervals the interval is Student's,
    of the worlds' shares; and Wilson's where these are all 0 or all 1, which do not scatter.
    """
    whole = trials.all() or not trials.any()
    if trials.shape[0] > 1 and not whole:
        value, low, high = statistics.mean_interval(trials.mean(axis=0))
        return Interval(value, max(low, 0.0), min(high, 1.0))
    return statistics.rate_interval(int(trials[0].sum()), trials.shape[1])


def _continued(table: pd.DataFrame) -> pd.DataFrame:
    """Return the trials that are continued if they are cut off: those with the highest limit."""
    return table[table["step_limit"] == table["step_limit"].max()]


def _costs(choosing: _Cells, cells: _Cells) -> pd.DataFrame:
    """Return the net reward where sensing has a price, at the interval that is best then.

    The trials for choosing choose the interval.
    """
    rows: list[dict[str, Cell]] = []
    for case in _CASES:
        for cost in COSTS:
            nets: dict[str, FloatArray] = {}
            for way in SHOWN:
                chosen_by = {each: _net(choosing[case, each, way], cost) for each in INTERVALS}
                best = max(chosen_by, key=lambda each: float(chosen_by[each].mean()))
                net = nets[way] = _net(cells[case, best, way], cost)
                gain, p_value = statistics.paired_difference(net, nets[BASELINE])
                rows.append(
                    {
                        "problem": case,
                        "way": way,
                        "cost_of_a_look": cost,
                        "best_interval": best,
                        "trials": net.size,
                        **cells_of("net_reward", statistics.mean_interval(net)),
                        **cells_of("gain", gain),
                        "p_value": p_value,
                    }
                )
    table = pd.DataFrame(rows)
    statistics.add_adjusted(table, "p_value", compared=table["way"] != BASELINE)
    return table


def _net(table: pd.DataFrame, cost: float) -> FloatArray:
    """Return the reward of each trial less the price of its sensing."""
    return np.asarray(table["reward"] - cost * table["sensing_decisions"])


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
