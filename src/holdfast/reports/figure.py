"""One trial in one picture: where the robot was, what it believed, and what it chose to sense.

On the left is the workspace, with the true and the estimated path, and the belief's particles at
some of the sensing steps. On the right is each coordinate of the state over the steps; below them,
which sensing action was chosen when, and the score of each alternative. Every sensing action has
its own colour and marker, so that a print in grey is legible as well.

This module imports matplotlib; import it only where a figure is wanted.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import MaxNLocator

from holdfast.config.loader import Configuration
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.problems import checked
from holdfast.problems.attributes import choice_labels, circular_states
from holdfast.problems.problem import Problem, Scene
from holdfast.reports.csv_export import state_labels
from holdfast.reports.facts import SCORES
from holdfast.reports.recorder import TrialRecord
from holdfast.reports.scene_drawing import obstacles_within, outline, shown_part, walls_at
from holdfast.robot.trial import SensingStep

_TRUE = "#111111"
_BELIEF = "#2F6DB3"
_OBSTACLE = "#C9CDD2"
_OBSTACLE_EDGE = "#8A9099"
_BODY = "#4A4F57"
_GOAL = "#1E8A4C"
_TARGET = "#C2571A"
_ESTIMATED: Any = {"color": _BELIEF, "linestyle": (0, (4, 1.5))}

# Ordered so that neighbours differ in lightness, too.
_ACTION_COLORS = ("#1D3C78", "#E8A317", "#B5342B", "#54B5A6", "#7D3C98", "#9AA05A")
_ACTION_MARKERS = ("o", "s", "^", "D", "v", "P")

_NUM_BODIES = 9
_NUM_CLOUDS = 4
_HIGHEST_WORKSPACE = 8.0
_MAX_MARKS = 120
"""With more sensing steps than this, marks on the paths would hide them; the strip has them all."""

_LABEL_WIDTH = 14
_WIDE_LABEL = 24
_FEW_CHOICES = 4
"""More of them have wider labels, for each line of theirs makes every row higher."""

_ROW = 0.15
"""Height of a line of a label, where a panel's is 1."""

_MOST_COLUMNS = 4
_LEGEND_SHARE = 0.98
"""Largest width of the legend, as a share of the figure's."""
_DOTS_PER_INCH = 150
_WIDTH = 11.0
_SMALLEST = 8.0
"""In points: 9 pixels high where the picture is 900 pixels wide."""

_OF_WINDOWS = ("backend", "backend_fallback", "interactive", "toolbar")

# Typed loosely: matplotlib's releases differ in how they type these keys. All of them, so that a
# figure is the same whatever the user's matplotlibrc says.
STYLE: Any = {
    **{key: value for key, value in mpl.rcParamsDefault.items() if key not in _OF_WINDOWS},
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.labelsize": 9.0,
    "axes.linewidth": 0.7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.color": "#E6E8EB",
    "grid.linewidth": 0.6,
    "xtick.major.width": 0.7,
    "ytick.major.width": 0.7,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "mathtext.default": "regular",
    "svg.hashsalt": "holdfast",
}


@in_own_mode
def trial_figure(configuration: Configuration, record: TrialRecord, kind: str = "png") -> bytes:
    """Draw a trial; return the picture as a file of this kind: ``png``, ``pdf`` or ``svg``."""
    problem = configuration.problem
    scene: Scene | None = checked.scene(problem)
    num_panels = problem.state_size + 2
    labels = _wrapped_choices(problem, record)
    rows = max(0.75, _ROW * max(label.count("\n") + 1 for label in labels) * len(labels))
    ratios = [1.0] * problem.state_size + [rows, 1.0]
    height = max(6.2, 1.12 * max(sum(ratios), num_panels) + 1.6)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(_WIDTH if scene else 8.0, height), layout="constrained")
        FigureCanvasAgg(figure)
        title = _title(configuration, record)
        figure.suptitle(title, x=0.012, ha="left", fontsize=12.0, wrap=True)
        if scene:
            # A workspace as high as many panels would leave a gap between it and its legend.
            filled = min(height, _HIGHEST_WORKSPACE) / height
            grid = figure.add_gridspec(
                2, 2, width_ratios=(1.08, 1.0), height_ratios=(filled, max(1.0 - filled, 1e-3))
            )
            left, right = figure.add_subfigure(grid[0, 0]), figure.add_subfigure(grid[:, 1])
            panel = left.subplots()
            _draw_workspace(panel, problem, scene, record)
            _draw_workspace_legend(panel, scene, record)
        else:
            right = figure.add_subfigure(figure.add_gridspec(1, 1)[0, 0])
        panels = right.subplots(num_panels, 1, sharex=True, height_ratios=ratios)
        _draw_coordinates(panels[: problem.state_size], problem, record)
        _draw_choices(panels[-2], problem, record)
        _draw_entropies(panels[-1], configuration, record)
        for panel in panels:
            panel.grid(visible=True)
            panel.margins(x=0.01)
        right.align_ylabels(list(panels))
        panels[-1].set_xlabel("step")
        panels[-1].xaxis.set_major_locator(MaxNLocator(integer=True))
        picture = io.BytesIO()
        # The same trial gives the same file, whenever it is drawn.
        undated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}}.get(kind)
        figure.savefig(picture, format=kind, dpi=_DOTS_PER_INCH, metadata=undated)
    return picture.getvalue()


