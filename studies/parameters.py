"""What the parameters do: each of them changed alone, on the same worlds.

No difference found does not mean that there is none: the interval says how large one could be.
Where it excludes all that would matter, the cheapest value will do. Each change is also compared
with random sensing with as many particles.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    SelectorSettings,
)
from studies import statistics
from studies.cases import CASES
from studies.judged_study import (
    P_VALUES,
    JudgedStudy,
    compared,
    compared_together,
    outcome_cells,
    steps_and_success,
)
from studies.statistics import interval_in
from studies.study import CLAIM, TRIALS, Number, Report, Scale
from studies.tables import Cell
from studies.trial_batches import TrialSeries, problem_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_MOST_QUICK_PARTICLES = 3.0
"""In a quick run, as a multiple of a problem's: ten times would take as long as all the rest."""

_INTERVALS: Mapping[str, int] = {
    "tight hole": 8,
    "three plates": 8,
    "peg in space": 4,
    "light and dark": 4,
    "passer-by": 8,
}
"""Steps between two sensing actions, in the problems whose outcome depends on sensing."""

_CASES = {case.name: case for case in CASES if case.name in _INTERVALS}

_TOGETHER = "all five problems (mean)"

Way = Literal["neighbours", "path, prior neighbours", "mixture", "random"]

_WAYS: Mapping[Way, SelectorSettings] = {
    "neighbours": SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    "path, prior neighbours": SelectorSettings(method="path_entropy", estimator="prior_neighbors"),
    "mixture": SelectorSettings(method="action_entropy", estimator="gaussian_mixture_upper"),
    "random": SelectorSettings(method="random"),
}
"""Ways of estimating an entropy (of actions, if not of paths), and one that estimates nothing."""

_FIRST: Way = "neighbours"
_RANDOM: Way = "random"


class Variant(NamedTuple):
    """Settings of which one differs from those of the way's reference."""

    parameter: str = ""  # what differs, and how; empty for the reference itself
    value: str = ""
    way: Way = _FIRST
    active_sensing: ActiveSensingSettings = ActiveSensingSettings()
    particle_filter: ParticleFilterSettings = ParticleFilterSettings()
    resolution: float | None = None
    """In units of the problem's own; None for that, and for a mixture the motion noise."""
    times_the_particles: float = 1.0

    def names(self) -> dict[str, Cell]:
        """Return the cells of a table that name it."""
        return {"way": self.way, "parameter": self.parameter, "value": self.value}


def variants() -> list[Variant]:
    """Return each way's reference, followed by all that differ from it."""
    path: Way = "path, prior neighbours"
    return [
        Variant(),
        *_particles(_FIRST, 0.5, 3.0, 10.0),
        *_sensing("M", "num_observation_samples", 1, 3, 30, 100),
        *_sensing("horizon", "horizon", 2, 3),
        _filter("resampling", "below 0.25 N", resampling_threshold=0.25),
        _filter("resampling", "below 0.5 N", resampling_threshold=0.5),
        _filter(
            "estimate",
            "most likely, resampling below 0.5 N",
            estimate="most_likely",
            resampling_threshold=0.5,
        ),
        _filter("estimate", "most likely", estimate="most_likely", resampling_threshold=1.0),
        *_sensing("k", "num_nearest_neighbors", 1, 3, 10, 20),
        *_resolutions(_FIRST, 0.1, 0.3, 3.0, 10.0),
        Variant(way=path),
        *_particles(path, 0.5, 3.0),
        *_sensing("M", "num_observation_samples", 3, 30, way=path),
        *_sensing("k", "num_nearest_neighbors", 3, 10, way=path),
        Variant(way="mixture"),
        *_particles("mixture", 0.5, 3.0, 10.0),
        # The same in all directions, as the motion noise itself need not be: so 1 is another, too.
        *_resolutions("mixture", 0.1, 0.3, 1.0, 3.0, 10.0),
        Variant(way=_RANDOM),
        *_particles(_RANDOM, 0.5, 3.0, 10.0),
    ]


