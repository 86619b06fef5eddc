"""The figures of the study of the thesis's chapter 6.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator

from holdfast.arrays import FloatArray
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
from holdfast.recording.figure import STYLE

__all__ = ["failbacks", "launches", "round_trips", "sensing_times", "successes"]

_THESIS = "#B5342B"
_MOST_DOTS = 250


class _Series(NamedTuple):
    """A value with its interval at each place, and single values behind it."""

    label: str
    color: str
    marker: str
    filled: bool = True
    offset: float = 0.0


def _panels(width: float, height: float, title: str, count: int, **options: object) -> list[Axes]:
    figure = figure_of(width, height, title)
    with mpl.rc_context(STYLE):
        made = figure.subplots(1, count, squeeze=False, **options)  # type: ignore[call-overload]
    return list(made[0])


def _figure(panels: Sequence[Axes]) -> Figure:
    figure = panels[0].figure
    assert isinstance(figure, Figure)
    return figure


def _widen(panel: Axes) -> None:
    """Let a logarithmic axis reach a little further than what is drawn."""
    low, high = panel.get_ylim()
    panel.set_ylim(low / 1.3, high * 1.3)


def _over_particles(panel: Axes) -> None:
    panel.set_xlabel("particles")
    panel.xaxis.set_major_locator(FixedLocator(list(PARTICLES)))
    panel.set_xlim(PARTICLES[0] - 60, PARTICLES[-1] + 60)


def _medians(
    panel: Axes, places: Sequence[float], intervals: Sequence[Interval], series: _Series
) -> None:
    """Draw medians with their intervals, joined by a thin line where there are several."""
    known = [number for number, each in enumerate(intervals) if math.isfinite(each.value)]
    if not known:
        return
    values = [intervals[number].value for number in known]
    at = [places[number] + series.offset for number in known]
    below = [_length(value - intervals[n].low) for value, n in zip(values, known, strict=True)]
    above = [_length(intervals[n].high - value) for value, n in zip(values, known, strict=True)]
    panel.errorbar(
        at,
        values,
        yerr=[below, above],
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
    panel.plot(at, values, color=series.color, linewidth=0.7, alpha=0.6, zorder=3)


def _length(value: float) -> float:
    """Return a bar's length; none, not even its caps, is drawn where there is no bound."""
    return max(0.0, value) if math.isfinite(value) else math.nan


def _dots(
    panel: Axes,
    place: float,
    values: FloatArray,
    color: str,
    spread: float,
    *,
    upright: bool = True,
) -> None:
    """Draw single values beside each other; of very many, some."""
    chance = np.random.default_rng(0)
    values = values[~np.isnan(values) & (values > 0.0)]
    if values.size > _MOST_DOTS:
        values = chance.choice(values, _MOST_DOTS, replace=False)
    places = place + spread * (chance.random(values.size) - 0.5)
    panel.scatter(
        places if upright else values,
        values if upright else places,
        s=7.0,
        color=color,
        alpha=0.3,
        linewidth=0,
        zorder=2,
        rasterized=True,
    )


def _thesis_line(panel: Axes, height: float, text: str, *, above: bool = True) -> None:
    panel.axhline(height, color=_THESIS, linewidth=1.1, linestyle=(0, (5, 2)), zorder=1.5)
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


# -- figures 9, 10 and 11 --------------------------------------------------------------------------


def sensing_times(rows: pd.DataFrame) -> Figure:
    """Draw how long it takes to choose a sensing action: in the cloud, locally, side by side."""
    panels = _panels(
        11.0, 4.3, "How long it takes to choose what to sense (Figures 9 to 11)", 3, sharey=True
    )
    in_cloud = select(rows, what="sensing", service="cloud")
    locally = select(rows, what="sensing", service="local")
    cloud = _Series("computing in the cloud service", COLORS[0], MARKERS[0])
    local = _Series("computing in the local service", COLORS[1], MARKERS[1])
    with mpl.rc_context(STYLE):
        for panel, chosen, series, title in (
            (panels[0], in_cloud, cloud, "Fig. 9: in the cloud service"),
            (panels[1], locally, local, "Fig. 10: in local recovery"),
        ):
            _of_particles(panel, chosen, "computed_ms", series, dots=True)
            panel.set_title(_with_count(title, len(chosen)), loc="left")
        for series, name, chosen in (
            (cloud._replace(offset=-6), "computed_ms", in_cloud),
            (local._replace(offset=6), "computed_ms", locally),
            (
                _Series("local, from question to answer", COLORS[1], MARKERS[1], False, 6),
                "round_trip_ms",
                locally,
            ),
            *(
                (
                    look._replace(
                        label=f"cloud, from question to answer: {path.label}",
                        filled=False,
                        offset=-6,
                    ),
                    "round_trip_ms",
                    select(in_cloud, path=path),
                )
                for path, look in _stream_looks(rows).items()
            ),
        ):
            _of_particles(panels[2], chosen, name, series)
        panels[2].set_title("Fig. 11: side by side, and with the way", loc="left")
        milliseconds(panels[0], "time for a sensing action (ms)")
        for panel in panels:
            _over_particles(panel)
            panel.grid(axis="y")
        legend_below(_figure(panels), panels[2], 3, fontsize=8.5)
    return _figure(panels)


