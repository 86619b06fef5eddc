"""The figures of the study of the thesis's chapter 6.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

from holdfast.lab.studies.plots import COLORS, MARKERS, figure_of, legend_below, milliseconds
from holdfast.lab.studies.statistics import Interval, interval_in, median_interval
from holdfast.lab.studies.thesis_measurements import (
    PARTICLES,
    THESIS_CLOUD_ROUND_TRIP_MS,
    THESIS_FAILBACK_MS,
    THESIS_LAUNCH_MS,
    THESIS_LOCAL_ROUND_TRIP_MS,
    THESIS_TIMEOUT_MS,
    THESIS_TRIALS,
    NetworkPath,
    clustered_median,
    paths_of,
    select,
)
from holdfast.numerics.arrays import FloatArray
from holdfast.recording.figure import STYLE

__all__ = ["failbacks", "launches", "round_trips", "sensing_times", "successes"]

_THESIS = "#B5342B"
_DASHED = (0, (5, 2))
_MOST_DOTS = 250


class _Series(NamedTuple):
    """The looks of a value with its interval at each place."""

    label: str
    color: str
    marker: str
    filled: bool = True
    offset: float = 0.0


def _panels(
    width: float, height: float, title: str, count: int, **options: Any
) -> tuple[Figure, list[Axes]]:
    figure = figure_of(width, height, title)
    with mpl.rc_context(STYLE):
        panels = figure.subplots(1, count, squeeze=False, **options)
    return figure, list(panels[0])


def _widen(panel: Axes) -> None:
    """Let a logarithmic axis reach a little further than what is drawn."""
    low, high = panel.get_ylim()
    panel.set_ylim(low / 1.3, high * 1.3)


def _over_particles(panels: Iterable[Axes]) -> None:
    for panel in panels:
        panel.set_xlabel("particles")
        panel.xaxis.set_major_locator(FixedLocator(list(PARTICLES)))
        panel.set_xlim(PARTICLES[0] - 60, PARTICLES[-1] + 60)


def _medians(
    panel: Axes,
    places: Sequence[float],
    intervals: Sequence[Interval],
    series: _Series,
    *,
    upright: bool = True,
) -> None:
    """Draw medians with their intervals, joined by a thin line where there are several."""
    known = [
        (place + series.offset, interval)
        for place, interval in zip(places, intervals, strict=True)
        if math.isfinite(interval.value)
    ]
    if not known:
        return
    at = [place for place, _ in known]
    values = [interval.value for _, interval in known]
    errors = [
        [_length(interval.value - interval.low) for _, interval in known],
        [_length(interval.high - interval.value) for _, interval in known],
    ]
    panel.errorbar(
        at if upright else values,
        values if upright else at,
        yerr=errors if upright else None,
        xerr=None if upright else errors,
        fmt=series.marker,
        color=series.color,
        markerfacecolor=series.color if series.filled else "white",
        markeredgecolor="white" if series.filled else series.color,
        markeredgewidth=0.7 if series.filled else 1.1,
        markersize=6.0,
        elinewidth=1.2,
        capsize=2.5,
        zorder=4,
        label=series.label,
    )
    if upright:
        panel.plot(at, values, color=series.color, linewidth=0.7, alpha=0.6, zorder=3)


def _length(value: float) -> float:
    """Return a bar's length; none, not even its caps, is drawn where there is no bound."""
    return max(0.0, value) if math.isfinite(value) else math.nan


def _dots(
    panel: Axes, place: float, values: pd.Series, color: str, spread: float, *, upright: bool = True
) -> None:
    """Draw single values beside each other; of very many, some."""
    chance = np.random.default_rng(0)
    some = values[values > 0.0].to_numpy(float)
    if some.size > _MOST_DOTS:
        some = chance.choice(some, _MOST_DOTS, replace=False)
    places = place + spread * (chance.random(some.size) - 0.5)
    panel.scatter(
        places if upright else some,
        some if upright else places,
        s=7.0,
        color=color,
        alpha=0.3,
        linewidth=0,
        zorder=2,
        rasterized=True,
    )


