"""When is it worth asking a service? The break-even of offloading, in particles.

A service has more cores than the robot, and a network path between them. Its decision arrives
sooner if the cores save more than the path costs. So there is a number of particles from which on
asking pays, and it depends on everything that makes a decision longer: hypothetical observations,
sensing actions, the horizon, the estimator.

Times are measured on this machine with as many threads as it has cores. For more cores they are
extrapolated by Amdahl's law, within stated bounds (:mod:`~.cost_model`). The paths are numbers, 20
and 87 ms; what an exchange takes besides is known from the study of the thesis's chapter 6.

Two robots are compared. The thesis's robot *waits for each decision*. Ours *decides ahead*: the
sensing action is computed while the robot moves, so it waits only for the excess, besides one round
trip for its task actions.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.settings import PlanningSettings
from holdfast.runtime.machine import available_cores
from studies.cost_model import Scaling, break_even
from studies.sensing_times import Measurement
from studies.statistics import (
    Interval,
    cells_of,
    interval_in,
    median_interval,
)
from studies.study import Number, Part, Report, Scale, Study, drawn
from studies.tables import Cell
from studies.tasks import Task
from studies.trial_batches import problem_of

_PROBLEMS = ("peg_in_hole_2d", "peg_in_hole_3d", "capsule_robot")
_ESTIMATORS = ("nearest_neighbor", "gaussian_mixture_upper")
_PARTICLES = (100, 300, 1000, 2000, 4000, 8000, 16_000, 32_000, 64_000, 100_000)
_SAMPLES = (10, 30, 100, 300)
SAMPLES_DRAWN = (10, 100)
"""In the figures; the tables have all."""

# Moving 4,096 particles or more uses all cores whatever it is told: beyond, one thread would not
# be one.
_PARTICLES_AHEAD = (100, 300, 1000, 2000, 4000)

_QUICK_PARTICLES = (100, 1000, 2000, 5000, 10_000, 20_000)

TIMES_THE_CORES = (8, 36)
_ROBOT_CORES = (1, 4)
PATHS_MS = (20.0, 87.0)
_RATES_HZ = (10.0, 50.0)
_SENSING_INTERVAL = PlanningSettings().sensing_interval

EXCHANGE_MS = 1.52
"""Time to ask over TCP, beside path and computation: "round trip without computation, cloud, same
machine" of the study ``thesis_chapter_6``, with 100 to 500 particles. With 10,000, of which both
ends take a digest, it was 1 ms more than with 100: less than the bounds of a break-even."""

_STEADY_FROM = 1000
"""From so many particles on the growth is fitted; below, what every decision costs is seen."""


class Kind(NamedTuple):
    """A kind of decision: J sensing actions, M hypothetical observations, horizon H."""

    problem: str
    sensing_actions: int
    estimator: str = "nearest_neighbor"
    samples: int = 10
    horizon: int = 1

    @property
    def label(self) -> str:
        """As figures name it."""
        parts = [self.problem, f"M = {self.samples}"]
        if self.sensing_actions != _actions_of(self.problem):
            parts.append(f"J = {self.sensing_actions}")
        parts += [f"H = {self.horizon}"] if self.horizon > 1 else []
        parts += ["mixture"] if self.estimator != _ESTIMATORS[0] else []
        return ", ".join(parts)


@functools.cache
def _actions_of(problem: str) -> int:
    return len(problem_of(problem).sensing_actions)


SHOWN = Kind(_PROBLEMS[0], 3)
"""The problem and the settings that the thesis reports on."""


class OffloadBreakEven(Study):
    """The study ``offload_break_even``."""

    name = "offload_break_even"
    title = "When is asking a service worth it? Sensing time, cores and the path to them"

    def parts(self, scale: Scale) -> Iterator[Part]:
        """Yield decisions of each kind."""
        for kind in _kinds(scale):
            yield Part(kind._asdict(), [_sensing_task(kind, scale)], "sensing_times")

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on the rows of all parts."""
        measured = tables["sensing_times"]
        times = times_table(measured)
        scalings = scalings_of(times)
        lines = break_even_table(scalings)
        return Report(
            summary={
                "sensing_times": times,
                "growth": _growth_table(measured),
                "break_even": lines,
                "break_even_ahead": ahead_table(scalings),
            },
            figures={
                "sensing_time": drawn("offload_figures:sensing_time", scalings),
                "break_even": drawn("offload_figures:break_even_lines", lines),
            },
            numbers=numbers_of(lines),
        )


