"""Two pictures of a series, after the thesis's Figures 14 and 15.

The first: how soon a loss is found, and how long the local service takes to launch. The second: how
soon a service that can be used again is used. A dot for each fault, a box for the middle half,
whiskers from the 5th to the 95th percentile, a bar for the median; the thesis's numbers as lines.
Times spread over decades, so the axes are logarithmic. Nothing is said by colour alone.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import io
import random
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from holdfast.files import write_atomically
from holdfast.lab.chaos.report import ChaosSummary
from holdfast.lab.chaos.trial import TrialOutcome
from holdfast.lab.testbed.fault_times import FaultTimes
from holdfast.lab.testbed.faults import FaultKind
from holdfast.recording.figure import STYLE

__all__ = ["FIGURE_STEMS", "draw_figures"]

FIGURE_STEMS = ("launch", "failback")

_THESIS_TIMEOUT_MS = 5000.0
_THESIS_LAUNCH_MS = 370.0
_THESIS_FAILBACK_MS = 1000.0

_DOTS_PER_INCH = 150
_DOT = "#2F6DB3"
_BOX = "#111111"
_THESIS = "#B5342B"
_ROW_INCHES = 0.42
_JITTER = 0.22
_BOX_HALF = 0.31
_FEWEST_FOR_BOX = 4


class _Panel(NamedTuple):
    """What a panel shows."""

    title: str
    label: str
    value: Callable[[FaultTimes], float | None]
    thesis_ms: float
    thesis: str


_DETECTION = _Panel(
    "Loss found",
    "time from the fault (ms)",
    lambda fault: fault.detection_ms,
    _THESIS_TIMEOUT_MS,
    "thesis: timeout, 5 s",
)
_LAUNCH = _Panel(
    "Local service launched",
    "time from its start until the robot sees it (ms)",
    lambda fault: fault.launch_ms,
    _THESIS_LAUNCH_MS,
    "thesis: 370 ms",
)
_FAILBACK = _Panel(
    "Used again",
    "time since it can be used again (ms)",
    lambda fault: fault.failback_ms,
    _THESIS_FAILBACK_MS,
    "thesis: 1 s",
)


def draw_figures(
    directory: Path, summary: ChaosSummary, outcomes: Sequence[TrialOutcome]
) -> list[str]:
    """Draw both figures, as PNG and as SVG.

    Raises
    ------
    OutputError
        If one cannot be written.
    """
    source = (
        f"{summary.finished:,} trials, {summary.faults:,} faults, seed {summary.seed}; "
        f"{summary.jobs} at a time on {summary.machine['cores'].split()[0]} cores; "
        f"holdfast {summary.holdfast_version}, commit {summary.commit}"
    )
    launch = (_DETECTION, _LAUNCH)
    names = _draw(
        directory / FIGURE_STEMS[0],
        "From a fault to a local service that decides",
        source,
        [(panel, _times(outcomes, panel, first=panel is _LAUNCH)) for panel in launch],
    )
    names += _draw(
        directory / FIGURE_STEMS[1],
        "Back to the cloud",
        source,
        [(_FAILBACK, _times(outcomes, _FAILBACK))],
    )
    return names


def _times(
    outcomes: Sequence[TrialOutcome], panel: _Panel, *, first: bool = False
) -> dict[FaultKind, list[float]]:
    """Return the times of each kind; of each trial only the first one, if later ones are warm."""
    times: dict[FaultKind, list[float]] = {}
    for outcome in outcomes:
        if outcome.kind is FaultKind.COMBINATION:
            continue
        found = [value for fault in outcome.faults if (value := panel.value(fault)) is not None]
        if first:
            found = found[:1]
        times.setdefault(outcome.kind, []).extend(found)
    return {kind: times[kind] for kind in FaultKind if times.get(kind)}


def _draw(
    stem: Path,
    title: str,
    source: str,
    panels: Sequence[tuple[_Panel, Mapping[FaultKind, Sequence[float]]]],
) -> list[str]:
    shown = {kind for _, times in panels for kind in times}
    kinds = [kind for kind in FaultKind if kind in shown]
    height = 1.7 + _ROW_INCHES * max(2, len(kinds))
    style: Any = {**STYLE, "svg.hashsalt": "holdfast"}
    with mpl.rc_context(style):
        figure = Figure(figsize=(4.6 * len(panels) + 1.8, height), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, x=0.012, ha="left", fontsize=12.0)
        figure.supxlabel(source, x=0.012, ha="left", fontsize=7.5, color="#555555")
        axes = figure.subplots(1, len(panels), sharey=True, squeeze=False)[0]
        for panel_axes, (panel, times) in zip(axes, panels, strict=True):
            _draw_panel(panel_axes, panel, times, kinds)
        names = []
        for ending in ("png", "svg"):
            picture = io.BytesIO()
            # Without the date, so that the same series gives the same file.
            metadata = {"Date": None} if ending == "svg" else None
            figure.savefig(picture, format=ending, metadata=metadata, dpi=_DOTS_PER_INCH)
            path = stem.with_suffix(f".{ending}")
            write_atomically(path, picture.getvalue())
            names.append(path.name)
    return names


def _draw_panel(
    axes: Axes,
    panel: _Panel,
    times: Mapping[FaultKind, Sequence[float]],
    kinds: Sequence[FaultKind],
) -> None:
    axes.set_title(panel.title, loc="left")
    axes.set_xlabel(panel.label)
    axes.set_yticks(range(len(kinds)), [kind.value.replace("_", " ") for kind in kinds])
    axes.set_ylim(len(kinds) - 0.4, -0.9)
    axes.grid(visible=True, axis="x")
    chance = random.Random(0)
    for row, kind in enumerate(kinds):
        values = times.get(kind, ())
        if not values:
            continue
        rows = [row + chance.uniform(-_JITTER, _JITTER) for _ in values]
        axes.scatter(values, rows, s=9.0, color=_DOT, alpha=0.55, linewidths=0.0, zorder=2)
        if len(values) < _FEWEST_FOR_BOX:
            continue
        low, first, median, third, high = np.percentile(values, (5, 25, 50, 75, 95))
        axes.hlines([row, row], [low, third], [first, high], color=_BOX, linewidth=0.9, zorder=3)
        axes.add_patch(
            Rectangle(
                (first, row - _BOX_HALF),
                third - first,
                2 * _BOX_HALF,
                edgecolor=_BOX,
                facecolor="none",
                linewidth=0.9,
                zorder=3,
            )
        )
        axes.vlines(median, row - _BOX_HALF, row + _BOX_HALF, color=_BOX, linewidth=2.2, zorder=4)
    axes.axvline(panel.thesis_ms, color=_THESIS, linewidth=1.1, linestyle=(0, (5, 2)), zorder=1)
    axes.annotate(
        panel.thesis,
        (panel.thesis_ms, -0.85),
        xytext=(-3.0, 0.0),
        textcoords="offset points",
        ha="right",
        va="top",
        fontsize=8.0,
        color=_THESIS,
    )
    every = [value for values in times.values() for value in values]
    # There must be room for the label to the left of its line.
    low = min([*every, panel.thesis_ms / 3.0])
    axes.set_xscale("log")
    axes.set_xlim(max(low / 1.3, 0.5), 1.4 * max([*every, panel.thesis_ms]))
    axes.xaxis.set_major_locator(LogLocator(base=10.0, subs=(1.0, 3.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