def _stream_looks(rows: pd.DataFrame) -> dict[NetworkPath, _Series]:
    """Return how the paths without loss over streams look."""
    return {path: look for path, look in _path_looks(rows).items() if path.transport != "udp"}


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
            _dots(panel, count + series.offset, here[name].to_numpy(float), series.color, 30.0)
    _medians(panel, PARTICLES, intervals, series)


def _median(rows: pd.DataFrame, name: str) -> Interval:
    return median_interval(rows[name].to_numpy(float))


def _with_count(title: str, count: int) -> str:
    return f"{title} (n = {count:,})"


# -- figure 12 -------------------------------------------------------------------------------------


def round_trips(rows: pd.DataFrame) -> Figure:
    """Draw round trips without the computation: over particles, and over loss."""
    panels = _panels(
        10.5,
        4.6,
        "Round trip with the computation taken out; 20 and 87 ms are set, not measured (Figure 12)",
        2,
        sharey=True,
        width_ratios=(1.25, 1.0),
    )
    with mpl.rc_context(STYLE):
        _of_particles(
            panels[0],
            select(rows, service="local"),
            "trip_ms",
            _Series("local service", COLORS[1], MARKERS[1], offset=-9.0),
            dots=True,
        )
        looks = _path_looks(rows)
        for path, series in looks.items():
            chosen = select(rows, service="cloud", path=path)
            _of_particles(panels[0], chosen, "trip_ms", series, dots=path.round_trip_ms == 0.0)
        _thesis_line(
            panels[0],
            THESIS_CLOUD_ROUND_TRIP_MS,
            f"thesis: at least {THESIS_CLOUD_ROUND_TRIP_MS:g} ms to the cloud",
            above=False,
        )
        _thesis_line(
            panels[0],
            THESIS_LOCAL_ROUND_TRIP_MS,
            f"thesis: local, under {THESIS_LOCAL_ROUND_TRIP_MS:g} ms",
        )
        milliseconds(panels[0], "round trip without computing (ms)")
        _over_particles(panels[0])
        panels[0].set_title("Nothing lost: medians with 95 % intervals", loc="left")
        _draw_loss(panels[1], rows, looks)
        legend_below(_figure(panels), panels[0], 3, fontsize=8.5)
    return _figure(panels)


