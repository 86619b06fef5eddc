"""The figures of the study of the thesis's chapter 6, from its tables.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd
from matplotlib.figure import Figure

from studies import plots
from studies.thesis_measurements import (
    PARTICLES,
    THESIS_FAILBACK_MS,
    THESIS_LAUNCH_MS,
    THESIS_TIMEOUT_MS,
)

_Line = tuple[Sequence[float], plots.Dots]


def times(decisions: pd.DataFrame) -> Figure:
    """Draw what a sensing action takes: to compute, and from question to answer (9 to 12)."""
    lines = {
        str(path): [
            _line(here, f"{what}, {service}", column)
            for what, column in (
                ("computing", "computed_ms"),
                ("question to answer", "answered_ms"),
                ("round trip", "round_trip_ms"),
            )
            for service, here in rows.groupby("service")
        ]
        for path, rows in _without_loss(decisions)
    }
    return _over_particles(lines, "What a sensing action takes, by path (Figures 9 to 12)")


def recovery(faults: pd.DataFrame) -> Figure:
    """Draw how soon a loss is found, the local service decides, and the cloud again (14, 15)."""
    limits = {
        "found_ms": ("until the robot finds the loss", THESIS_TIMEOUT_MS),
        "first_local_ms": ("from then until a local decision", THESIS_LAUNCH_MS),
        "failback_ms": ("from ready cloud to its decision", THESIS_FAILBACK_MS),
    }
    lines = {
        what: [_line(rows, str(path), column) for path, rows in _without_loss(faults)]
        for column, (what, _) in limits.items()
    }
    title = "The cloud dies and comes back; dashed, the thesis's limits (Figures 14 and 15)"
    figure = _over_particles(lines, title)
    for panel, (_, limit_ms) in zip(figure.axes, limits.values(), strict=True):
        panel.axhline(limit_ms, color="#B5342B", linewidth=1.1, linestyle="--")
    return figure


def _without_loss(table: pd.DataFrame) -> Sequence[tuple[object, pd.DataFrame]]:
    return list(table[table["loss"] == 0.0].groupby("path", sort=False, observed=True))


def _line(rows: pd.DataFrame, label: str, column: str) -> _Line:
    return rows["particles"].tolist(), plots.dots_of(label, rows, column)


def _over_particles(lines: Mapping[str, Sequence[_Line]], title: str) -> Figure:
    figure, panels = plots.line_grid(
        lines,
        columns=3,
        title=title,
        labels=("particles", "medians (ms), 95 % intervals"),
        row_height=3.2,
        offset=7.0,
    )
    for panel in panels.values():
        panel.set_xticks(PARTICLES)
        plots.milliseconds(panel, "")
    return figure
