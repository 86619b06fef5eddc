"""Published problems: the reward of published planners, and of holdfast's ways of looking.

Van der Pol tag with barriers (:mod:`holdfast.lab.studies.vdp_tag`) has a price for each look and
published figures of seven planners. Two of them are heuristics that are simple enough to be run
here: if they earn what was published, the world is the same one. Beside them are plans for beliefs
(:mod:`holdfast.lab.studies.vdp_pursuit`) with several rules for when to look, all of them with the
same plans and the same targets, so that they are compared trial by trial.

Of ``manage_uncertainty`` our mean is the lower one on each of three seeds (by 1.4 to 3 standard
errors of the difference), and it tags in the fifth step more often than the published trials say;
single trials with the same number of steps and looks earn the same to the last digit. Why, is not
known.

Seed 8001 chose the thresholds of the rules and how far plans look ahead; seed 8101 judges.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from functools import partial
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pandas as pd

from holdfast.arrays import FloatArray, IntArray
from holdfast.config.settings import (
    ActiveSensingSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.errors import InvalidValueError
from holdfast.lab.errors import TaskError
from holdfast.lab.studies import statistics
from holdfast.lab.studies.statistics import Interval, cells_of, interval_in
from holdfast.lab.studies.study import Number, Report, Results, Scale
from holdfast.lab.studies.tables import Cell
from holdfast.lab.studies.tasks import Task
from holdfast.lab.studies.trial_files import rounded
from holdfast.lab.studies.vdp_pursuit import Pursuit, always, by_chance, by_selector, never
from holdfast.lab.studies.vdp_tag import DISCOUNT
from holdfast.lab.studies.vdp_trials import (
    VdpTagPolicy,
    intercept,
    manage_uncertainty,
    run_vdp_tag_trials,
    to_next,
)
from holdfast.randomness import Stream

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["COLUMNS", "WAYS", "PublishedWorlds", "Way", "published_planners", "run_vdp_tag"]

COLUMNS = ("trial", "discounted_reward", "tagged", "steps", "looks", "mean_decision_ms")
"""Of the table of a task: a row for each trial."""

_FRACTIONS = ("discounted_reward", "mean_decision_ms")

BEST = "priced looks"
"""The way that is compared with all others."""

STRONGEST = "pomcpow"
"""The published planner that earned most."""

_QUICK_TRIALS = 4
_TRIALS_IN_EACH = 25  # side by side
_FEW_PARTICLES = 300
_PARTICLES = 1000


class Way(NamedTuple):
    """A policy with its settings.

    Attributes
    ----------
    trials : int
        As many as its standard error needs.
    published : bool
        Whether it is a published heuristic, with the particle filter of its figures.
    known_state : bool
        Whether it is told the true state.
    """

    policy: VdpTagPolicy
    trials: int
    num_particles: int = _PARTICLES
    published: bool = False
    known_state: bool = False


def _selecting(least_nats: float, selector: SelectorSettings, samples: int = 16) -> VdpTagPolicy:
    sensing = ActiveSensingSettings(num_observation_samples=samples, num_cores=1, discount=DISCOUNT)
    planning = PlanningSettings(selector=selector, active_sensing=sensing)
    return Pursuit(by_selector(planning, least_nats)).decide


_EXPECTED_RETURN = SelectorSettings(
    method="expected_return", rollout_steps=20, max_observation_samples=8
)

WAYS: Mapping[str, Way] = {
    "to_next": Way(to_next, 1000, _FEW_PARTICLES, published=True),
    "manage_uncertainty": Way(manage_uncertainty, 1000, _FEW_PARTICLES, published=True),
    BEST: Way(Pursuit().decide, 1000),
    "known state": Way(intercept, 1000, 1, known_state=True),
    "always looks": Way(Pursuit(always).decide, 200),
    "random looks": Way(Pursuit(by_chance(0.4)).decide, 200),
    "state entropy": Way(_selecting(0.6, SelectorSettings(method="state_entropy")), 200),
    "action entropy": Way(_selecting(0.25, SelectorSettings()), 200),
    "path entropy": Way(_selecting(0.4, SelectorSettings(method="path_entropy")), 60),
    "never looks": Way(Pursuit(never).decide, 60),
    "expected return": Way(_selecting(0.0, _EXPECTED_RETURN, 8), 60),
}
"""By the names that tables give them. All but the published heuristics and the one that is told the
true state (a bound) make the same plans, and differ in when they look. Selectors that know no price
look if that takes so many nats of entropy: the best of two or three thresholds, on seed 8001, as is
the share of random looks."""


class PublishedWorlds:
    """The study ``published_worlds``."""

    name = "published_worlds"
    title = "Worlds of others: Van der Pol tag, beside the planners published for it"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        return [task for way in WAYS for task in _tasks(way, scale)]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        tables = []
        for way in WAYS:
            table = results.of(_tasks(way, scale))
            table = table.assign(**{name: rounded(table[name]) for name in _FRACTIONS})
            table.insert(0, "way", way)
            tables.append(table)
        return self.report_of(pd.concat(tables, ignore_index=True))

    def report_of(self, trials: pd.DataFrame) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""
        if list(trials.columns) != ["way", *COLUMNS] or set(trials["way"]) != set(WAYS):
            raise InvalidValueError(f"{self.name}: these are trials of something else")
        tables = {way: trials[trials["way"] == way] for way in WAYS}
        summary, rivals = _summary(tables), _rivals(tables)
        return Report(
            trials=trials,
            summary={"vdp_tag": summary, "looks": rivals},
            figures={"vdp_tag": partial(_draw, summary)},
            numbers=_numbers(summary, rivals),
        )


def run_vdp_tag(way: str, seed: int, first_trial: int, num_trials: int) -> pd.DataFrame:
    """Run some trials; the function of tasks of the kind ``vdp_tag``.

    ``way`` is one of :data:`WAYS`. The table has the columns of :data:`COLUMNS`; all but the times
    are the same wherever it is run.
    """
    if way not in WAYS:
        raise TaskError(f"way {way!r}: there are {', '.join(WAYS)}")
    chosen = WAYS[way]
    policy = _Timed(chosen.policy)
    trials = run_vdp_tag_trials(
        policy,
        seed,
        range(first_trial, first_trial + num_trials),
        chosen.num_particles,
        misses_at_once=not chosen.published,
        known_state=chosen.known_state,
    )
    milliseconds = 1e3 * policy.seconds / max(1, policy.decisions)
    rows = [
        (first_trial + index, each.discounted_reward, each.tagged, each.steps, each.looks)
        for index, each in enumerate(trials)
    ]
    return pd.DataFrame([(*row, milliseconds) for row in rows], columns=list(COLUMNS))


class _Timed:
    """A policy, and how much of the processor's time its decisions take."""

    def __init__(self, policy: VdpTagPolicy) -> None:
        self._policy = policy
        self.seconds = 0.0
        self.decisions = 0

    def __call__(self, beliefs: FloatArray, draws: Sequence[Stream]) -> tuple[FloatArray, IntArray]:
        began = time.process_time()
        decided = self._policy(beliefs, draws)
        self.seconds += time.process_time() - began
        self.decisions += len(draws)
        return decided


