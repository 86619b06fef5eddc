"""The results of 2017, three ways: as logged, with that implementation's defects, and without.

The first implementation's logs end with how many of 1,000 trials succeeded and what the successful
ones earned. If the same numbers come of its defects (:mod:`holdfast.experiments.emulation_2017`)
put around our problems and policies, these are the same as its own, and what a sound filter does
differently is the filter's doing.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping
from functools import partial
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np

from holdfast.experiments import statistics
from holdfast.experiments.study import Report, Results, Scale
from holdfast.experiments.tables import Cell, Table, number_of
from holdfast.experiments.tasks import Task
from holdfast.experiments.trial_batches import TrialSeries, trial_tasks
from holdfast.recording.tables import wilson_interval
from holdfast.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Published2017", "PublishedRow", "published_rows", "series_of"]

LEVEL = 0.01
"""Of each family of tests: the probability that any row is said to differ although none does."""

_PROBLEMS: Mapping[str, str] = {
    "peg_hole_2d": "peg_in_hole_2d",
    "multitier_peg_hole_2d": "multitier_peg_in_hole_2d",
    "capsule_robot": "capsule_robot",
}
"""What the logs call the problems."""

_EARLIER_VERSION = "2017-09-04"
"""Logged by an earlier version of the program: failed trials cost as much as others, so they ended
early, while in all later logs they go on to the last step and cost two to three times as much."""

_WIDER_MAP = (-15.0, -15.0, 15.0, 15.0)
_WIDER_TOLERANCES: Mapping[str, tuple[float, float, float]] = {
    "2017-09-06": (0.3, 0.2, 0.1),
    "2017-09-07": (0.2, 0.15, 0.1),
}
"""The logs of these days list other holes, and a wider map."""

_CENTERS = ((4.0, 6.0), (-4.0, 0.0), (0.0, -6.0))
_QUICK_TRIALS = 12
_TRIALS_IN_EACH = 50
_EMULATED_IN_EACH = 250  # side by side
_SELECTORS = ("random", "state_entropy", "action_entropy")


class PublishedRow(NamedTuple):
    """A row of the table of 2017."""

    problem: str
    logged: str
    sensing_interval: int
    max_steps: int
    num_trials: int
    num_particles: int
    num_observation_samples: int
    num_nearest_neighbors: int
    selector: str
    successes: int
    mean_reward_of_successes: float
    mean_sensing_seconds: float

    @property
    def covered(self) -> bool:
        """Whether our problem is the one that was logged."""
        return not self.logged.startswith(_EARLIER_VERSION)


def published_rows() -> list[PublishedRow]:
    """Return the table, in the order of the file."""
    file = resources.files("holdfast.experiments") / "data" / "results_2017.csv"
    rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
    return [msgspec.convert(list(row.values()), PublishedRow, strict=False) for row in rows]


def series_of(row: PublishedRow, num_trials: int, seed: int) -> TrialSeries:
    """Return the trials that a row is about, as ours."""
    model: dict[str, Any] = {}
    tolerances = _WIDER_TOLERANCES.get(row.logged[:10])
    if tolerances is not None:
        model = {
            "map_dim": _WIDER_MAP,
            "holes": [
                {"center": center, "tol": tolerance}
                for center, tolerance in zip(_CENTERS, tolerances, strict=True)
            ],
        }
    return TrialSeries(
        problem=_PROBLEMS[row.problem],
        model=model,
        planning=PlanningSettings(
            particle_filter=ParticleFilterSettings(num_particles=row.num_particles),
            active_sensing=ActiveSensingSettings(
                num_observation_samples=row.num_observation_samples,
                num_nearest_neighbors=row.num_nearest_neighbors,
                num_cores=1,
            ),
            selector=msgspec.convert(
                {"method": row.selector, "estimator": "nearest_neighbor"}, SelectorSettings
            ),
            sensing_interval=row.sensing_interval,
        ),
        max_steps=row.max_steps,
        seed=seed,
        num_trials=num_trials,
    )


class Published2017:
    """The study ``published_2017``."""

    name = "published_2017"
    title = "The results of 2017: as logged, with that implementation's defects, and without"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        return [
            task
            for row in published_rows()
            if row.covered
            for task in (*_emulated(row, scale), *_sound(row, scale))
        ]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        report = Report()
        rows = [row for row in published_rows() if row.covered]
        raw = Table({})
        cells: list[dict[str, Cell]] = []
        for row in rows:
            emulated = results.of(_emulated(row, scale))
            sound = results.of(_sound(row, scale))
            for way, table in (("emulated", emulated), ("sound", sound)):
                raw.extend(_outcomes(table), **_names(row), way=way)
            cells.append({**_names(row), **_compared(row, emulated, sound)})
        summary = Table.of_records(cells)
        _adjust(summary)
        report.summary["published_2017"] = summary
        report.raw["published_2017"] = raw
        report.figures["published_2017"] = partial(_draw, summary)
        report.findings = _findings(summary)
        return report


def _emulated(row: PublishedRow, scale: Scale) -> list[Task]:
    series = series_of(row, _num_trials(row, scale), scale.seed)
    return list(trial_tasks(series, _EMULATED_IN_EACH, "emulation_2017"))


def _sound(row: PublishedRow, scale: Scale) -> list[Task]:
    series = series_of(row, _num_trials(row, scale), scale.seed)
    return list(trial_tasks(series, _TRIALS_IN_EACH))


def _num_trials(row: PublishedRow, scale: Scale) -> int:
    return _QUICK_TRIALS if scale.quick else row.num_trials


def _names(row: PublishedRow) -> dict[str, Cell]:
    return {
        "problem": _PROBLEMS[row.problem],
        "logged": row.logged[:10],
        "max_steps": row.max_steps,
        "sensing_interval": row.sensing_interval,
        "selector": row.selector,
    }


def _outcomes(table: Table) -> Table:
    return Table({name: table.columns[name] for name in ("trial", "success", "steps", "reward")})


def _compared(row: PublishedRow, emulated: Table, sound: Table) -> dict[str, Cell]:
    cells: dict[str, Cell] = {
        "trials_logged": row.num_trials,
        "trials": emulated.num_rows,
        **_rate("logged", row.successes, row.num_trials),
    }
    for way, table in (("emulated", emulated), ("sound", sound)):
        cells |= _rate(way, int(table.numbers("success").sum()), table.num_rows)
    cells["successes_p_value"] = statistics.agreement_of_rates(
        int(emulated.numbers("success").sum()), emulated.num_rows, row.successes, row.num_trials
    )
    cells["reward_of_successes_logged"] = row.mean_reward_of_successes
    for way, table in (("emulated", emulated), ("sound", sound)):
        earned = table.numbers("reward")[table.numbers("success") == 1.0]
        interval = statistics.mean_interval(earned)
        cells |= statistics.cells_of(f"reward_of_successes_{way}", interval)
        if way == "emulated":
            p_value = statistics.agreement_of_means(
                earned, row.mean_reward_of_successes, row.successes
            )
            cells["reward_p_value"] = None if math.isnan(p_value) else p_value
    interval = statistics.mean_interval(sound.numbers("reward"))
    cells |= statistics.cells_of("mean_reward_sound", interval)
    cells["mean_sensing_ms_logged"] = 1e3 * row.mean_sensing_seconds
    cells["mean_sensing_ms_sound"] = float(np.nanmean(sound.numbers("mean_sensing_ms")))
    return cells


def _rate(way: str, successes: int, trials: int) -> dict[str, Cell]:
    low, high = wilson_interval(successes, trials)
    return {
        f"success_{way}": successes / trials,
        f"success_{way}_low": low,
        f"success_{way}_high": high,
    }


def _adjust(summary: Table) -> None:
    """Add p-values that are adjusted for the number of rows of each problem."""
    for name in ("successes", "reward"):
        p_values = summary.numbers(f"{name}_p_value")
        problems = np.array(summary.columns["problem"])
        adjusted = np.full(p_values.size, np.nan)
        for problem in set(summary.columns["problem"]):
            family = (problems == problem) & ~np.isnan(p_values)
            adjusted[family] = statistics.smallest_levels(p_values[family])
        summary.columns[f"{name}_adjusted_p_value"] = [
            None if np.isnan(value) else float(value) for value in adjusted
        ]


def _findings(summary: Table) -> list[str]:
    findings = []
    problems = np.array(summary.columns["problem"])
    for problem in dict.fromkeys(summary.columns["problem"]):
        here = problems == problem
        for name, what, test in (
            ("successes", "successes", "Fisher's exact test"),
            ("reward", "mean rewards of successful trials", "normal test"),
        ):
            levels = summary.numbers(f"{name}_adjusted_p_value")[here]
            tested = levels[~np.isnan(levels)]
            agreeing = int(np.count_nonzero(tested >= LEVEL))
            findings.append(
                f"{problem}, emulated and logged {what}: no difference found in {agreeing} of "
                f"{tested.size} rows"
                + (f", one in {tested.size - agreeing}" if agreeing < tested.size else "")
                + f" ({test}, Holm-adjusted level {LEVEL:g}; least adjusted p "
                f"{_level(tested.min())})"
                if tested.size
                else f"{problem}, {what}: too few successes to compare"
            )
        rows = [row for row in summary.rows() if row["problem"] == problem]
        # That no difference was found says little unless it is said how large one may be.
        findings += [
            f"{problem}, emulated less logged {what}: {text}"
            for what, text in (
                ("successes", _largest(map(_successes_apart, rows), ".1f", 100.0, " points")),
                ("mean rewards of successful trials", _largest(map(_rewards_apart, rows), ".2g")),
            )
            if text
        ]
        logged, sound = summary.numbers("success_logged")[here], summary.numbers("success_sound")
        low = summary.numbers("success_sound_low")[here]
        above = int(np.count_nonzero(low > summary.numbers("success_logged_high")[here]))
        findings.append(
            f"{problem}, true filter: success {100 * sound[here].min():.1f} to "
            f"{100 * sound[here].max():.1f} %, logged {100 * logged.min():.1f} to "
            f"{100 * logged.max():.1f} %; in {above} of {int(here.sum())} rows its 95 % interval "
            "(Wilson) is above the logged one"
        )
        selectors = np.array(summary.columns["selector"])
        ranges = []
        for selector in dict.fromkeys(selectors[here]):
            values = 100.0 * sound[here & (selectors == selector)]
            ranges.append(f"{selector} {values.min():.1f} to {values.max():.1f} %")
        findings.append(
            f"{problem}, true filter, by what chooses: success {', '.join(ranges)} (over the rows; "
            "intervals are in the table)"
        )
    return findings


def _successes_apart(row: Mapping[str, Cell]) -> statistics.Interval:
    emulated, logged = (
        statistics.Interval(
            *(number_of(row[f"success_{way}{end}"]) for end in ("", "_low", "_high"))
        )
        for way in ("emulated", "logged")
    )
    return statistics.independent_difference(emulated, logged)


def _rewards_apart(row: Mapping[str, Cell]) -> statistics.Interval:
    """Return the difference of mean rewards; the logged ones are taken to scatter as ours do."""
    emulated = statistics.Interval(
        *(number_of(row[f"reward_of_successes_emulated{end}"]) for end in ("", "_low", "_high"))
    )
    counts = (
        number_of(row[f"success_{way}"]) * number_of(row[trials])
        for way, trials in (("emulated", "trials"), ("logged", "trials_logged"))
    )
    ours, others = counts
    if not (ours and others):
        return statistics.Interval(math.nan, math.nan, math.nan)
    half = math.sqrt(ours / others) * (emulated.high - emulated.value)
    value = number_of(row["reward_of_successes_logged"])
    logged = statistics.Interval(value, value - half, value + half)
    return statistics.independent_difference(emulated, logged)


def _largest(
    differences: Iterable[statistics.Interval], form: str, scale: float = 1.0, unit: str = ""
) -> str | None:
    """Say which of some differences is the largest, and within what all their intervals lie."""
    known = [each for each in differences if all(map(math.isfinite, each))]
    if not known:
        return None
    largest = max(known, key=lambda each: abs(each.value))
    ends = (*largest, min(each.low for each in known), max(each.high for each in known))
    value, low, high, least, most = (f"{scale * end:+{form}}" for end in ends)
    return (
        f"the largest difference is {value}{unit} [{low}, {high}], and all intervals of "
        f"{len(known)} rows lie within {least} and {most} (single 95 % intervals, by Newcombe)"
    )


def _level(p_value: float) -> str:
    return f"{p_value:.2g}" if p_value > 0.0 else "below 1e-300"


def _draw(summary: Table) -> Figure:
    from holdfast.experiments import plots

    problems = list(dict.fromkeys(map(str, summary.columns["problem"])))
    rows_of = {
        problem: [row for row in summary.rows() if row["problem"] == problem]
        for problem in problems
    }
    figure, panels = plots.stacked_panels(
        [len(rows) for rows in rows_of.values()],
        title="Successes of 2017: as logged, with the resampler of then emulated, with a true one",
        width=8.4,
    )
    ways = {"logged": "as logged", "emulated": "emulated", "sound": "true filter"}
    for number, (panel, (problem, rows)) in enumerate(zip(panels, rows_of.items(), strict=True)):
        labels = [f"{row['logged']}, every {_steps(row)}, {row['selector']}" for row in rows]
        plots.dot_rows(
            panel,
            labels,
            [
                plots.Dots(
                    label,
                    [100.0 * float(row[f"success_{way}"] or 0.0) for row in rows],
                    [100.0 * float(row[f"success_{way}_low"] or 0.0) for row in rows],
                    [100.0 * float(row[f"success_{way}_high"] or 0.0) for row in rows],
                )
                for way, label in ways.items()
            ],
            legend=number == 0,
        )
        panel.set_title(problem, loc="left")
    panels[-1].set_xlabel("trials that reach the goal (%), with 95 % intervals")
    return figure


def _steps(row: Mapping[str, Cell]) -> str:
    interval = int(row["sensing_interval"] or 0)
    return "step" if interval == 0 else f"{interval + 1} steps"
