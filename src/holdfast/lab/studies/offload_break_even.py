"""When is it worth asking a service? The break-even of offloading, in particles.

A service has more cores than the robot, and a network path between them. Its decision arrives
sooner if the cores save more than the path costs. So there is a number of particles from which on
asking pays, and it depends on everything that makes a decision longer: hypothetical observations,
sensing actions, the horizon, the estimator.

Times are measured on this machine with as many threads as it has cores. For more cores they are
extrapolated by Amdahl's law, within stated bounds (:mod:`~.cost_model`). The paths are numbers, 20
and 87 ms; the rest of an exchange is measured.

Two robots are compared. The thesis's robot *waits for each decision*. Ours *decides ahead*: the
sensing action is computed while the robot moves, so it waits only for the excess, besides one round
trip for its task actions.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from holdfast.config.settings import PlanningSettings
from holdfast.lab.studies.cost_model import BreakEven, Scaling, break_even, power_law
from holdfast.lab.studies.exchange_times import Exchange
from holdfast.lab.studies.sensing_times import Measurement
from holdfast.lab.studies.statistics import Interval, cells_of, interval_in, median_interval
from holdfast.lab.studies.study import Number, Report, Results, Scale
from holdfast.lab.studies.tables import Cell
from holdfast.lab.studies.tasks import Task
from holdfast.lab.studies.trial_batches import problem_of
from holdfast.robot.trials import available_cores

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = [
    "PATHS_MS",
    "RATES_HZ",
    "SAMPLES_DRAWN",
    "SHOWN",
    "TIMES_THE_CORES",
    "Kind",
    "OffloadBreakEven",
    "ahead_ms_of",
    "break_even_table",
    "drawings",
    "exchange_ms_of",
    "kind_of",
    "line_of",
    "numbers_of",
    "scalings_of",
    "times_table",
]

_PROBLEMS = ("peg_in_hole_2d", "peg_in_hole_3d", "capsule_robot")
_ESTIMATORS = ("nearest_neighbor", "gaussian_mixture_upper")
_PARTICLES = (100, 300, 1000, 2000, 4000, 8000, 16_000, 32_000, 64_000, 100_000)
_SAMPLES = (10, 30, 100, 300)
SAMPLES_DRAWN = (10, 100)
"""In the figures; the tables and the map have all."""

# Moving 4,096 particles or more uses all cores whatever it is told: beyond, one thread would not
# be one.
_PARTICLES_AHEAD = (100, 300, 1000, 2000, 4000)

_QUICK_PARTICLES = (100, 1000, 2000, 5000, 10_000, 20_000)
_QUICK_SAMPLES = (10, 100)

TIMES_THE_CORES = (8, 36)
_ROBOT_CORES = (1, 4)
PATHS_MS = (20.0, 87.0)
RATES_HZ = (10.0, 50.0)
_SENSING_INTERVAL = PlanningSettings().sensing_interval
_EXCHANGE_PARTICLES = (100, 10_000)

_STEADY_FROM = 1000
"""From so many particles on the growth is fitted; below, what every decision costs is seen."""


class Kind(NamedTuple):
    """A kind of decision.

    Attributes
    ----------
    sensing_actions : int
        J.
    samples : int
        M.
    horizon : int
        H.
    """

    problem: str
    sensing_actions: int
    estimator: str = "nearest_neighbor"
    samples: int = 10
    horizon: int = 1

    @property
    def label(self) -> str:
        """As figures name it."""
        parts = [self.problem, f"M = {self.samples}"]
        parts += [f"J = {self.sensing_actions}"] if self.sensing_actions != _all(self) else []
        parts += [f"H = {self.horizon}"] if self.horizon > 1 else []
        parts += ["mixture"] if self.estimator != _ESTIMATORS[0] else []
        return ", ".join(parts)


def _all(kind: Kind) -> int:
    return _actions_of(kind.problem)


@functools.cache
def _actions_of(problem: str) -> int:
    return len(problem_of(problem, {}, {}).sensing_actions)


SHOWN = Kind(_PROBLEMS[0], 3)
"""The problem and the settings that the thesis reports on."""


class OffloadBreakEven:
    """The study ``offload_break_even``."""

    name = "offload_break_even"
    title = "When is asking a service worth it? Sensing time, cores and the path to them"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all tasks, in the order in which to begin."""
        return [
            *(task for _, task in _exchanges(scale)),
            *(_measured(kind, scale) for kind in _kinds(scale)),
        ]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return the report on the results of all tasks."""
        of_beliefs = {kind: results.of([_measured(kind, scale)]) for kind in _kinds(scale)}
        asked = {key: results.of([task]) for key, task in _exchanges(scale)}
        times, exchange = times_table(of_beliefs), _exchange_table(asked)
        scalings, exchange_ms = scalings_of(times), exchange_ms_of(exchange)
        lines = break_even_table(scalings, exchange_ms)
        raw = [table.assign(**kind._asdict()) for kind, table in of_beliefs.items()]
        return Report(
            raw={"sensing_times": pd.concat(raw, ignore_index=True)},
            summary={
                "sensing_times": times,
                "exchange": exchange,
                "growth": _growth_table(of_beliefs),
                "break_even": lines,
                "break_even_ahead": _ahead_table(scalings, exchange_ms),
            },
            figures=drawings(times, exchange, lines),
            numbers=numbers_of(times, exchange, lines),
        )


def drawings(
    times: pd.DataFrame, exchange: pd.DataFrame, lines: pd.DataFrame
) -> dict[str, partial[Figure]]:
    """Return what draws the figures, from the tables of the summary."""
    scalings, exchange_ms = scalings_of(times), exchange_ms_of(exchange)
    return {
        "sensing_time": partial(_draw, "sensing_time", scalings, exchange_ms),
        "break_even_map": partial(_draw, "break_even_map", scalings, exchange_ms),
        "break_even": partial(_draw, "break_even_lines", lines),
        "waiting": partial(_draw, "waiting", scalings, exchange_ms),
    }


def _draw(drawing: str, *of: Any) -> Figure:
    # Imports matplotlib, so only when a figure is wanted.
    from holdfast.lab.studies import offload_figures

    figure: Figure = getattr(offload_figures, drawing)(*of)
    return figure


# -- what is measured --------------------------------------------------------------------------


def _kinds(scale: Scale) -> list[Kind]:
    """Return all that is measured, what is shown first."""
    kinds: list[Kind] = []
    for problem in _PROBLEMS:
        actions = _actions_of(problem)
        for estimator in _ESTIMATORS:
            samples: Sequence[int] = _SAMPLES
            if scale.quick:
                shown = problem == SHOWN.problem
                samples = _QUICK_SAMPLES if shown and estimator == _ESTIMATORS[0] else (10,)
                if estimator != _ESTIMATORS[0] and not shown:
                    continue
            kinds += [Kind(problem, actions, estimator, each) for each in samples]
    whole = Kind("peg_in_hole_3d", _actions_of("peg_in_hole_3d"))
    for actions in (3,) if scale.quick else (1, 2, 3):
        kinds.append(whole._replace(sensing_actions=actions))
    for problem in (SHOWN.problem,) if scale.quick else _PROBLEMS:
        for horizon in (2,) if scale.quick else (2, 4):
            for samples_ahead in (10, 30) if horizon == 2 and not scale.quick else (10,):
                kinds.append(
                    Kind(problem, _actions_of(problem), samples=samples_ahead, horizon=horizon)
                )
    return kinds


def _measured(kind: Kind, scale: Scale) -> Task:
    whole = _QUICK_PARTICLES if scale.quick else _PARTICLES
    ahead = _QUICK_PARTICLES[:2] if scale.quick else _PARTICLES_AHEAD
    particles = ahead if kind.horizon > 1 else whole
    measurement = Measurement(
        problem=kind.problem,
        num_sensing_actions=kind.sensing_actions,
        estimator=kind.estimator,
        num_observation_samples=kind.samples,
        horizon=kind.horizon,
        particles=particles,
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
        units=len(particles),
        exclusive=True,
    )


def _threads() -> tuple[int, ...]:
    """Return 1, 2, 4 and so on, as far as this machine has cores, and 2 in any case."""
    most = max(2, available_cores())
    return tuple(2**power for power in range(most.bit_length()) if 2**power <= most)


def _exchanges(scale: Scale) -> Iterator[tuple[tuple[str, int], Task]]:
    for way in ("tcp", "in_process"):
        for particles in _EXCHANGE_PARTICLES:
            exchange = Exchange(
                problem=SHOWN.problem,
                particles=particles,
                way=way,
                num_trials=1 if scale.quick else 3,
                seed=scale.seed,
            )
            task = Task(
                kind="exchange_times",
                parameters=msgspec.to_builtins(exchange),
                units=exchange.num_trials,
                exclusive=True,
            )
            yield (way, particles), task


# -- tables ------------------------------------------------------------------------------------


def times_table(of_beliefs: Mapping[Kind, pd.DataFrame]) -> pd.DataFrame:
    """Return median times over the beliefs by kind, particles and threads, and divided shares."""
    rows: list[dict[str, Cell]] = []
    for kind, table in of_beliefs.items():
        for particles, here in table.groupby("particles"):
            one = here[here["threads"] == 1]
            share = cells_of("divided_share", median_interval(one["share"].to_numpy(float)))
            rows += [
                {
                    **kind._asdict(),
                    "particles": particles,
                    "threads": threads,
                    "beliefs": len(those),
                    "repetitions": int(those["repetitions"].iloc[0]),
                    **cells_of("ms", median_interval(those["median_ms"].to_numpy(float))),
                    **share,
                    "mapping_share": float((those["mapping_ms"] / those["median_ms"]).median()),
                    "others_cores": float(those["others_cores"].iloc[0]),
                }
                for threads, those in here.groupby("threads")
            ]
    return pd.DataFrame(rows)


def scalings_of(times: pd.DataFrame) -> dict[Kind, Scaling]:
    """Return the times on one thread and the divided shares by kind, from :func:`times_table`."""
    found: dict[Kind, Scaling] = {}
    one = times[times["threads"] == 1]
    for _, rows in one.groupby(list(Kind._fields), sort=False):
        records = rows.to_dict("records")
        kind = kind_of(records[0])
        found[kind] = Scaling(
            tuple(row["particles"] for row in records),
            tuple(_unbounded(interval_in(row, "ms")) for row in records),
            tuple(_unbounded(interval_in(row, "divided_share")) for row in records),
            kind.sensing_actions * kind.samples,
        )
    return found


def kind_of(row: Mapping[Any, Any]) -> Kind:
    """Return the kind of decision that a row of a table is about."""
    return Kind(**{name: row[name] for name in Kind._fields})


def _unbounded(interval: Interval) -> Interval:
    """Return an interval whose missing bounds are infinite."""
    value, low, high = interval
    return Interval(
        value, -math.inf if math.isnan(low) else low, math.inf if math.isnan(high) else high
    )


def _exchange_table(asked: Mapping[tuple[str, int], pd.DataFrame]) -> pd.DataFrame:
    """Return the time of an exchange beside the computation and the path."""
    rows: list[dict[str, Cell]] = []
    for (way, particles), table in asked.items():
        task = table["task_ms"] - table["task_computed_ms"]
        both = table["sensing_ms"] - table["computed_ms"]
        computed = table["task_computed_ms"]
        rows.append(
            {
                "way": way,
                "particles": particles,
                "questions": len(table),
                **cells_of("task_exchange_ms", median_interval(task.to_numpy(float))),
                **cells_of("sensing_exchange_ms", median_interval(both.to_numpy(float))),
                **cells_of("task_computed_ms", median_interval(computed.to_numpy(float))),
            }
        )
    return pd.DataFrame(rows)


def exchange_ms_of(exchange: pd.DataFrame) -> float:
    """Return the time of an exchange over TCP beside its computation, without a path.

    It grows a little with the particles, because of their digest; the largest counts for all.
    """
    return float(exchange.loc[exchange["way"] == "tcp", "sensing_exchange_ms"].max())


def _growth_table(of_beliefs: Mapping[Kind, pd.DataFrame]) -> pd.DataFrame:
    """Return the exponents of the time on one thread, in particles, M, J and H."""
    tables = [table.assign(**kind._asdict()) for kind, table in of_beliefs.items()]
    every = pd.concat(tables, ignore_index=True)
    one = every[every["threads"] == 1]
    cells: list[dict[str, Cell]] = []
    for _, rows in one.groupby(list(Kind._fields), sort=False):
        for start in (100, _STEADY_FROM):
            larger = rows[rows["particles"] >= start]
            cells += _exponents("particles", larger, f"from {start:,} on")
    for changed in ("samples", "sensing_actions", "horizon"):
        others = [name for name in Kind._fields if name != changed]
        for _, family in one.groupby(others, sort=False):
            tried = family.groupby("particles")[changed].nunique()
            common = tried.index[(tried == family[changed].nunique()) & (tried > 1)]
            common = common[common <= _STEADY_FROM]
            if len(common):
                here = family[family["particles"] == common.max()]
                cells += _exponents(changed, here, f"at {common.max():,} particles")
    return pd.DataFrame(cells)


def _exponents(what: str, rows: pd.DataFrame, where: str) -> list[dict[str, Cell]]:
    """Return a row with the median exponent over the beliefs, each fitted alone; none if few."""
    beliefs = [(own[what].to_numpy(float), own["median_ms"]) for _, own in rows.groupby("belief")]
    most = max((sizes.size for sizes, _ in beliefs), default=0)
    if most < 2:
        return []
    whole = [(sizes, times.to_numpy()) for sizes, times in beliefs if sizes.size == most]
    slopes = [power_law(sizes, times)[1].value for sizes, times in whole]
    smallest, largest = int(whole[0][0].min()), int(whole[0][0].max())
    names = rows[list(Kind._fields)].iloc[0].to_dict()
    if what != "particles":
        names[what] = None
    return [
        {
            "grows_with": what,
            **names,
            "where": where,
            "smallest": smallest,
            "largest": largest,
            "beliefs": len(slopes),
            **cells_of("exponent", median_interval(np.array(slopes))),
            "n_log_n": _exponent_of_n_log_n(smallest, largest) if what == "particles" else math.nan,
        }
    ]


def _exponent_of_n_log_n(smallest: int, largest: int) -> float:
    """Return the exponent that n log n would have between two sizes."""
    return 1.0 + math.log(math.log(largest) / math.log(smallest)) / math.log(largest / smallest)


class Line(NamedTuple):
    """A break-even with its bounds: favourable to few cores, to many, and divided evenly."""

    value: BreakEven
    last: BreakEven
    first: BreakEven
    even: BreakEven


def line_of(
    scaling: Scaling, robot_cores: int, cores: int, cost_ms: float, ahead_ms: float = 0.0
) -> Line:
    """Return the break-even of a service, with its bounds."""
    found = [
        break_even(each.saved_ms(robot_cores, cores, ahead_ms), cost_ms)
        for each in (scaling, *scaling.bounds())
    ]
    return Line(*found)


def _line_cells(
    scaling: Scaling,
    robot_cores: int,
    cores: int,
    path_ms: float,
    exchange_ms: float,
    ahead_ms: float = 0.0,
) -> dict[str, Cell]:
    line = line_of(scaling, robot_cores, cores, path_ms + exchange_ms, ahead_ms)
    return {
        "robot_cores": robot_cores,
        "service_cores": cores,
        "path_ms": path_ms,
        "particles": _whole(line.value),
        "particles_low": _whole(line.first),
        "particles_high": _whole(line.last),
        "particles_if_divided_evenly": _whole(line.even),
        "words": line.value.words,
        "measured_to": scaling.particles[-1],
    }


def _whole(found: BreakEven) -> Cell:
    return math.nan if found.particles is None else round(found.particles)


def break_even_table(scalings: Mapping[Kind, Scaling], exchange_ms: float) -> pd.DataFrame:
    """Return the break-even of a robot that waits for each decision."""
    return pd.DataFrame(
        {
            **kind._asdict(),
            **_line_cells(scaling, robot_cores, times * robot_cores, path_ms, exchange_ms),
        }
        for kind, scaling in scalings.items()
        for robot_cores in _ROBOT_CORES
        for times in TIMES_THE_CORES
        for path_ms in PATHS_MS
    )


def _ahead_table(scalings: Mapping[Kind, Scaling], exchange_ms: float) -> pd.DataFrame:
    """Return the break-even of a robot that decides ahead, by its rate."""
    return pd.DataFrame(
        {
            **kind._asdict(),
            "rate_hz": rate_hz,
            "ahead_ms": ahead_ms_of(rate_hz),
            **_line_cells(scaling, 1, cores, path_ms, exchange_ms, ahead_ms_of(rate_hz)),
        }
        for kind, scaling in scalings.items()
        for rate_hz in RATES_HZ
        for cores in TIMES_THE_CORES
        for path_ms in PATHS_MS
    )


def ahead_ms_of(rate_hz: float) -> float:
    """Return how long a robot moves between two sensing steps."""
    return 1e3 * _SENSING_INTERVAL / rate_hz


def numbers_of(times: pd.DataFrame, exchange: pd.DataFrame, lines: pd.DataFrame) -> list[Number]:
    """Return the break-even of the thesis's settings, the divided shares, and the exchange."""
    numbers = []
    of_shown = (lines[list(Kind._fields)] == pd.Series(SHOWN._asdict())).all(axis=1)
    for row in lines[of_shown & (lines["robot_cores"] == 1)].to_dict("records"):
        name = (
            f"a service with {row['service_cores']} cores at {row['path_ms']:g} ms is faster from"
        )
        numbers.append(Number(name, interval_in(row, "particles"), "particles"))
    long = times[(times["threads"] == 1) & (times["ms"] >= 5.0)]
    for steps, rows in (
        ("one step", long[long["horizon"] == 1]),
        ("several steps", long[long["horizon"] > 1]),
    ):
        # The settings share beliefs: a range, and not an interval.
        shares = 100.0 * rows["divided_share"]
        range_ = Interval(shares.median(), shares.min(), shares.max())
        name = f"share divided among threads, {steps} (median, least and most of the settings)"
        numbers.append(Number(name, range_, "% of the time on one thread", len(rows)))
    numbers += [
        Number(
            f"exchange beside computation and path, {row['way']}, {row['particles']:,} particles",
            interval_in(row, "sensing_exchange_ms"),
            "ms",
            row["questions"],
        )
        for row in exchange.to_dict("records")
    ]
    # Where others kept a quarter of a core busy, the shares are lower bounds.
    others = times["others_cores"].median()
    return [*numbers, Number("cores that other processes kept busy", Interval(*[others] * 3))]
