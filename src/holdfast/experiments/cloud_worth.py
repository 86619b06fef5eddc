"""When is the cloud worth it? From where on more cores further away are faster than few at hand.

A service has more cores than the robot, and a path between them. Its decision is there sooner if
what the cores save is more than the path costs; so there is a number of particles beyond which it
is worth asking, and it depends on everything that makes a decision longer: hypothetical
observations, sensing actions, the horizon, the estimate.

Times are measured on this machine with as many threads as it has cores; for more cores than that
they are extrapolated by Amdahl's law, within stated bounds (:mod:`~.cost_model`). The paths are
numbers, 20 and 87 ms; what asking costs beside the path is measured.

Two ways of asking are told apart. The thesis's robot *waits for each decision*. Ours *decides
ahead*: the sensing action is computed while the robot moves, and it waits for what that takes
longer, besides one round trip for its task actions.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import msgspec
import numpy as np

from holdfast.experiments.cost_model import (
    BreakEven,
    Scaling,
    break_even,
    power_law,
)
from holdfast.experiments.exchange_times import Exchange
from holdfast.experiments.medians import median_interval
from holdfast.experiments.sensing_times import Measurement
from holdfast.experiments.statistics import cells_of
from holdfast.experiments.study import Report, Results, Scale
from holdfast.experiments.tables import Cell, Table, number_of
from holdfast.experiments.tasks import Task
from holdfast.experiments.trial_batches import problem_of
from holdfast.planning import encode_checkpoint, initial_state
from holdfast.runtime.trials import available_cores
from holdfast.settings import ParticleFilterSettings, PlanningSettings

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from holdfast.problems.problem import FloatArray

__all__ = ["CloudWorth", "Kind", "scaling_of"]

_PROBLEMS = ("peg_in_hole_2d", "peg_in_hole_3d", "capsule_robot")
_ESTIMATORS = ("nearest_neighbor", "gaussian_mixture_upper")
_PARTICLES = (100, 300, 1000, 2000, 4000, 8000, 16_000, 32_000, 64_000, 100_000)
_SAMPLES = (10, 30, 100, 300)
_SAMPLES_DRAWN = (10, 100)
"""Of these figures and sentences tell; the tables and the map have all."""

# Moving 4,096 particles or more uses all cores whatever it is told: beyond, one thread would not
# be one.
_PARTICLES_AHEAD = (100, 300, 1000, 2000, 4000)

_QUICK_PARTICLES = (100, 1000, 2000, 5000, 10_000, 20_000)
_QUICK_SAMPLES = (10, 100)

_TIMES_THE_CORES = (8, 36)
_ROBOT_CORES = (1, 4)
_PATHS_MS = (20.0, 87.0)
_RATES_HZ = (10.0, 50.0)
_SENSING_INTERVAL = PlanningSettings().sensing_interval
_EXCHANGE_PARTICLES = (100, 10_000)

_STEADY_FROM = 1000
"""From so many particles on the growth is fitted; below, what every decision costs is seen."""

_DISTURBED_FROM = 0.25
"""Cores that others kept busy, from which on a share measured meanwhile says little."""

_SPEED_OF_A_PATH = 1.25e6  # bytes in a second: 10 Mbit/s


class Kind(NamedTuple):
    """Decisions of one kind.

    Attributes
    ----------
    problem : str
    sensing_actions : int
        J.
    estimator : str
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

    def names(self) -> dict[str, Cell]:
        """Return the cells of a table that name it."""
        return {
            "problem": self.problem,
            "sensing_actions": self.sensing_actions,
            "estimator": self.estimator,
            "samples": self.samples,
            "horizon": self.horizon,
        }


def _all(kind: Kind) -> int:
    return _actions_of(kind.problem)


@functools.cache
def _actions_of(problem: str) -> int:
    return len(problem_of(problem, {}, {}).sensing_actions)


_SHOWN = Kind(_PROBLEMS[0], 3)
"""The problem and the settings that the thesis reports on."""


