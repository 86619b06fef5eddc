"""What the parameters do: each of them changed alone, on the same worlds.

That no difference is found does not mean that there is none: the intervals say how large one could
be. Where they exclude all that would matter, the cheapest value will do.

The best value of a parameter is chosen by the trials of one seed, and all that is said rests on the
trials of another. Whatever is changed is compared with random sensing, too, with as many particles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal, NamedTuple

import msgspec
import numpy as np

from holdfast.experiments import statistics
from holdfast.experiments.cases import CASES
from holdfast.experiments.study import CHOICE, CLAIM, Report, Results, Scale
from holdfast.experiments.tables import Cell, Table, number_of
from holdfast.experiments.tasks import Task
from holdfast.experiments.trial_batches import problem_of, trial_tasks
from holdfast.experiments.trial_files import cells_of_trials, kept_trials, require_cells
from holdfast.recording.tables import wilson_interval
from holdfast.settings import ActiveSensingSettings, ParticleFilterSettings, SelectorSettings

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from holdfast.experiments.statistics import FloatArray

__all__ = ["Parameters", "Variant", "variants"]

LEVEL = 0.01
"""Of the tests of steps, and of those of successes: the probability that any difference is claimed
where there is none."""

_TRIALS = {CHOICE: 10, CLAIM: 60}
_QUICK_TRIALS = {CHOICE: 2, CLAIM: 4}
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

METHOD: Literal["action_entropy"] = "action_entropy"
"""Whose parameters are changed."""

_CASES = {case.name: case for case in CASES if case.name in _INTERVALS}

_TOGETHER = "all five problems (mean)"

Way = Literal["neighbours", "path, prior neighbours", "mixture", "random"]

_WAYS: Mapping[Way, SelectorSettings] = {
    "neighbours": SelectorSettings(method=METHOD, estimator="nearest_neighbor"),
    "path, prior neighbours": SelectorSettings(method="path_entropy", estimator="prior_neighbors"),
    "mixture": SelectorSettings(method=METHOD, estimator="gaussian_mixture_upper"),
    "random": SelectorSettings(method="random"),
}
"""Ways of estimating an entropy (of actions, if not of paths), and one that estimates nothing."""

_DEFAULT: Way = "neighbours"
_RANDOM: Way = "random"


class Variant(NamedTuple):
    """Settings of which one differs from those of the way's reference.

    Attributes
    ----------
    parameter, value : str
        What differs, and how; empty for the reference itself.
    way : {"neighbours", "path, prior neighbours", "mixture", "random"}
    active_sensing : ActiveSensingSettings
    particle_filter : ParticleFilterSettings
    resolution : float, optional
        In units of the problem's own; None for that, and for a mixture the motion noise.
    times_the_particles : float
        As many as the problem has.
    """

    parameter: str = ""
    value: str = ""
    way: Way = _DEFAULT
    active_sensing: ActiveSensingSettings = ActiveSensingSettings()
    particle_filter: ParticleFilterSettings = ParticleFilterSettings()
    resolution: float | None = None
    times_the_particles: float = 1.0

    def names(self) -> dict[str, Cell]:
        """Return the cells of a table that name it."""
        return {"way": self.way, "parameter": self.parameter, "value": self.value}


def variants() -> list[Variant]:
    """Return each way's reference, followed by all that differ from it."""
    found = [Variant(), *_numbers_of_particles("neighbours")]
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
    found += _resolutions("neighbours", (0.1, 0.3, 3.0, 10.0))
    found += _of_paths("path, prior neighbours")
    found += [Variant(way="mixture"), *_numbers_of_particles("mixture")]
    # The same in all directions, as the motion noise itself need not be: so 1 is another, too.
    found += _resolutions("mixture", (0.1, 0.3, 1.0, 3.0, 10.0))
    return [*found, Variant(way=_RANDOM), *_numbers_of_particles(_RANDOM)]


def _numbers_of_particles(way: Way) -> list[Variant]:
    return [
        Variant("particles", f"x {times:g}", way=way, times_the_particles=times)
        for times in (0.5, 3.0, 10.0)
    ]


