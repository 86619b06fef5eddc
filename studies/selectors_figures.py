"""The figures of the study of selectors.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

from collections.abc import Callable

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from studies import plots
from studies.cases import CASES
from studies.selectors import BASELINE, COSTS, GROUPS, INTERVALS, SHOWN, WAYS

__all__ = ["choice_of_sensing", "costs_of_looks", "selectors"]

_PROBLEMS = [case.name for case in CASES]


def choice_of_sensing(summary: pd.DataFrame) -> Figure:
    """Draw steps by the interval between two sensing actions."""
    return _draw_ways(
        summary,
        "What choosing the sensing action gains (means, 95 % intervals)",
        ("sensing_interval", "steps between two sensing actions"),
        ("mean_steps", "steps (mean; failures count as the limit)"),
        _set_intervals,
    )


def costs_of_looks(costs: pd.DataFrame) -> Figure:
    """Draw the net reward by the price of a sensing action."""
    return _draw_ways(
        costs,
        "Where sensing has a price: reward at the best interval (means, 95 % intervals)",
        ("cost_of_a_look", "price of a sensing action (reward)"),
        ("net_reward", "mean reward less the price of sensing"),
        _set_costs,
    )


def _draw_ways(
    table: pd.DataFrame,
    title: str,
    across: tuple[str, str],
    up: tuple[str, str],
    finish: Callable[[Axes], float],
) -> Figure:
    """Draw a panel for each problem and a line for each way.

    Parameters
    ----------
    across, up : (str, str)
        Columns of the two axes, with their labels.
    finish : callable
        Sets the axes of a panel; returns how far apart the ways are drawn.
    """
    figure, panels = plots.grid_of_panels(_PROBLEMS, columns=4, title=title, width=11.0)
    for case, panel in panels.items():
        step = finish(panel)
        for number, (way, label) in enumerate(SHOWN.items()):
            rows = table[(table["problem"] == case) & (table["way"] == way)]
            plots.line_with_intervals(
                panel,
                rows[across[0]].tolist(),
                plots.dots_of(label, rows, up[0]),
                number=number,
                offset=step * (number - 2.0),
            )
        if step:
            panel.set_ylim(0.0, 1.1 * panel.dataLim.y1)
    plots.label_grid(figure, panels, across[1], up[1])
    return figure


def _set_intervals(panel: Axes) -> float:
    panel.set_xticks(INTERVALS)
    return 0.2


def _set_costs(panel: Axes) -> float:
    panel.set_xscale("symlog", linthresh=COSTS[1])
    panel.set_xlim(0.0, 1.1 * COSTS[-1])
    return 0.0


def selectors(relative_steps: pd.DataFrame) -> Figure:
    """Draw the steps of all ways, relative to random sensing."""
    figure, panels = plots.grid_of_panels(
        [*_PROBLEMS, *GROUPS],
        columns=5,
        title="Steps relative to random sensing (geometric mean, 95 % intervals)",
        width=12.0,
        same_rows=True,
    )
    ways = [way for way in WAYS if way != BASELINE]
    for case, panel in panels.items():
        rows = relative_steps[relative_steps["problem"] == case]
        plots.dot_rows(panel, ways, [plots.dots_of("", rows, "steps_ratio")])
    plots.ratio_axes(panels.values())
    plots.label_grid(figure, panels, "steps, relative to random", "")
    return figure