class CloudWorth:
    """The study ``cloud_worth``."""

    name = "cloud_worth"
    title = "When is the cloud worth it? Sensing time, cores and the way to them"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        return [
            *(task for _, task in _exchanges(scale)),
            *(_measured(kind, scale) for kind in _kinds(scale)),
        ]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        report = Report()
        raw = Table({})
        scalings: dict[Kind, Scaling] = {}
        of_beliefs: dict[Kind, Table] = {}
        for kind in _kinds(scale):
            table = results.of([_measured(kind, scale)])
            raw.extend(table, **kind.names())
            of_beliefs[kind] = table
            scalings[kind] = scaling_of(kind, table)
        asked = {key: results.of([task]) for key, task in _exchanges(scale)}
        exchange = _exchange_table(asked)
        exchange_ms = _exchange_ms(asked)
        report.raw["sensing_times"] = raw
        report.summary["sensing_times"] = _times_table(of_beliefs, scalings)
        report.summary["exchange"] = exchange
        report.summary["growth"] = _growth_table(of_beliefs)
        report.summary["break_even"] = _break_even_table(scalings, exchange_ms)
        report.summary["break_even_ahead"] = _ahead_table(scalings, exchange_ms)
        report.figures["sensing_time"] = partial(_draw_times, scalings, exchange_ms)
        report.figures["break_even_map"] = partial(_draw_map, scalings, exchange_ms)
        report.figures["break_even"] = partial(_draw_all, report.summary["break_even"])
        report.figures["waiting"] = partial(_draw_waiting, scalings, exchange_ms)
        report.findings = _findings(report.summary, of_beliefs, scalings, exchange_ms)
        return report


# -- what is measured --------------------------------------------------------------------------


def _kinds(scale: Scale) -> list[Kind]:
    """Return all that is measured, what is shown first."""
    kinds: list[Kind] = []
    for problem in _PROBLEMS:
        actions = _actions_of(problem)
        for estimator in _ESTIMATORS:
            samples: Sequence[int] = _SAMPLES
            if scale.quick:
                shown = problem == _SHOWN.problem
                samples = _QUICK_SAMPLES if shown and estimator == _ESTIMATORS[0] else (10,)
                if estimator != _ESTIMATORS[0] and not shown:
                    continue
            kinds += [Kind(problem, actions, estimator, each) for each in samples]
    whole = Kind("peg_in_hole_3d", _actions_of("peg_in_hole_3d"))
    for actions in (3,) if scale.quick else (1, 2, 3):
        kinds.append(whole._replace(sensing_actions=actions))
    for problem in (_SHOWN.problem,) if scale.quick else _PROBLEMS:
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
                problem=_SHOWN.problem,
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


def scaling_of(kind: Kind, table: Table) -> Scaling:
    """Return what a table of :func:`~.sensing_times.measure_sensing` says, by particles.

    Times and shares are medians over the beliefs.
    """
    one = table.numbers("threads") == 1
    particles = table.numbers("particles")
    numbers = np.unique(particles)
    times, shares = [], []
    for number in numbers:
        here = one & (particles == number)
        times.append(median_interval(table.numbers("median_ms")[here]))
        shares.append(median_interval(table.numbers("share")[here]))
    return Scaling(
        tuple(int(number) for number in numbers),
        tuple(times),
        tuple(shares),
        kind.sensing_actions * kind.samples,
    )


# -- tables ------------------------------------------------------------------------------------


def _times_table(of_beliefs: dict[Kind, Table], scalings: dict[Kind, Scaling]) -> Table:
    """Return the median times by kind, particles and threads, with the share that is divided."""
    cells: list[dict[str, Cell]] = []
    for kind, table in of_beliefs.items():
        scaling = scalings[kind]
        for number, share in zip(scaling.particles, scaling.shares, strict=True):
            here = table.numbers("particles") == number
            threads = table.numbers("threads")
            for each in np.unique(threads):
                those = here & (threads == each)
                mapping = table.numbers("mapping_ms")[those] / table.numbers("median_ms")[those]
                cells.append(
                    {
                        **kind.names(),
                        "particles": number,
                        "threads": int(each),
                        "beliefs": int(those.sum()),
                        "repetitions": int(table.numbers("repetitions")[those][0]),
                        **cells_of("ms", median_interval(table.numbers("median_ms")[those])),
                        **cells_of("divided_share", share),
                        "mapping_share": float(np.median(mapping)),
                        "others_cores": _found(table.numbers("others_cores")[those][0]),
                    }
                )
    return Table.of_records(cells)


def _found(value: float) -> Cell:
    return float(value) if math.isfinite(value) else None


