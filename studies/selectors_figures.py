"""The figures of the study of selectors.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies import plots
from studies.cases import CASES
from studies.selectors import COSTS, GROUPS, INTERVALS, SHOWN

__all__ = ["choice_of_sensing", "costs_of_looks", "selectors"]

_PROBLEMS = [case.name for case in CASES]


def choice_of_sensing(summary: pd.DataFrame) -> Figure:
    """Draw steps by the interval between two sensing actions."""
    figure, panels = _by_problem(
        summary,
        "What choosing the sensing action gains (means, 95 % intervals)",
        ("sensing_interval", "steps between two sensing actions"),
        ("mean_steps", "steps (mean; failures count as the limit)"),
        offset=0.2,
    )
    for panel in panels.values():
        panel.set_xticks(INTERVALS)
        panel.set_ylim(0.0, 1.1 * panel.dataLim.y1)
    return figure


def costs_of_looks(costs: pd.DataFrame) -> Figure:
    """Draw the net reward by the price of a sensing action."""
    figure, panels = _by_problem(
        costs,
        "Where sensing has a price: reward at the best interval (means, 95 % intervals)",
        ("cost_of_a_look", "price of a sensing action (reward)"),
        ("net_reward", "mean reward less the price of sensing"),
        offset=0.0,
    )
    for panel in panels.values():
        panel.set_xscale("symlog", linthresh=COSTS[1])
        panel.set_xlim(0.0, 1.1 * COSTS[-1])
    return figure


def _by_problem(
    table: pd.DataFrame, title: str, across: tuple[str, str], up: tuple[str, str], offset: float
) -> tuple[Figure, dict[str, Axes]]:
    """Draw a panel for each problem and a line for each way; columns come with their labels."""
    rows = dict(list(table.groupby(["problem", "way"])))
    lines = {
        case: [
            (rows[case, way][across[0]].tolist(), plots.dots_of(label, rows[case, way], up[0]))
            for way, label in SHOWN.items()
        ]
        for case in _PROBLEMS
    }
    return plots.line_grid(lines, columns=4, title=title, labels=(across[1], up[1]), offset=offset)


def selectors(relative_steps: pd.DataFrame) -> Figure:
    """Draw the steps of all ways, relative to random sensing."""
    problem = relative_steps["problem"]
    return plots.ratio_grid(
        {name: relative_steps[problem == name] for name in (*_PROBLEMS, *GROUPS)},
        relative_steps["way"],
        columns=5,
        title="Steps relative to random sensing (geometric mean, 95 % intervals)",
        width=12.0,
        label="steps, relative to random",
    )