# -- what is measured --------------------------------------------------------------------------


def _kinds(scale: Scale) -> list[Kind]:
    """Return all that is measured, what is shown first."""
    plane, space, _ = _PROBLEMS
    whole = {problem: Kind(problem, _actions_of(problem)) for problem in _PROBLEMS}
    kinds = [
        *(
            kind._replace(estimator=estimator, samples=samples)
            for kind in whole.values()
            for estimator in _ESTIMATORS
            for samples in _SAMPLES
        ),
        *(whole[space]._replace(sensing_actions=actions) for actions in (1, 2, 3)),
        *(
            kind._replace(horizon=horizon, samples=samples)
            for kind in whole.values()
            for horizon, samples in ((2, 10), (2, 30), (4, 10))
        ),
    ]
    if not scale.quick:
        return kinds
    few = {
        *whole.values(),
        whole[plane]._replace(samples=100),
        whole[plane]._replace(estimator=_ESTIMATORS[1]),
        whole[space]._replace(sensing_actions=3),
        whole[plane]._replace(horizon=2),
    }
    return [kind for kind in kinds if kind in few]


def _sensing_task(kind: Kind, scale: Scale) -> Task:
    whole = _QUICK_PARTICLES if scale.quick else _PARTICLES
    ahead = _QUICK_PARTICLES[:2] if scale.quick else _PARTICLES_AHEAD
    measurement = Measurement(
        problem=kind.problem,
        num_sensing_actions=kind.sensing_actions,
        estimator=kind.estimator,
        num_observation_samples=kind.samples,
        horizon=kind.horizon,
        particles=ahead if kind.horizon > 1 else whole,
        threads=_threads(),
        num_trials=9,
        seed=scale.seed,
        repeat_s=0.1 if scale.quick else 0.3,
        least_repetitions=1 if scale.quick else 3,
        limit_s=2.0 if scale.quick else 8.0,
    )
    return Task(
        kind="sensing_times",
        parameters=msgspec.to_builtins(measurement),
        units=len(measurement.particles),
        exclusive=True,
    )


def _threads() -> tuple[int, ...]:
    """Return 1, 2, 4 and so on, as far as this machine has cores, and 2 in any case."""
    most = max(2, available_cores())
    return tuple(2**power for power in range(most.bit_length()) if 2**power <= most)


# -- tables ------------------------------------------------------------------------------------


def times_table(measured: pd.DataFrame) -> pd.DataFrame:
    """Return median times over the beliefs by kind, particles and threads, and divided shares."""
    rows: list[dict[str, Cell]] = []
    names = [*Kind._fields, "particles"]
    for key, here in measured.groupby(names, sort=False):
        share = median_interval(here["share"][here["threads"] == 1])
        rows += [
            {
                **dict(zip(names, key, strict=True)),
                "threads": threads,
                "beliefs": len(those),
                "repetitions": int(those["repetitions"].iloc[0]),
                **cells_of("ms", median_interval(those["median_ms"])),
                **cells_of("divided_share", share),
            }
            for threads, those in here.groupby("threads")
        ]
    return pd.DataFrame(rows)


def scalings_of(times: pd.DataFrame) -> dict[Kind, Scaling]:
    """Return the times on one thread and the divided shares by kind, from :func:`times_table`."""
    found: dict[Kind, Scaling] = {}
    one = times[times["threads"] == 1]
    for _, rows in one.groupby(list(Kind._fields), sort=False):
        kind = kind_of(rows.iloc[0])
        found[kind] = Scaling(
            rows["particles"].to_numpy(float),
            _intervals(rows, "ms"),
            _intervals(rows, "divided_share"),
            kind.sensing_actions * kind.samples,
        )
    return found