def _particles(way: Way, *factors: float) -> list[Variant]:
    return [
        Variant("particles", f"x {times:g}", way=way, times_the_particles=times)
        for times in factors
    ]


def _sensing(parameter: str, key: str, *values: int, way: Way = _FIRST) -> list[Variant]:
    return [
        Variant(parameter, str(value), way, ActiveSensingSettings(**{key: value}))
        for value in values
    ]


def _filter(parameter: str, value: str, **settings: Any) -> Variant:
    return Variant(parameter, value, particle_filter=ParticleFilterSettings(**settings))


def _resolutions(way: Way, *factors: float) -> list[Variant]:
    return [
        Variant("resolution", f"x {factor:g}", way=way, resolution=factor) for factor in factors
    ]


_Cell = tuple[str, Variant]
"""The name of a case, and a variant."""

_Tables = Mapping[_Cell, pd.DataFrame]


class Parameters(JudgedStudy):
    """The study ``parameters``."""

    name = "parameters"
    title = "What the parameters do: particles, M, k, resolution, horizon, estimate, resampling"
    columns = ("problem", "sensing_interval", "way", "parameter", "value")
    num_trials: ClassVar = {CLAIM: 60}
    quick_trials: ClassVar = {CLAIM: 4}

    def cells(self, scale: Scale) -> Iterator[_Cell]:
        """Return all cells, in the order of the tables."""
        for case in _CASES:
            for variant in variants():
                if not scale.quick or variant.times_the_particles <= _MOST_QUICK_PARTICLES:
                    yield case, variant

    def names(self, cell: _Cell) -> tuple[Cell, ...]:
        """Return a cell's values of the columns."""
        case, variant = cell
        return case, _INTERVALS[case], *variant.names().values()

    def series(self, cell: _Cell, purpose: str, scale: Scale, num_trials: int) -> TrialSeries:
        """Return the trials of a cell for a purpose."""
        name, variant = cell
        case = _CASES[name]
        case = msgspec.structs.replace(
            case, num_particles=round(variant.times_the_particles * case.num_particles)
        )
        selector = _WAYS[variant.way]
        if variant.resolution is not None:
            own = problem_of(case.problem, case.model).resolution
            resolution = np.multiply(variant.resolution, own).tolist()
            if isinstance(resolution, list):
                resolution = tuple(resolution)
            selector = msgspec.structs.replace(selector, resolution=resolution)
        return case.series(
            selector,
            _INTERVALS[name],
            seed=scale.seed_of(purpose),
            num_trials=num_trials,
            active_sensing=variant.active_sensing,
            particle_filter=variant.particle_filter,
        )

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""
        claim = self.by_cell(tables[TRIALS])[CLAIM]
        summary, together = _alone(claim), _together(claim)
        return Report(
            summary={
                "parameters": summary,
                "together": together,
                "more_particles": _more_particles(claim),
            },
            figures={"parameters": partial(_draw, summary, together)},
            numbers=_numbers(together),
        )


_OVER_RANDOM = "_over_random"
"""Ends the names of columns of a comparison with random."""


def _varied(tables: _Tables) -> list[Variant]:
    return list(dict.fromkeys(variant for _, variant in tables))


def _random_rival(variant: Variant) -> Variant:
    """Return random sensing with as many particles."""
    own = [each for each in variants() if each.way == _RANDOM]
    return next(each for each in own if each.times_the_particles == variant.times_the_particles)


def _paired(table: pd.DataFrame, reference: pd.DataFrame) -> dict[str, Cell]:
    """Return how the trials of one problem differ from those of a reference."""
    return compared(steps_and_success(table), steps_and_success(reference))


