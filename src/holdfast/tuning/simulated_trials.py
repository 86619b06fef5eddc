"""Many simulated trials as one table, and such tables compared: ``hf.run_trials``, ``hf.compare``.

Seed and trial name every random number, so trial 7 of two planners happens in the same world if
their seeds are the same. :func:`compare` compares such trials in pairs, by the statistics of
``holdfast compare --outcomes`` (:mod:`holdfast.reports.outcome_comparison`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from holdfast.config.loader import Configuration
from holdfast.errors import InvalidValueError
from holdfast.journal.run_directory import world_of
from holdfast.numerics.arrays import whole
from holdfast.planning.inputs import Sensed
from holdfast.planning.outcome import TRIAL_COLUMNS, TrialResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import LostSettings, SimulatorSettings, check_settings
from holdfast.printable import brief
from holdfast.problems.attributes import sensing_costs
from holdfast.problems.problem import Problem
from holdfast.reports.outcome_comparison import (
    ComparedRun,
    OutcomeComparison,
    compare_results,
    estimates_of,
    read_outcomes,
    shown_estimate,
)
from holdfast.reports.table_formats import Table
from holdfast.robot.lost_values import REMEDY, remark_on_lost_values
from holdfast.robot.trial_pool import Arm, FinishedTrial, TrialPool
from holdfast.runtime.command_line import MAX_SEED, MAX_TRIALS
from holdfast.runtime.machine import available_cores
from holdfast.validation import as_function, as_path

_SHOWN = ("trial", "outcome", "steps", "reward", "sensing_decisions", "mean_sensing_ms")


class SimulatedTrial(TrialResult, frozen=True, kw_only=True):
    """The result of a simulated trial, without its decisions.

    ``sensing_price`` is the sum of the prices of its sensing actions, which ``reward`` has lost
    already; None if the problem has no prices. ``lost_values`` names the coordinates of few values
    (a bit, a colour) of which no particle had the true one at the end.
    """

    sensing_price: float | None = None
    lost_values: tuple[str, ...] = ()

    @classmethod
    def of(cls, done: FinishedTrial) -> SimulatedTrial:
        """Return the result of a trial that has just run."""
        result, problem = done.result, done.arm.problem
        costs = sensing_costs(problem, optional=True)
        looks = [each for each in result.decisions or () if isinstance(each, Sensed)]
        priced = getattr(problem, "sensing_costs", None) is not None
        price = sum(float(costs[each.sensing_action]) for each in looks) if priced else None
        fields = {name: getattr(result, name) for name in TrialResult.__struct_fields__}
        fields |= {"decisions": None, "lost_values": done.lost_values}
        return cls(**fields, sensing_price=price)


class TrialSummary(Table):
    """Each measure of many trials, as :func:`compare` has them, with its 95 % interval.

    ``estimates`` has Wilson's interval of rates, the percentile bootstrap's of the others.
    """

    def __init__(self, trials: Trials) -> None:
        self._title, self._limit = str(trials.label), trials.max_steps
        self.estimates = estimates_of(trials.results, step_limit=self._limit)
        reached = [each.success for each in trials]
        lost = remark_on_lost_values([each.lost_values for each in trials], reached)
        self._remarks = [f"{lost}. {REMEDY}."] if lost else []

    def columns(self) -> Sequence[str]:
        """Return the names of the columns, for programs."""
        return ("measure", "trials", "value", "low", "high")

    def rows(self) -> list[tuple[object, ...]]:
        """Return a row for each measure; without bounds where all trials are alike."""
        return [(*each[:3], *(each.interval or (None, None))) for each in self.estimates]

    def shown(self) -> list[tuple[str, ...]]:
        """Return a row for each measure."""
        head = (self._title, "value", "95% interval")
        return [head, *map(shown_estimate, self.estimates)]

    def legend(self) -> str:
        """Return how steps are defined, and what was lost."""
        steps = f"a trial that did not reach the goal counts as {self._limit:,} steps"
        return "\n".join([f"steps: the geometric mean; {steps}.", *self._remarks])


class Trials(Table):
    """Simulated trials of one planner: a row for each trial.

    Its columns: ``trials.csv``'s, ``sensing_price``, ``lost_values``. A notebook shows a summary.

    Attributes
    ----------
    results : tuple of SimulatedTrial
        In the order of their numbers.
    world : mapping
        What is known of the task, to tell whether two tables are of the same.
    """

    def __init__(
        self, label: str, seed: int, max_steps: int, results: Sequence[SimulatedTrial], world: Any
    ) -> None:
        self.label, self.seed, self.max_steps, self.world = label, seed, max_steps, world
        self.results = tuple(sorted(results, key=lambda result: result.trial))

    def __len__(self) -> int:
        return len(self.results)

    def __iter__(self) -> Iterator[SimulatedTrial]:
        return iter(self.results)

    def columns(self) -> Sequence[str]:
        """Return the names of the columns, for programs."""
        return (*TRIAL_COLUMNS, "sensing_price", "lost_values")

    def rows(self) -> Iterator[tuple[object, ...]]:
        """Yield a row for each trial."""
        for each in self.results:
            plain = tuple(getattr(each, name) for name in (*TRIAL_COLUMNS, "sensing_price"))
            yield (*plain, "; ".join(each.lost_values))

    def shown(self) -> list[tuple[str, ...]]:
        """Return a row for each trial, with the columns that people compare."""
        names = self.names()
        rows = ((_short(getattr(result, name)) for name in names) for result in self.results)
        return [tuple(name.replace("_", " ") for name in names), *map(tuple, rows)]

    def names(self) -> Sequence[str]:
        """Return the names of those columns."""
        prices = any(result.sensing_price is not None for result in self.results)
        return (*_SHOWN, *["sensing_price"] * prices)

    def summary(self) -> TrialSummary:
        """Return each measure with its interval."""
        return TrialSummary(self)

    def __str__(self) -> str:
        """Return the summary; a table of all trials is ``to_markdown()``."""
        return f"{len(self)} trials, seed {self.seed}\n{self.summary()}"

    def _repr_html_(self) -> str:
        return f"<p>{len(self)} trials, seed {self.seed}</p>{self.summary()._repr_html_()}"


def _short(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def run_trials(
    planner: Planner | Configuration | Problem,
    n: int,
    *,
    seed: int | None = None,
    jobs: int | None = None,
    max_steps: int | None = None,
    lost: LostSettings | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Trials:
    """Run ``n`` simulated trials, on all cores, and return them as a table.

    A problem whose class is defined in a notebook or a script goes to the worker processes by
    cloudpickle (extra ``tune``). Ctrl-C ends the workers.

    Parameters
    ----------
    planner : Planner, Configuration or Problem
        A problem alone is planned for by the default settings.
    n : int
        Trials 0 to n - 1; at least 1.
    seed, max_steps, lost : optional
        Default: the configuration's, otherwise 0 and those of :func:`holdfast.run_trial`.
    jobs : int, optional
        Largest number of processes (default: one for each core). Changes time only. In a worker
        of ``multiprocessing`` or joblib, which may start none, all trials run in that process.
    progress : callable, optional
        Called with the number of finished trials and ``n`` after each trial.

    Raises
    ------
    InvalidValueError
        If an argument is out of bounds, the configuration names an environment, or the problem
        cannot be sent to another process.
    TrialError
        If holdfast refuses something in a trial, or a function of the problem raises.
    WorkerDiedError
        If a worker process was killed.
    """
    n = whole("n", n, 1, MAX_TRIALS)
    told = as_function("progress", (lambda *_: None) if progress is None else progress)
    arm = arm_of(planner)
    if seed is not None:
        arm = dataclasses.replace(arm, seed=whole("seed", seed, 0, MAX_SEED))
    if max_steps is not None:
        arm = dataclasses.replace(arm, max_steps=whole("max_steps", max_steps, 1))
    if lost is not None:
        arm = dataclasses.replace(arm, lost=check_settings(lost, LostSettings, "lost"))
    results: list[SimulatedTrial] = []
    with TrialPool(available_cores() if jobs is None else jobs, expected=n) as pool:
        for done in pool.run((arm, trial) for trial in range(n)):
            results.append(SimulatedTrial.of(done))
            told(len(results), n)
    return table_of(arm, results)


def arm_of(planner: Planner | Configuration | Problem, label: str = "") -> Arm:
    """Return the arm of what is simulated; InvalidValueError if it cannot be."""
    if isinstance(planner, Configuration):
        if (name := planner.environment.object) is not None:
            raise InvalidValueError(
                f"{planner.path}: environment.object is {name}: only trials in a simulated world "
                "can be compared; leave the key out, or use holdfast run"
            )
        return Arm.of(planner, label)
    if isinstance(planner, str | Path):
        raise InvalidValueError(
            f"planner is {str(planner)!r}: load_configuration(path) reads a file, and make(name) "
            "builds a problem"
        )
    if not isinstance(planner, Planner):
        planner = Planner(planner)
    problem, limit = planner.problem, SimulatorSettings().max_steps
    return Arm(problem, planner.settings, 0, limit, LostSettings(), type(problem).__name__, label)


def table_of(arm: Arm, results: Sequence[SimulatedTrial]) -> Trials:
    """Return the finished trials of an arm as a table."""
    world: dict[str, object] = {"problem": arm.problem_name}
    if arm.plain is not None:
        configuration = arm.plain["configuration"]
        world["model"] = configuration["model"]
        world["environment"] = world_of(configuration["environment"])
    label = arm.label or arm.planning.selector.method
    return Trials(label, arm.seed, arm.max_steps, results, world)


def compare(
    runs: Mapping[str, Trials | str | Path], baseline: str | None = None, *, paired: bool = True
) -> OutcomeComparison:
    """Compare trials with those of a baseline: effects with 95 % intervals, and notes.

    Steps of a trial that did not reach the goal are the limit. Decision times get no verdict.

    Parameters
    ----------
    runs : mapping of str to Trials or path
        At least two, by what the tables call them; a path is that of a run on the disk.
    baseline : str, optional
        One of the names; default: the first.
    paired : bool
        Whether trials of one number are in the same world, as those of one seed and problem are.
        If False, each is a sample of its own, so that other seeds can be compared.

    Raises
    ------
    InvalidValueError
        If there are fewer than two, or none has the baseline's name.
    OutputError
        If a path is no run, or if limits or (paired) seeds differ, or there are too few trials.
    """
    if not isinstance(runs, Mapping) or len(runs) < 2:
        raise InvalidValueError(f"runs is {brief(runs)}; compare takes a mapping of at least 2")
    names = list(runs)
    if not isinstance(paired, bool):
        raise InvalidValueError(f"paired is {brief(paired)}; it must be True or False")
    if baseline is not None:
        if not isinstance(baseline, str) or baseline not in runs:
            raise InvalidValueError(f"baseline is {brief(baseline)}; it must be one of {names}")
        names = [baseline, *(name for name in names if name != baseline)]
    return compare_results([_compared(runs[name], name) for name in names], paired=paired)


def _compared(trials: Trials | str | Path, name: str) -> ComparedRun:
    if not isinstance(trials, Trials):
        return read_outcomes(as_path(f"runs[{name!r}]", trials), name)
    results = {result.trial: result for result in trials.results}
    return ComparedRun(name, results, trials.seed, trials.max_steps, trials.world)