def _exchange_table(asked: dict[tuple[str, int], Table]) -> Table:
    """Return what asking costs beside the computation and the path."""
    cells: list[dict[str, Cell]] = []
    for (way, particles), table in asked.items():
        task = table.numbers("task_ms") - table.numbers("task_computed_ms")
        both = table.numbers("sensing_ms") - table.numbers("computed_ms")
        cells.append(
            {
                "way": way,
                "particles": particles,
                "questions": table.num_rows,
                **cells_of("task_exchange_ms", median_interval(task)),
                **cells_of("sensing_exchange_ms", median_interval(both)),
                **cells_of("task_computed_ms", median_interval(table.numbers("task_computed_ms"))),
            }
        )
    return Table.of_records(cells)


def _exchange_ms(asked: dict[tuple[str, int], Table]) -> float:
    """Return what a service's answer takes beside its computation, without a path.

    It grows a little with the particles, whose digest is taken; the largest is counted for all.
    """
    return max(
        float(np.median(table.numbers("sensing_ms") - table.numbers("computed_ms")))
        for (way, _), table in asked.items()
        if way == "tcp"
    )


def _growth_table(of_beliefs: dict[Kind, Table]) -> Table:
    """Return the exponents of the time on one thread, in particles, M, J and H."""
    cells: list[dict[str, Cell]] = []
    for kind, table in of_beliefs.items():
        for start in (100, _STEADY_FROM):
            points = _one_thread(table)
            mine = {
                belief: {n: ms for n, ms in times.items() if n >= start}
                for belief, times in points.items()
            }
            cells += _exponents("particles", kind, mine, f"from {start:,} on")
    for changed in ("samples", "sensing_actions", "horizon"):
        for kind in of_beliefs:
            family = [
                other
                for other in of_beliefs
                if other._replace(**{changed: getattr(kind, changed)}) == kind
            ]
            if len(family) < 2 or family[0] != kind:
                continue
            common = set.intersection(
                *(set(map(int, of_beliefs[other].columns["particles"])) for other in family)  # type: ignore[arg-type]
            )
            at = max((n for n in common if n <= _STEADY_FROM), default=None)
            if at is None:
                continue
            of_each: dict[int, dict[int, float]] = {}
            for other in family:
                for belief, times in _one_thread(of_beliefs[other]).items():
                    if at in times:
                        of_each.setdefault(belief, {})[getattr(other, changed)] = times[at]
            cells += _exponents(changed, kind, of_each, f"at {at:,} particles")
    return Table.of_records(cells)


def _exponents(
    what: str, kind: Kind, points: dict[int, dict[int, float]], where: str
) -> list[dict[str, Cell]]:
    """Return a row with the median exponent over the beliefs, each fitted alone; none if few."""
    most = max((len(times) for times in points.values()), default=0)
    slopes = [
        power_law(np.array(list(times), dtype=float), np.array(list(times.values())))[1].value
        for times in points.values()
        if len(times) == most and most > 1
    ]
    if not slopes:
        return []
    sizes = sorted(next(times for times in points.values() if len(times) == most))
    names = kind.names()
    if what != "particles":
        names[what] = None
    return [
        {
            "grows_with": what,
            **names,
            "where": where,
            "smallest": sizes[0],
            "largest": sizes[-1],
            "beliefs": len(slopes),
            **cells_of("exponent", median_interval(np.array(slopes))),
            "n_log_n": _exponent_of_n_log_n(sizes[0], sizes[-1]) if what == "particles" else None,
        }
    ]


def _exponent_of_n_log_n(smallest: int, largest: int) -> float:
    """Return the exponent that n log n would have between two sizes."""
    return 1.0 + math.log(math.log(largest) / math.log(smallest)) / math.log(largest / smallest)


def _one_thread(table: Table) -> dict[int, dict[int, float]]:
    """Return the times of each belief on one thread, by particles."""
    found: dict[int, dict[int, float]] = {}
    for row in table.rows():
        if row["threads"] == 1:
            belief, particles, ms = row["belief"], row["particles"], row["median_ms"]
            assert isinstance(belief, int) and isinstance(particles, int)
            assert isinstance(ms, float)
            found.setdefault(belief, {})[particles] = ms
    return found


class _Line(NamedTuple):
    """A break-even with its bounds: favourable to few cores, to many, and divided evenly."""

    value: BreakEven
    last: BreakEven
    first: BreakEven
    even: BreakEven


def _line(
    scaling: Scaling, robot_cores: int, cores: int, cost_ms: float, ahead_ms: float = 0.0
) -> _Line:
    found = [
        break_even(each.saved_ms(robot_cores, cores, ahead_ms), cost_ms)
        for each in (scaling, *scaling.bounds())
    ]
    return _Line(*found)