def _alone(tables: _Tables) -> pd.DataFrame:
    """Return how each variant differs from its way's reference and from random, in each problem."""
    rows: list[dict[str, Cell]] = []
    for (case, variant), table in tables.items():
        rival = _paired(table, tables[case, _random_rival(variant)])
        rows.append(
            {
                "problem": case,
                **variant.names(),
                **outcome_cells(table),
                **_paired(table, tables[case, Variant(way=variant.way)]),
                **{f"{name}{_OVER_RANDOM}": cell for name, cell in rival.items()},
            }
        )
    summary = pd.DataFrame(rows)
    statistics.add_adjusted(summary, *P_VALUES, compared=summary["parameter"] != "")
    over_random = (f"{name}{_OVER_RANDOM}" for name in P_VALUES)
    statistics.add_adjusted(summary, *over_random, compared=summary["way"] != _RANDOM)
    return summary


def _pairs(tables: _Tables) -> Iterator[tuple[Variant, Variant]]:
    """Yield the comparisons over several problems.

    Each variant with its way's reference and with random with as many particles, and the references
    of the other ways also with the first one's.
    """
    for variant in _varied(tables):
        rivals = [Variant(way=variant.way)]
        if variant.way not in (_FIRST, _RANDOM):
            rivals.append(Variant())
        rivals.append(_random_rival(variant))
        for rival in dict.fromkeys(rivals):
            if rival != variant:
                yield variant, rival


def _together(tables: _Tables) -> pd.DataFrame:
    """Return how variants differ over all problems."""
    table = pd.DataFrame(
        {
            **variant.names(),
            "reference": rival.way,
            **compared_together(tables, variant, rival),
        }
        for variant, rival in _pairs(tables)
    )
    statistics.add_adjusted(table, *P_VALUES)
    return table


def _more_particles(tables: _Tables) -> pd.DataFrame:
    """Return the gain of the last multiplication of the particles, for two ways.

    The default has more particles than the reference, so the gain beyond the reference is not the
    gain beyond the default.
    """
    rows: list[dict[str, Cell]] = []
    for way in (_FIRST, _RANDOM):
        numbers = [
            each
            for each in _varied(tables)
            if each.way == way and each.parameter in ("", "particles")
        ]
        fewer, more = sorted(numbers, key=lambda each: each.times_the_particles)[-2:]
        names: dict[str, Cell] = {
            "way": way,
            "from": f"x {fewer.times_the_particles:g}",
            "to": f"x {more.times_the_particles:g}",
        }
        rows += [
            {
                "problem": case,
                **names,
                "trials": len(tables[case, more]),
                **_paired(tables[case, more], tables[case, fewer]),
            }
            for case in _CASES
        ]
        rows.append({"problem": _TOGETHER, **names, **compared_together(tables, more, fewer)})
    table = pd.DataFrame(rows)
    statistics.add_adjusted(table, *P_VALUES)
    return table


def _numbers(together: pd.DataFrame) -> list[Number]:
    """Return what the number of particles does, over all problems."""
    return [
        Number(
            f"{row['way']}, particles {row['value']} against "
            f"{'the same way' if row['reference'] == row['way'] else row['reference']}",
            interval_in(row, "steps_ratio"),
            "times the steps",
            row["trials"],
        )
        for row in together.to_dict("records")
        if row["parameter"] == "particles"
    ]


def _draw(summary: pd.DataFrame, together: pd.DataFrame) -> Figure:
    from studies import plots

    changed = summary[summary["parameter"] != ""]
    mean = together[together["reference"] == together["way"]]
    rows = {case: changed[changed["problem"] == case] for case in _CASES}
    rows["mean of all five"] = mean.set_index(mean.index + len(summary))
    every = pd.concat(rows.values())
    names = every["parameter"] + " " + every["value"].str.replace("resampling ", "")
    return plots.ratio_grid(
        rows,
        # The way is named once, above its first row, so that the panels have room.
        names.where(every.duplicated(["problem", "way"]), every["way"] + ":\n" + names),
        columns=len(rows),
        title="Steps, against each way's reference (95 % intervals)",
        width=9.6,
        row_height=9.2,
        label="steps, relative to the reference",
    )
