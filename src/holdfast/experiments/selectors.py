"""What is really best: the ways of choosing what to sense, on problems easy and hard.

All ways see the same worlds: trial i starts in the same state and is disturbed by the same noise,
whatever looks where. So ways are compared trial by trial. Three measures: how many trials reach the
goal, how many steps they take (a trial that fails takes all that it has), and the mean reward over
all trials. Steps have a meaning in every problem; it is their ratio that is compared (the mean of
differences of logarithms), so that a tenth fewer counts the same where a task takes fifty or five
hundred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from holdfast.experiments import statistics
from holdfast.experiments.cases import CASES, Case
from holdfast.experiments.study import Report, Results, Scale
from holdfast.experiments.tables import Cell, Table, number_of
from holdfast.experiments.tasks import Task
from holdfast.experiments.trial_batches import problem_of, trial_tasks
from holdfast.recording.tables import wilson_interval
from holdfast.settings import SelectorSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["INTERVALS", "WAYS", "Selectors"]

INTERVALS = (0, 4, 8, 14)
"""Steps between two sensing steps."""

LEVEL = 0.01
"""Of a family of tests: the probability that any difference is claimed where there is none."""

WAYS: Mapping[str, SelectorSettings] = {
    "random": SelectorSettings(method="random"),
    "fixed": SelectorSettings(method="fixed"),
    "state entropy, neighbours": SelectorSettings(
        method="state_entropy", estimator="nearest_neighbor"
    ),
    "state entropy, mixture": SelectorSettings(
        method="state_entropy", estimator="gaussian_mixture_upper"
    ),
    "action entropy, neighbours": SelectorSettings(estimator="nearest_neighbor"),
    "action entropy, neighbours, executed": SelectorSettings(
        estimator="nearest_neighbor", actions="executed"
    ),
    "action entropy, mixture": SelectorSettings(estimator="gaussian_mixture_upper"),
    "action entropy, mixture, executed": SelectorSettings(
        estimator="gaussian_mixture_upper", actions="executed"
    ),
    "action covariance": SelectorSettings(method="action_covariance"),
}
"""By the names that tables and figures give them; actions are the commanded ones, unless it says
that they are the executed ones."""

BASELINE = "random"

_DEFAULT = "action entropy, neighbours"
"""The project's; how it compares is told whether or not a difference was found."""

_DISTRACTING = ("busy room", "passer-by")
"""Made so that asking for the state and asking for the action differ."""

_GROUPS: Mapping[str, tuple[str, ...]] = {
    "all problems": tuple(case.name for case in CASES),
    "without distractions": tuple(case.name for case in CASES if case.name not in _DISTRACTING),
}
"""Problems that are taken together, each with the same weight."""

_SHOWN = {
    "random": "random",
    "fixed": "fixed",
    "state entropy, neighbours": "state entropy",
    "action entropy, neighbours": "action entropy",
}
"""Ways in the figures for a first look, and what they are called there: both entropies by the same
estimate, the default."""

_TRIALS = 200
_QUICK_TRIALS = 8
_TRIALS_IN_EACH = 20


class Selectors:
    """The study ``selectors``."""

    name = "selectors"
    title = "What is really best: choosing what to sense, on eight problems"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        return [task for cell in _cells() for task in _tasks(*cell, scale)]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        report = Report()
        tables = {cell: results.of(_tasks(*cell, scale)) for cell in _cells()}
        raw = Table({})
        for (case, interval, way), table in tables.items():
            raw.extend(table, problem=case, sensing_interval=interval, way=way)
        summary = _summary(tables)
        logarithms = _of_trials(tables, _logarithms)
        relative_steps = _relative_steps(logarithms)
        rivals = _rivals(_pairs(), logarithms, "steps_ratio", statistics.ratio_of)
        successes = _of_trials(tables, lambda table: table.numbers("success"))
        # In steps every way is compared with the baseline already.
        pairs = [(_DEFAULT, BASELINE), *_pairs()]
        rivals_in_success = _rivals(pairs, successes, "success_gain", _as_it_is)
        costs = _costs(tables)
        report.raw["selectors"] = raw
        report.summary |= {
            "cases": _cases_table(tables),
            "selectors": summary,
            "relative_steps": relative_steps,
            "rivals": rivals,
            "rivals_in_success": rivals_in_success,
            "costs_of_looks": costs,
        }
        report.figures["choice_of_sensing"] = partial(_draw_choice, summary)
        report.figures["selectors"] = partial(_draw_relative_steps, relative_steps)
        report.figures["costs_of_looks"] = partial(_draw_costs, costs)
        report.findings = _findings(relative_steps, rivals, rivals_in_success, costs)
        return report


FloatArray = npt.NDArray[np.float64]

_Shown = Callable[[statistics.Interval], statistics.Interval]
"""What is shown of a difference."""