class PublishedPlanner(NamedTuple):
    """A row of the published figures."""

    trials: int
    mean: float
    standard_error: float


def published_planners() -> dict[str, PublishedPlanner]:
    """Return the published figures, by the planners' names."""
    file = resources.files("holdfast.lab.studies") / "data" / "vdp_tag_2018.csv"
    with file.open() as lines:
        rows = pd.read_csv(lines)[["planner", "trials", "mean_discounted_reward", "standard_error"]]
    return {
        planner: PublishedPlanner(*figures)
        for planner, *figures in rows.itertuples(index=False, name=None)
    }


def _tasks(way: str, scale: Scale) -> list[Task]:
    trials = _QUICK_TRIALS if scale.quick else WAYS[way].trials
    each = min(_TRIALS_IN_EACH, trials)
    return [
        Task(
            kind="vdp_tag",
            parameters={
                "way": way,
                "seed": scale.seed,
                "first_trial": first,
                "num_trials": min(each, trials - first),
            },
            units=min(each, trials - first),
        )
        for first in range(0, trials, each)
    ]


def _summary(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Return a row for each way and each published planner."""
    published = published_planners()
    rows: list[dict[str, Cell]] = []
    for way in dict.fromkeys([*tables, *published]):
        row: dict[str, Cell] = {"way": way}
        if way in tables:
            own = tables[way]
            row |= {
                "trials": len(own),
                "mean_discounted_reward": own["discounted_reward"].mean(),
                "standard_error": own["discounted_reward"].sem(),
                **{name: own[name].mean() for name in ("tagged", "steps", "looks")},
                "decision_ms": own["mean_decision_ms"].mean(),
            }
        if way in published:
            row["published_mean"] = published[way].mean
            row["published_standard_error"] = published[way].standard_error
        rows.append(row)
    table = pd.DataFrame(rows)
    table["standard_errors_apart"] = (
        table["mean_discounted_reward"] - table["published_mean"]
    ) / np.hypot(table["standard_error"], table["published_standard_error"])
    return table


def _rivals(tables: Mapping[str, pd.DataFrame]) -> pd.DataFrame:
    """Return how much more priced looks earn than other rules, trial by trial."""
    rows: list[dict[str, Cell]] = []
    best = tables[BEST]["discounted_reward"].to_numpy()
    for way, table in tables.items():
        if way == BEST or WAYS[way].published:
            continue
        own = table["discounted_reward"].to_numpy()
        count = min(own.size, best.size)
        gain, p_value = statistics.paired_difference(best[:count], own[:count])
        rows.append(
            {
                "way": BEST,
                "rival": way,
                "trials": count,
                **cells_of("reward_gain", gain),
                "p_value": p_value,
            }
        )
    table = pd.DataFrame(rows)
    statistics.add_adjusted(table, "p_value")
    return table


def _numbers(summary: pd.DataFrame, rivals: pd.DataFrame) -> list[Number]:
    """Return how the heuristics repeat, and how priced looks compare."""
    rows = {row["way"]: row for row in summary.to_dict("records")}
    ours, strongest = rows[BEST], rows[STRONGEST]
    unit = "of discounted reward"
    numbers = [
        Number(
            f"{way}, here less published",
            _apart(rows[way], rows[way]),
            unit,
            rows[way]["trials"],
        )
        for way in WAYS
        if WAYS[way].published
    ]
    numbers.append(Number(f"{BEST} less {STRONGEST}, as published", _apart(ours, strongest), unit))
    return numbers + [
        Number(f"{BEST} less {row['rival']}", interval_in(row, "reward_gain"), unit, row["trials"])
        for row in rivals.to_dict("records")
    ]


def _apart(own: Mapping[Any, Any], published: Mapping[Any, Any]) -> Interval:
    """Return the difference of our mean from a published one, with the normal interval."""
    value = own["mean_discounted_reward"] - published["published_mean"]
    half = 1.96 * math.hypot(own["standard_error"], published["published_standard_error"])
    return Interval(value, value - half, value + half)


def _draw(summary: pd.DataFrame) -> Figure:
    from holdfast.lab.studies import plots

    figure, (panel,) = plots.stacked_panels(
        [len(summary)],
        title="Van der Pol tag with barriers: discounted reward (means, 95 % intervals)",
        width=8.4,
    )
    dots = []
    for label, mean, error in (
        ("here", "mean_discounted_reward", "standard_error"),
        ("published", "published_mean", "published_standard_error"),
    ):
        values, half = summary[mean], 1.96 * summary[error]
        dots.append(
            plots.Dots(label, values.tolist(), (values - half).tolist(), (values + half).tolist())
        )
    plots.dot_rows(panel, summary["way"].tolist(), dots)
    panel.set_xlabel("mean discounted reward")
    return figure
