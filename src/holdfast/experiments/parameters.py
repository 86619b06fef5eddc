"""What the parameters do: each of them changed alone, on the same worlds.

That no difference is found does not mean that there is none: the intervals say how large one could
be. Where they exclude all that would matter, the cheapest value will do.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import msgspec
import numpy as np

from holdfast.experiments import statistics
from holdfast.experiments.cases import CASES
from holdfast.experiments.study import Report, Results, Scale
from holdfast.experiments.tables import Cell, Table, number_of
from holdfast.experiments.tasks import Task
from holdfast.experiments.trial_batches import problem_of, trial_tasks
from holdfast.recording.tables import wilson_interval
from holdfast.settings import ActiveSensingSettings, ParticleFilterSettings, SelectorSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from holdfast.experiments.statistics import FloatArray

__all__ = ["Parameters", "Variant", "variants"]

LEVEL = 0.01
"""Of the tests of steps, and of those of successes: the probability that any difference is claimed
where there is none."""

_TRIALS = 200
_QUICK_TRIALS = 6
_MOST_QUICK_PARTICLES = 3.0
"""In a quick run, as a multiple of a problem's."""

_TRIALS_IN_EACH = 20

_INTERVALS: Mapping[str, int] = {
    "tight hole": 8,
    "three plates": 8,
    "peg in space": 4,
    "light and dark": 4,
    "passer-by": 8,
}
"""Steps between two looks, in the problems in which sensing decides about the outcome."""

_CASES = {case.name: case for case in CASES if case.name in _INTERVALS}

_TOGETHER = "all five problems (mean)"

Estimator = Literal["gaussian_mixture_upper", "nearest_neighbor"]

_DEFAULT: Estimator = "nearest_neighbor"

_ESTIMATORS: Mapping[Estimator, str] = {
    "gaussian_mixture_upper": "mixture",
    "nearest_neighbor": "neighbours",
}
"""What tables call them."""


class Variant(NamedTuple):
    """Settings of action entropy of which one differs from those of the estimator's reference.

    Attributes
    ----------
    parameter, value : str
        What differs, and how; empty for the reference itself.
    estimator : {"gaussian_mixture_upper", "nearest_neighbor"}
    active_sensing : ActiveSensingSettings
    particle_filter : ParticleFilterSettings
    resolution : float, optional
        In units of the problem's own; None for that, and for a mixture the motion noise.
    times_the_particles : float
        As many as the problem has.
    """

    parameter: str = ""
    value: str = ""
    estimator: Estimator = "nearest_neighbor"
    active_sensing: ActiveSensingSettings = ActiveSensingSettings()
    particle_filter: ParticleFilterSettings = ParticleFilterSettings()
    resolution: float | None = None
    times_the_particles: float = 1.0

    def names(self) -> dict[str, Cell]:
        """Return the cells of a table that name it."""
        return {
            "estimator": _ESTIMATORS[self.estimator],
            "parameter": self.parameter,
            "value": self.value,
        }


def variants() -> list[Variant]:
    """Return each estimator's reference, followed by all that differ from it."""
    found = [Variant(), *_numbers_of_particles("nearest_neighbor")]
    for samples in (1, 3, 30, 100):
        sensing = ActiveSensingSettings(num_observation_samples=samples)
        found.append(Variant("M", str(samples), active_sensing=sensing))
    for horizon in (2, 3):
        sensing = ActiveSensingSettings(horizon=horizon)
        found.append(Variant("horizon", str(horizon), active_sensing=sensing))
    found += [
        Variant("resampling", f"below {threshold:g} N", particle_filter=filtering)
        for threshold in (0.25, 0.5)
        for filtering in [ParticleFilterSettings(resampling_threshold=threshold)]
    ]
    found += [
        Variant("estimate", value, particle_filter=filtering)
        for threshold, value in (
            (0.5, "most likely, resampling below 0.5 N"),
            (1.0, "most likely"),
        )
        for filtering in [
            ParticleFilterSettings(estimate="most_likely", resampling_threshold=threshold)
        ]
    ]
    for neighbors in (1, 3, 10, 20):
        sensing = ActiveSensingSettings(num_nearest_neighbors=neighbors)
        found.append(Variant("k", str(neighbors), active_sensing=sensing))
    found += _resolutions("nearest_neighbor", (0.1, 0.3, 3.0, 10.0))
    found.append(Variant(estimator="gaussian_mixture_upper"))
    found += _numbers_of_particles("gaussian_mixture_upper")
    # The same in all directions, as the motion noise itself need not be: so 1 is another, too.
    return found + _resolutions("gaussian_mixture_upper", (0.1, 0.3, 1.0, 3.0, 10.0))


