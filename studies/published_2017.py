"""The results of 2017, three ways: as logged, with that implementation's defects, and without.

The first implementation's logs end with how many of 1,000 trials succeeded and what the successful
ones earned. If the same numbers come of its defects (:mod:`studies.emulation_2017`)
put around our problems and policies, these are the same as its own, and what a sound filter does
differently is the filter's doing.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import pandas as pd

from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from studies import statistics
from studies.statistics import Interval, cells_of, interval_in
from studies.study import Number, Part, Report, Scale, Study
from studies.tables import Cell
from studies.trial_batches import TrialSeries, trial_tasks

if TYPE_CHECKING:
    from matplotlib.figure import Figure


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
_TRIALS_IN_EACH: Mapping[str, int] = {"emulation_2017": 250, "trials": 50}
"""By kind of task: those of the emulation run side by side."""

_WAYS: Mapping[str, str] = {"emulated": "emulation_2017", "sound": "trials"}
"""The two ways in which each row is run, with their kinds of tasks."""


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
    file = resources.files("studies") / "data" / "results_2017.csv"
    rows = csv.DictReader(file.read_text(encoding="utf-8").splitlines())
    return [msgspec.convert(list(row.values()), PublishedRow, strict=False) for row in rows]


def _covered() -> list[PublishedRow]:
    return [row for row in published_rows() if row.covered]


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


class Published2017(Study):
    """The study ``published_2017``."""

    name = "published_2017"
    title = "The results of 2017: as logged, with that implementation's defects, and without"

    def parts(self, scale: Scale) -> Iterator[Part]:
        """Yield each row of 2017 that our problems cover, in both ways."""
        for number, row in enumerate(_covered()):
            series = series_of(row, _QUICK_TRIALS if scale.quick else row.num_trials, scale.seed)
            for way, kind in _WAYS.items():
                tasks = list(trial_tasks(series, _TRIALS_IN_EACH[kind], kind))
                yield Part({"row": number, **_names(row), "way": way}, tasks, self.name)

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on the rows of all parts."""
        summary = pd.DataFrame(
            {**_names(row), **_compared(row, trials)}
            for row, (_, trials) in zip(_covered(), tables[self.name].groupby("row"), strict=True)
        )
        for name in ("successes", "reward"):
            # Adjusted for the number of rows of each problem.
            known = summary[summary[f"{name}_p_value"].notna()]
            adjusted = known.groupby("problem")[f"{name}_p_value"].transform(statistics.holm)
            summary[f"{name}_adjusted_p_value"] = adjusted
        return Report(
            summary={"published_2017": summary},
            figures={"published_2017": partial(_draw, summary)},
            numbers=numbers_of(summary),
        )


def _names(row: PublishedRow) -> dict[str, Cell]:
    return {
        "problem": _PROBLEMS[row.problem],
        "logged": row.logged[:10],
        "max_steps": row.max_steps,
        "sensing_interval": row.sensing_interval,
        "selector": row.selector,
    }


def _compared(row: PublishedRow, trials: pd.DataFrame) -> dict[str, Cell]:
    """Return the cells of a row, with our trials of both ways."""
    ways = {way: trials[trials["way"] == way] for way in _WAYS}
    emulated, sound = ways.values()
    successes = {way: (int(own["success"].sum()), len(own)) for way, own in ways.items()}
    logged = (row.successes, row.num_trials)
    cells: dict[str, Cell] = {"trials_logged": row.num_trials, "trials": len(emulated)}
    for way, counts in {"logged": logged, **successes}.items():
        cells |= cells_of(f"success_{way}", statistics.rate_interval(*counts))
    cells["successes_p_value"] = statistics.agreement_of_rates(*successes["emulated"], *logged)
    cells["reward_of_successes_logged"] = row.mean_reward_of_successes
    earned = {way: own["reward"][own["success"]].to_numpy() for way, own in ways.items()}
    rewards = {way: statistics.mean_interval(own) for way, own in earned.items()}
    return cells | {
        **cells_of("reward_of_successes_emulated", rewards["emulated"]),
        "reward_p_value": statistics.agreement_of_means(
            earned["emulated"], row.mean_reward_of_successes, row.successes
        ),
        **cells_of("reward_of_successes_sound", rewards["sound"]),
        **cells_of("mean_reward_sound", statistics.mean_interval(sound["reward"].to_numpy())),
        "mean_sensing_ms_logged": 1e3 * row.mean_sensing_seconds,
        "mean_sensing_ms_sound": float(sound["mean_sensing_ms"].mean()),
    }


def numbers_of(summary: pd.DataFrame) -> list[Number]:
    """Return the largest differences between emulated and logged, for each problem.

    That no difference was found says little without how large one may be.
    """
    numbers = []
    apart: dict[str, tuple[str, Callable[[Mapping[Any, Any]], Interval]]] = {
        "successes": ("points", _successes_apart),
        "mean rewards of successful trials": ("of reward", _rewards_apart),
    }
    for problem, rows in summary.groupby("problem", sort=False):
        for what, (unit, difference) in apart.items():
            found = map(difference, rows.to_dict("records"))
            known = [each for each in found if all(map(math.isfinite, each))]
            if known:
                largest = max(known, key=lambda each: abs(each.value))
                name = f"{problem}, {what}, emulated less logged: the largest difference"
                numbers.append(Number(name, largest, unit, len(known)))
    return numbers


def _successes_apart(row: Mapping[Any, Any]) -> Interval:
    """Return the difference of successes in points, with Newcombe's interval."""
    return statistics.independent_difference(
        interval_in(row, "success_emulated", 100.0), interval_in(row, "success_logged", 100.0)
    )


def _rewards_apart(row: Mapping[Any, Any]) -> Interval:
    """Return the difference of mean rewards; the logged ones are taken to scatter as ours do."""
    emulated = interval_in(row, "reward_of_successes_emulated")
    ours = row["success_emulated"] * row["trials"]
    others = row["success_logged"] * row["trials_logged"]
    if not (ours and others):
        return statistics.exactly(math.nan)
    half = math.sqrt(ours / others) * (emulated.high - emulated.value)
    value = row["reward_of_successes_logged"]
    return statistics.independent_difference(emulated, Interval(value, value - half, value + half))


def _draw(summary: pd.DataFrame) -> Figure:
    from studies import plots

    groups = list(summary.groupby("problem", sort=False))
    figure, panels = plots.stacked_panels(
        [len(rows) for _, rows in groups],
        title="Successes of 2017: as logged, emulated, and with a true filter",
        width=8.4,
    )
    ways = {"logged": "as logged", "emulated": "emulated", "sound": "true filter"}
    for number, (panel, (problem, rows)) in enumerate(zip(panels, groups, strict=True)):
        labels = [
            f"{row['logged']}, every {_steps(row['sensing_interval'])}, {row['selector']}"
            for row in rows.to_dict("records")
        ]
        dots = [plots.dots_of(label, rows, f"success_{way}", 100.0) for way, label in ways.items()]
        plots.dot_rows(panel, labels, dots, legend=number == 0)
        panel.set_title(problem, loc="left")
    panels[-1].set_xlabel("trials that reach the goal (%), with 95 % intervals")
    return figure


def _steps(interval: int) -> str:
    return "step" if interval == 0 else f"{interval + 1} steps"
