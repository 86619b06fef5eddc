"""When to sense, where sensing has a price, and what to sense where one sensor is weak.

*When*: a look costs as much as some steps. A robot that looks at fixed intervals is compared with
one that chooses at each step (or each fifth) whether to look: by the entropy that a look takes
away, of the commanded or of the executed actions, or by the return. For each way the trials for
choosing choose its number (the interval, or the least gain in nats), for each price anew; other
trials compare them, in pairs of the same worlds. The cost of a trial is its steps and the price of
its looks; a failure counts as the limit.

*What*: a boat has a sharp range finder for x and a weak GPS for y. Entropy counts factors, so the
range finder, which shows x ten times more sharply than it must be known, takes away more of it than
the GPS. The resolution says below which distance that is of no use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import msgspec
import numpy as np
import pandas as pd

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.settings import (
    ENTROPY_METHODS,
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from studies import statistics
from studies.judged_study import JudgedStudy
from studies.statistics import cells_of, interval_in
from studies.study import CHOICE, CLAIM, TRIALS, Number, Report, Scale, drawn
from studies.tables import Cell
from studies.trial_batches import TrialSeries

if TYPE_CHECKING:
    from matplotlib.figure import Figure


PRICES = (1.0, 4.0)
"""Prices of a sensing action, in steps."""

INTERVALS = (0.0, 2.0, 4.0, 8.0, 14.0, 29.0)
"""Steps between two looks."""

NATS = (0.2, 0.4, 0.8, 1.2, 1.6, 2.0)
"""That a look must be expected to gain."""

FIXED = "intervals"
"""The way with which the others are compared: the default, at fixed intervals."""

WAYS: Mapping[str, tuple[float, ...]] = {
    FIXED: INTERVALS,
    "nats": NATS,
    "nats, executed": NATS,
    "return, intervals": (4.0, 8.0),
    "return": (0.0, 4.0),
}
"""With the numbers among which each chooses: intervals in steps, or nats."""

RESOLUTIONS = (0.05, 0.1, 0.3, 0.6, 1.2)
"""In metres; the boat's motion noise is the first, half its goal's width the third."""

_RANDOM = "random"
_OF_BOAT: Mapping[str, SelectorSettings] = {
    _RANDOM: SelectorSettings(method="random"),
    "path entropy": SelectorSettings(),
    "action entropy": SelectorSettings(method="action_entropy"),
    "action covariance": SelectorSettings(method="action_covariance"),
    "expected return": SelectorSettings(method="expected_return"),
}


class _Posed(NamedTuple):
    """A problem, the limit of a trial, and which share of the trials is run, at which prices."""

    place: str
    max_steps: int
    share: float = 1.0
    prices: tuple[float, ...] = PRICES
    ways: tuple[str, ...] = tuple(WAYS)


_MODULE = "studies.priced_problems"

PROBLEMS: Mapping[str, _Posed] = {
    "dock": _Posed(f"{_MODULE}:Dock", 300, 1.5),
    "boat": _Posed(f"{_MODULE}:Boat", 200, 1.5),
    # A trial of expected_return takes seconds here.
    "peg in hole": _Posed(
        f"{_MODULE}:PricedPeg", 500, 0.5, PRICES[:1], (FIXED, "nats", "nats, executed", "return")
    ),
}

_WEAK = "boat, 80 steps"
"""The problem of the second question."""

_BOAT_RESOLUTION = 0.6
"""The width of the goal of the first question's boat. No executed action is as large."""


class _Cell(NamedTuple):
    """One setting. ``price`` is 0 where no decision depends on it."""

    problem: str
    way: str
    number: float
    price: float


_Cells = Mapping[_Cell, pd.DataFrame]