def _numbers_of_particles(estimator: Estimator) -> list[Variant]:
    return [
        Variant("particles", f"x {times:g}", estimator=estimator, times_the_particles=times)
        for times in (0.5, 3.0, 10.0)
    ]


def _resolutions(estimator: Estimator, factors: Sequence[float]) -> list[Variant]:
    return [
        Variant("resolution", f"x {factor:g}", estimator=estimator, resolution=factor)
        for factor in factors
    ]


class Parameters:
    """The study ``parameters``."""

    name = "parameters"
    title = "What the parameters do: particles, M, k, resolution, horizon, estimate, resampling"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        return [task for case, variant in _cells(scale) for task in _tasks(case, variant, scale)]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        tables = {
            (case, variant): results.of(_tasks(case, variant, scale))
            for case, variant in _cells(scale)
        }
        summary, together = _alone(tables), _together(tables)
        more_particles = _more_particles(tables)
        report = Report()
        raw = Table({})
        for (case, variant), table in tables.items():
            raw.extend(table, problem=case, **variant.names())
        report.raw["parameters"] = raw
        report.summary["parameters"] = summary
        report.summary["together"] = together
        report.summary["more_particles"] = more_particles
        report.figures["parameters"] = partial(_draw, summary, together)
        report.findings = _findings(summary, together, more_particles)
        return report


def _cells(scale: Scale) -> Iterator[tuple[str, Variant]]:
    for case in _CASES:
        for variant in variants():
            # Ten times the particles alone would take as long as all the rest.
            if not scale.quick or variant.times_the_particles <= _MOST_QUICK_PARTICLES:
                yield case, variant


def _tasks(name: str, variant: Variant, scale: Scale) -> list[Task]:
    case = _CASES[name]
    case = msgspec.structs.replace(
        case, num_particles=round(variant.times_the_particles * case.num_particles)
    )
    selector = SelectorSettings(estimator=variant.estimator)
    if variant.resolution is not None:
        own = problem_of(case.problem, case.model, {}).resolution
        resolution = np.multiply(variant.resolution, own).tolist()
        if isinstance(resolution, list):
            resolution = tuple(resolution)
        selector = msgspec.structs.replace(selector, resolution=resolution)
    series = case.series(
        selector,
        _INTERVALS[name],
        seed=scale.seed,
        num_trials=_QUICK_TRIALS if scale.quick else _TRIALS,
        active_sensing=variant.active_sensing,
        particle_filter=variant.particle_filter,
    )
    return list(trial_tasks(series, _TRIALS_IN_EACH))


_Tables = Mapping[tuple[str, Variant], Table]

_P_VALUES = ("success_p_value", "steps_p_value")


def _alone(tables: _Tables) -> Table:
    """Return how each variant differs from its estimator's reference, in each problem."""
    rows: list[dict[str, Cell]] = []
    reference = Table({})
    for (case, variant), table in tables.items():
        if not variant.parameter:
            reference = table
        rows.append({"problem": case, **variant.names(), **_compared(table, reference)})
    summary = Table.of_records(rows)
    varied = np.array([bool(name) for name in summary.columns["parameter"]])
    statistics.add_adjusted(summary, *_P_VALUES, compared=varied)
    return summary


def _compared(table: Table, reference: Table) -> dict[str, Cell]:
    success = table.numbers("success") == 1.0
    low, high = wilson_interval(int(success.sum()), success.size)
    steps = statistics.mean_interval(table.numbers("steps"))
    return {
        "trials": table.num_rows,
        "success": float(success.mean()),
        "success_low": low,
        "success_high": high,
        **statistics.cells_of("mean_steps", steps),
        "mean_reward": float(np.mean(table.numbers("reward"))),
        "mean_sensing_ms": float(np.nanmean(table.numbers("mean_sensing_ms"))),
        **_paired(table, reference),
    }


def _paired(table: Table, reference: Table) -> dict[str, Cell]:
    """Return how the trials of a problem differ from those of a reference."""
    return _differences(
        statistics.paired_difference(
            statistics.logarithms_of_steps(table.numbers("steps")),
            statistics.logarithms_of_steps(reference.numbers("steps")),
        ),
        statistics.paired_rates(*(each.numbers("success") == 1.0 for each in (table, reference))),
    )