def _of_paths(way: Way) -> list[Variant]:
    found = [Variant(way=way), *_numbers_of_particles(way)[:2]]
    for samples in (3, 30):
        sensing = ActiveSensingSettings(num_observation_samples=samples)
        found.append(Variant("M", str(samples), way=way, active_sensing=sensing))
    for neighbors in (3, 10):
        sensing = ActiveSensingSettings(num_nearest_neighbors=neighbors)
        found.append(Variant("k", str(neighbors), way=way, active_sensing=sensing))
    return found


def _resolutions(way: Way, factors: Sequence[float]) -> list[Variant]:
    return [
        Variant("resolution", f"x {factor:g}", way=way, resolution=factor) for factor in factors
    ]


class Parameters:
    """The study ``parameters``."""

    name = "parameters"
    title = "What the parameters do: particles, M, k, resolution, horizon, estimate, resampling"

    def tasks(self, scale: Scale) -> list[Task]:
        """Return all that is to be computed, in the order in which to begin."""
        return [
            task
            for purpose in _TRIALS
            for case, variant in _cells(scale)
            for task in _tasks(purpose, case, variant, scale)
        ]

    def report(self, scale: Scale, results: Results) -> Report:
        """Return what it comes to, from the results of all its tasks."""
        trials = Table({})
        for purpose in _TRIALS:
            for case, variant in _cells(scale):
                tasks = _tasks(purpose, case, variant, scale)
                trials.extend(
                    kept_trials(results.of(tasks)),
                    purpose=purpose,
                    seed=int(tasks[0].parameters["seed"]),
                    problem=case,
                    sensing_interval=_INTERVALS[case],
                    **variant.names(),
                )
        return self.report_of(trials)

    def report_of(self, trials: Table) -> Report:
        """Return what it comes to, from all its trials.

        Raises
        ------
        InvalidValueError
            If they are not those of this study.
        """
        cells = cells_of_trials(trials, ("purpose", "problem", "way", "parameter", "value"))
        # A quick run leaves some out.
        tried = {tuple(cell[2:]) for cell in cells}
        known = [each for each in variants() if tuple(each.names().values()) in tried]
        expected = {
            (purpose, case, *variant.names().values()): (purpose, case, variant)
            for purpose in _TRIALS
            for case in _CASES
            for variant in known
        }
        require_cells(self.name, cells, expected)
        tables: dict[str, dict[tuple[str, Variant], Table]] = {each: {} for each in _TRIALS}
        for cell, (purpose, case, variant) in expected.items():
            tables[purpose][case, variant] = cells[cell]
        claim = tables[CLAIM]
        summary, together = _alone(claim), _together(claim)
        more_particles = _more_particles(claim)
        over_problems = _over_problems(claim)
        chosen = _chosen_values(tables[CHOICE], claim)
        report = Report(trials=trials)
        report.summary["parameters"] = summary
        report.summary["together"] = together
        report.summary["more_particles"] = more_particles
        report.summary["over_problems"] = over_problems
        report.summary["chosen_values"] = chosen
        report.figures["parameters"] = partial(_draw, summary, together)
        report.findings = [
            *_findings(summary, together, more_particles),
            *_findings_over_problems(over_problems),
            *_findings_of_choices(chosen),
        ]
        return report


def _cells(scale: Scale) -> Iterator[tuple[str, Variant]]:
    for case in _CASES:
        for variant in variants():
            # Ten times the particles alone would take as long as all the rest.
            if not scale.quick or variant.times_the_particles <= _MOST_QUICK_PARTICLES:
                yield case, variant


