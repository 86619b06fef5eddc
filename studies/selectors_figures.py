"""The figures of the study of selectors.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from studies import plots
from studies.cases import CASES
from studies.selectors import GROUPS, INTERVALS, SHOWN

__all__ = ["choice_of_sensing", "selectors"]

_PROBLEMS = [case.name for case in CASES]


def choice_of_sensing(summary: pd.DataFrame) -> Figure:
    """Draw steps by the interval between two sensing actions."""
    rows = dict(list(summary.groupby(["problem", "way"])))
    lines = {
        case: [
            (INTERVALS, plots.dots_of(label, rows[case, way], "mean_steps"))
            for way, label in SHOWN.items()
        ]
        for case in _PROBLEMS
    }
    figure, panels = plots.line_grid(
        lines,
        columns=4,
        title="What choosing the sensing action gains (means, 95 % intervals)",
        labels=(
            "steps between two sensing actions",
            "steps (mean; failures count as the limit)",
        ),
        offset=0.2,
    )
    for panel in panels.values():
        panel.set_xticks(INTERVALS)
        panel.set_ylim(0.0, 1.1 * panel.dataLim.y1)
    return figure


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
