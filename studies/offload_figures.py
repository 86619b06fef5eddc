"""The figures of the offload break-even.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from studies import plots
from studies.cost_model import Scaling
from studies.offload_break_even import (
    EXCHANGE_MS,
    PATHS_MS,
    SAMPLES_DRAWN,
    SHOWN,
    TIMES_THE_CORES,
    Kind,
    kind_of,
)


def sensing_time(scalings: Mapping[Kind, Scaling]) -> Figure:
    """Draw time against particles: here, and on more cores further away."""
    kinds = [SHOWN._replace(samples=samples) for samples in SAMPLES_DRAWN]
    lines = {
        f"{kind.label}, path of {path_ms:g} ms": _lines(scalings[kind], path_ms + EXCHANGE_MS)
        for kind in kinds
        if kind in scalings
        for path_ms in PATHS_MS
    }
    figure, panels = plots.line_grid(
        lines,
        columns=len(PATHS_MS),
        title="Choosing a sensing action: on the robot's one core, or on more further away",
        labels=("particles", "time until the sensing action is there (ms)"),
        width=9.2,
        row_height=3.4,
    )
    for panel in panels.values():
        panel.set_xscale("log")
        panel.set_yscale("log")
    return figure


def _lines(scaling: Scaling, cost_ms: float) -> list[tuple[list[float], plots.Dots]]:
    """Return the robot's times with their intervals, and those of services with their bounds."""
    particles, (value, low, high) = scaling.particles.tolist(), scaling.times
    known = np.isfinite(low) & np.isfinite(high)
    ends = (np.where(known, end, value).tolist() for end in (low, high))
    lines = [(particles, plots.Dots("robot: 1 core (over beliefs)", value.tolist(), *ends))]
    for cores in TIMES_THE_CORES:
        middle, (least, most) = scaling.on_cores(cores), scaling.band(cores)
        times = ((cost_ms + curve.values).tolist() for curve in (middle, least, most))
        lines.append((particles, plots.Dots(f"service: {cores} cores (bounds)", *times)))
    return lines


def break_even_lines(lines: pd.DataFrame) -> Figure:
    """Draw the break-even of all kinds of decisions, for a robot with one core."""
    lines = lines[(lines["robot_cores"] == 1) & lines["samples"].isin(SAMPLES_DRAWN)]
    kinds = lines.groupby(list(Kind._fields))
    never = int((kinds["particles"].count() == 0).sum())
    lines = lines[kinds["particles"].transform("count") > 0]
    ends = {kind_of(row): row["measured_to"] for row in lines.to_dict("records")}
    figure, (panel,) = plots.stacked_panels(
        [max(2, round(1.5 * len(ends)))],  # on a busy machine there may be no line at all
        title="Beyond how many particles a service is faster than the robot's one core",
        width=9.2,
    )
    dots = []
    for path_ms in PATHS_MS:
        for cores in TIMES_THE_CORES:
            rows = lines[(lines["service_cores"] == cores) & (lines["path_ms"] == path_ms)]
            # A bound that was not reached is at least where the measurement ended.
            unreached = rows[["particles", "measured_to"]].max(axis=1)
            dots.append(
                plots.Dots(
                    f"{cores} cores, path of {path_ms:g} ms",
                    rows["particles"].tolist(),
                    rows["particles_low"].fillna(rows["particles"]).tolist(),
                    rows["particles_high"].fillna(unreached).tolist(),
                )
            )
    panel.set_xscale("log")
    plots.dot_rows(panel, [kind.label for kind in ends], dots, legend=False)
    for place, end in enumerate(ends.values()):
        panel.plot([end, end], [place - 0.4, place + 0.4], color="#8A9099", linewidth=1.2)
    panel.set_xticks(ticks := [300, 1_000, 3_000, 10_000, 30_000], [f"{each:,}" for each in ticks])
    text = "particles at break-even, with bounds; grey: measured up to here"
    panel.set_xlabel(f"{text}\n({never} kinds of decisions with a horizon H: none is known)")
    plots.legend_below(figure, panel, 4, frameon=False)
    return figure