def _together(tables: _Tables) -> Table:
    """Return how variants differ over all problems, each with the same weight.

    Each is compared with its estimator's reference, and a mixture with the neighbours' as well.
    """
    varied = list(dict.fromkeys(variant for _, variant in tables))
    references = {each.estimator: each for each in varied if not each.parameter}
    rows: list[dict[str, Cell]] = []
    for variant in varied:
        for estimator, reference in references.items():
            if variant == reference or estimator not in ("nearest_neighbor", variant.estimator):
                continue
            rows.append(
                {
                    **variant.names(),
                    "reference": _ESTIMATORS[estimator],
                    **_compared_together(tables, variant, reference),
                }
            )
    table = Table.of_records(rows)
    statistics.add_adjusted(table, *_P_VALUES)
    return table


def _compared_together(tables: _Tables, variant: Variant, reference: Variant) -> dict[str, Cell]:
    """Return how a variant differs from another one over all problems.

    The value of a trial is the mean over the problems' trials of its number, of which all have one.
    """
    fewest = min(table.num_rows for table in tables.values())

    def means(variant: Variant, column: str) -> FloatArray:
        numbers = [tables[case, variant].numbers(column)[:fewest] for case in _CASES]
        if column == "steps":
            numbers = [statistics.logarithms_of_steps(steps) for steps in numbers]
        return np.asarray(np.mean(numbers, axis=0))

    steps, success = (
        statistics.paired_difference(means(variant, column), means(reference, column))
        for column in ("steps", "success")
    )
    return {"trials": fewest, **_differences(steps, success)}


def _more_particles(tables: _Tables) -> Table:
    """Return what the last multiplication of the particles gains, by nearest neighbours.

    The default has more particles than the reference, so what is gained beyond the reference is not
    what is gained beyond the default.
    """
    varied = dict.fromkeys(variant for _, variant in tables if variant.estimator == _DEFAULT)
    numbers = [each for each in varied if each.parameter in ("", "particles")]
    fewer, more = sorted(numbers, key=lambda each: each.times_the_particles)[-2:]
    names: dict[str, Cell] = {
        "estimator": _ESTIMATORS[_DEFAULT],
        "from": f"x {fewer.times_the_particles:g}",
        "to": f"x {more.times_the_particles:g}",
    }
    rows: list[dict[str, Cell]] = [
        {"problem": case, **names, "trials": table.num_rows, **_paired(table, reference)}
        for case in _CASES
        for table, reference in [(tables[case, more], tables[case, fewer])]
    ]
    rows.append({"problem": _TOGETHER, **names, **_compared_together(tables, more, fewer)})
    table = Table.of_records(rows)
    statistics.add_adjusted(table, *_P_VALUES)
    return table


def _differences(
    steps: tuple[statistics.Interval, float], success: tuple[statistics.Interval, float]
) -> dict[str, Cell]:
    """Return the cells of differences in the logarithm of steps and in success, with p-values."""
    return {
        **statistics.cells_of("steps_ratio", statistics.ratio_of(steps[0])),
        **statistics.cells_of("success_gain", success[0]),
        "success_p_value": success[1],
        "steps_p_value": steps[1],
    }