class SensingPrice(JudgedStudy):
    """The study ``sensing_price``."""

    name = "sensing_price"
    title = "When to sense at a price, and what to sense where one sensor is weak"
    columns = ("problem", "way", "number", "price")
    num_trials: ClassVar = {CHOICE: 20, CLAIM: 40}

    def cells(self, scale: Scale) -> Iterator[_Cell]:
        """Return all cells, in the order of the tables."""
        for way, selector in _OF_BOAT.items():
            numbers = RESOLUTIONS if _depends_on_resolution(selector) else RESOLUTIONS[:1]
            for resolution in numbers:
                yield _Cell(_WEAK, way, resolution, 0.0)
        for problem, posed in list(PROBLEMS.items())[: 1 if scale.quick else None]:
            for way in posed.ways:
                for number in WAYS[way]:
                    for price in posed.prices if way == "return" else (0.0,):
                        yield _Cell(problem, way, number, price)

    def names(self, cell: _Cell) -> tuple[Cell, ...]:
        """Return a cell's values of the columns, as a file of trials has them."""
        return (cell.problem, cell.way, float(np.float32(cell.number)), cell.price)

    def series(self, cell: _Cell, purpose: str, scale: Scale, num_trials: int) -> TrialSeries:
        """Return the trials of a cell for a purpose."""
        if cell.problem == _WEAK:
            selector, interval = _OF_BOAT[cell.way], 8
            # Cheap, and shares of trials need many.
            posed = PROBLEMS["boat"]._replace(max_steps=80, share=5.0)
            model = {"resolution": cell.number}
            particles = 300
        else:
            selector, interval = _selector_of(cell)
            posed = PROBLEMS[cell.problem]
            # In nats the price of a look is the least gain.
            model = {"price": 1.0 if cell.way.startswith("nats") else cell.price}
            if cell.problem == "boat" and selector.actions == "commanded":
                model["resolution"] = _BOAT_RESOLUTION
            particles = 100
        return TrialSeries(
            problem=posed.place,
            model=model,
            planning=PlanningSettings(
                particle_filter=ParticleFilterSettings(num_particles=particles),
                active_sensing=ActiveSensingSettings(num_cores=1),
                selector=selector,
                sensing_interval=interval,
            ),
            max_steps=posed.max_steps,
            seed=scale.seed_of(purpose),
            num_trials=max(2, round(posed.share * num_trials)),
        )

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""
        choosing, cells = self.by_cell(tables[TRIALS]).values()
        when, weak = _when(choosing, cells), _weak_sensor(cells)
        alone = _when_alone(when, cells)
        return Report(
            summary={
                "when_to_sense": when,
                "when_alone": alone,
                "weak_sensor": weak,
            },
            figures={
                "when_to_sense": drawn("sensing_price:when_to_sense", when),
                "weak_sensor": drawn("sensing_price:weak_sensor", weak),
            },
            numbers=[*_numbers_of_when(when), *_numbers_of_weak(weak)],
        )


def _depends_on_resolution(selector: SelectorSettings) -> bool:
    return selector.method in ENTROPY_METHODS


def _selector_of(cell: _Cell) -> tuple[SelectorSettings, int]:
    """Return how a cell chooses what to sense, and its interval."""
    returns = SelectorSettings(
        method="expected_return", rollout_reward="steps", rollout_sensing_steps=8
    )
    if cell.way == FIXED:
        return SelectorSettings(), int(cell.number)
    if cell.way == "return, intervals":
        return returns, int(cell.number)
    if cell.way == "return":
        return _optional(returns), int(cell.number)
    executed = cell.way == "nats, executed"
    by_nats = SelectorSettings(
        nats_per_cost=cell.number,
        actions="executed" if executed else "commanded",
    )
    return _optional(by_nats), 0


def _optional(selector: SelectorSettings) -> SelectorSettings:
    return msgspec.structs.replace(selector, sensing_is_optional=True)


def _cost(table: pd.DataFrame, price: float) -> FloatArray:
    """Return the cost of each trial in steps."""
    return np.asarray(table["steps"] + price * table["sensing_decisions"], dtype=np.float64)


def _of(cells: _Cells, problem: str, way: str, price: float) -> dict[float, pd.DataFrame]:
    """Return the trials of a way at a price, by its number."""
    return {
        cell.number: table
        for cell, table in cells.items()
        if (cell.problem, cell.way) == (problem, way) and cell.price in (0.0, price)
    }


def _when(choosing: _Cells, cells: _Cells) -> pd.DataFrame:
    """Return what each way costs, and how much less than fixed intervals do."""
    rows: list[dict[str, Cell]] = []
    for problem in [name for name in PROBLEMS if any(cell.problem == name for cell in cells)]:
        for price in PROBLEMS[problem].prices:
            costs: dict[str, FloatArray] = {}
            for way in PROBLEMS[problem].ways:
                tried = _of(choosing, problem, way, price)
                best = min(tried, key=lambda number: float(_cost(tried[number], price).mean()))
                table = _of(cells, problem, way, price)[best]
                costs[way] = _cost(table, price)
                saved, p_value = statistics.paired_difference(costs[FIXED], costs[way])
                rows.append(
                    {
                        "problem": problem,
                        "price": price,
                        "way": way,
                        "number": best,
                        "trials": len(table),
                        **cells_of(
                            "success",
                            statistics.rate_interval(int(table["success"].sum()), len(table)),
                        ),
                        "mean_steps": float(table["steps"].mean()),
                        "mean_looks": float(table["sensing_decisions"].mean()),
                        **cells_of("cost", statistics.mean_interval(costs[way])),
                        **cells_of("saved", saved),
                        "p_value": p_value,
                    }
                )
    found = pd.DataFrame(rows)
    statistics.add_adjusted(found, "p_value", compared=found["way"] != FIXED)
    return found