_Cell = tuple[str, int, str]
"""Names of a case, an interval and a way."""

_CASES: Mapping[str, Case] = {case.name: case for case in CASES}


def _cells() -> Iterator[_Cell]:
    for case in _CASES:
        for interval in INTERVALS:
            for way in WAYS:
                yield case, interval, way


def _tasks(case: str, interval: int, way: str, scale: Scale) -> list[Task]:
    series = _CASES[case].series(
        WAYS[way],
        interval,
        seed=scale.seed,
        num_trials=_QUICK_TRIALS if scale.quick else _TRIALS,
    )
    return list(trial_tasks(series, _TRIALS_IN_EACH))


def _cases_table(tables: Mapping[_Cell, Table]) -> Table:
    """Return how each problem is posed, so that others can pose it."""
    rows: list[dict[str, Cell]] = []
    for name, case in _CASES.items():
        series = case.series(WAYS[_DEFAULT], INTERVALS[0], seed=0, num_trials=_TRIALS)
        sensing = series.planning.active_sensing
        rows.append(
            {
                "problem": name,
                "class": case.problem,
                "model": ", ".join(f"{key} {value}" for key, value in case.model.items()),
                "particles": series.planning.particle_filter.num_particles,
                "resampling_threshold": series.planning.particle_filter.resampling_threshold,
                "M": sensing.num_observation_samples,
                "k": sensing.num_nearest_neighbors,
                "horizon": sensing.horizon,
                "resolution": _resolution(case),
                "max_steps": case.max_steps,
                "trials": tables[name, INTERVALS[0], _DEFAULT].num_rows,
            }
        )
    return Table.of_records(rows)


def _resolution(case: Case) -> Cell:
    """Return a problem's resolution, or in a text those of all coordinates."""
    own = problem_of(case.problem, case.model, {}).resolution
    rounded = [f"{each:.4g}" for each in np.atleast_1d(own)]
    return float(rounded[0]) if isinstance(own, (int, float)) else ", ".join(rounded)


def _summary(tables: Mapping[_Cell, Table]) -> Table:
    """Return a row for each cell, with its paired differences from the baseline."""
    rows: list[dict[str, Cell]] = []
    for (case, interval, way), table in tables.items():
        baseline = tables[case, interval, BASELINE]
        success, other = (each.numbers("success") == 1.0 for each in (table, baseline))
        low, high = wilson_interval(int(success.sum()), success.size)
        row: dict[str, Cell] = {
            "problem": case,
            "sensing_interval": interval,
            "way": way,
            "trials": table.num_rows,
            "success": float(success.mean()),
            "success_low": low,
            "success_high": high,
        }
        for name in ("steps", "reward"):
            row |= statistics.cells_of(
                f"mean_{name}", statistics.mean_interval(table.numbers(name))
            )
        row["mean_sensing_ms"] = float(np.nanmean(table.numbers("mean_sensing_ms")))
        difference, row["success_p_value"] = statistics.paired_rates(success, other)
        row |= statistics.cells_of("success_gain", difference)
        difference, row["reward_p_value"] = statistics.paired_difference(
            table.numbers("reward"), baseline.numbers("reward")
        )
        row |= statistics.cells_of("reward_gain", difference)
        difference, row["steps_p_value"] = statistics.paired_difference(
            _logarithms(table), _logarithms(baseline)
        )
        row |= statistics.cells_of("steps_ratio", statistics.ratio_of(difference))
        rows.append(row)
    summary = Table.of_records(rows)
    compared = np.array([way != BASELINE for way in summary.columns["way"]])
    statistics.add_adjusted(
        summary, "success_p_value", "reward_p_value", "steps_p_value", compared=compared
    )
    return summary


_Trials = Mapping[tuple[str, str], FloatArray]
"""A number for each trial, by problem (or group of problems) and way."""


def _of_trials(
    tables: Mapping[_Cell, Table], number_of: Callable[[Table], FloatArray]
) -> dict[tuple[str, str], FloatArray]:
    """Return a number of each trial: the mean over the sensing intervals, which share its world.

    The entries of a group of problems are means over its problems, of the trials that all have.
    """
    found = {
        (case, way): np.asarray(
            np.mean([number_of(tables[case, interval, way]) for interval in INTERVALS], axis=0)
        )
        for case in _CASES
        for way in WAYS
    }
    fewest = min(entries.size for entries in found.values())
    for group, cases in _GROUPS.items():
        for way in WAYS:
            found[group, way] = np.mean([found[case, way][:fewest] for case in cases], axis=0)
    return found


def _logarithms(table: Table) -> FloatArray:
    return statistics.logarithms_of_steps(table.numbers("steps"))