def _findings(summary: Table, together: Table, more_particles: Table) -> list[str]:
    findings = [
        f"{_TOGETHER}, {_told(row)}: {_interval(row, 'steps_ratio')} times the steps and "
        f"{_interval(row, 'success_gain', percent=True)} points of success of the "
        f"reference of the {row['reference']} (geometric mean and mean, n = {row['trials']}, "
        f"paired t-tests, Holm-adjusted p {number_of(row['steps_adjusted_p_value']):.2g} and "
        f"{number_of(row['success_adjusted_p_value']):.2g})"
        for row in together.rows()
        if _is_told(row)
    ]
    untold: dict[str, list[dict[str, Cell]]] = {}
    for row in together.rows():
        if not _is_told(row):
            untold.setdefault(f"{row['estimator']}, {row['parameter']}", []).append(row)
    findings += [
        f"{_TOGETHER}, {name} ({', '.join(str(row['value']) for row in rows)}): no difference in "
        "steps found (paired t-test, least Holm-adjusted p "
        f"{min(number_of(row['steps_adjusted_p_value']) for row in rows):.2g}); single 95 % "
        "intervals lie within "
        f"{min(number_of(row['steps_ratio_low']) for row in rows):.3g} and "
        f"{max(number_of(row['steps_ratio_high']) for row in rows):.3g} times the steps"
        for name, rows in untold.items()
    ]
    findings += [
        f"{row['problem']}, {row['estimator']}, particles {row['to']} instead of {row['from']}: "
        f"{_interval(row, 'steps_ratio')} times the steps and "
        f"{_interval(row, 'success_gain', percent=True)} points of success (geometric mean and "
        f"mean, n = {row['trials']}, paired t-tests, Holm-adjusted p "
        f"{number_of(row['steps_adjusted_p_value']):.2g} and "
        f"{number_of(row['success_adjusted_p_value']):.2g})"
        for row in more_particles.rows()
        if row["problem"] == _TOGETHER
    ]
    for row in summary.rows():
        where = f"{row['problem']}, {_told(row)}"
        level = number_of(row["steps_adjusted_p_value"])
        if row["parameter"] and level < LEVEL:
            findings.append(
                f"{where}: {_interval(row, 'steps_ratio')} times the steps of the reference "
                f"(geometric mean, n = {row['trials']}, paired t-test, Holm-adjusted p "
                f"{level:.2g})"
            )
        level = number_of(row["success_adjusted_p_value"])
        if row["parameter"] and level < LEVEL:
            findings.append(
                f"{where}: {_interval(row, 'success_gain', percent=True)} points of success (n = "
                f"{row['trials']}, McNemar's test, Holm-adjusted p {level:.2g})"
            )
    least: dict[str, float] = {}
    for row in summary.rows():
        if row["parameter"]:
            name = f"{row['parameter']} ({row['estimator']})"
            level = float(row["steps_adjusted_p_value"] or 0.0)
            least[name] = min(least.get(name, 1.0), level)
    without = [f"{name} (least p {value:.2g})" for name, value in least.items() if value >= LEVEL]
    findings.append(
        "no difference in steps beyond noise (paired t-test, Holm-adjusted level "
        f"{LEVEL:g} over all): {', '.join(without) or 'none'}"
    )
    return findings


def _is_told(row: Mapping[str, Cell]) -> bool:
    """Tell whether a row over all problems is told of even if no difference was found."""
    return (
        row["parameter"] == "particles"
        or row["estimator"] != row["reference"]
        or min(number_of(row[f"{each}_adjusted_p_value"]) for each in ("success", "steps")) < LEVEL
    )


def _told(row: Mapping[str, Cell]) -> str:
    changed = f"{row['parameter']} {row['value']}" if row["parameter"] else "reference"
    return f"{row['estimator']}, {changed}"


def _interval(row: Mapping[str, Cell], name: str, *, percent: bool = False) -> str:
    value, low, high = (number_of(row[f"{name}{end}"]) for end in ("", "_low", "_high"))
    if percent:
        return f"{100.0 * value:+.1f} [{100.0 * low:+.1f}, {100.0 * high:+.1f}]"
    return str(statistics.Interval(value, low, high))


def _draw(summary: Table, together: Table) -> Figure:
    from holdfast.experiments import plots

    figure, panels = plots.grid_of_panels(
        [*_CASES, _TOGETHER],
        columns=len(_CASES) + 1,
        title=(
            "Steps, against each estimator's reference: M = 10, horizon 1, the mean, resampling "
            "always, k = 5"
        ),
        width=14.5,
        row_height=8.4,
        same_rows=True,
    )
    shown = {
        case: [row for row in summary.rows() if row["problem"] == case and row["parameter"]]
        for case in _CASES
    }
    shown[_TOGETHER] = [row for row in together.rows() if row["reference"] == row["estimator"]]
    for name, panel in panels.items():
        rows = shown[name]
        labels = [f"{row['estimator']}: {row['parameter']} {row['value']}" for row in rows]
        values, lows, highs = (
            [number_of(row[f"steps_ratio{end}"]) for row in rows] for end in ("", "_low", "_high")
        )
        plots.dot_rows(panel, labels, [plots.Dots("", values, lows, highs)])
    plots.ratio_axes(panels.values())
    plots.label_grid(figure, panels, "", "")
    figure.supxlabel("steps, relative to the estimator's reference (95 % intervals)", fontsize=10.0)
    return figure
