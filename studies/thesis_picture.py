"""The picture of a run in which the cloud service dies and comes back.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeAlias

import matplotlib as mpl
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D

from holdfast.numerics.arrays import FloatArray
from holdfast.reports.figure import STYLE
from studies.plots import COLORS, MARKERS, figure_of, milliseconds

_STATUS_LOOKS = {
    "standard": ("#E9F1FA", "standard:\nthe cloud decides"),
    "local_recovery": ("#F5D79E", "local recovery:\nthe robot's own service decides"),
    "keep_alive": ("#E7F4EA", "keep alive: the cloud again,\nthe local service stays ready"),
}
_KILLED, _STARTED = "#B5342B", "#1E8A4C"

_Kill: TypeAlias = Mapping[str, float]
"""The times of the kill, without those that are not known; none if nothing was killed."""


def cloud_dies(table: pd.DataFrame) -> Figure:
    """Draw one run in which the cloud dies and comes back.

    Parameters
    ----------
    table : DataFrame
        Of the task kind ``cloud_trials``, of one run, with its actions.
    """
    rows = table.loc[table["what"] == "kill", ["at_s", "found_ms", "away_ms"]]
    kill: _Kill = {} if rows.empty else rows.iloc[0].dropna().astype(float).to_dict()
    bands = _status_bands(table, kill)
    verdict = "and no decision changes" if table["identical"].all() else "BUT DECISIONS CHANGE"
    figure = figure_of(9.6, 5.6, f"The cloud dies, the robot goes on, {verdict}")
    with mpl.rc_context(STYLE):
        motion, answers = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 1.15))
        for begin, end, status in bands:
            color, words = _STATUS_LOOKS[status]
            for panel in (motion, answers):
                panel.axvspan(begin, end, color=color, linewidth=0, zorder=0)
            if end - begin > 0.12 * (bands[-1][1] - bands[0][0]):
                _note(motion, words, (0.5 * (begin + end), 1.0), (0, 4), "center", "bottom", _TOP)
        _draw_motion(motion, table["at_s"][table["what"] == "action"].to_numpy(float))
        _draw_answers(answers, table)
        _draw_moments((motion, answers), kill)
        answers.set_xlabel("time since the robot's first decision (s)")
        answers.set_xlim(bands[0][0], bands[-1][1])
        figure.align_ylabels()
    return figure


_TOP = ("data", "axes fraction")


def _note(
    panel: Axes,
    text: str,
    place: tuple[float, float],
    offset: tuple[float, float],
    across: str,
    up: str,
    coordinates: Any = "data",
    **looks: Any,
) -> None:
    panel.annotate(
        text,
        place,
        offset,
        coordinates,
        "offset points",
        ha=across,
        va=up,
        fontsize=8.5,
        **looks,
    )


def _status_bands(table: pd.DataFrame, kill: _Kill) -> list[tuple[float, float, str]]:
    """Return from when until when the robot had which status.

    A decision says which it had then; local recovery begins when the robot says that it has lost
    the cloud, before the first decision of the local service.
    """
    known = table[table["status"].notna()]
    statuses = list(zip(known["at_s"], known["status"], strict=True))
    if "found_ms" in kill:
        statuses.append((kill["at_s"] + 1e-3 * kill["found_ms"], "local_recovery"))
    end_s = float(np.nanmax(table["at_s"].to_numpy(float)))
    bands: list[tuple[float, float, str]] = []
    for at_s, status in sorted(statuses):
        if bands and bands[-1][2] == status:
            continue
        if bands:
            bands[-1] = (bands[-1][0], at_s, bands[-1][2])
        bands.append((at_s, end_s, status))
    return bands


def _draw_motion(panel: Axes, moments: FloatArray) -> None:
    ordered = np.sort(moments)
    done = np.arange(1, ordered.size + 1)
    panel.step(ordered, done, where="post", color="#111111", linewidth=1.8)
    panel.set_ylim(0.0, 1.12 * ordered.size)
    panel.set_ylabel("task actions performed")
    pauses = np.diff(ordered)
    if pauses.size:
        longest = int(pauses.argmax())
        early = longest < 0.5 * ordered.size
        text = f"the longest time between two actions: {1e3 * pauses[longest]:.0f} ms"
        place = float(ordered[longest + 1]), float(done[longest])
        looks = {"arrowstyle": "-", "linewidth": 0.8, "color": "#4A4F57"}
        if early:
            _note(panel, text, place, (30, -4), "left", "top", arrowprops=looks)
        else:
            _note(panel, text, place, (-30, 4), "right", "bottom", arrowprops=looks)


def _draw_answers(panel: Axes, table: pd.DataFrame) -> None:
    """Draw how long each answer took, and from whom it came."""
    what = table["what"].to_numpy(object)
    service = table["service"].to_numpy(object)
    at_s, took_ms = table["at_s"].to_numpy(float), table["round_trip_ms"].to_numpy(float)
    for name, number, text in (
        ("cloud", 0, "the cloud answers"),
        ("local", 1, "the robot's own service answers"),
    ):
        for kind, filled in (("task", False), ("sensing", True)):
            chosen = (what == kind) & (service == name)
            panel.scatter(
                at_s[chosen],
                took_ms[chosen],
                s=26.0,
                marker=MARKERS[number],
                facecolor=COLORS[number] if filled else "white",
                edgecolor=COLORS[number],
                linewidth=1.0,
                zorder=4,
            )
        chosen = (service == name) & np.isfinite(took_ms)
        if chosen.any():
            first = float(at_s[chosen].min())
            below = name == "cloud"
            height = took_ms[chosen].min() if below else took_ms[chosen].max()
            _note(
                panel,
                text,
                (first, float(height)),
                (4, -8 if below else 8),
                "left",
                "top" if below else "bottom",
                color=COLORS[number] if below else "#8A5A00",
                bbox={"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 1.0},
                zorder=5,
            )
    milliseconds(panel, "from question to answer (ms)")
    low, high = panel.get_ylim()
    panel.set_ylim(low / 1.6, high * 1.6)
    handles = {
        label: tuple(
            Line2D([], [], marker=MARKERS[at], linestyle="", color=COLORS[at], markerfacecolor=face)
            for at, face in enumerate(faces)
        )
        for label, faces in (
            ("what to sense", COLORS[:2]),
            ("what to do until then", ("white", "white")),
        )
    }
    panel.legend(
        list(handles.values()),
        list(handles),
        loc="lower right",
        handler_map={tuple: HandlerTuple(None)},
        markerscale=0.8,
        fontsize=8.5,
    )


def _draw_moments(panels: Sequence[Axes], kill: _Kill) -> None:
    """Mark when the cloud is killed, and when it listens again."""
    if not kill:
        return
    killed_s = kill["at_s"]
    moments = [(killed_s, "the cloud's process\nis killed (SIGKILL)", _KILLED, "X", "left")]
    if "away_ms" in kill:
        back_s = killed_s + 1e-3 * kill["away_ms"]
        moments.append((back_s, "it was started\nagain and listens", _STARTED, "^", "right"))
    for at_s, text, color, marker, side in moments:
        for panel in panels:
            panel.axvline(at_s, color=color, linewidth=1.2, zorder=2)
            panel.plot(
                [at_s],
                [0.0],
                marker=marker,
                color=color,
                markersize=9.0,
                clip_on=False,
                zorder=6,
                transform=panel.get_xaxis_transform(),
            )
        across, aside = ("right", -5) if side == "left" else ("left", 5)
        _note(panels[0], text, (at_s, 0.97), (aside, 0), across, "top", _TOP, color=color)
