"""Four problems on which looking one step ahead fails, and which way of sensing is right there.

Two cues that count only together, a cue that must be sensed early, a sharp sensor of what keeps
changing beside a weak one of what decides, and one of what does not matter. None was used to choose
the default. A trial costs its steps; one that fails costs the limit.

The trials of one seed choose a way for each problem, as a user would who simulates their own; those
of another judge.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, ClassVar

import pandas as pd

from holdfast.planning.settings import SelectorSettings
from studies import statistics
from studies.cases import Case
from studies.judged_study import JudgedStudy, compared, steps_and_success
from studies.statistics import cells_of, interval_in
from studies.study import CHOICE, CLAIM, TRIALS, Number, Report, Scale, drawn
from studies.tables import Cell
from studies.trial_batches import TrialSeries

if TYPE_CHECKING:
    from matplotlib.figure import Figure


_EXAMPLE = "studies.two_ends"

CASES: Mapping[str, tuple[Case, int]] = {
    name: (Case(name=name, problem=place, num_particles=300, max_steps=limit), interval)
    for name, place, limit, interval in (
        ("two cues", f"{_EXAMPLE}:TwoCues", 120, 4),
        ("T maze", f"{_EXAMPLE}:TMaze", 150, 4),
        ("sorting", f"{_EXAMPLE}:Sorting", 100, 4),
        ("boat", "studies.priced_problems:Boat", 80, 8),
    )
}
"""How each is posed, and the steps between two sensing actions."""

_BASELINE, _DEFAULT = "random", "default"

WAYS: Mapping[str, SelectorSettings] = {
    _BASELINE: SelectorSettings(method="random"),
    _DEFAULT: SelectorSettings(),
    "state entropy": SelectorSettings(method="state_entropy", estimator="nearest_neighbor"),
    "action covariance": SelectorSettings(method="action_covariance"),
    "expected return, 8 looks": SelectorSettings(
        method="expected_return", rollout_reward="steps", rollout_sensing_steps=8
    ),
}

_Cells = Mapping[tuple[str, str], pd.DataFrame]
"""Trials by problem and way."""


class Myopic(JudgedStudy):
    """The study ``myopic``."""

    name = "myopic"
    title = "Where looking one step ahead fails: five ways on four problems"
    columns = ("problem", "way")
    num_trials: ClassVar = {CHOICE: 30, CLAIM: 150}

    def cells(self, scale: Scale) -> Iterator[tuple[str, str]]:
        """Return all cells, in the order of the tables."""
        del scale
        return ((case, way) for case in CASES for way in WAYS)

    def names(self, cell: tuple[str, str]) -> tuple[Cell, ...]:
        """Return a cell's values of the columns."""
        return cell

    def series(
        self, cell: tuple[str, str], purpose: str, scale: Scale, num_trials: int
    ) -> TrialSeries:
        """Return the trials of a cell for a purpose."""
        name, way = cell
        case, interval = CASES[name]
        return case.series(WAYS[way], interval, seed=scale.seed_of(purpose), num_trials=num_trials)

    def report_of(self, tables: Mapping[str, pd.DataFrame]) -> Report:
        """Return the report on all trials; InvalidValueError if they are not of this study."""
        choosing, cells = self.by_cell(tables[TRIALS]).values()
        outcomes = _outcomes(choosing, cells)
        return Report(
            summary={"outcomes": outcomes},
            figures={"myopic": drawn("myopic:success", outcomes)},
            numbers=[
                Number(
                    f"{row['problem']}: {row['way']} against random sensing",
                    interval_in(row, "success_gain", 100.0),
                    "points of success",
                    row["trials"],
                )
                for row in outcomes.to_dict("records")
                if row["rival"] == _BASELINE
            ],
        )


def _outcomes(choosing: _Cells, cells: _Cells) -> pd.DataFrame:
    """Return how each way differs from random sensing and from the default.

    ``chosen`` says which way the trials for choosing choose. P-values are adjusted for all rows.
    """
    rows: list[dict[str, Cell]] = []
    for case in CASES:
        means = {way: float(choosing[case, way]["steps"].mean()) for way in WAYS}
        chosen = min(means, key=lambda way: means[way])
        for way in WAYS:
            table = cells[case, way]
            steps, right = table["steps"].to_numpy(float), table["success"].to_numpy(bool)
            for rival in (_BASELINE, _DEFAULT):
                if way in (_BASELINE, rival):
                    continue
                other = cells[case, rival]
                saved, _ = statistics.paired_difference(steps, other["steps"].to_numpy(float))
                rows.append(
                    {
                        "problem": case,
                        "way": way,
                        "rival": rival,
                        "chosen": way == chosen,
                        "trials": len(table),
                        **cells_of(
                            "success", statistics.rate_interval(int(right.sum()), len(table))
                        ),
                        **cells_of("cost", statistics.mean_interval(steps)),
                        **cells_of("cost_difference", saved),
                        **compared(steps_and_success(table), steps_and_success(other)),
                        "median_sensing_ms": float(table["median_sensing_ms"].iloc[0]),
                    }
                )
    found = pd.DataFrame(rows)
    statistics.add_adjusted(found, "steps_p_value", "success_p_value")
    return found


def success(outcomes: pd.DataFrame) -> Figure:
    """Draw the points of success of each way beyond random sensing; this imports matplotlib."""
    from studies import plots

    problems = list(CASES)
    figure, panels = plots.grid_of_panels(
        problems,
        columns=len(problems),
        title="Success beyond random sensing (95 % intervals)",
        width=10.0,
    )
    ways = [way for way in WAYS if way != _BASELINE]
    for number, (problem, panel) in enumerate(panels.items()):
        rows = outcomes[(outcomes["problem"] == problem) & (outcomes["rival"] == _BASELINE)]
        plots.dot_rows(panel, ways, [plots.dots_of("", rows, "success_gain", 100.0)], legend=False)
        if number > 0:
            panel.set_yticks(range(len(ways)), [""] * len(ways))
        panel.axvline(0.0, color="black", linewidth=0.8)
    plots.label_grid(figure, panels, "points of success", "")
    return figure
