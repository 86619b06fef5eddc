"""The figures of the study of sensing at a price.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import pandas as pd
from matplotlib.figure import Figure

from studies import plots
from studies.sensing_price import FIXED, PRICES, WAYS

__all__ = ["weak_sensor", "when_to_sense"]


def when_to_sense(when: pd.DataFrame) -> Figure:
    """Draw the steps that each way saves against fixed intervals, at each price."""
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
