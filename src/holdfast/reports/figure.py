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
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from holdfast.config.loader import Configuration
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.outcome import Outcome
from holdfast.problems import checked
from holdfast.problems.attributes import choice_labels, circular_states, state_labels
from holdfast.problems.problem import Problem, Scene
from holdfast.reports.facts import SCORES
from holdfast.reports.recorder import TrialRecord
from holdfast.robot.trial import SensingStep
from holdfast.runtime.files import write_atomically

__all__ = ["STYLE", "trial_figure"]

_TRUE = "#111111"
_BELIEF = "#2F6DB3"
_OBSTACLE = "#C9CDD2"
_OBSTACLE_EDGE = "#8A9099"
_BODY = "#4A4F57"
_GOAL = "#1E8A4C"
_ESTIMATED: Any = {"color": _BELIEF, "linestyle": (0, (4, 1.5))}

# Ordered so that neighbours differ in lightness, too.
_ACTION_COLORS = ("#1D3C78", "#E8A317", "#B5342B", "#54B5A6", "#7D3C98", "#9AA05A")
_ACTION_MARKERS = ("o", "s", "^", "D", "v", "P")

_OUTCOMES: dict[Outcome, str] = {
    "succeeded": "goal reached",
    "failed": "failed",
    "truncated": "goal not reached",
}

_NUM_BODIES = 9
_NUM_CLOUDS = 4
_DISC_CORNERS = 48
_NARROWEST, _WIDEST = 1.0, 1.35
_HIGHEST_WORKSPACE = 8.0
_ROOM_FOR_A_MARK = 0.02
"""From its centre to the end of the drawn part, by the size of that."""

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
}


@in_own_mode
def trial_figure(configuration: Configuration, record: TrialRecord, path: Path) -> None:
    """Draw a trial and write the picture as PNG.

    Raises
    ------
    OutputError
        If it cannot be written.
    """
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
        figure.suptitle(_title(configuration, record), x=0.012, ha="left", fontsize=12.0)
        if scene:
            # A workspace as high as many panels would leave a gap between it and its legend.
            filled = min(height, _HIGHEST_WORKSPACE) / height
            grid = figure.add_gridspec(
                2, 2, width_ratios=(1.08, 1.0), height_ratios=(filled, max(1.0 - filled, 1e-3))
            )
            left, right = figure.add_subfigure(grid[0, 0]), figure.add_subfigure(grid[:, 1])
            _draw_workspace(left.subplots(), problem, scene, record)
            _draw_workspace_legend(left, problem, scene, record)
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
        figure.savefig(picture, format="png", dpi=_DOTS_PER_INCH)
    write_atomically(path, picture.getvalue())


def _title(configuration: Configuration, record: TrialRecord) -> str:
    text = f"{configuration.problem_name}, seed {configuration.simulator.seed}"
    result = record.result
    if result is not None:
        outcome = _OUTCOMES[result.outcome]
        text += (
            f", trial {result.trial}: {outcome} in {result.steps:,} steps, "
            f"{result.sensing_decisions:,} sensing actions"
        )
        if result.reward is not None:
            text += f", reward {result.reward:.4g}"
        shown = len(record.actions)
        if shown < result.steps:
            text += f" (the first {shown:,} steps)"
    return text


def _labels(problem: Problem) -> Sequence[str]:
    labels = state_labels(problem)
    if len(labels) == problem.state_size:
        return labels
    return [f"state[{index}]" for index in range(problem.state_size)]


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
    x_label, y_label = (_labels(problem)[axis] for axis in axes)
    panel.set_xlabel(x_label)
    panel.set_ylabel(y_label)
    for spine in panel.spines.values():
        spine.set_visible(True)

    _draw_obstacles(panel, scene)
    _draw_clouds(panel, record.sensing, axes)
    estimates = _stacked(record.estimates, problem.state_size)
    truth = _stacked(record.true_states, problem.state_size)
    way = truth if len(truth) else estimates
    outlines = _outlines(scene, way)
    x_min, y_min, x_max, y_max = _shown_part(scene, [estimates[:, axes], truth[:, axes], *outlines])
    panel.set_xlim(x_min, x_max)
    panel.set_ylim(y_min, y_max)
    _draw_bodies(panel, outlines)
    if len(estimates):
        panel.plot(*estimates[:, axes].T, **_ESTIMATED, linewidth=1.3)
    if len(truth):
        panel.plot(*truth[:, axes].T, color=_TRUE, linewidth=1.3)
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