def _line_cells(line: _Line) -> dict[str, Cell]:
    return {
        "particles": _whole(line.value),
        "particles_low": _whole(line.first),
        "particles_high": _whole(line.last),
        "particles_if_divided_evenly": _whole(line.even),
        "words": line.value.words,
    }


def _whole(found: BreakEven) -> Cell:
    return None if found.particles is None else round(found.particles)


def _break_even_table(scalings: dict[Kind, Scaling], exchange_ms: float) -> Table:
    """Return from where on a service is faster for a robot that waits for each decision."""
    return Table.of_records(
        [
            {
                **kind.names(),
                "robot_cores": robot_cores,
                "service_cores": times * robot_cores,
                "path_ms": path_ms,
                **_line_cells(
                    _line(scaling, robot_cores, times * robot_cores, path_ms + exchange_ms)
                ),
                "measured_to": scaling.particles[-1],
            }
            for kind, scaling in scalings.items()
            for robot_cores in _ROBOT_CORES
            for times in _TIMES_THE_CORES
            for path_ms in _PATHS_MS
        ]
    )


def _ahead_table(scalings: dict[Kind, Scaling], exchange_ms: float) -> Table:
    """Return the same for a robot that decides ahead, by its rate."""
    return Table.of_records(
        [
            {
                **kind.names(),
                "rate_hz": rate_hz,
                "ahead_ms": _ahead_ms(rate_hz),
                "robot_cores": 1,
                "service_cores": cores,
                "path_ms": path_ms,
                **_line_cells(_line(scaling, 1, cores, path_ms + exchange_ms, _ahead_ms(rate_hz))),
                "measured_to": scaling.particles[-1],
            }
            for kind, scaling in scalings.items()
            for rate_hz in _RATES_HZ
            for cores in _TIMES_THE_CORES
            for path_ms in _PATHS_MS
        ]
    )


def _ahead_ms(rate_hz: float) -> float:
    """Return how long a robot moves between two sensing steps."""
    return 1e3 * _SENSING_INTERVAL / rate_hz


# -- sentences ---------------------------------------------------------------------------------


def _findings(
    summary: dict[str, Table],
    of_beliefs: dict[Kind, Table],
    scalings: dict[Kind, Scaling],
    exchange_ms: float,
) -> list[str]:
    shown = scalings[_SHOWN]
    findings = [_about_disturbance(of_beliefs), *_about_shares(scalings, of_beliefs)]
    findings += [
        f"{kind.label}, a robot with one core that waits for each decision: "
        + _told(scaling, exchange_ms)
        for kind, scaling in scalings.items()
        if kind.samples in _SAMPLES_DRAWN and kind.sensing_actions == _all(kind)
    ]
    findings += [
        f"{_SHOWN.label}, a robot with one core that decides ahead at {rate_hz:g} Hz and has "
        f"{_ahead_ms(rate_hz):,.0f} ms for each sensing action while it moves: "
        + _told(shown, exchange_ms, _ahead_ms(rate_hz))
        for rate_hz in _RATES_HZ
    ]
    findings.append(
        f"{_SHOWN.label}, a robot with {_ROBOT_CORES[1]} cores that waits for each decision: "
        + _told(shown, exchange_ms, robot_cores=_ROBOT_CORES[1])
    )
    findings += _about_growth(summary["growth"])
    findings.append(_about_asking(summary["exchange"]))
    findings.append(_about_checkpoints(shown))
    return findings


def _told(scaling: Scaling, exchange_ms: float, ahead_ms: float = 0.0, robot_cores: int = 1) -> str:
    """Say beyond how many particles services are faster, with bounds."""
    texts = []
    for path_ms in _PATHS_MS:
        for times in _TIMES_THE_CORES:
            cores = times * robot_cores
            line = _line(scaling, robot_cores, cores, path_ms + exchange_ms, ahead_ms)
            value, low, high, even = (
                _shown_particles(end, scaling)
                for end in (line.value, line.first, line.last, line.even)
            )
            where = f"beyond {value}"
            if line.value.particles is None:
                where = f"nowhere up to {scaling.particles[-1]:,}"
            texts.append(
                f"with {cores} cores at {path_ms:g} ms {where} particles (bounds {low} and {high}; "
                f"divided evenly {even})"
            )
    return "a service is faster " + ", ".join(texts)