def _title(configuration: Configuration, record: TrialRecord) -> str:
    text = f"{configuration.problem_name}, seed {configuration.simulator.seed}"
    result = record.result
    if result is not None:
        text += f", trial {result.trial} {result.in_words()}"
        shown = len(record.actions)
        if shown < result.steps:
            text += f" (the first {shown:,} steps)"
    return text


def _style_of(sensing_action: int) -> tuple[str, str]:
    return (
        _ACTION_COLORS[sensing_action % len(_ACTION_COLORS)],
        _ACTION_MARKERS[(sensing_action + sensing_action // 6) % len(_ACTION_MARKERS)],
    )


def _scatter_chosen(
    panel: Axes, x: npt.ArrayLike, y: npt.ArrayLike, sensing_action: int, record: TrialRecord
) -> None:
    """Mark where a sensing action was chosen."""
    color, marker = _style_of(sensing_action)
    look: Any = {"color": color, "marker": marker, "edgecolor": "white", "linewidth": 0.4}
    panel.scatter(x, y, s=_marker_size(record), zorder=4, **look)


def _marker_size(record: TrialRecord) -> float:
    """Return the area of a marker: smaller where there are many."""
    return float(np.clip(1800.0 / max(len(record.sensing), 1), 7.0, 26.0))


def _draw_workspace(panel: Axes, problem: Problem, scene: Scene, record: TrialRecord) -> None:
    axes = list(scene.axes)
    panel.set_aspect("equal", anchor="N")
    x_label, y_label = (state_labels(problem)[axis] for axis in axes)
    panel.set_xlabel(x_label)
    panel.set_ylabel(y_label)
    for spine in panel.spines.values():
        spine.set_visible(True)

    _draw_obstacles(panel, scene)
    for target in scene.targets:
        _draw_clouds(panel, record.sensing, target, _TARGET)
    _draw_clouds(panel, record.sensing, scene.axes, _BELIEF)
    estimates = _stacked(record.estimates, problem.state_size)
    truth = _stacked(record.true_states, problem.state_size)
    way = truth if len(truth) else estimates
    outlines = _outlines(scene, way)
    happened = [states[:, each] for states in (estimates, truth) for each in (axes, *scene.targets)]
    x_min, y_min, x_max, y_max = shown_part(scene, [*happened, *outlines])
    panel.set_xlim(x_min, x_max)
    panel.set_ylim(y_min, y_max)
    _draw_bodies(panel, outlines)
    for states, look in ((estimates, _ESTIMATED), (truth, {"color": _TRUE, "linestyle": "-"})):
        for wall in walls_at(scene, states[-1]) if len(states) else ():
            panel.add_patch(Polygon(_corners(wall), fill=False, linewidth=1.3, zorder=2, **look))
        for x, y in scene.targets if len(states) else ():
            panel.plot(*states[:, [x, y]].T, **{**look, "color": _TARGET}, linewidth=1.1)
            panel.plot(*states[-1, [x, y]], "h", color=_TARGET, markeredgecolor="white", zorder=5)
        if len(states):
            panel.plot(*states[:, axes].T, **look, linewidth=1.3)
    for sensing in record.sensing if len(record.sensing) <= _MAX_MARKS else ():
        x, y = way[sensing.before.step, axes]
        _scatter_chosen(panel, x, y, sensing.sensing_action, record)
    if scene.points is not None:
        x, y = scene.points.T
        panel.scatter(x, y, s=42, facecolor="white", edgecolor=_GOAL, zorder=3)
    if len(way):
        x, y = way[0, axes]
        panel.scatter(x, y, s=70, facecolor="white", edgecolor=_TRUE, zorder=5)
    if scene.goal is not None:
        x, y = scene.goal
        panel.scatter(x, y, s=150, marker="*", color=_GOAL, edgecolor="white", zorder=5)


def _draw_obstacles(panel: Axes, scene: Scene) -> None:
    rectangles = [_corners(each) for each in obstacles_within(scene)]
    # The faces are drawn over the edges, so that touching rectangles look like one.
    for width, face in ((1.4, "none"), (0.0, _OBSTACLE)):
        drawn = PolyCollection(
            rectangles, facecolor=face, edgecolor=_OBSTACLE_EDGE, linewidth=width, zorder=1
        )
        panel.add_collection(drawn, autolim=False)


def _draw_clouds(
    panel: Axes, sensing: Sequence[SensingStep], axes: tuple[int, int], color: str
) -> None:
    """Draw the particles of a few beliefs, the older the paler."""
    if not sensing:
        return
    chosen = np.unique(np.linspace(0, len(sensing) - 1, _NUM_CLOUDS).round().astype(int))
    clouds: list[FloatArray] = [sensing[0].before.belief.states]
    clouds += [sensing[index].after.belief.states for index in chosen]
    for cloud, opacity in zip(clouds, np.linspace(0.3, 0.8, len(clouds)), strict=True):
        x, y = cloud[:, list(axes)].T
        panel.scatter(x, y, s=9, color=color, alpha=float(opacity), linewidth=0, zorder=2)


def _outlines(scene: Scene, way: FloatArray) -> list[FloatArray]:
    """Return the body's outlines at places spread evenly along the way, first and last included."""
    if scene.body is None or not len(way):
        return []
    places = way[:, list(scene.axes)]
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
    wanted = np.linspace(0.0, distance[-1], _NUM_BODIES)
    indices = np.unique(np.append(np.searchsorted(distance, wanted[:-1]), len(way) - 1))
    return [outline(scene, way[index]) for index in indices]


def _draw_bodies(panel: Axes, outlines: Sequence[FloatArray]) -> None:
    """Draw the outlines, the earlier the paler, and the last one in bold."""
    opacities = np.linspace(0.3, 1.0, len(outlines))
    lines = LineCollection(
        [np.vstack([outline, outline[:1]]) for outline in outlines],
        colors=[to_rgba(_BODY, float(opacity)) for opacity in opacities],
        linewidths=[0.8] * (len(outlines) - 1) + [1.6],
        zorder=2.5,
    )
    panel.add_collection(lines, autolim=False)


def _corners(rectangle: FloatArray) -> list[tuple[float, float]]:
    left, bottom, right, top = rectangle.tolist()
    return [(left, bottom), (right, bottom), (right, top), (left, top)]


def _draw_workspace_legend(panel: Axes, scene: Scene, record: TrialRecord) -> None:
    handles: list[Line2D | Patch] = []
    # Without a true path, the estimated one has the start, the bodies and the marks.
    of_estimate = "" if record.true_states else ", estimated"
    if record.true_states:
        handles.append(Line2D([], [], color=_TRUE, label="true path"))
    handles += [
        Line2D([], [], **_ESTIMATED, label="estimated path"),
        _dot(_BELIEF, "o", "particles, older ones paler", size=3.5),
        _dot(_TRUE, "o", f"start{of_estimate}", hollow=1.0),
    ]
    if scene.goal is not None:
        handles.append(_dot(_GOAL, "*", "goal", size=11.0))
    if scene.points is not None:
        handles.append(_dot(_GOAL, "o", "landmark", hollow=1.0))
    if scene.body is not None:
        handles.append(Line2D([], [], color=_BODY, linewidth=0.9, label=f"body{of_estimate}"))
    if len(scene.obstacles):
        handles.append(Patch(facecolor=_OBSTACLE, edgecolor=_OBSTACLE_EDGE, label="obstacle"))
    if scene.targets:
        handles.append(_dot(_TARGET, "h", "target, and particles"))
    if scene.walls:
        handles.append(Patch(fill=False, **_ESTIMATED, label="wall, estimated at the end"))
    if record.sensing:
        handles.append(_dot(_style_of(0)[0], "o", "sensed; colours: rows on the right", size=5.5))
    # Right beneath the axes, however high these are; as many columns as are not cut off.
    for columns in range(_MOST_COLUMNS, 0, -1):
        legend = panel.legend(
            handles=handles,
            loc="upper center",
            bbox_to_anchor=(0.5, 0.0),
            borderaxespad=4.5,
            ncols=columns,
            columnspacing=1.6,
            handletextpad=0.6,
        )
        if legend.get_window_extent().width <= _LEGEND_SHARE * panel.figure.bbox.width:
            return


def _choices(problem: Problem, record: TrialRecord) -> list[str]:
    """Return the labels of the sensing actions, and of not to sense where that was a choice."""
    labels, count = choice_labels(problem), len(problem.sensing_actions)
    is_optional = any(
        sensing.sensing_action == count
        or (
            sensing.sensing_info.entropies is not None
            and len(sensing.sensing_info.entropies) > count
        )
        for sensing in record.sensing
    )
    return labels if is_optional else labels[:-1]


def _wrapped_choices(problem: Problem, record: TrialRecord) -> list[str]:
    """Return the labels of the choices in lines, as they stand at their rows."""
    choices = _choices(problem, record)
    width = _LABEL_WIDTH if len(choices) <= _FEW_CHOICES else _WIDE_LABEL
    return [fill(label, width) for label in choices]


def _dot(color: str, marker: str, label: str, *, size: float = 6.0, hollow: float = 0.0) -> Line2D:
    """Return a legend's entry for a marker; a hollow one has an edge of this width."""
    inside = "white" if hollow else color
    look: Any = {"markersize": size, "markerfacecolor": inside, "markeredgewidth": hollow}
    return Line2D([], [], color=color, marker=marker, linestyle="", label=label, **look)


def _stacked(rows: Sequence[FloatArray], width: int) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(len(rows), width)


def _draw_coordinates(
    panels: npt.NDArray[np.object_], problem: Problem, record: TrialRecord
) -> None:
    estimates = _stacked(record.estimates, problem.state_size)
    deviations = _stacked(record.standard_deviations, problem.state_size)
    truth = _stacked(record.true_states, problem.state_size)
    for index in circular_states(problem):
        _follow_turns(estimates[:, index], truth[:, index])
    steps = np.arange(len(estimates))
    for index, (panel, label) in enumerate(zip(panels, state_labels(problem), strict=True)):
        mean, two = estimates[:, index], 2.0 * deviations[:, index]
        panel.fill_between(steps, mean - two, mean + two, color=_BELIEF, alpha=0.22, linewidth=0)
        panel.plot(steps, mean, **_ESTIMATED, linewidth=1.1)
        if len(truth):
            panel.plot(np.arange(len(truth)), truth[:, index], color=_TRUE, linewidth=1.1)
        if len(record.sensing) <= _MAX_MARKS:
            _scatter_sensing(
                panel, record, [estimates[sensing.before.step, index] for sensing in record.sensing]
            )
        panel.set_ylabel(label)
        panel.yaxis.set_major_locator(MaxNLocator(nbins=4))
    handles: list[Line2D | Patch] = []
    if len(truth):
        handles.append(Line2D([], [], color=_TRUE, label="true"))
    handles += [
        Line2D([], [], **_ESTIMATED, label="estimate"),
        Patch(facecolor=_BELIEF, alpha=0.22, label="± 2 standard deviations"),
    ]
    above: Any = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": len(handles)}
    panels[0].legend(handles=handles, columnspacing=1.2, handletextpad=0.5, **above)


def _follow_turns(estimates: FloatArray, truth: FloatArray) -> None:
    """Make a heading a line without jumps, in place; an estimate is as near the truth as it is."""
    if len(truth):
        truth[:] = np.unwrap(truth)
        known = min(len(truth), len(estimates))
        difference = estimates[:known] - truth[:known]
        estimates[:known] = truth[:known] + numerics.wrapped(difference)
    else:
        estimates[:] = np.unwrap(estimates)


def _scatter_sensing(panel: Axes, record: TrialRecord, heights: Sequence[float]) -> None:
    """Mark the sensing steps, one call for each sensing action."""
    height = np.asarray(heights, dtype=np.float64)
    actions = np.array([sensing.sensing_action for sensing in record.sensing], dtype=int)
    steps = np.array([sensing.before.step for sensing in record.sensing], dtype=int)
    for action in np.unique(actions):
        chosen = actions == action
        _scatter_chosen(panel, steps[chosen], height[chosen], int(action), record)


def _draw_choices(panel: Axes, problem: Problem, record: TrialRecord) -> None:
    """Draw a row for each sensing action, with a mark where it was chosen."""
    choices = _choices(problem, record)
    count = len(choices)
    _scatter_sensing(panel, record, [float(sensing.sensing_action) for sensing in record.sensing])
    unexplained = [
        (sensing.before.step, float(sensing.sensing_action))
        for sensing in record.sensing
        if not sensing.observation_info.explained
    ]
    if unexplained:
        x, y = zip(*unexplained, strict=True)
        size = 3.0 * _marker_size(record)
        panel.scatter(x, y, s=size, marker="x", color=_TRUE, linewidth=0.9, zorder=5)
        _legend_above(panel, [_dot(_TRUE, "x", "far from every particle", hollow=1.0)])
    labels = _wrapped_choices(problem, record)
    size = 9.0 if max(map(len, labels), default=0) <= _LABEL_WIDTH else _SMALLEST
    panel.set_yticks(range(count), labels, fontsize=size)
    panel.tick_params(axis="y", length=0, pad=14)
    for action in range(count):
        # The rows are the legend of the colours, which needs none for what was never chosen.
        color, marker = _style_of(action)
        look: Any = {"color": color, "marker": marker, "clip_on": False, "markersize": 5.0}
        panel.plot(-0.022, action, transform=panel.get_yaxis_transform(), **look)
    panel.set_ylim(count - 0.4, -0.6)
    panel.set_ylabel("sensed")


def _legend_above(panel: Axes, handles: list[Line2D]) -> None:
    panel.legend(
        handles=handles,
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=len(handles),
        fontsize=_SMALLEST,
        borderpad=0.1,
        borderaxespad=0.1,
        columnspacing=1.2,
        handletextpad=0.3,
    )


def _draw_entropies(panel: Axes, configuration: Configuration, record: TrialRecord) -> None:
    """Draw every sensing action's score at each sensing step; the lowest was chosen."""
    panel.set_ylabel(SCORES.get(configuration.planning.selector.method, ""), fontsize=_SMALLEST)
    panel.yaxis.set_major_locator(MaxNLocator(nbins=4))
    known = [sensing for sensing in record.sensing if sensing.sensing_info.entropies is not None]
    if not known:
        panel.text(
            0.5, 0.5, "no entropies: the selector looks at no belief", ha="center", va="center",
            transform=panel.transAxes, color=_BODY,
        )  # fmt: skip
        panel.set_yticks([])
        return
    steps = np.array([sensing.before.step for sensing in known])
    entropies = np.array([sensing.sensing_info.entropies for sensing in known])
    chosen = np.array([sensing.sensing_action for sensing in known])
    panel.vlines(
        steps, entropies.min(axis=1), entropies.max(axis=1), color="#B4B9C0", linewidth=0.8
    )
    chosen_or_not = [
        _dot(_BODY, "o", "chosen", size=4.5),
        _dot(_BODY, "o", "not chosen (hollow)", size=3.5, hollow=0.7),
    ]
    _legend_above(panel, chosen_or_not)
    for action in range(entropies.shape[1]):
        color, marker = _style_of(action)
        won = chosen == action
        # The alternatives are hollow, so that the choice stands out.
        look: Any = {"facecolor": "white", "edgecolor": color, "marker": marker, "linewidth": 0.7}
        size = 0.6 * _marker_size(record)
        panel.scatter(steps[~won], entropies[~won, action], s=size, zorder=3, **look)
        _scatter_chosen(panel, steps[won], entropies[won, action], action, record)