def _shown_part(scene: Scene, points: Sequence[FloatArray]) -> FloatArray:
    """Return the part of the plane that has all marks and all that happened within the limits."""
    limits = _limits(scene)
    low, high = limits[:2], limits[2:]
    happened = np.concatenate([*points, _marks(scene)])
    if not len(happened):
        return limits
    margin = 0.12 * (happened.max(axis=0) - happened.min(axis=0)).max()
    lower = np.clip(happened.min(axis=0) - margin, low, high)
    upper = np.clip(happened.max(axis=0) + margin, low, high)
    # A flat part is made higher and a narrow one wider, to fill the space that there is.
    width, height = upper - lower
    for axis, missing in ((1, width / _WIDEST - height), (0, height * _NARROWEST - width)):
        if missing > 0.0:
            lower[axis] = max(lower[axis] - 0.5 * missing, low[axis])
            upper[axis] = min(upper[axis] + 0.5 * missing, high[axis])
    return np.concatenate([lower, upper]) if np.all(upper > lower) else limits


def _marks(scene: Scene) -> FloatArray:
    """Return the goal and the places of interest, shape ``(m, 2)``."""
    places = [each for each in (scene.goal, scene.points) if each is not None]
    return np.concatenate([np.empty((0, 2)), *(each.reshape(-1, 2) for each in places)])


def _limits(scene: Scene) -> FloatArray:
    """Return the scene's limits, made wider where a mark lies on them or beyond."""
    limits = np.array(scene.limits, dtype=np.float64)
    low, high = limits[:2], limits[2:]
    marks = _marks(scene)
    if len(marks):
        low, high = np.minimum(low, marks.min(axis=0)), np.maximum(high, marks.max(axis=0))
        room = _ROOM_FOR_A_MARK * (high - low).max()
        low = np.minimum(low, marks.min(axis=0) - room)
        high = np.maximum(high, marks.max(axis=0) + room)
    return np.concatenate([low, high])


def _draw_obstacles(panel: Axes, scene: Scene) -> None:
    # Cut to a little more than what is shown: some obstacles reach to the end of the world.
    x_min, y_min, x_max, y_max = _limits(scene)
    reach = 0.05 * max(x_max - x_min, y_max - y_min)
    low = np.array([x_min - reach, y_min - reach])
    high = np.array([x_max + reach, y_max + reach])
    lower = np.clip(scene.obstacles[:, :2], low, high)
    upper = np.clip(scene.obstacles[:, 2:], low, high)
    rectangles = [
        [(left, bottom), (right, bottom), (right, top), (left, top)]
        for (left, bottom), (right, top) in zip(lower, upper, strict=True)
        if right > left and top > bottom
    ]
    # The faces are drawn over the edges, so that touching rectangles look like one.
    for width, face in ((1.4, "none"), (0.0, _OBSTACLE)):
        drawn = PolyCollection(
            rectangles, facecolor=face, edgecolor=_OBSTACLE_EDGE, linewidth=width, zorder=1
        )
        panel.add_collection(drawn, autolim=False)


def _draw_clouds(panel: Axes, sensing: Sequence[SensingStep], axes: list[int]) -> None:
    """Draw the particles of a few beliefs, the older the paler."""
    if not sensing:
        return
    chosen = np.unique(np.linspace(0, len(sensing) - 1, _NUM_CLOUDS).round().astype(int))
    clouds: list[FloatArray] = [sensing[0].before.belief.states]
    clouds += [sensing[index].after.belief.states for index in chosen]
    for cloud, opacity in zip(clouds, np.linspace(0.3, 0.8, len(clouds)), strict=True):
        x, y = cloud[:, axes].T
        panel.scatter(x, y, s=9, color=_BELIEF, alpha=float(opacity), linewidth=0, zorder=2)