def _shown_particles(found: BreakEven, scaling: Scaling) -> str:
    if found.particles is None:
        return f"> {scaling.particles[-1]:,}"
    return f"{found.particles:,.0f}"


def _about_disturbance(of_beliefs: dict[Kind, Table]) -> str:
    """Say whether the machine was quiet."""
    others = np.concatenate([table.numbers("others_cores") for table in of_beliefs.values()])
    others = others[np.isfinite(others)]
    if not others.size:
        return "How busy other processes kept the machine is not known"
    middle = float(np.median(others))
    text = f"Other processes kept {middle:.2f} cores busy meanwhile (median over all measurements)"
    if available_cores() < max(_threads()):
        return f"{text}; this machine has one core, so what threads share could not be measured"
    if middle < _DISTURBED_FROM:
        return text
    return (
        f"{text}: the shares of the work that threads divide, and with them what more cores gain, "
        "are lower bounds; measure again on a quiet machine"
    )


def _about_shares(scalings: dict[Kind, Scaling], of_beliefs: dict[Kind, Table]) -> list[str]:
    """Say what of a decision is divided among threads, for one step and for several."""
    findings = []
    for several in (False, True):
        shares, mapping = [], []
        for kind, scaling in scalings.items():
            if (kind.horizon > 1) != several:
                continue
            long = [
                (number, share.value)
                for number, share, time in zip(
                    scaling.particles, scaling.shares, scaling.times, strict=True
                )
                if time.value >= 5.0
            ]
            shares += [share for _, share in long]
            table = of_beliefs[kind]
            for number, _ in long:
                here = (table.numbers("particles") == number) & (table.numbers("threads") == 1)
                mapping.append(
                    float(
                        np.median(
                            table.numbers("mapping_ms")[here] / table.numbers("median_ms")[here]
                        )
                    )
                )
        if not shares:
            continue
        which = "of several steps (H > 1)" if several else "of one step (H = 1)"
        # The settings share beliefs: a range, which claims nothing, and not an interval.
        lowest, middle, highest = 100.0 * np.quantile(shares, [0.0, 0.5, 1.0])
        findings.append(
            f"Decisions {which} of 5 ms and more: {middle:.0f} % of the time on one thread is "
            f"divided among threads (median of {len(shares)} settings, which range from "
            f"{lowest:.0f} to {highest:.0f} %; from 1 and "
            f"{' and '.join(map(str, _threads()[1:]))} threads); mapping all particles to actions "
            "and observations, which one thread does, is "
            f"{100 * float(np.median(mapping)):.1f} %"
        )
    return findings


def _about_growth(growth: Table) -> list[str]:
    """Say how the time grows."""
    findings = []
    for row in growth.rows():
        one_step = row["horizon"] == 1 or row["grows_with"] == "horizon"
        ten = row["samples"] == 10 and row["where"] == f"from {_STEADY_FROM:,} on"
        if not one_step or (row["grows_with"] == "particles" and not ten):
            continue
        if row["grows_with"] == "particles" and row["sensing_actions"] != _actions_of(
            str(row["problem"])
        ):
            continue
        symbol = {"particles": "N", "samples": "M", "sensing_actions": "J", "horizon": "H"}[
            str(row["grows_with"])
        ]
        value, low, high = row["exponent"], row["exponent_low"], row["exponent_high"]
        ends = f"[{low:.2f}, {high:.2f}]" if low is not None and high is not None else ""
        text = (
            f"{row['problem']}, {str(row['estimator']).replace('_', ' ')}: time grows as {symbol} "
            f"to the {value:.2f} {ends} for {symbol} from {row['smallest']:,} to "
            f"{row['largest']:,}"
        )
        text += (
            f" (N log N would be {row['n_log_n']:.2f})"
            if row["grows_with"] == "particles"
            else f" {row['where']}"
        )
        findings.append(f"{text}; median of {row['beliefs']} beliefs")
    return findings


def _about_asking(exchange: Table) -> str:
    """Say what asking costs."""
    texts = [
        f"{row['sensing_exchange_ms']:.2f} ms "
        + (
            f"[{row['sensing_exchange_ms_low']:.2f}, {row['sensing_exchange_ms_high']:.2f}] "
            if row["sensing_exchange_ms_low"] is not None
            else ""
        )
        + f"{'over tcp' if row['way'] == 'tcp' else 'in process'} with {row['particles']:,} "
        "particles"
        for row in exchange.rows()
    ]
    return (
        "Asking for a sensing action costs, beside computation and path, a median of "
        + ", ".join(texts)
    )


