"""What is really best: the ways of choosing what to sense, on problems easy and hard.

All ways see the same worlds: trial i starts in the same state and is disturbed by the same noise,
whatever looks where. So ways are compared trial by trial. Three measures: how many trials reach the
goal, how many steps they take (a trial that fails takes all that it has), and the mean reward over
all trials. Steps have a meaning in every problem; it is their ratio that is compared (the mean of
differences of logarithms), so that a tenth fewer counts the same where a task takes fifty or five
hundred.

What seems best among many seems better than it is on the trials that made it seem so. So whatever
is chosen is chosen by trials of one seed, and judged by those of another; all tables and sentences
rest on the latter.

A trial that fails is cut off at its limit, which says nothing of how long it would have taken. So
trials of the main ways are continued, to see who is slow and who is stuck for good.

The mean over these eight problems says nothing of a ninth. For that, problems are taken as drawn
from all that there could be.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from holdfast.experiments import statistics
from holdfast.experiments.cases import CASES, Case
from holdfast.experiments.study import CHOICE, CLAIM, Report, Results, Scale
from holdfast.experiments.tables import Cell, Table, number_of
from holdfast.experiments.tasks import Task
from holdfast.experiments.trial_batches import problem_of, trial_tasks
from holdfast.experiments.trial_files import cells_of_trials, kept_trials, require_cells
from holdfast.recording.tables import wilson_interval
from holdfast.settings import SelectorSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["INTERVALS", "WAYS", "Selectors"]

INTERVALS = (0, 4, 8, 14)
"""Steps between two sensing steps."""

LEVEL = 0.01
"""Of a family of tests: the probability that any difference is claimed where there is none."""

LEVEL_OF_VERDICT = 0.05
"""Of the tests whether a candidate is beaten, which the candidate had better not pass lightly."""

WAYS: Mapping[str, SelectorSettings] = {
    "random": SelectorSettings(method="random"),
    "fixed": SelectorSettings(method="fixed"),
    "state entropy, neighbours": SelectorSettings(
        method="state_entropy", estimator="nearest_neighbor"
    ),
    "state entropy, mixture": SelectorSettings(
        method="state_entropy", estimator="gaussian_mixture_upper"
    ),
    "action entropy, neighbours": SelectorSettings(
        method="action_entropy", estimator="nearest_neighbor"
    ),
    "action entropy, neighbours, executed": SelectorSettings(
        method="action_entropy", estimator="nearest_neighbor", actions="executed"
    ),
    "action entropy, mixture": SelectorSettings(
        method="action_entropy", estimator="gaussian_mixture_upper"
    ),
    "action entropy, mixture, executed": SelectorSettings(
        method="action_entropy", estimator="gaussian_mixture_upper", actions="executed"
    ),
    "action covariance": SelectorSettings(method="action_covariance"),
    "path entropy, neighbours": SelectorSettings(
        method="path_entropy", estimator="nearest_neighbor"
    ),
    "action entropy, prior neighbours": SelectorSettings(
        method="action_entropy", estimator="prior_neighbors"
    ),
    "path entropy, prior neighbours": SelectorSettings(
        method="path_entropy", estimator="prior_neighbors"
    ),
}
"""By the names that tables and figures give them; actions are the commanded ones, unless it says
that they are the executed ones."""

BASELINE = "random"

_DEFAULT = "path entropy, prior neighbours"
"""The project's; how it compares is told whether or not a difference was found."""

_CANDIDATES = (
    "path entropy, neighbours",
    "action entropy, prior neighbours",
    "path entropy, prior neighbours",
)
"""Ways of which one may become the default: the better one on the trials for choosing."""

_BEFORE = "action entropy, neighbours"
"""What the default was when they were compared with it."""

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
    "path entropy, prior neighbours": "path entropy",
}
"""Ways in the figures for a first look, and what they are called there."""

_CONTINUED = tuple(way for way in _SHOWN if way != "fixed")
"""Ways whose trials are continued where they are cut off."""

_CONTINUED_TRIALS = 60
"""Of these, as many at each interval: a trial that is stuck takes twenty times as long as one that
is cut off."""

_TRIALS = {CHOICE: 20, CLAIM: 120}
_QUICK_TRIALS = {CHOICE: 2, CLAIM: 4}
_TRIALS_IN_EACH = 20