def _relative_steps(logarithms: _Trials) -> Table:
    """Return how many steps each way takes, relative to the baseline."""
    return _compared(
        (
            {"problem": case, "way": way},
            statistics.ratio_of,
            "steps_ratio",
            own,
            logarithms[case, BASELINE],
        )
        for (case, way), own in logarithms.items()
        if way != BASELINE
    )


def _pairs() -> list[tuple[str, str]]:
    """Return each way that chooses with each of those before it."""
    choosing = [way for way in WAYS if WAYS[way].method not in ("random", "fixed")]
    return [(way, rival) for number, way in enumerate(choosing) for rival in choosing[:number]]


def _rivals(pairs: Sequence[tuple[str, str]], trials: _Trials, name: str, shown: _Shown) -> Table:
    """Return how the first way of each pair differs from the second one, everywhere."""
    return _compared(
        (
            {"problem": case, "way": way, "rival": rival},
            shown,
            name,
            trials[case, way],
            trials[case, rival],
        )
        for case in (*_CASES, *_GROUPS)
        for way, rival in pairs
    )


def _as_it_is(difference: statistics.Interval) -> statistics.Interval:
    return difference


def _compared(
    pairs: Iterable[tuple[dict[str, Cell], _Shown, str, FloatArray, FloatArray]],
) -> Table:
    """Return paired differences, with p-values adjusted for all rows of the table."""
    rows: list[dict[str, Cell]] = []
    for names, shown, name, own, other in pairs:
        difference, p_value = statistics.paired_difference(own, other)
        rows.append(
            {
                **names,
                "trials": int(np.count_nonzero(~np.isnan(own))),
                **statistics.cells_of(name, shown(difference)),
                "p_value": p_value,
            }
        )
    table = Table.of_records(rows)
    statistics.add_adjusted(table, "p_value")
    return table


