"""The common parts of the studies' figures: sizes, marks that read in grey, intervals.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from holdfast.reports.figure import STYLE
from holdfast.runtime.files import write_atomically

# Ordered so that neighbours differ in lightness, too.
COLORS = ("#1D3C78", "#E8A317", "#B5342B", "#54B5A6", "#7D3C98", "#9AA05A", "#4A4F57", "#D98CA6")
MARKERS = ("s", "o", "D", "^", "v", "P", "X", "*")

_RATIOS = {
    1.6: (0.8, 0.9, 1.0, 1.1, 1.25),
    8.0: (0.3, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0),
    25.0: (0.2, 0.4, 0.7, 1.0, 2.0, 3.0, 5.0, 10.0),
    math.inf: (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0),
}
"""Ticks of an axis of ratios, by how many times its low end the high end is at most."""

_MARGIN = 1.03

_ROW_INCHES = 0.26
_DOTS_PER_INCH = 150
_PAGE_PIXELS, _LEAST_PIXELS = 900, 9
"""The width at which pages show figures, and the least height of their texts there."""


class Dots(NamedTuple):
    """A value with its interval in each row."""

    label: str
    values: Sequence[float]
    lows: Sequence[float]
    highs: Sequence[float]

    @property
    def errors(self) -> list[list[float]]:
        """How far the intervals reach below and above the values."""
        value, low, high = map(np.asarray, (self.values, self.lows, self.highs))
        return [(value - low).tolist(), (high - value).tolist()]


def dots_of(label: str, rows: pd.DataFrame, name: str, factor: float = 1.0) -> Dots:
    """Return the values of a column with its intervals; without a bound, the value itself."""
    values, lows, highs = (factor * rows[f"{name}{end}"] for end in ("", "_low", "_high"))
    return Dots(label, values.tolist(), lows.fillna(values).tolist(), highs.fillna(values).tolist())


def figure_of(width: float, height: float, title: str) -> Figure:
    """Return an empty figure of some inches."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(figure)
        figure.suptitle(title, x=0.012, ha="left", fontsize=12.0)
    return figure


def stacked_panels(
    rows_of_each: Sequence[int], *, title: str, width: float
) -> tuple[Figure, list[Axes]]:
    """Return a figure with panels one above the other, each as high as its rows need."""
    heights = [_ROW_INCHES * rows + 0.5 for rows in rows_of_each]
    figure = figure_of(width, sum(heights) + 0.7, title)
    with mpl.rc_context(STYLE):
        panels = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)
    return figure, list(panels[:, 0])