class Selectors:
    """The study ``selectors``."""

    name = "selectors"
    title = "What is really best: choosing what to sense, on eight problems"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        return [
            task
            for purpose in _TRIALS
            for cell in _cells()
            for task in _tasks(purpose, cell, scale)
        ]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        trials = Table({})
        for purpose in _TRIALS:
            for cell in _cells():
                tasks = _tasks(purpose, cell, scale)
                names: dict[str, Cell] = dict(zip(_NAMES, cell, strict=True))
                seed = int(tasks[0].parameters["seed"])
                trials.extend(kept_trials(results.of(tasks)), purpose=purpose, seed=seed, **names)
        return self.report_of(trials)

    def report_of(self, trials: Table) -> Report:
        """Return what it comes to, from all its trials.

        Raises
        ------
        InvalidValueError
            If they are not those of this study.
        """
        cells = cells_of_trials(trials, ("purpose", *_NAMES))
        expected = {(purpose, *cell) for purpose in _TRIALS for cell in _cells()}
        require_cells(self.name, cells, expected)
        choosing, tables = (
            {cell: cells[purpose, *cell] for cell in _cells()} for purpose in (CHOICE, CLAIM)
        )
        summary = _summary(tables)
        logarithms = _of_trials(tables, _logarithms)
        successes = _of_trials(tables, _successes)
        relative_steps = _relative_steps(logarithms)
        rivals = _rivals(logarithms, "steps_ratio", statistics.ratio_of)
        rivals_in_success = _rivals(successes, "success_gain", statistics.as_it_is)
        over_problems = _over_problems(logarithms, successes)
        best = _best(_of_trials(choosing, _logarithms), logarithms, successes)
        candidates = _default_candidates(_of_trials(choosing, _logarithms), tables)
        stuck = _stuck(tables)
        costs = _costs(choosing, tables)
        report = Report(trials=trials)
        report.summary |= {
            "cases": _cases_table(tables, choosing),
            "selectors": summary,
            "relative_steps": relative_steps,
            "rivals": rivals,
            "rivals_in_success": rivals_in_success,
            "over_problems": over_problems,
            "chosen_ways": best,
            "default_candidates": candidates,
            "stuck": stuck,
            "costs_of_looks": costs,
        }
        report.figures["choice_of_sensing"] = partial(_draw_choice, summary)
        report.figures["selectors"] = partial(_draw_relative_steps, relative_steps)
        report.figures["costs_of_looks"] = partial(_draw_costs, costs)
        report.findings = [
            *_findings(relative_steps, rivals, rivals_in_success),
            *_findings_over_problems(over_problems),
            *_findings_of_choices(best, candidates),
            *_findings_of_stuck(stuck),
            *_findings_of_costs(costs),
        ]
        return report


FloatArray = npt.NDArray[np.float64]

_Shown = Callable[[statistics.Interval], statistics.Interval]
"""What is shown of a difference."""

_Cell = tuple[str, int, str]
"""Names of a case, an interval and a way."""

_NAMES = ("problem", "sensing_interval", "way")

_CASES: Mapping[str, Case] = {case.name: case for case in CASES}


def _cells() -> Iterator[_Cell]:
    for case in _CASES:
        for interval in INTERVALS:
            for way in WAYS:
                yield case, interval, way


def _tasks(purpose: str, cell: _Cell, scale: Scale) -> list[Task]:
    case, interval, way = cell
    series = _CASES[case].series(
        WAYS[way],
        interval,
        seed=scale.claim_seed if purpose == CLAIM else scale.seed,
        num_trials=(_QUICK_TRIALS if scale.quick else _TRIALS)[purpose],
        continued_trials=_CONTINUED_TRIALS if purpose == CLAIM and way in _CONTINUED else 0,
    )
    return list(trial_tasks(series, _TRIALS_IN_EACH))


def _cases_table(tables: Mapping[_Cell, Table], choosing: Mapping[_Cell, Table]) -> Table:
    """Return how each problem is posed, so that others can pose it."""
    rows: list[dict[str, Cell]] = []
    for name, case in _CASES.items():
        series = case.series(WAYS[_DEFAULT], INTERVALS[0], seed=0, num_trials=2)
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
                "trials_for_choosing": choosing[name, INTERVALS[0], _DEFAULT].num_rows,
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
        row["median_sensing_ms"] = table.columns["median_sensing_ms"][0]
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