def kind_of(row: Mapping[Any, Any] | pd.Series) -> Kind:
    """Return the kind of decision that a row of a table is about."""
    return Kind(*(row[name] for name in Kind._fields))


def _intervals(rows: pd.DataFrame, name: str) -> FloatArray:
    """Return a column and its intervals, shape (3, n); missing bounds are infinite."""
    ends = {name: math.nan, f"{name}_low": -math.inf, f"{name}_high": math.inf}
    return np.asarray(rows[list(ends)].fillna(ends).to_numpy(float).T)


def _growth_table(measured: pd.DataFrame) -> pd.DataFrame:
    """Return the exponents with which the time on one thread grows with the particles.

    Power laws, by least squares of logarithms: the median over the beliefs, each fitted alone.
    """
    from scipy import stats

    one = measured[measured["threads"] == 1]
    cells: list[dict[str, Cell]] = []
    for kind, rows in one.groupby(list(Kind._fields), sort=False):
        for start in (100, _STEADY_FROM):
            logs = rows[rows["particles"] >= start].pivot_table("median_ms", "belief", "particles")
            # Where there was no time for all beliefs, those that have all numbers.
            logs = np.log(logs.dropna())
            if logs.shape[1] < 2:
                continue
            sizes = np.log(logs.columns.to_numpy(float))
            slopes = [stats.linregress(sizes, own).slope for own in logs.to_numpy()]
            cells.append(
                {
                    **dict(zip(Kind._fields, kind, strict=True)),
                    "smallest": logs.columns.min(),
                    "largest": logs.columns.max(),
                    "beliefs": len(slopes),
                    **cells_of("exponent", median_interval(slopes)),
                }
            )
    return pd.DataFrame(cells)


def _line_cells(
    scaling: Scaling, robot_cores: int, cores: int, path_ms: float, ahead_ms: float = 0.0
) -> dict[str, Cell]:
    """Return the break-even of a service, with its bounds: favourable to many cores, and to few."""
    few, many = scaling.bounds()
    value, low, high = (
        break_even(each.saved_ms(robot_cores, cores, ahead_ms), path_ms + EXCHANGE_MS)
        for each in (scaling, many, few)
    )
    return {
        "robot_cores": robot_cores,
        "service_cores": cores,
        "path_ms": path_ms,
        **cells_of("particles", Interval(*np.round([value, low, high]).tolist())),
        "measured_to": int(scaling.particles[-1]),
    }


def break_even_table(scalings: Mapping[Kind, Scaling]) -> pd.DataFrame:
    """Return the break-even of a robot that waits for each decision."""
    return pd.DataFrame(
        {**kind._asdict(), **_line_cells(scaling, robot_cores, times * robot_cores, path_ms)}
        for kind, scaling in scalings.items()
        for robot_cores in _ROBOT_CORES
        for times in TIMES_THE_CORES
        for path_ms in PATHS_MS
    )


def ahead_table(scalings: Mapping[Kind, Scaling]) -> pd.DataFrame:
    """Return the break-even of a robot that decides ahead, by its rate.

    It moves for ``ahead_ms`` between two sensing steps.
    """
    return pd.DataFrame(
        {
            **kind._asdict(),
            "rate_hz": rate_hz,
            "ahead_ms": ahead_ms,
            **_line_cells(scaling, 1, cores, path_ms, ahead_ms),
        }
        for kind, scaling in scalings.items()
        for rate_hz in _RATES_HZ
        for ahead_ms in (1e3 * _SENSING_INTERVAL / rate_hz,)
        for cores in TIMES_THE_CORES
        for path_ms in PATHS_MS
    )


def numbers_of(lines: pd.DataFrame) -> list[Number]:
    """Return the break-even of the thesis's settings."""
    numbers = []
    of_shown = (lines[list(Kind._fields)] == pd.Series(SHOWN._asdict())).all(axis=1)
    for row in lines[of_shown & (lines["robot_cores"] == 1)].to_dict("records"):
        name = (
            f"a service with {row['service_cores']} cores at {row['path_ms']:g} ms is faster from"
        )
        numbers.append(Number(name, interval_in(row, "particles"), "particles"))
    return numbers