def _path_looks(rows: pd.DataFrame) -> dict[NetworkPath, _Series]:
    """Return how the cloud's paths without loss look."""
    looks = {}
    for path in paths_of(rows):
        if path.loss:
            continue
        far = path.round_trip_ms > 0.0
        color = 0 if not far else 3 if path.round_trip_ms < THESIS_CLOUD_ROUND_TRIP_MS else 4
        marker = "s" if not far else "^" if path.transport != "udp" else "v"
        offset = 9.0 if not far else -7.0 if path.transport != "udp" else 7.0
        filled = path.transport != "udp"
        label = f"cloud, {path.label}" + (" set" if far else "")
        looks[path] = _Series(label, COLORS[color], marker, filled, offset)
    return looks


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
        at = [place + shifted.offset for place in places]
        panel.plot(
            at,
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
    (panel,) = _panels(6.6, 4.2, "Trials in which the peg is inserted (Figure 13)", 1)
    with mpl.rc_context(STYLE):
        per_count = len(table) // len(PARTICLES)
        for part in range(per_count):
            rows = table.iloc[part::per_count].to_dict("records")
            trials = rows[0]["trials"]
            intervals = [interval_in(row, "success", 100.0) for row in rows]
            few = part == 0
            series = _Series(
                f"holdfast, {'the first ' if few else ''}{trials} trials",
                COLORS[1 if few else 0],
                MARKERS[1 if few else 0],
                filled=not few,
                offset=-8.0 if few else 8.0,
            )
            _medians(panel, PARTICLES, intervals, series)
        thesis = 100.0 * table["success_thesis"].to_numpy()[::per_count]
        for first, last in _levels(thesis):
            panel.plot(
                [PARTICLES[first] - 35, PARTICLES[last] + 35],
                [thesis[first], thesis[first]],
                color=_THESIS,
                linestyle=(0, (5, 2)),
                linewidth=1.4,
                label=f"thesis, {THESIS_TRIALS} trials, as its text has it" if first == 0 else None,
            )
        panel.set_ylim(0.0, 104.0)
        panel.set_ylabel("successes (%), with 95 % intervals (Wilson)")
        panel.grid(axis="y")
        _over_particles(panel)
        panel.legend(loc="lower right")
    return _figure([panel])


def _levels(heights: FloatArray) -> list[tuple[int, int]]:
    """Return where the heights are the same, as first and last place."""
    changes = [0, *(np.flatnonzero(np.diff(heights)) + 1).tolist(), len(heights)]
    return [(first, last - 1) for first, last in itertools.pairwise(changes)]


# -- figures 14 and 15 -----------------------------------------------------------------------------


def launches(rows: pd.DataFrame) -> Figure:
    """Draw how soon a loss is found, and how soon the local service decides then."""
    panels = _panels(
        10.5, 4.6, "From the cloud's death to local recovery (Figure 14)", 2, width_ratios=(1, 1.3)
    )
    kills = select(rows, what="kill")
    cold = kills[kills["launch_ms"].notna()]
    with mpl.rc_context(STYLE):
        for name, series in (
            (
                "launch_ms",
                _Series("local service: from its start until seen", COLORS[0], "s", False, -8.0),
            ),
            (
                "first_local_ms",
                _Series(
                    "from the cloud found dead until the local service decides",
                    COLORS[1],
                    "o",
                    True,
                    8.0,
                ),
            ),
        ):
            _of_particles(panels[0], cold, name, series, dots=True, median=_median)
        _thesis_line(
            panels[0], THESIS_LAUNCH_MS, f"thesis: under {THESIS_LAUNCH_MS:g} ms after its timeout"
        )
        milliseconds(panels[0], "time (ms)")
        _widen(panels[0])
        _over_particles(panels[0])
        panels[0].set_title(_with_count("The local service is launched", len(cold)), loc="left")
        legend_below(_figure(panels), panels[0], 2, fontsize=8.5)
        _over_paths(panels[1], kills, "found_ms")
        milliseconds(panels[1], "time from the kill until found (ms)", upright=False)
        _thesis_upright(
            panels[1], THESIS_TIMEOUT_MS, f"thesis: a timeout of {THESIS_TIMEOUT_MS / 1e3:g} s"
        )
        panels[1].set_xlim(right=1.8 * THESIS_TIMEOUT_MS)
        panels[1].set_title(_with_count("The cloud is found dead, by path", len(kills)), loc="left")
    return _figure(panels)


def failbacks(rows: pd.DataFrame) -> Figure:
    """Draw how soon a cloud that was started again is used."""
    panels = _panels(
        10.5, 4.6, "Back to the relaunched cloud (Figure 15)", 2, width_ratios=(1, 1.3)
    )
    kills = select(rows, what="kill").dropna(subset="failback_ms")
    with mpl.rc_context(STYLE):
        for path, look in _stream_looks(rows).items():
            _of_particles(
                panels[0],
                select(kills, path=path),
                "failback_ms",
                look._replace(label=path.label, offset=0.0),
                dots=True,
                median=_median,
            )
        _over_particles(panels[0])
        panels[0].set_title("By particles, over streams without loss", loc="left")
        legend_below(_figure(panels), panels[0], 3, fontsize=8.5)
        _over_paths(panels[1], kills, "failback_ms")
        panels[1].set_title(_with_count("By path", len(kills)), loc="left")
        what = "from its ready line until it decides (ms)"
        _thesis_line(panels[0], THESIS_FAILBACK_MS, "thesis: under 1 s")
        _thesis_upright(panels[1], THESIS_FAILBACK_MS, "thesis: under 1 s")
        milliseconds(panels[0], what)
        _widen(panels[0])
        milliseconds(panels[1], what, upright=False)
    return _figure(panels)


def _over_paths(panel: Axes, rows: pd.DataFrame, name: str) -> None:
    """Draw a row for each path: dots, median and interval."""
    paths = paths_of(rows)
    for number, path in enumerate(paths):
        here = select(rows, path=path)[name].to_numpy(float)
        datagrams = path.transport == "udp"
        color = COLORS[4] if datagrams else COLORS[0]
        _dots(panel, number, here, color, 0.5, upright=False)
        interval = median_interval(here)
        panel.errorbar(
            [interval.value],
            [number],
            xerr=[
                [_length(interval.value - interval.low)],
                [_length(interval.high - interval.value)],
            ],
            fmt="v" if datagrams else "s",
            color=color,
            markeredgecolor="white",
            markeredgewidth=0.7,
            markersize=6.0,
            elinewidth=1.4,
            capsize=2.5,
            zorder=4,
        )
    panel.set_yticks(range(len(paths)), [path.label for path in paths])
    panel.set_ylim(len(paths) - 0.4, -1.3)
    panel.tick_params(axis="y", length=0)


def _thesis_upright(panel: Axes, place: float, text: str) -> None:
    panel.axvline(place, color=_THESIS, linewidth=1.1, linestyle=(0, (5, 2)), zorder=1.5)
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