def _successes(table: Table) -> FloatArray:
    return table.numbers("success")


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
    """Return each way that chooses with the baseline and with each of those before it."""
    choosing = [way for way in WAYS if WAYS[way].method not in ("random", "fixed")]
    return [
        (way, rival)
        for number, way in enumerate(choosing)
        for rival in (BASELINE, *choosing[:number])
    ]


def _rivals(trials: _Trials, name: str, shown: _Shown) -> Table:
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
        for way, rival in _pairs()
    )


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


_MEASURES: Mapping[str, _Shown] = {
    "steps_ratio": statistics.ratio_of,
    "success_gain": statistics.as_it_is,
}

_LEAST_DIFFERENCES = {"steps_ratio": 0.01, "success_gain": 1.0 / len(INTERVALS)}
"""By which the means of two trials over the intervals can differ; of steps, one in a hundred."""


def _over_problems(logarithms: _Trials, successes: _Trials) -> Table:
    """Return how ways differ over these problems, and over all that are like them."""
    rows: list[dict[str, Cell]] = []
    for measure, trials in (("steps_ratio", logarithms), ("success_gain", successes)):
        for way, rival in _pairs():
            rows.append(
                {
                    "measure": measure,
                    "way": way,
                    "rival": rival,
                    **statistics.cells_across_problems(
                        [(trials[case, way], trials[case, rival]) for case in _CASES],
                        _LEAST_DIFFERENCES[measure],
                        _MEASURES[measure],
                    ),
                }
            )
    table = Table.of_records(rows)
    statistics.add_adjusted(table, "mean_p_value", "expected_p_value")
    return table


def _best(choosing: _Trials, logarithms: _Trials, successes: _Trials) -> Table:
    """Return the way that takes the fewest steps on the trials for choosing, and how it does.

    Of each problem and of each group of them, against the baseline and the default.
    """
    rows: list[dict[str, Cell]] = []
    for place in (*_CASES, *_GROUPS):
        way = min(WAYS, key=lambda way: float(np.nanmean(choosing[place, way])))
        for rival in (BASELINE, _DEFAULT):
            seemed, _ = statistics.paired_difference(choosing[place, way], choosing[place, rival])
            row: dict[str, Cell] = {
                "problem": place,
                "chosen": way,
                "rival": rival,
                "steps_ratio_when_chosen": statistics.ratio_of(seemed).value,
                "trials": logarithms[place, way].size,
            }
            for name, trials in (("steps_ratio", logarithms), ("success_gain", successes)):
                difference, p_value = statistics.paired_difference(
                    trials[place, way], trials[place, rival]
                )
                row |= statistics.cells_of(name, _MEASURES[name](difference))
                row[f"{name}_p_value"] = p_value
            rows.append(row)
    table = Table.of_records(rows)
    another = np.array([row["chosen"] != row["rival"] for row in table.rows()])
    statistics.add_adjusted(table, *(f"{name}_p_value" for name in _MEASURES), compared=another)
    return table


_MEAN = "mean"
"""In place of an interval: the mean over all of them."""


def _default_candidates(choosing: _Trials, tables: Mapping[_Cell, Table]) -> Table:
    """Return what decides whether another way becomes the default.

    It does not if it is beaten beyond noise, in steps or success, by the baseline or by the default
    before, in any cell. The p-values of a candidate are adjusted for all its comparisons, of both
    measures.
    """
    place = next(iter(_GROUPS))
    chosen = min(_CANDIDATES, key=lambda way: float(np.nanmean(choosing[place, way])))
    found = Table({})
    for candidate in _CANDIDATES:
        rows = [
            {
                "candidate": candidate,
                "chosen": candidate == chosen,
                "problem": case,
                "sensing_interval": interval,
                "rival": rival,
                **_differences(tables, case, interval, candidate, rival),
            }
            for case in _CASES
            for interval in (*INTERVALS, _MEAN)
            for rival in (BASELINE, _BEFORE)
        ]
        table = Table.of_records(rows)
        p_values = np.concatenate([table.numbers(f"{name}_p_value") for name in _MEASURES])
        adjusted = statistics.smallest_levels(p_values).reshape(len(_MEASURES), -1)
        for name, levels in zip(_MEASURES, adjusted, strict=True):
            table.columns[f"{name}_adjusted_p_value"] = [float(level) for level in levels]
        table.columns["beaten_in"] = [_beaten_in(row) for row in table.rows()]
        found.extend(table)
    return found