_COSTS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Of a look, in units of reward (the length of the way, in most problems)."""


def _costs(tables: Mapping[_Cell, Table]) -> Table:
    """Return how often to look where looking costs, what that earns, and how much beyond random.

    The interval is chosen by the trials of even number and judged by the others: the best of four
    means, judged by the trials that made it the best, would seem better than it is.
    """
    rows: list[dict[str, Cell]] = []
    for case in _CASES:
        for cost in _COSTS:
            nets = {way: _best_net(tables, case, way, cost) for way in _SHOWN}
            for way, (interval, net) in nets.items():
                gain, p_value = statistics.paired_difference(net, nets[BASELINE][1])
                rows.append(
                    {
                        "problem": case,
                        "way": way,
                        "cost_of_a_look": cost,
                        "best_interval": interval,
                        "trials": net.size,
                        **statistics.cells_of("net_reward", statistics.mean_interval(net)),
                        **statistics.cells_of("gain", gain),
                        "p_value": p_value,
                    }
                )
    table = Table.of_records(rows)
    compared = np.array([way != BASELINE for way in table.columns["way"]])
    statistics.add_adjusted(table, "p_value", compared=compared)
    return table


def _best_net(
    tables: Mapping[_Cell, Table], case: str, way: str, cost: float
) -> tuple[int, FloatArray]:
    """Return the best interval by one half of the trials, and what the other half earns with it."""
    nets = {
        interval: tables[case, interval, way].numbers("reward")
        - cost * tables[case, interval, way].numbers("sensing_decisions")
        for interval in INTERVALS
    }
    best = max(nets, key=lambda interval: float(nets[interval][::2].mean()))
    return best, nets[best][1::2]


def _findings(
    relative_steps: Table, rivals: Table, rivals_in_success: Table, costs: Table
) -> list[str]:
    every = f"mean over the intervals {', '.join(map(str, INTERVALS))}"
    findings = [
        f"{_place(row)}, {row['way']}: {_ratio(row)} times the steps of random (geometric mean, "
        f"failures count as the limit; {every}; n = {row['trials']}, paired t-test, {_level(row)})"
        for row in relative_steps.rows()
        if row["problem"] in _GROUPS or _is_sure(row)
    ]
    findings += [
        f"{_place(row)}, {row['way']} against {row['rival']}: {_ratio(row)} times the steps "
        f"({every}; n = {row['trials']}, paired t-test, {_level(row)})"
        for row in rivals.rows()
        if _is_sure(row) or _is_about_the_default(row)
    ]
    findings += [
        f"{_place(row)}, {row['way']} against {row['rival']}: "
        f"{100.0 * number_of(row['success_gain']):+.1f} points of success "
        f"[{100.0 * number_of(row['success_gain_low']):+.1f}, "
        f"{100.0 * number_of(row['success_gain_high']):+.1f}] ({every}; n = {row['trials']}, "
        f"paired t-test, {_level(row)})"
        for row in rivals_in_success.rows()
        if _is_sure(row) or _is_about_the_default(row)
    ]
    findings += [
        f"{row['problem']}, a look costs {row['cost_of_a_look']}, {row['way']} at its "
        f"best interval: {number_of(row['gain']):+.3g} [{number_of(row['gain_low']):+.3g}, "
        f"{number_of(row['gain_high']):+.3g}] of reward beyond random at its best (n = "
        f"{row['trials']}, paired t-test, {_level(row)})"
        for row in costs.rows()
        if row["cost_of_a_look"] in (0.1, 1.0)
        and row["way"] != BASELINE
        and (_is_sure(row) or row["way"] == _DEFAULT)
    ]
    return findings


def _is_about_the_default(row: Mapping[str, Cell]) -> bool:
    """Tell whether a row compares the default over several problems, or anywhere with random."""
    pair = (row["way"], row["rival"])
    return _DEFAULT in pair and (row["problem"] in _GROUPS or BASELINE in pair)


def _is_sure(row: Mapping[str, Cell]) -> bool:
    return number_of(row["adjusted_p_value"]) < LEVEL


def _level(row: Mapping[str, Cell]) -> str:
    return f"Holm-adjusted p {number_of(row['adjusted_p_value']):.2g}"


def _ratio(row: Mapping[str, Cell]) -> str:
    ends = (float(row[f"steps_ratio{end}"] or 0.0) for end in ("", "_low", "_high"))
    return str(statistics.Interval(*ends))


def _place(row: Mapping[str, Cell]) -> str:
    return f"{row['problem']} (mean)" if row["problem"] in _GROUPS else str(row["problem"])


def _draw_choice(summary: Table) -> Figure:
    from holdfast.experiments import plots

    figure, panels = plots.grid_of_panels(
        list(_CASES),
        columns=4,
        title=(
            "What choosing the sensing action gains (entropies by nearest neighbours; means, 95 % "
            "intervals)"
        ),
        width=11.0,
    )
    for case, panel in panels.items():
        for number, (way, label) in enumerate(_SHOWN.items()):
            rows = [row for row in summary.rows() if row["problem"] == case and row["way"] == way]
            plots.line_with_intervals(
                panel,
                [int(row["sensing_interval"] or 0) for row in rows],
                plots.Dots(label, *_ends(rows, "mean_steps")),
                number=number,
                offset=0.22 * (number - 1.5),
            )
        panel.set_xticks(INTERVALS)
        panel.set_ylim(0.0, 1.1 * panel.dataLim.y1)
    plots.label_grid(
        figure, panels, "steps between two looks", "steps (mean; failures count as the limit)"
    )
    return figure


def _draw_relative_steps(relative_steps: Table) -> Figure:
    from holdfast.experiments import plots

    figure, panels = plots.grid_of_panels(
        [*_CASES, *_GROUPS],
        columns=5,
        title=(
            "Steps relative to random looks (geometric mean, 95 % intervals; failures count as the "
            "limit)"
        ),
        width=12.0,
        same_rows=True,
    )
    ways = [way for way in WAYS if way != BASELINE]
    for case, panel in panels.items():
        rows = [
            row for row in relative_steps.rows() if row["problem"] == case and row["way"] in ways
        ]
        plots.dot_rows(panel, ways, [plots.Dots("", *_ends(rows, "steps_ratio"))])
    plots.ratio_axes(panels.values())
    plots.label_grid(figure, panels, "steps, relative to random", "")
    return figure


def _draw_costs(costs: Table) -> Figure:
    from holdfast.experiments import plots

    figure, panels = plots.grid_of_panels(
        list(_CASES),
        columns=4,
        title="Where a look costs: reward at the best of the intervals (means, 95 % intervals)",
        width=11.0,
    )
    for case, panel in panels.items():
        for number, (way, label) in enumerate(_SHOWN.items()):
            rows = [row for row in costs.rows() if row["problem"] == case and row["way"] == way]
            plots.line_with_intervals(
                panel,
                [float(row["cost_of_a_look"] or 0.0) for row in rows],
                plots.Dots(label, *_ends(rows, "net_reward")),
                number=number,
            )
        panel.set_xscale("symlog", linthresh=_COSTS[1])
        panel.set_xlim(left=0.0)
    plots.label_grid(
        figure, panels, "cost of a look (reward)", "mean reward less the costs of looks"
    )
    return figure


def _ends(
    rows: Iterable[Mapping[str, Cell]], name: str
) -> tuple[list[float], list[float], list[float]]:
    values, lows, highs = [], [], []
    for row in rows:
        value = float(row[name] or 0.0)
        low, high = row[f"{name}_low"], row[f"{name}_high"]
        values.append(value)
        # Of a single trial there is no interval.
        lows.append(value if low is None else float(low))
        highs.append(value if high is None else float(high))
    return values, lows, highs