def _tasks(purpose: str, name: str, variant: Variant, scale: Scale) -> list[Task]:
    case = _CASES[name]
    case = msgspec.structs.replace(
        case, num_particles=round(variant.times_the_particles * case.num_particles)
    )
    selector = _WAYS[variant.way]
    if variant.resolution is not None:
        own = problem_of(case.problem, case.model, {}).resolution
        resolution = np.multiply(variant.resolution, own).tolist()
        if isinstance(resolution, list):
            resolution = tuple(resolution)
        selector = msgspec.structs.replace(selector, resolution=resolution)
    series = case.series(
        selector,
        _INTERVALS[name],
        seed=scale.claim_seed if purpose == CLAIM else scale.seed,
        num_trials=(_QUICK_TRIALS if scale.quick else _TRIALS)[purpose],
        active_sensing=variant.active_sensing,
        particle_filter=variant.particle_filter,
    )
    return list(trial_tasks(series, _TRIALS_IN_EACH))


_Tables = Mapping[tuple[str, Variant], Table]

_P_VALUES = ("success_p_value", "steps_p_value")


def _random_rival(variant: Variant) -> Variant:
    """Return random sensing with as many particles."""
    own = [each for each in variants() if each.way == _RANDOM]
    return next(each for each in own if each.times_the_particles == variant.times_the_particles)


def _alone(tables: _Tables) -> Table:
    """Return how each variant differs from its way's reference and from random, in each problem."""
    rows: list[dict[str, Cell]] = []
    reference = Table({})
    for (case, variant), table in tables.items():
        if not variant.parameter:
            reference = table
        rival = _paired(table, tables[case, _random_rival(variant)])
        rows.append(
            {
                "problem": case,
                **variant.names(),
                **_compared(table, reference),
                **{f"{name}{_OVER_RANDOM}": cell for name, cell in rival.items()},
            }
        )
    summary = Table.of_records(rows)
    varied = np.array([bool(name) for name in summary.columns["parameter"]])
    statistics.add_adjusted(summary, *_P_VALUES, compared=varied)
    chosen = np.array([way != _RANDOM for way in summary.columns["way"]])
    for name in _P_VALUES:
        over_random = Table({name: summary.columns[f"{name}{_OVER_RANDOM}"]})
        statistics.add_adjusted(over_random, name, compared=chosen)
        adjusted = name.replace("p_value", "adjusted_p_value")
        summary.columns[f"{adjusted}{_OVER_RANDOM}"] = over_random.columns[adjusted]
    return summary


_OVER_RANDOM = "_over_random"
"""Ends the names of columns of a comparison with random."""


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
        "median_sensing_ms": table.columns["median_sensing_ms"][0],
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


def _pairs(tables: _Tables) -> Iterator[tuple[Variant, Variant]]:
    """Yield what is compared over several problems.

    Each with its way's reference and with random of as many particles, and the mixture's reference
    with that of the neighbours, too.
    """
    varied = list(dict.fromkeys(variant for _, variant in tables))
    for variant in varied:
        rivals = [Variant(way=variant.way), Variant()]
        if variant.way == _DEFAULT or variant.way == _RANDOM:
            rivals = rivals[:1]
        rivals.append(_random_rival(variant))
        for rival in dict.fromkeys(rivals):
            if rival != variant:
                yield variant, rival


def _together(tables: _Tables) -> Table:
    """Return how variants differ over all problems, each with the same weight."""
    rows: list[dict[str, Cell]] = [
        {
            **variant.names(),
            "reference": rival.way,
            **_compared_together(tables, variant, rival),
        }
        for variant, rival in _pairs(tables)
    ]
    table = Table.of_records(rows)
    statistics.add_adjusted(table, *_P_VALUES)
    return table


def _compared_together(tables: _Tables, variant: Variant, reference: Variant) -> dict[str, Cell]:
    """Return how a variant differs from another one over all problems.

    The value of a trial is the mean over the problems' trials of its number, of which all have one.
    """
    fewest = min(table.num_rows for table in tables.values())

    def means(variant: Variant, column: str) -> FloatArray:
        numbers = [_numbers(tables[case, variant], column)[:fewest] for case in _CASES]
        return np.asarray(np.mean(numbers, axis=0))

    steps, success = (
        statistics.paired_difference(means(variant, column), means(reference, column))
        for column in ("steps", "success")
    )
    return {"trials": fewest, **_differences(steps, success)}