def _differences(
    tables: Mapping[_Cell, Table], case: str, interval: int | str, way: str, rival: str
) -> dict[str, Cell]:
    """Return how two ways differ at an interval, or in the mean over all intervals."""
    intervals = INTERVALS if isinstance(interval, str) else (interval,)
    row: dict[str, Cell] = {"trials": tables[case, intervals[0], way].num_rows}
    for name, number in (("steps_ratio", _logarithms), ("success_gain", _successes)):
        own, other = (
            np.asarray(np.mean([number(tables[case, each, which]) for each in intervals], axis=0))
            for which in (way, rival)
        )
        if name == "success_gain" and len(intervals) == 1:
            difference, p_value = statistics.paired_rates(own == 1.0, other == 1.0)
        else:
            difference, p_value = statistics.paired_difference(own, other)
        row |= statistics.cells_of(name, _MEASURES[name](difference))
        row[f"{name}_p_value"] = p_value
    return row


def _beaten_in(row: Mapping[str, Cell]) -> str:
    """Return in which measures the rival is better beyond noise."""
    worse = {
        "steps": number_of(row["steps_ratio"]) > 1.0
        and number_of(row["steps_ratio_adjusted_p_value"]) < LEVEL_OF_VERDICT,
        "success": number_of(row["success_gain"]) < 0.0
        and number_of(row["success_gain_adjusted_p_value"]) < LEVEL_OF_VERDICT,
    }
    return " and ".join(name for name, is_so in worse.items() if is_so)


def _stuck(tables: Mapping[_Cell, Table]) -> Table:
    """Return how many trials were cut off, and how many of these never reached the goal.

    At each interval, and in the mean over all of them.
    """
    rows: list[dict[str, Cell]] = []
    for name, case in _CASES.items():
        continued = {cell: _continued(table) for cell, table in tables.items() if cell[0] == name}
        for interval in (*INTERVALS, _MEAN):
            intervals = INTERVALS if isinstance(interval, str) else (interval,)
            others = np.array([_stuck_in(continued[name, each, BASELINE]) for each in intervals])
            for way in _CONTINUED:
                found = [continued[name, each, way] for each in intervals]
                cut = np.array([table.numbers("success") != 1.0 for table in found])
                stuck = np.array([_stuck_in(table) for table in found])
                row: dict[str, Cell] = {
                    "problem": name,
                    "sensing_interval": interval,
                    "way": way,
                    "trials": stuck.size,
                    "max_steps": case.max_steps,
                    "cut_off": int(cut.sum()),
                    "continued_to": found[0].columns["step_limit"][0],
                    "stuck": int(stuck.sum()),
                }
                row |= statistics.cells_of("cut_off_share", _share(cut))
                row |= statistics.cells_of("stuck_share", _share(stuck))
                if len(intervals) == 1:
                    difference, p_value = statistics.paired_rates(stuck[0], others[0])
                else:
                    difference, p_value = statistics.paired_difference(
                        stuck.mean(axis=0), others.mean(axis=0)
                    )
                row |= statistics.cells_of("stuck_beyond_random", difference)
                row["p_value"] = p_value
                rows.append(row)
    table = Table.of_records(rows)
    compared = np.array([way != BASELINE for way in table.columns["way"]])
    statistics.add_adjusted(table, "p_value", compared=compared)
    return table


def _share(trials: npt.NDArray[np.bool_]) -> statistics.Interval:
    """Return the share of trials, shape (intervals, worlds), in which something is so.

    Trials of one world are not independent: over several intervals the interval is Student's, of
    the worlds' shares, and Wilson's where these are all 0 or all 1, which have no scatter.
    """
    whole = trials.all() or not trials.any()
    if trials.shape[0] > 1 and not whole:
        value, low, high = statistics.mean_interval(trials.mean(axis=0))
        return statistics.Interval(value, max(low, 0.0), min(high, 1.0))
    successes = int(trials[0].sum())
    return statistics.Interval(
        successes / trials.shape[1], *wilson_interval(successes, trials.shape[1])
    )