def _when_alone(when: pd.DataFrame, cells: _Cells) -> pd.DataFrame:
    """Return what the return saves by choosing when, against itself at fixed intervals."""
    chosen = when.set_index(["problem", "price", "way"])["number"]
    rows: list[dict[str, Cell]] = []
    for problem, price, way in chosen.index:
        if way == "return, intervals":
            intervals, free = (
                _cost(_of(cells, problem, each, price)[chosen[problem, price, each]], price)
                for each in (way, "return")
            )
            saved, p_value = statistics.paired_difference(intervals, free)
            rows.append(
                {"problem": problem, "price": price, **cells_of("saved", saved), "p_value": p_value}
            )
    found = pd.DataFrame(rows)
    statistics.add_adjusted(found, "p_value")
    return found


def _weak_sensor(cells: _Cells) -> pd.DataFrame:
    """Return the boat's success by method and resolution, beside random sensing."""
    own = {cell: table for cell, table in cells.items() if cell.problem == _WEAK}
    baseline = next(table for cell, table in own.items() if cell.way == _RANDOM)
    rows: list[dict[str, Cell]] = []
    for cell, table in own.items():
        success = table["success"].to_numpy(bool)
        gain, p_value = statistics.paired_rates(success, baseline["success"].to_numpy(bool))
        rows.append(
            {
                "way": cell.way,
                "resolution": cell.number,
                "by_resolution": _depends_on_resolution(_OF_BOAT[cell.way]),
                "trials": len(table),
                **cells_of("success", statistics.rate_interval(int(success.sum()), len(table))),
                **cells_of("gain", gain),
                "p_value": p_value,
            }
        )
    found = pd.DataFrame(rows)
    statistics.add_adjusted(found, "p_value", compared=found["way"] != _RANDOM)
    return found


def _numbers_of_when(when: pd.DataFrame) -> Sequence[Number]:
    return [
        Number(
            f"{row['problem']}, a look costs {row['price']:g} steps: {row['way']} against fixed "
            "intervals",
            interval_in(row, "saved"),
            "steps saved",
            row["trials"],
        )
        for row in when.to_dict("records")
        if row["way"] != FIXED
    ]


def _numbers_of_weak(weak: pd.DataFrame) -> Sequence[Number]:
    return [
        Number(
            f"boat: {row['way']}, resolution {row['resolution']:g} m, against random sensing",
            interval_in(row, "gain", 100.0),
            "points of success",
            row["trials"],
        )
        for row in weak.to_dict("records")
        if row["way"] != _RANDOM
    ]


def when_to_sense(when: pd.DataFrame) -> Figure:
    """Draw the steps that each way saves against fixed intervals, at each price."""
    from studies import plots

    problems = list(dict.fromkeys(when["problem"]))
    figure, panels = plots.grid_of_panels(
        problems,
        columns=len(problems),
        title="Choosing when to look, against the best fixed interval (means, 95 % intervals)",
        width=10.0,
    )
    ways = [way for way in WAYS if way != FIXED]
    for number, (problem, panel) in enumerate(panels.items()):
        rows = when[when["problem"] == problem].set_index(["price", "way"])
        places = pd.MultiIndex.from_product([PRICES, ways])
        rows = rows.reindex(places).reset_index(names=["price", "way"])
        kinds = [
            plots.dots_of(f"a look costs {price:g}", rows[rows["price"] == price], "saved")
            for price in PRICES
        ]
        plots.dot_rows(panel, ways, kinds, legend=False)
        if number > 0:
            panel.set_yticks(range(len(ways)), [""] * len(ways))
        panel.axvline(0.0, color="black", linewidth=0.8)
    plots.label_grid(figure, panels, "cost saved in a trial (steps)", "")
    return figure


def weak_sensor(weak: pd.DataFrame) -> Figure:
    """Draw the boat's success by way and resolution."""
    from studies import plots

    figure, (panel,) = plots.stacked_panels(
        [len(weak)],
        title="A sharp range finder beside a weak GPS: success (95 % intervals)",
        width=7.0,
    )
    labels = [
        f"{row['way']}, {row['resolution']:g} m" if row["by_resolution"] else str(row["way"])
        for row in weak.to_dict("records")
    ]
    plots.dot_rows(panel, labels, [plots.dots_of("", weak, "success", 100.0)])
    panel.set_xlabel("trials in which the boat reaches the harbour within 80 steps (%)")
    return figure