def _numbers(table: Table, column: str) -> FloatArray:
    """Return a number of each trial whose differences are compared."""
    numbers = table.numbers(column)
    return statistics.logarithms_of_steps(numbers) if column == "steps" else numbers


def _over_problems(tables: _Tables) -> Table:
    """Return how variants differ over these problems, and over all that are like them."""
    rows: list[dict[str, Cell]] = [
        {
            "measure": measure,
            **variant.names(),
            "reference": rival.way,
            **statistics.cells_across_problems(
                [
                    (
                        _numbers(tables[case, variant], column),
                        _numbers(tables[case, rival], column),
                    )
                    for case in _CASES
                ],
                least,
                shown,
            ),
        }
        for measure, column, least, shown in (
            ("steps_ratio", "steps", 0.01, statistics.ratio_of),
            ("success_gain", "success", 1.0, statistics.as_it_is),
        )
        for variant, rival in _pairs(tables)
    ]
    table = Table.of_records(rows)
    statistics.add_adjusted(table, "mean_p_value", "expected_p_value")
    return table


def _chosen_values(choosing: _Tables, tables: _Tables) -> Table:
    """Return the value of each parameter that takes the fewest steps on the trials for choosing.

    Over all problems; the reference has a value, too. How it does is told of the other trials,
    against the reference and against random.
    """
    varied = list(dict.fromkeys(variant for _, variant in tables))
    rows: list[dict[str, Cell]] = []
    for way, parameter in dict.fromkeys(
        (each.way, each.parameter) for each in varied if each.parameter
    ):
        reference = Variant(way=way)
        values = [each for each in varied if (each.way, each.parameter) == (way, parameter)]

        def seemed(variant: Variant, reference: Variant = reference) -> float:
            return number_of(_compared_together(choosing, variant, reference)["steps_ratio"])

        best = min([reference, *values], key=seemed)
        rows += [
            {
                "way": way,
                "parameter": parameter,
                "chosen": best.value or "as it is",
                "reference": rival.way,
                "steps_ratio_when_chosen": seemed(best, rival),
                **_compared_together(tables, best, rival),
            }
            for rival in dict.fromkeys((reference, _random_rival(best)))
        ]
    table = Table.of_records(rows)
    changed = [
        row["chosen"] != "as it is" or row["reference"] != row["way"] for row in table.rows()
    ]
    statistics.add_adjusted(table, *_P_VALUES, compared=np.array(changed))
    return table


def _more_particles(tables: _Tables) -> Table:
    """Return what the last multiplication of the particles gains, by nearest neighbours.

    And for random sensing. The default has more particles than the reference, so what is gained
    beyond the reference is not what is gained beyond the default.
    """
    rows: list[dict[str, Cell]] = []
    for way in (_DEFAULT, _RANDOM):
        varied = dict.fromkeys(variant for _, variant in tables if variant.way == way)
        numbers = [each for each in varied if each.parameter in ("", "particles")]
        fewer, more = sorted(numbers, key=lambda each: each.times_the_particles)[-2:]
        names: dict[str, Cell] = {
            "way": way,
            "from": f"x {fewer.times_the_particles:g}",
            "to": f"x {more.times_the_particles:g}",
        }
        rows += [
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
        f"{_interval(row, 'success_gain', percent=True)} points of success of "
        f"{_reference_of(row)} (geometric mean and mean, n = {row['trials']}, "
        f"paired t-tests, Holm-adjusted p {number_of(row['steps_adjusted_p_value']):.2g} and "
        f"{number_of(row['success_adjusted_p_value']):.2g})"
        for row in together.rows()
        if _is_told(row)
    ]
    untold: dict[str, list[dict[str, Cell]]] = {}
    for row in together.rows():
        if not _is_told(row):
            name = f"{row['way']}, {row['parameter']} against {_reference_of(row)}"
            untold.setdefault(name, []).append(row)
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
        f"{row['problem']}, {row['way']}, particles {row['to']} instead of {row['from']}: "
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
            name = f"{row['parameter']} ({row['way']})"
            level = float(row["steps_adjusted_p_value"] or 0.0)
            least[name] = min(least.get(name, 1.0), level)
    without = [f"{name} (least p {value:.2g})" for name, value in least.items() if value >= LEVEL]
    findings.append(
        "no difference in steps beyond noise (paired t-test, Holm-adjusted level "
        f"{LEVEL:g} over all): {', '.join(without) or 'none'}"
    )
    return findings