def _thesis_line(panel: Axes, height: float, text: str, *, above: bool = True) -> None:
    panel.axhline(height, color=_THESIS, linewidth=1.1, linestyle=_DASHED, zorder=1.5)
    panel.annotate(
        text,
        (0.99, height),
        xycoords=("axes fraction", "data"),
        xytext=(0, 2.5 if above else -2.5),
        textcoords="offset points",
        ha="right",
        va="bottom" if above else "top",
        color=_THESIS,
        fontsize=8.0,
    )


def _upright_thesis_line(panel: Axes, place: float, text: str) -> None:
    panel.axvline(place, color=_THESIS, linewidth=1.1, linestyle=_DASHED, zorder=1.5)
    panel.annotate(
        text,
        (place, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(-3, -2),
        textcoords="offset points",
        ha="right",
        va="top",
        color=_THESIS,
        fontsize=8.0,
    )


def _of_particles(
    panel: Axes,
    rows: pd.DataFrame,
    name: str,
    series: _Series,
    *,
    dots: bool = False,
    median: Callable[[pd.DataFrame, str], Interval] = clustered_median,
) -> None:
    intervals = []
    for count in PARTICLES:
        here = select(rows, particles=count)
        intervals.append(median(here, name))
        if dots:
            _dots(panel, count + series.offset, here[name], series.color, 30.0)
    _medians(panel, PARTICLES, intervals, series)


def _median(rows: pd.DataFrame, name: str) -> Interval:
    return median_interval(rows[name])


def _title(panel: Axes, title: str, rows: pd.DataFrame) -> None:
    panel.set_title(f"{title} (n = {len(rows):,})", loc="left")


def _path_looks(rows: pd.DataFrame) -> dict[NetworkPath, _Series]:
    """Return how the cloud's paths without loss look."""
    looks = {}
    for path in paths_of(rows):
        if path.loss == 0.0:
            label = f"cloud, {path.label}"
            if path.round_trip_ms == 0.0:
                looks[path] = _Series(label, COLORS[0], "s", offset=9.0)
                continue
            datagrams = path.transport == "udp"
            color = COLORS[3 if path.round_trip_ms < THESIS_CLOUD_ROUND_TRIP_MS else 4]
            marker, offset = ("v", 7.0) if datagrams else ("^", -7.0)
            looks[path] = _Series(f"{label} set", color, marker, not datagrams, offset)
    return looks


def _stream_looks(rows: pd.DataFrame) -> dict[NetworkPath, _Series]:
    """Return how the paths without loss over streams look."""
    return {path: look for path, look in _path_looks(rows).items() if path.transport != "udp"}


# -- figures 9, 10 and 11 --------------------------------------------------------------------------


def sensing_times(rows: pd.DataFrame) -> Figure:
    """Draw how long it takes to choose a sensing action: in the cloud, locally, side by side."""
    figure, panels = _panels(
        11.0, 4.3, "How long it takes to choose what to sense (Figures 9 to 11)", 3, sharey=True
    )
    in_cloud = select(rows, what="sensing", service="cloud")
    locally = select(rows, what="sensing", service="local")
    cloud = _Series("computing in the cloud service", COLORS[0], MARKERS[0])
    local = _Series("computing in the local service", COLORS[1], MARKERS[1])
    answered = _Series("local, from question to answer", COLORS[1], MARKERS[1], False, 6)
    with mpl.rc_context(STYLE):
        _of_particles(panels[0], in_cloud, "computed_ms", cloud, dots=True)
        _title(panels[0], "Fig. 9: in the cloud service", in_cloud)
        _of_particles(panels[1], locally, "computed_ms", local, dots=True)
        _title(panels[1], "Fig. 10: in local recovery", locally)
        _of_particles(panels[2], in_cloud, "computed_ms", cloud._replace(offset=-6))
        _of_particles(panels[2], locally, "computed_ms", local._replace(offset=6))
        _of_particles(panels[2], locally, "round_trip_ms", answered)
        for path, look in _stream_looks(rows).items():
            label = f"cloud, from question to answer: {path.label}"
            look = look._replace(label=label, filled=False, offset=-6)
            _of_particles(panels[2], select(in_cloud, path=path), "round_trip_ms", look)
        panels[2].set_title("Fig. 11: side by side, and with the way", loc="left")
        milliseconds(panels[0], "time for a sensing action (ms)")
        _over_particles(panels)
        for panel in panels:
            panel.grid(axis="y")
        legend_below(figure, panels[2], 3, fontsize=8.5)
    return figure


# -- figure 12 -------------------------------------------------------------------------------------


def round_trips(rows: pd.DataFrame) -> Figure:
    """Draw round trips without the computation: over particles, and over loss."""
    figure, (panel, over_loss) = _panels(
        10.5,
        4.6,
        "Round trip with the computation taken out; 20 and 87 ms are set, not measured (Figure 12)",
        2,
        sharey=True,
        width_ratios=(1.25, 1.0),
    )
    with mpl.rc_context(STYLE):
        local = _Series("local service", COLORS[1], MARKERS[1], offset=-9.0)
        _of_particles(panel, select(rows, service="local"), "trip_ms", local, dots=True)
        looks = _path_looks(rows)
        for path, series in looks.items():
            chosen = select(rows, service="cloud", path=path)
            _of_particles(panel, chosen, "trip_ms", series, dots=path.round_trip_ms == 0.0)
        far, near = THESIS_CLOUD_ROUND_TRIP_MS, THESIS_LOCAL_ROUND_TRIP_MS
        _thesis_line(panel, far, f"thesis: at least {far:g} ms to the cloud", above=False)
        _thesis_line(panel, near, f"thesis: local, under {near:g} ms")
        milliseconds(panel, "round trip without computing (ms)")
        _over_particles([panel])
        panel.set_title("Nothing lost: medians with 95 % intervals", loc="left")
        _draw_loss(over_loss, rows, looks)
        legend_below(figure, panel, 3, fontsize=8.5)
    return figure


def _draw_loss(panel: Axes, rows: pd.DataFrame, looks: dict[NetworkPath, _Series]) -> None:
    """Draw medians and 95th percentiles over the share of packets that are lost."""
    losses = sorted({path.loss for path in paths_of(rows)})
    for path, series in looks.items():
        if path.round_trip_ms == 0.0:
            continue
        places, medians, tails = [], [], []
        for number, loss in enumerate(losses):
            chosen = select(rows, service="cloud", what="task", path=path._replace(loss=loss))
            if len(chosen):
                places.append(float(number))
                medians.append(clustered_median(chosen, "trip_ms"))
                tails.append(float(np.percentile(chosen["trip_ms"], 95.0)))
        shifted = series._replace(offset=series.offset / 90.0)
        _medians(panel, places, medians, shifted)
        panel.plot(
            [place + shifted.offset for place in places],
            tails,
            linestyle=(0, (1, 1.5)),
            color=series.color,
            marker=series.marker,
            markersize=4.0,
            markerfacecolor=series.color if series.filled else "white",
        )
    panel.set_xlim(-0.4, len(losses) - 0.6)
    panel.set_xticks(range(len(losses)), [f"{100.0 * loss:g}" for loss in losses])
    panel.set_xlabel("packets lost, each way (%)")
    panel.grid(axis="y")
    panel.set_title("With loss: medians; dotted, 95th percentiles", loc="left")


# -- figure 13 -------------------------------------------------------------------------------------


def successes(table: pd.DataFrame) -> Figure:
    """Draw how many trials reach the goal."""
    figure, (panel,) = _panels(6.6, 4.2, "Trials in which the peg is inserted (Figure 13)", 1)
    few = _Series("holdfast, the first {} trials", COLORS[1], MARKERS[1], False, -8.0)
    every = _Series("holdfast, {} trials", COLORS[0], MARKERS[0], True, 8.0)
    with mpl.rc_context(STYLE):
        for part, series in enumerate((few, every)):
            rows = table.iloc[part::2].to_dict("records")
            label = series.label.format(rows[0]["trials"])
            intervals = [interval_in(row, "success", 100.0) for row in rows]
            _medians(panel, PARTICLES, intervals, series._replace(label=label))
        thesis = 100.0 * table["success_thesis"].to_numpy()[::2]
        for first, last in _levels(thesis):
            panel.plot(
                [PARTICLES[first] - 35, PARTICLES[last] + 35],
                [thesis[first], thesis[first]],
                color=_THESIS,
                linestyle=_DASHED,
                linewidth=1.4,
                label=f"thesis, {THESIS_TRIALS} trials, as its text has it" if first == 0 else None,
            )
        panel.set_ylim(0.0, 104.0)
        panel.set_ylabel("successes (%), with 95 % intervals (Wilson)")
        panel.grid(axis="y")
        _over_particles([panel])
        panel.legend(loc="lower right")
    return figure


def _levels(heights: FloatArray) -> list[tuple[int, int]]:
    """Return where the heights are the same, as first and last place."""
    changes = [0, *(np.flatnonzero(np.diff(heights)) + 1).tolist(), len(heights)]
    return [(first, last - 1) for first, last in itertools.pairwise(changes)]


# -- figures 14 and 15 -----------------------------------------------------------------------------


def launches(rows: pd.DataFrame) -> Figure:
    """Draw how soon a loss is found, and how soon the local service decides then."""
    figure, (panel, by_path) = _panels(
        10.5, 4.6, "From the cloud's death to local recovery (Figure 14)", 2, width_ratios=(1, 1.3)
    )
    kills = select(rows, what="kill")
    cold = kills[kills["launch_ms"].notna()]
    seen = _Series("local service: from its start until seen", COLORS[0], "s", False, -8.0)
    label = "from the cloud found dead until the local service decides"
    decides = _Series(label, COLORS[1], "o", True, 8.0)
    with mpl.rc_context(STYLE):
        _of_particles(panel, cold, "launch_ms", seen, dots=True, median=_median)
        _of_particles(panel, cold, "first_local_ms", decides, dots=True, median=_median)
        limit_ms = THESIS_LAUNCH_MS
        _thesis_line(panel, limit_ms, f"thesis: under {limit_ms:g} ms after its timeout")
        milliseconds(panel, "time (ms)")
        _widen(panel)
        _over_particles([panel])
        _title(panel, "The local service is launched", cold)
        legend_below(figure, panel, 2, fontsize=8.5)
        _over_paths(by_path, kills, "found_ms")
        milliseconds(by_path, "time from the kill until found (ms)", upright=False)
        timeout_ms = THESIS_TIMEOUT_MS
        _upright_thesis_line(by_path, timeout_ms, f"thesis: a timeout of {timeout_ms / 1e3:g} s")
        by_path.set_xlim(right=1.8 * timeout_ms)
        _title(by_path, "The cloud is found dead, by path", kills)
    return figure


def failbacks(rows: pd.DataFrame) -> Figure:
    """Draw how soon a cloud that was started again is used."""
    figure, (panel, by_path) = _panels(
        10.5, 4.6, "Back to the relaunched cloud (Figure 15)", 2, width_ratios=(1, 1.3)
    )
    kills = select(rows, what="kill").dropna(subset="failback_ms")
    what = "from its ready line until it decides (ms)"
    with mpl.rc_context(STYLE):
        for path, look in _stream_looks(rows).items():
            look = look._replace(label=path.label, offset=0.0)
            chosen = select(kills, path=path)
            _of_particles(panel, chosen, "failback_ms", look, dots=True, median=_median)
        _over_particles([panel])
        panel.set_title("By particles, over streams without loss", loc="left")
        legend_below(figure, panel, 3, fontsize=8.5)
        _thesis_line(panel, THESIS_FAILBACK_MS, "thesis: under 1 s")
        milliseconds(panel, what)
        _widen(panel)
        _over_paths(by_path, kills, "failback_ms")
        _title(by_path, "By path", kills)
        _upright_thesis_line(by_path, THESIS_FAILBACK_MS, "thesis: under 1 s")
        milliseconds(by_path, what, upright=False)
    return figure


def _over_paths(panel: Axes, rows: pd.DataFrame, name: str) -> None:
    """Draw a row for each path: dots, median and interval."""
    paths = paths_of(rows)
    for number, path in enumerate(paths):
        here = select(rows, path=path)[name]
        color, marker = (COLORS[4], "v") if path.transport == "udp" else (COLORS[0], "s")
        _dots(panel, number, here, color, 0.5, upright=False)
        series = _Series(path.label, color, marker)
        _medians(panel, [number], [median_interval(here)], series, upright=False)
    panel.set_yticks(range(len(paths)), [path.label for path in paths])
    panel.set_ylim(len(paths) - 0.4, -1.3)
    panel.tick_params(axis="y", length=0)