def _about_checkpoints(shown: Scaling) -> str:
    """Say what handing the state over costs, which only happens when a service lacks it."""
    problem = problem_of(_SHOWN.problem, {}, {})
    settings = PlanningSettings(particle_filter=ParticleFilterSettings(num_particles=1000))
    size = len(encode_checkpoint(initial_state(problem, settings, 0, 0))) / 1000.0
    particles = shown.particles[-1]
    megabytes = size * particles / 1e6
    return (
        f"A service that lacks the state is handed a checkpoint of {size:.0f} bytes for each "
        f"particle, once: with {particles:,} particles {megabytes:.2g} MB, which at 10 Mbit/s take "
        f"{size * particles / _SPEED_OF_A_PATH:.2g} s; the other questions take some 75 bytes"
    )


# -- figures -----------------------------------------------------------------------------------


def _shown_samples(scalings: dict[Kind, Scaling]) -> list[Kind]:
    """Return the kinds that are shown, by numbers of hypothetical observations."""
    family = [kind for kind in scalings if kind._replace(samples=_SHOWN.samples) == _SHOWN]
    return sorted(family, key=lambda kind: kind.samples)


def _panels(figure: Figure, rows: int, columns: int) -> list[list[Axes]]:
    """Return panels with the same axes, row by row."""
    import matplotlib as mpl

    from holdfast.recording.figure import STYLE

    with mpl.rc_context(STYLE):
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    return [list(row) for row in panels]


def _draw_times(scalings: dict[Kind, Scaling], exchange_ms: float) -> Figure:
    """Draw time against particles: here, and on more cores further away."""
    from holdfast.experiments import plots

    kinds = [kind for kind in _shown_samples(scalings) if kind.samples in _SAMPLES_DRAWN]
    figure = plots.figure_of(
        9.2,
        3.4 * len(kinds) + 0.6,
        "Choosing a sensing action: on the robot's one core, or on more further away",
    )
    panels = _panels(figure, len(kinds), len(_PATHS_MS))
    for row, kind in zip(panels, kinds, strict=True):
        for panel, path_ms in zip(row, _PATHS_MS, strict=True):
            _draw_lines(panel, scalings[kind], path_ms, exchange_ms)
            panel.set_title(f"{kind.label}, path of {path_ms:g} ms", loc="left")
        row[0].set_ylabel("time until the sensing action is there (ms)")
    for panel in panels[-1]:
        panel.set_xlabel("particles")
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=2, handlelength=3.2, frameon=False
    )
    return figure


_LINES = ((8, "--", "o"), (36, "-.", "D"))


def _draw_lines(panel: Axes, scaling: Scaling, path_ms: float, exchange_ms: float) -> None:
    from holdfast.experiments import plots

    cost_ms = path_ms + exchange_ms
    numbers = np.array(scaling.particles, dtype=float)
    dense = np.geomspace(numbers[0], numbers[-1], 300).clip(numbers[0], numbers[-1])
    value = np.array([time.value for time in scaling.times])
    low = np.array([time.low for time in scaling.times])
    high = np.array([time.high for time in scaling.times])
    finite = np.isfinite(low) & np.isfinite(high)
    panel.errorbar(
        numbers,
        value,
        yerr=np.where(finite, [value - low, high - value], 0.0),
        fmt="s-",
        color="#1A1D21",
        markersize=4.0,
        markerfacecolor="white",
        elinewidth=1.0,
        capsize=2.0,
        label="robot: 1 core (95 % interval over beliefs)",
        zorder=3,
    )
    for (cores, style, mark), color in zip(_LINES, plots.COLORS[1:], strict=False):
        least, most = scaling.band(cores)
        panel.fill_between(
            dense,
            cost_ms + least.at(dense),
            cost_ms + most.at(dense),
            color=color,
            alpha=0.22,
            linewidth=0,
        )
        panel.plot(
            dense,
            cost_ms + scaling.on_cores(cores).at(dense),
            style,
            color=color,
            linewidth=1.6,
            label=f"service: {cores} cores (band: divided evenly to least share)",
        )
        found = break_even(scaling.saved_ms(1, cores), cost_ms)
        if found.particles is None:
            continue
        at = np.array([found.particles])
        height = float(scaling.on_cores(1).at(at)[0])
        panel.plot(at, [height], mark, color=color, markeredgecolor="#1A1D21", zorder=4)
        # Where nothing is drawn: decisions of many particles are never that fast.
        panel.text(
            0.98,
            0.12 if cores == _LINES[0][0] else 0.05,
            f"equal with {cores} cores: {found.particles:,.0f}",
            transform=panel.transAxes,
            horizontalalignment="right",
            fontsize=9.0,
        )
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.grid(which="major")