def _outlines(scene: Scene, way: FloatArray) -> list[FloatArray]:
    """Return the body's outlines at places spread evenly along the way, first and last included."""
    if scene.body is None or not len(way):
        return []
    body = np.asarray(scene.body, dtype=np.float64)
    if body.ndim == 0:
        turn = np.linspace(0.0, 2.0 * np.pi, _DISC_CORNERS, endpoint=False)
        body = body * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    places = way[:, list(scene.axes)]
    distance = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(places, axis=0).T))])
    wanted = np.linspace(0.0, distance[-1], _NUM_BODIES)
    indices = np.unique(np.append(np.searchsorted(distance, wanted[:-1]), len(way) - 1))
    return [_outline(body, scene, way[index]) for index in indices]


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


def _outline(body: FloatArray, scene: Scene, state: FloatArray) -> FloatArray:
    angle = 0.0 if scene.angle is None else float(state[scene.angle])
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = body.T
    turned = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)
    return np.asarray(turned + state[list(scene.axes)], dtype=np.float64)


def _draw_workspace_legend(
    figure: SubFigure, problem: Problem, scene: Scene, record: TrialRecord
) -> None:
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
    handles += _action_handles(problem, record)
    # Outside the axes, where the layout makes room for it however many rows it has. As many columns
    # as are not cut off.
    for columns in range(_MOST_COLUMNS, 0, -1):
        legend = figure.legend(
            handles=handles,
            loc="outside lower center",
            ncols=columns,
            columnspacing=1.6,
            handletextpad=0.6,
        )
        if columns == 1 or legend.get_window_extent().width <= _LEGEND_SHARE * figure.bbox.width:
            return
        legend.remove()


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


def _action_handles(problem: Problem, record: TrialRecord) -> list[Line2D]:
    """Return a legend's entries for the actions that are drawn: chosen, or with an entropy."""
    chosen = {sensing.sensing_action for sensing in record.sensing}
    compared = any(sensing.sensing_info.entropies is not None for sensing in record.sensing)
    handles = []
    for action, name in enumerate(_choices(problem, record)):
        if action in chosen:
            is_sensed = action < len(problem.sensing_actions)
            label = fill(f"sensed {name}", 30) if is_sensed else "did not sense"
            handles.append(_dot(*_style_of(action), label, size=5.5))
        elif compared:
            label = fill(f"{name}, never sensed", 30)
            handles.append(_dot(*_style_of(action), label, size=4.5, hollow=0.9))
    return handles


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
    for index, (panel, label) in enumerate(zip(panels, _labels(problem), strict=True)):
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
    if not all(sensing.observation_info.explained for sensing in record.sensing):
        handles.append(_dot(_TRUE, "x", "far from every particle", size=7.0, hollow=1.0))
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
    labels = _wrapped_choices(problem, record)
    size = 9.0 if max(map(len, labels), default=0) <= _LABEL_WIDTH else _SMALLEST
    panel.set_yticks(range(count), labels, fontsize=size)
    panel.set_ylim(count - 0.4, -0.6)
    panel.set_ylabel("sensed")


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
    panel.legend(
        handles=[
            _dot(_BODY, "o", "chosen", size=4.5),
            _dot(_BODY, "o", "not chosen (hollow)", size=3.5, hollow=0.7),
        ],
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=2,
        fontsize=_SMALLEST,
        borderpad=0.1,
        borderaxespad=0.1,
        columnspacing=1.2,
        handletextpad=0.3,
    )
    for action in range(entropies.shape[1]):
        color, marker = _style_of(action)
        won = chosen == action
        # The alternatives are hollow, so that the choice stands out.
        look: Any = {"facecolor": "white", "edgecolor": color, "marker": marker, "linewidth": 0.7}
        size = 0.6 * _marker_size(record)
        panel.scatter(steps[~won], entropies[~won, action], s=size, zorder=3, **look)
        _scatter_chosen(panel, steps[won], entropies[won, action], action, record)