def _continued(table: Table) -> Table:
    """Return the trials that are continued if they are cut off: those with the highest limit."""
    limits = table.numbers("step_limit")
    which = np.flatnonzero(limits == limits.max())
    return Table({name: [cells[row] for row in which] for name, cells in table.columns.items()})


def _stuck_in(table: Table) -> npt.NDArray[np.bool_]:
    return np.asarray(np.isnan(table.numbers("steps_to_goal")))


_COSTS = (0.0, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Of a look, in units of reward (the length of the way, in most problems)."""


def _costs(choosing: Mapping[_Cell, Table], tables: Mapping[_Cell, Table]) -> Table:
    """Return how often to look where looking costs, what that earns, and how much beyond random.

    The interval is the best one on the trials for choosing.
    """
    rows: list[dict[str, Cell]] = []
    for case in _CASES:
        for cost in _COSTS:
            best = {
                way: max(
                    INTERVALS,
                    key=lambda interval: float(_net(choosing[case, interval, way], cost).mean()),
                )
                for way in _SHOWN
            }
            nets = {way: _net(tables[case, best[way], way], cost) for way in _SHOWN}
            for way, net in nets.items():
                gain, p_value = statistics.paired_difference(net, nets[BASELINE])
                rows.append(
                    {
                        "problem": case,
                        "way": way,
                        "cost_of_a_look": cost,
                        "best_interval": best[way],
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


def _net(table: Table, cost: float) -> FloatArray:
    """Return the reward of each trial less the costs of its looks."""
    return np.asarray(table.numbers("reward") - cost * table.numbers("sensing_decisions"))


def _findings(relative_steps: Table, rivals: Table, rivals_in_success: Table) -> list[str]:
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
        # How steps compare with random's is told above.
        if row["rival"] != BASELINE and (_is_sure(row) or _is_about_the_default(row))
    ]
    findings += [
        f"{_place(row)}, {row['way']} against {row['rival']}: {_points(row, 'success_gain')} "
        f"points of success ({every}; n = {row['trials']}, paired t-test, {_level(row)})"
        for row in rivals_in_success.rows()
        if _is_sure(row) or _is_about_the_default(row)
    ]
    return findings


def _findings_over_problems(over_problems: Table) -> list[str]:
    findings = []
    for row in over_problems.rows():
        told = (*_CANDIDATES, _DEFAULT)
        if row["way"] not in told or row["rival"] not in (BASELINE, *told):
            continue
        shown, unit = (
            (_ratio, "times the steps")
            if row["measure"] == "steps_ratio"
            else (_points, "points of success")
        )
        factor, form = (1.0, ".3g") if row["measure"] == "steps_ratio" else (100.0, "+.1f")
        new_low, new_high = (
            format(factor * number_of(row[f"new_problem_{end}"]), form) for end in ("low", "high")
        )
        findings.append(
            f"problems as a random effect, {row['way']} against {row['rival']}: "
            f"{shown(row, 'expected')} {unit} in the mean over all such problems, from "
            f"{new_low} to {new_high} in a new one (n = {row['problems']} problems, "
            f"Paule-Mandel, Hartung-Knapp, {_level(row, 'expected_adjusted_p_value')}); "
            f"{shown(row, 'mean')} in the mean over these"
        )
    return findings


def _findings_of_choices(best: Table, candidates: Table) -> list[str]:
    findings = [
        f"{_place(row)}, {row['chosen']} (the fewest steps on the other seed) against "
        f"{row['rival']}: {_ratio(row)} times the steps "
        f"({number_of(row['steps_ratio_when_chosen']):.3g} where it was chosen) and "
        f"{_points(row, 'success_gain')} points of success (n = {row['trials']}, paired t-tests, "
        f"{_level(row, 'steps_ratio_adjusted_p_value')} and "
        f"{number_of(row['success_gain_adjusted_p_value']):.2g})"
        for row in best.rows()
        if row["chosen"] != row["rival"]
    ]
    for candidate in _CANDIDATES:
        rows = [row for row in candidates.rows() if row["candidate"] == candidate]
        beaten = [row for row in rows if row["beaten_in"]]
        better = sum(_is_better(row) for row in rows)
        chosen = "chosen on the other seed" if rows[0]["chosen"] else "not chosen on the other seed"
        places = "; ".join(
            f"{row['problem']} at {row['sensing_interval']} by {row['rival']} in {row['beaten_in']}"
            for row in beaten
        )
        findings.append(
            f"{candidate} as the default ({chosen}): beaten beyond noise in {len(beaten)} of "
            f"{len(rows)} comparisons with random and {_BEFORE}"
            f"{f' ({places})' if places else ''}, better beyond noise in {better} (each problem, "
            "each interval and the mean over them; paired t-tests and McNemar's, Holm-adjusted "
            f"level {LEVEL_OF_VERDICT:g} over all)"
        )
    return findings


def _is_better(row: Mapping[str, Cell]) -> bool:
    fewer = number_of(row["steps_ratio"]) < 1.0
    more = number_of(row["success_gain"]) > 0.0
    return (fewer and number_of(row["steps_ratio_adjusted_p_value"]) < LEVEL_OF_VERDICT) or (
        more and number_of(row["success_gain_adjusted_p_value"]) < LEVEL_OF_VERDICT
    )


def _findings_of_stuck(stuck: Table) -> list[str]:
    return [
        f"{row['problem']}, {row['way']}: {row['cut_off']} of {row['trials']} trials are cut off "
        f"at {row['max_steps']} steps, {row['stuck']} are not at the goal after "
        f"{row['continued_to']:,} ({_points(row, 'stuck_beyond_random')} points beyond random; all "
        f"intervals, paired t-test, {_level(row)})"
        for row in stuck.rows()
        if row["sensing_interval"] == _MEAN and row["cut_off"]
    ]


def _findings_of_costs(costs: Table) -> list[str]:
    return [
        f"{row['problem']}, a look costs {row['cost_of_a_look']}, {row['way']} at its "
        f"best interval: {number_of(row['gain']):+.3g} [{number_of(row['gain_low']):+.3g}, "
        f"{number_of(row['gain_high']):+.3g}] of reward beyond random at its best (n = "
        f"{row['trials']}, paired t-test, {_level(row)})"
        for row in costs.rows()
        if row["cost_of_a_look"] in (0.1, 1.0)
        and row["way"] != BASELINE
        and (_is_sure(row) or row["way"] == _DEFAULT)
    ]


def _is_about_the_default(row: Mapping[str, Cell]) -> bool:
    """Tell whether a row compares the default or a candidate over several problems.

    Or anywhere with random.
    """
    pair = {row["way"], row["rival"]}
    told = {_DEFAULT, *_CANDIDATES}
    return bool(pair & told) and (row["problem"] in _GROUPS or BASELINE in pair)


def _is_sure(row: Mapping[str, Cell]) -> bool:
    return number_of(row["adjusted_p_value"]) < LEVEL


def _level(row: Mapping[str, Cell], name: str = "adjusted_p_value") -> str:
    return f"Holm-adjusted p {number_of(row[name]):.2g}"


def _ratio(row: Mapping[str, Cell], name: str = "steps_ratio") -> str:
    ends = (number_of(row[f"{name}{end}"]) for end in ("", "_low", "_high"))
    return str(statistics.Interval(*ends))


def _points(row: Mapping[str, Cell], name: str) -> str:
    value, low, high = (100.0 * number_of(row[f"{name}{end}"]) for end in ("", "_low", "_high"))
    return f"{value:+.1f} [{low:+.1f}, {high:+.1f}]"


def _place(row: Mapping[str, Cell]) -> str:
    return f"{row['problem']} (mean)" if row["problem"] in _GROUPS else str(row["problem"])


def _draw_choice(summary: Table) -> Figure:
    from holdfast.experiments import plots

    figure, panels = plots.grid_of_panels(
        list(_CASES),
        columns=4,
        title="What choosing the sensing action gains (means, 95 % intervals)",
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
                offset=0.2 * (number - 2.0),
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