def _draw_map(scalings: dict[Kind, Scaling], exchange_ms: float) -> Figure:
    """Draw where a service is faster, over particles and hypothetical observations."""
    from matplotlib.colors import BoundaryNorm, ListedColormap
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    from holdfast.experiments import plots

    kinds = _shown_samples(scalings)
    figure = plots.figure_of(
        9.2, 7.0, f"When is the cloud worth it? {_SHOWN.problem}, a robot with one core that waits"
    )
    panels = _panels(figure, len(_TIMES_THE_CORES), len(_PATHS_MS))
    first = min(scalings[kind].particles[0] for kind in kinds)
    last = max(scalings[kind].particles[-1] for kind in kinds)
    numbers = np.geomspace(first, last, 160).clip(first, last)
    samples = np.geomspace(kinds[0].samples, kinds[-1].samples, 80)
    edges = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, 1e9)
    colors = ("#FFFFFF", "#ECEFF4", "#D5DCE8", "#9DB2D6", "#5E7FB8", "#1D3C78")
    shades = ListedColormap(colors)
    norm = BoundaryNorm(edges, shades.N)
    for row, cores in zip(panels, _TIMES_THE_CORES, strict=True):
        for panel, path_ms in zip(row, _PATHS_MS, strict=True):
            cost_ms = path_ms + exchange_ms
            own, there = (
                _over_samples(kinds, [scalings[kind].on_cores(c).beyond(numbers) for kind in kinds])
                for c in (1, cores)
            )
            ratio = own(samples) / (cost_ms + there(samples))
            panel.pcolormesh(
                numbers, samples, ratio, cmap=shades, norm=norm, shading="nearest", rasterized=True
            )
            panel.fill_betweenx(
                [kind.samples for kind in kinds],
                [scalings[kind].particles[-1] for kind in kinds],
                last,
                facecolor="none",
                edgecolor="#8A9099",
                hatch="////",
                linewidth=0.0,
            )
            _draw_break_even(panel, kinds, scalings, cores, cost_ms)
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.set_yticks([kind.samples for kind in kinds], [str(k.samples) for k in kinds])
            panel.minorticks_off()
            panel.set_xlim(first, last)
            panel.set_ylim(kinds[0].samples, kinds[-1].samples)
            panel.set_title(f"{cores} cores, path of {path_ms:g} ms", loc="left")
        row[0].set_ylabel("hypothetical observations M")
    for panel in panels[-1]:
        panel.set_xlabel("particles")
    words = (
        "more than 10 times slower",
        "2 to 10 times slower",
        "up to 2 times slower",
        "up to 2 times faster",
        "2 to 4 times faster",
        "more than 4 times faster",
    )
    handles: list[Patch | Line2D] = [
        Patch(facecolor=shade, edgecolor="#4A4F57", linewidth=0.5, label=word)
        for shade, word in zip(colors, words, strict=True)
    ]
    handles += [
        Patch(facecolor="none", edgecolor="#8A9099", hatch="////", label="extrapolated"),
        Line2D([], [], color="#B5342B", linewidth=2.2, marker="o", label="equally fast"),
        Line2D([], [], color="#B5342B", linewidth=1.0, linestyle="--", label="its bounds"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _over_samples(
    kinds: Sequence[Kind], rows: Sequence[FloatArray]
) -> Callable[[FloatArray], FloatArray]:
    """Return the times between numbers of samples, straight in logarithms."""
    at = np.log([kind.samples for kind in kinds])
    heights = np.log(np.array(rows))

    def times(samples: FloatArray) -> FloatArray:
        columns = [
            np.interp(np.log(samples), at, heights[:, column]) for column in range(heights.shape[1])
        ]
        return np.asarray(np.exp(np.array(columns).T))

    return times


def _draw_break_even(
    panel: Axes,
    kinds: Sequence[Kind],
    scalings: dict[Kind, Scaling],
    cores: int,
    cost_ms: float,
) -> None:
    lines = [_line(scalings[kind], 1, cores, cost_ms) for kind in kinds]
    for which in ("value", "first", "last"):
        ends = [getattr(line, which).particles for line in lines]
        particles = [math.nan if end is None else end for end in ends]
        samples = [kind.samples for kind in kinds]
        if which == "value":
            panel.plot(particles, samples, "o-", color="#B5342B", linewidth=2.2, clip_on=False)
        else:
            panel.plot(particles, samples, "--", color="#B5342B", linewidth=1.0)


def _draw_all(table: Table) -> Figure:
    """Draw the break-even of all kinds of decisions, for a robot with one core."""
    from holdfast.experiments import plots

    rows = [
        row
        for row in table.rows()
        if row["robot_cores"] == _ROBOT_CORES[0] and row["samples"] in _SAMPLES_DRAWN
    ]
    kinds = list(dict.fromkeys(_kind_of(row) for row in rows))
    figure, panels = plots.stacked_panels(
        [2 * len(kinds)],
        title="Beyond how many particles a service is faster than the robot's one core",
        width=9.2,
    )
    (panel,) = panels
    dots = []
    for path_ms in _PATHS_MS:
        for cores in _TIMES_THE_CORES:
            mine = [
                row for row in rows if row["service_cores"] == cores and row["path_ms"] == path_ms
            ]
            values = [number_of(row["particles"]) for row in mine]
            lows = [number_of(row["particles_low"]) for row in mine]
            highs = [number_of(row["particles_high"]) for row in mine]
            to = [number_of(row["measured_to"]) for row in mine]
            dots.append(
                plots.Dots(
                    f"{cores} cores, path of {path_ms:g} ms",
                    values,
                    [v if math.isnan(low) else low for v, low in zip(values, lows, strict=True)],
                    # A bound that was not reached is at least where the measurement ended.
                    [
                        max(v, t) if math.isnan(h) else h
                        for v, h, t in zip(values, highs, to, strict=True)
                    ],
                )
            )
    panel.set_xscale("log")
    plots.dot_rows(panel, [kind.label for kind in kinds], dots)
    for place, kind in enumerate(kinds):
        end = max(number_of(row["measured_to"]) for row in rows if _kind_of(row) == kind)
        panel.plot([end, end], [place - 0.4, place + 0.4], color="#8A9099", linewidth=1.2)
    panel.set_xlabel("particles at break-even, with bounds; grey: measured up to here")
    legend = panel.get_legend()
    assert legend is not None
    legend.remove()
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _kind_of(row: Mapping[str, Cell]) -> Kind:
    return msgspec.convert([row[name] for name in _SHOWN.names()], Kind)


def _draw_waiting(scalings: dict[Kind, Scaling], exchange_ms: float) -> Figure:
    """Draw what a robot waits for at each turn, if it waits for the decision and if not."""
    from holdfast.experiments import plots

    scaling = scalings[_SHOWN]
    ways = [("waits for each decision", 0.0)]
    ways += [
        (f"decides ahead, {rate_hz:g} Hz", _ahead_ms(rate_hz))
        for rate_hz in sorted(_RATES_HZ, reverse=True)
    ]
    figure = plots.figure_of(
        9.2, 3.9, f"What a robot stands still for at each turn: {_SHOWN.label}"
    )
    (panels,) = _panels(figure, 1, len(ways))
    first, last = scaling.particles[0], scaling.particles[-1]
    numbers = np.geomspace(first, last, 400).clip(first, last)
    places = (
        (1, 0.0, "-", "robot: 1 core"),
        (8, _PATHS_MS[0], "--", f"service: 8 cores, {_PATHS_MS[0]:g} ms"),
        (36, _PATHS_MS[1], "-.", f"service: 36 cores, {_PATHS_MS[1]:g} ms"),
    )
    for panel, (way, ahead_ms) in zip(panels, ways, strict=True):
        for color, (cores, path_ms, style, label) in zip(
            ("#1A1D21", *plots.COLORS[1:]), places, strict=False
        ):
            cost_ms = path_ms + exchange_ms if cores > 1 else 0.0
            waits = cost_ms + np.maximum(scaling.on_cores(cores).at(numbers) - ahead_ms, 0.0)
            panel.plot(numbers, waits, style, color=color, linewidth=1.6, label=label)
        panel.set_xscale("log")
        panel.set_ylim(-6.0, 250.0)
        panel.grid()
        panel.set_title(way, loc="left")
        panel.set_xlabel("particles")
    panels[0].set_ylabel("waiting at each turn (ms)")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="outside lower center", ncols=3, handlelength=3.2, frameon=False
    )
    return figure