def _findings_over_problems(over_problems: Table) -> list[str]:
    findings = []
    for row in over_problems.rows():
        surely = number_of(row["expected_adjusted_p_value"]) < LEVEL
        if not surely and (row["parameter"] or row["way"] == row["reference"]):
            continue
        percent = row["measure"] == "success_gain"
        factor, form = (100.0, "+.1f") if percent else (1.0, ".3g")
        low, high = (
            format(factor * number_of(row[f"new_problem_{end}"]), form) for end in ("low", "high")
        )
        unit = "points of success" if percent else "times the steps"
        findings.append(
            f"problems as a random effect, {_told(row)} against {_reference_of(row)}: "
            f"{_interval(row, 'expected', percent=percent)} {unit} in the mean over all such "
            f"problems, from {low} to {high} in a new one (n = {row['problems']} problems, "
            "Paule-Mandel, Hartung-Knapp, Holm-adjusted p "
            f"{number_of(row['expected_adjusted_p_value']):.2g})"
        )
    return findings


def _findings_of_choices(chosen: Table) -> list[str]:
    return [
        f"{_TOGETHER}, {row['way']}, {row['parameter']}: {row['chosen']} takes the fewest steps on "
        f"the other seed, and {_interval(row, 'steps_ratio')} times the steps and "
        f"{_interval(row, 'success_gain', percent=True)} points of success of "
        f"{_reference_of(row)} (n = {row['trials']}, paired t-tests, Holm-adjusted p "
        f"{number_of(row['steps_adjusted_p_value']):.2g} and "
        f"{number_of(row['success_adjusted_p_value']):.2g})"
        for row in chosen.rows()
    ]


def _is_told(row: Mapping[str, Cell]) -> bool:
    """Tell whether a row over all problems is told of even if no difference was found."""
    return (
        row["parameter"] == "particles"
        or row["way"] != row["reference"]
        or min(number_of(row[f"{each}_adjusted_p_value"]) for each in ("success", "steps")) < LEVEL
    )


def _told(row: Mapping[str, Cell]) -> str:
    changed = f"{row['parameter']} {row['value']}" if row["parameter"] else "reference"
    return f"{row['way']}, {changed}"


def _reference_of(row: Mapping[str, Cell]) -> str:
    if row["reference"] == _RANDOM and row["way"] != _RANDOM:
        return "random with as many particles"
    return f"the reference of {row['reference']}"


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
            "Steps, against each way's reference: M = 10, horizon 1, the mean, resampling "
            "always, k = 5"
        ),
        width=14.5,
        row_height=9.2,
        same_rows=True,
    )
    shown = {
        case: [row for row in summary.rows() if row["problem"] == case and row["parameter"]]
        for case in _CASES
    }
    shown[_TOGETHER] = [row for row in together.rows() if row["reference"] == row["way"]]
    for name, panel in panels.items():
        rows = shown[name]
        labels = [f"{row['way']}: {row['parameter']} {row['value']}" for row in rows]
        values, lows, highs = (
            [number_of(row[f"steps_ratio{end}"]) for row in rows] for end in ("", "_low", "_high")
        )
        plots.dot_rows(panel, labels, [plots.Dots("", values, lows, highs)])
    plots.ratio_axes(panels.values())
    plots.label_grid(figure, panels, "", "")
    figure.supxlabel("steps, relative to the way's reference (95 % intervals)", fontsize=10.0)
    return figure
