"""The figures of the offload break-even.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from holdfast.lab.studies import plots
from holdfast.lab.studies.cost_model import Scaling, break_even
from holdfast.lab.studies.offload_break_even import (
    PATHS_MS,
    RATES_HZ,
    SAMPLES_DRAWN,
    SHOWN,
    TIMES_THE_CORES,
    Kind,
    ahead_ms_of,
    kind_of,
    line_of,
)
from holdfast.numerics.arrays import FloatArray
from holdfast.recording.figure import STYLE

__all__ = ["break_even_lines", "break_even_map", "sensing_time", "waiting"]


def _shown_samples(scalings: Mapping[Kind, Scaling]) -> list[Kind]:
    """Return the kinds that are shown, by numbers of hypothetical observations."""
    family = [kind for kind in scalings if kind._replace(samples=SHOWN.samples) == SHOWN]
    return sorted(family, key=lambda kind: kind.samples)


def _panels(figure: Figure, rows: int, columns: int) -> list[list[Axes]]:
    """Return panels with the same axes, row by row."""
    with mpl.rc_context(STYLE):
        panels = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    return [list(row) for row in panels]


def sensing_time(scalings: Mapping[Kind, Scaling], exchange_ms: float) -> Figure:
    """Draw time against particles: here, and on more cores further away."""
    kinds = [kind for kind in _shown_samples(scalings) if kind.samples in SAMPLES_DRAWN]
    figure = plots.figure_of(
        9.2,
        3.4 * len(kinds) + 0.6,
        "Choosing a sensing action: on the robot's one core, or on more further away",
    )
    panels = _panels(figure, len(kinds), len(PATHS_MS))
    for row, kind in zip(panels, kinds, strict=True):
        for panel, path_ms in zip(row, PATHS_MS, strict=True):
            _draw_lines(panel, scalings[kind], path_ms, exchange_ms)
            panel.set_title(f"{kind.label}, path of {path_ms:g} ms", loc="left")
        row[0].set_ylabel("time until the sensing action is there (ms)")
    for panel in panels[-1]:
        panel.set_xlabel("particles")
    plots.legend_below(figure, panels[0][0], 2, handlelength=3.2, frameon=False)
    return figure


_LINES = ((8, "--", "o"), (36, "-.", "D"))


def _draw_lines(panel: Axes, scaling: Scaling, path_ms: float, exchange_ms: float) -> None:
    cost_ms = path_ms + exchange_ms
    numbers, (value, low, high) = scaling.particles, scaling.times
    dense = np.geomspace(numbers[0], numbers[-1], 300).clip(numbers[0], numbers[-1])
    finite = np.isfinite(low) & np.isfinite(high)
    panel.errorbar(
        numbers,
        value,
        yerr=np.where(finite, [value - low, high - value], 0.0),
        fmt="s-",
        color="#1A1D21",
        markersize=4.0,
        markerfacecolor="white",
        elinewidth=1.0,
        capsize=2.0,
        label="robot: 1 core (95 % interval over beliefs)",
        zorder=3,
    )
    for (cores, style, mark), color in zip(_LINES, plots.COLORS[1:], strict=False):
        least, most = scaling.band(cores)
        panel.fill_between(
            dense,
            cost_ms + least.at(dense),
            cost_ms + most.at(dense),
            color=color,
            alpha=0.22,
            linewidth=0,
        )
        panel.plot(
            dense,
            cost_ms + scaling.on_cores(cores).at(dense),
            style,
            color=color,
            linewidth=1.6,
            label=f"service: {cores} cores (band: divided evenly to least share)",
        )
        found = break_even(scaling.saved_ms(1, cores), cost_ms)
        if found.particles is None:
            continue
        at = np.array([found.particles])
        height = float(scaling.on_cores(1).at(at)[0])
        panel.plot(at, [height], mark, color=color, markeredgecolor="#1A1D21", zorder=4)
        # Where nothing is drawn: decisions of many particles are never that fast.
        panel.text(
            0.98,
            0.12 if cores == _LINES[0][0] else 0.05,
            f"equal with {cores} cores: {found.particles:,.0f}",
            transform=panel.transAxes,
            horizontalalignment="right",
            fontsize=9.0,
        )
    panel.set_xscale("log")
    panel.set_yscale("log")
    panel.grid(which="major")


def break_even_map(scalings: Mapping[Kind, Scaling], exchange_ms: float) -> Figure:
    """Draw where a service is faster, over particles and hypothetical observations."""
    kinds = _shown_samples(scalings)
    figure = plots.figure_of(
        9.2, 7.0, f"When is the cloud worth it? {SHOWN.problem}, a robot with one core that waits"
    )
    panels = _panels(figure, len(TIMES_THE_CORES), len(PATHS_MS))
    first = min(scalings[kind].particles[0] for kind in kinds)
    last = max(scalings[kind].particles[-1] for kind in kinds)
    numbers = np.geomspace(first, last, 160).clip(first, last)
    samples = np.geomspace(kinds[0].samples, kinds[-1].samples, 80)
    edges = (0.0, 0.1, 0.5, 1.0, 2.0, 4.0, 1e9)
    colors = ("#FFFFFF", "#ECEFF4", "#D5DCE8", "#9DB2D6", "#5E7FB8", "#1D3C78")
    shades = ListedColormap(colors)
    norm = BoundaryNorm(edges, shades.N)
    for row, cores in zip(panels, TIMES_THE_CORES, strict=True):
        for panel, path_ms in zip(row, PATHS_MS, strict=True):
            cost_ms = path_ms + exchange_ms
            own, there = (
                _over_samples(kinds, [scalings[kind].on_cores(c).beyond(numbers) for kind in kinds])
                for c in (1, cores)
            )
            ratio = own(samples) / (cost_ms + there(samples))
            panel.pcolormesh(
                numbers, samples, ratio, cmap=shades, norm=norm, shading="nearest", rasterized=True
            )
            panel.fill_betweenx(
                [kind.samples for kind in kinds],
                [scalings[kind].particles[-1] for kind in kinds],
                last,
                facecolor="none",
                edgecolor="#8A9099",
                hatch="////",
                linewidth=0.0,
            )
            _draw_break_even(panel, kinds, scalings, cores, cost_ms)
            panel.set_xscale("log")
            panel.set_yscale("log")
            panel.set_yticks([kind.samples for kind in kinds], [str(k.samples) for k in kinds])
            panel.minorticks_off()
            panel.set_xlim(first, last)
            panel.set_ylim(kinds[0].samples, kinds[-1].samples)
            panel.set_title(f"{cores} cores, path of {path_ms:g} ms", loc="left")
        row[0].set_ylabel("hypothetical observations M")
    for panel in panels[-1]:
        panel.set_xlabel("particles")
    words = (
        "more than 10 times slower",
        "2 to 10 times slower",
        "up to 2 times slower",
        "up to 2 times faster",
        "2 to 4 times faster",
        "more than 4 times faster",
    )
    handles: list[Patch | Line2D] = [
        Patch(facecolor=shade, edgecolor="#4A4F57", linewidth=0.5, label=word)
        for shade, word in zip(colors, words, strict=True)
    ]
    handles += [
        Patch(facecolor="none", edgecolor="#8A9099", hatch="////", label="extrapolated"),
        Line2D([], [], color="#B5342B", linewidth=2.2, marker="o", label="equally fast"),
        Line2D([], [], color="#B5342B", linewidth=1.0, linestyle="--", label="its bounds"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _over_samples(
    kinds: Sequence[Kind], rows: Sequence[FloatArray]
) -> Callable[[FloatArray], FloatArray]:
    """Return the times between numbers of samples, straight in logarithms."""
    at = np.log([kind.samples for kind in kinds])
    heights = np.log(np.array(rows))

    def times(samples: FloatArray) -> FloatArray:
        columns = [
            np.interp(np.log(samples), at, heights[:, column]) for column in range(heights.shape[1])
        ]
        return np.asarray(np.exp(np.array(columns).T))

    return times


def _draw_break_even(
    panel: Axes,
    kinds: Sequence[Kind],
    scalings: Mapping[Kind, Scaling],
    cores: int,
    cost_ms: float,
) -> None:
    lines = [line_of(scalings[kind], 1, cores, cost_ms) for kind in kinds]
    for which in ("value", "first", "last"):
        ends = [getattr(line, which).particles for line in lines]
        particles = [math.nan if end is None else end for end in ends]
        samples = [kind.samples for kind in kinds]
        if which == "value":
            panel.plot(particles, samples, "o-", color="#B5342B", linewidth=2.2, clip_on=False)
        else:
            panel.plot(particles, samples, "--", color="#B5342B", linewidth=1.0)


def break_even_lines(lines: pd.DataFrame) -> Figure:
    """Draw the break-even of all kinds of decisions, for a robot with one core."""
    lines = lines[(lines["robot_cores"] == 1) & lines["samples"].isin(SAMPLES_DRAWN)]
    ends = {kind_of(row): row["measured_to"] for row in lines.to_dict("records")}
    figure, (panel,) = plots.stacked_panels(
        [2 * len(ends)],
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
    panel.set_xlabel("particles at break-even, with bounds; grey: measured up to here")
    plots.legend_below(figure, panel, 4, frameon=False)
    return figure


def waiting(scalings: Mapping[Kind, Scaling], exchange_ms: float) -> Figure:
    """Draw what a robot waits for at each turn, if it waits for the decision and if not."""
    scaling = scalings[SHOWN]
    ways = [("waits for each decision", 0.0)]
    ways += [
        (f"decides ahead, {rate_hz:g} Hz", ahead_ms_of(rate_hz))
        for rate_hz in sorted(RATES_HZ, reverse=True)
    ]
    figure = plots.figure_of(9.2, 3.9, f"What a robot stands still for at each turn: {SHOWN.label}")
    (panels,) = _panels(figure, 1, len(ways))
    first, last = scaling.particles[0], scaling.particles[-1]
    numbers = np.geomspace(first, last, 400).clip(first, last)
    places = (
        (1, 0.0, "-", "robot: 1 core"),
        (8, PATHS_MS[0], "--", f"service: 8 cores, {PATHS_MS[0]:g} ms"),
        (36, PATHS_MS[1], "-.", f"service: 36 cores, {PATHS_MS[1]:g} ms"),
    )
    for panel, (way, ahead_ms) in zip(panels, ways, strict=True):
        for color, (cores, path_ms, style, label) in zip(
            ("#1A1D21", *plots.COLORS[1:]), places, strict=False
        ):
            cost_ms = path_ms + exchange_ms if cores > 1 else 0.0
            waits = cost_ms + np.maximum(scaling.on_cores(cores).at(numbers) - ahead_ms, 0.0)
            panel.plot(numbers, waits, style, color=color, linewidth=1.6, label=label)
        panel.set_xscale("log")
        panel.set_ylim(-6.0, 250.0)
        panel.grid()
        panel.set_title(way, loc="left")
        panel.set_xlabel("particles")
    panels[0].set_ylabel("waiting at each turn (ms)")
    plots.legend_below(figure, panels[0], 3, handlelength=3.2, frameon=False)
    return figure