def grid_of_panels(
    names: Sequence[str],
    *,
    columns: int,
    title: str,
    width: float,
    row_height: float = 2.5,
    same_rows: bool = False,
) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure with a panel for each name, row by row, each with its name on top.

    ``width`` is that of the figure, ``row_height`` that of a row of panels, in inches. With
    ``same_rows`` all panels have the same rows, which are named once, and one scale.
    """
    rows = -(-len(names) // columns)
    figure = figure_of(width, row_height * rows + 0.8, title)
    with mpl.rc_context(STYLE):
        panels = figure.subplots(
            rows, columns, squeeze=False, sharex=same_rows, sharey=same_rows
        ).ravel()
    for panel in panels[len(names) :]:
        panel.remove()
    for panel, name in zip(panels, names, strict=False):
        panel.set_title(name, loc="left", fontsize=10.0)
    return figure, dict(zip(names, panels, strict=False))


def label_grid(figure: Figure, panels: Mapping[str, Axes], x_label: str, y_label: str) -> None:
    """Label a figure of panels, with one legend below for all that say the same."""
    lowest = {}
    for panel in panels.values():
        place = panel.get_subplotspec()
        if place is not None:
            lowest[place.colspan.start] = panel
    for panel in lowest.values():
        panel.set_xlabel(x_label)
        panel.tick_params(axis="x", labelbottom=True)
    if y_label:
        figure.supylabel(y_label, fontsize=10.0)
    first = next(iter(panels.values()))
    labels = first.get_legend_handles_labels()[1]
    if any(labels):
        in_rows = -(-len(labels) // 5)
        legend_below(figure, first, -(-len(labels) // in_rows), fontsize=9.0)


def legend_below(figure: Figure, panel: Axes, columns: int, **looks: Any) -> None:
    """Give a figure one legend below, with what a panel shows."""
    handles, labels = panel.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, **looks)


def _line(
    panel: Axes, places: Sequence[float], line: Dots, *, number: int, offset: float = 0.0
) -> None:
    """Draw values over places, joined, each with its interval.

    ``number`` is that of the colour and mark. The offset moves all to the right, so that intervals
    do not cover each other.
    """
    panel.errorbar(
        [place + offset for place in places],
        line.values,
        yerr=line.errors,
        fmt=MARKERS[number] + "-",
        color=COLORS[number],
        markersize=4.2,
        linewidth=1.1,
        elinewidth=1.0,
        label=line.label,
    )
    panel.grid(axis="y")


def line_grid(
    lines: Mapping[str, Sequence[tuple[Sequence[float], Dots]]],
    *,
    columns: int,
    title: str,
    labels: tuple[str, str],
    width: float = 11.0,
    row_height: float = 2.5,
    offset: float = 0.0,
) -> tuple[Figure, dict[str, Axes]]:
    """Return a figure with a panel for each name, with lines of values over places.

    ``labels`` are those of the two axes; by ``offset`` each line is further right than the last.
    """
    figure, panels = grid_of_panels(
        list(lines), columns=columns, title=title, width=width, row_height=row_height
    )
    for panel, own in zip(panels.values(), lines.values(), strict=True):
        for number, (places, line) in enumerate(own):
            shift = offset * (number - 0.5 * (len(own) - 1))
            _line(panel, places, line, number=number, offset=shift)
    label_grid(figure, panels, *labels)
    return figure, panels


def dot_rows(
    panel: Axes, labels: Sequence[str], kinds: Sequence[Dots], *, legend: bool = True
) -> None:
    """Draw labelled rows of values with intervals, a mark for each kind, the first row on top.

    The first kind's marks are hollow. The legend is above the rows, if a kind has a label.
    """
    step = 0.7 / len(kinds)
    for number, kind in enumerate(kinds):
        offset = step * (number - 0.5 * (len(kinds) - 1))
        color = COLORS[number]
        places = [row + offset for row in range(len(labels))]
        panel.errorbar(
            kind.values,
            places,
            xerr=kind.errors,
            fmt=MARKERS[number],
            color=color,
            markerfacecolor="white" if number == 0 else color,
            markersize=4.2,
            elinewidth=1.0,
            label=kind.label,
        )
    panel.set_yticks(range(len(labels)), labels)
    panel.set_ylim(len(labels) - 0.4, -0.6)
    panel.grid(axis="x")
    panel.tick_params(axis="y", length=0)
    if legend and any(kind.label for kind in kinds):
        # Above the rows, where it covers none.
        panel.legend(
            loc="lower right",
            bbox_to_anchor=(1.0, 1.0),
            ncols=len(kinds),
            handletextpad=0.3,
            borderaxespad=0.2,
        )


def ratio_axes(panels: Iterable[Axes]) -> None:
    """Give panels that have been drawn one scale of ratios: equal factors, equal lengths."""
    panels = list(panels)
    # Some range on either side of 1, so that there are ticks.
    low = min(0.95, *(panel.dataLim.x0 for panel in panels)) / _MARGIN
    high = max(1.05, *(panel.dataLim.x1 for panel in panels)) * _MARGIN
    fitting = next(ticks for most, ticks in _RATIOS.items() if high / low <= most)
    ticks = [tick for tick in fitting if low <= tick <= high]
    for panel in panels:
        panel.set_xscale("log")
        panel.set_xlim(low, high)
        panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        panel.minorticks_off()
        panel.axvline(1.0, color="black", linewidth=0.8)


def ratio_grid(
    rows_of: Mapping[str, pd.DataFrame],
    labels: pd.Series,
    *,
    columns: int,
    title: str,
    width: float,
    row_height: float = 2.5,
    label: str,
) -> Figure:
    """Return a figure with a panel of ratios of steps for each table.

    ``labels`` are those of rows, by the index of the tables.
    """
    figure, panels = grid_of_panels(
        list(rows_of),
        columns=columns,
        title=title,
        width=width,
        row_height=row_height,
        same_rows=True,
    )
    for panel, rows in zip(panels.values(), rows_of.values(), strict=True):
        dot_rows(panel, labels[rows.index].tolist(), [dots_of("", rows, "steps_ratio")])
    ratio_axes(panels.values())
    label_grid(figure, panels, "", "")
    figure.supxlabel(label)
    return figure


def milliseconds(panel: Axes, label: str, *, upright: bool = True) -> None:
    """Let an axis show times over decades."""
    if upright:
        panel.set_yscale("log")
        panel.set_ylabel(label)
    else:
        panel.set_xscale("log")
        panel.set_xlabel(label)
    axis = panel.yaxis if upright else panel.xaxis
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())
    panel.grid(axis="y" if upright else "x")


def mark(figure: Figure, words: str) -> None:
    """Say something about a figure, beside its title."""
    figure.text(0.988, 0.995, words, ha="right", va="top", fontsize=8.0, color="#B5342B")


def make_legible(figure: Figure) -> None:
    """Enlarge all texts to at least 9 pixels on a page that shows the figure 900 pixels wide."""
    least = _LEAST_PIXELS / _PAGE_PIXELS * float(figure.get_figwidth()) * 72.0
    for panel in figure.axes:
        for axis in (panel.xaxis, panel.yaxis):
            if any(font_size_of(label) < least for label in axis.get_ticklabels()):
                axis.set_tick_params(which="both", labelsize=least)
    for text in figure.findobj(Text):
        if isinstance(text, Text) and font_size_of(text) < least:
            text.set_fontsize(least)


def font_size_of(text: Text) -> float:
    """Return the size of a text in points."""
    return float(text.get_fontsize())


def save(figure: Figure, directory: Path, name: str) -> list[str]:
    """Write a figure as PNG and as SVG, legible where a page shows it; return the files' names."""
    names = []
    make_legible(figure)
    # Without a date and with fixed ids the same results give the same file.
    with mpl.rc_context({**STYLE, "svg.hashsalt": "holdfast", "svg.fonttype": "path"}):
        for ending, metadata in (("png", {"Software": None}), ("svg", {"Date": None})):
            content = io.BytesIO()
            figure.savefig(content, format=ending, dpi=_DOTS_PER_INCH, metadata=metadata)
            write_atomically(directory / f"{name}.{ending}", content.getvalue())
            names.append(f"{name}.{ending}")
    return names
