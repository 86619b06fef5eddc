"""A problem as shapes for RViz and Foxglove: obstacles, goal, body and sensing action.

A marker here is plain data; :mod:`holdfast.reports.mcap_export` makes ``visualization_msgs`` of
it. The body's frame is the estimate (or the true pose), which moves, so the body is written once.
What a problem does not define is left out.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.geometry import BoxWorld
from holdfast.planning.belief import Belief, estimate
from holdfast.problems import checked
from holdfast.problems.attributes import sensing_labels, state_labels
from holdfast.problems.problem import Problem, Scene
from holdfast.reports.poses import POSE_COORDINATES, PoseLayout
from holdfast.reports.scene_drawing import body_corners

_AT_ORIGIN = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
_OBSTACLE = (0.79, 0.80, 0.82, 0.6)
_GOAL = (0.12, 0.54, 0.30, 0.9)
_ESTIMATE = (0.18, 0.43, 0.70, 1.0)
_TRUTH = (0.07, 0.07, 0.07, 1.0)
_SENSED = (0.91, 0.64, 0.09, 1.0)

_Place = TypeVar("_Place")

_THICKNESS = 0.02
_LINE = 0.004
_ARROW = 0.12
_TEXT = 0.03
"""By the size of the scene: how thick a flat obstacle is, a line, an arrow's half length, a text's
height."""

_PATH_GROWTH = 20
"""A path is shown anew when it is longer by this part of itself: all of them together take twenty
times its length, not the square of it."""

_ARC_POINTS = 25


class Marker(NamedTuple):
    """A shape, as ``visualization_msgs/Marker`` has it.

    ``kind`` is a constant of that message (``CUBE``, ``LINE_STRIP``, ...), ``pose`` a position and
    a quaternion (x, y, z, w). Lengths are in metres; colours are red, green, blue and opacity, 0 to
    1.
    """

    kind: str
    frame: str
    namespace: str
    pose: tuple[float, ...] = _AT_ORIGIN
    scale: tuple[float, float, float] = (1.0, 1.0, 1.0)
    color: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    points: tuple[tuple[float, ...], ...] = ()
    text: str = ""
    moves_with_frame: bool = False


class GrowingPath(Generic[_Place]):
    """The places of a trial so far; from ``most`` on every second, every fourth, ... is kept."""

    def __init__(self, most: float = math.inf) -> None:
        self.places: list[_Place] = []
        self._most = most
        self._count = 0
        self._every = 1
        self._next_length = 0

    def add(self, place: _Place, *, last: bool) -> bool:
        """Add a place, and return whether it is time to show the path."""
        if self._count % self._every == 0 or last:
            self.places.append(place)
        self._count += 1
        if len(self.places) > self._most:
            self.places = self.places[::2]
            self._every *= 2
            self._next_length = 0
        if len(self.places) < self._next_length and not last:
            return False
        self._next_length = len(self.places) + 1 + len(self.places) // _PATH_GROWTH
        return True


def scene_markers(
    problem: Problem,
    layout: PoseLayout,
    frame: str,
    estimate_frame: str | None,
    truth_frame: str | None,
) -> list[Marker]:
    """Return what does not change in a trial: obstacles, landmarks, goal and bodies.

    Its poses are in ``frame``; the body is at the origin of the two other frames.
    """
    scene: Scene | None = checked.scene(problem)
    axes = None if scene is None else _position_axes(scene, layout)
    if scene is None or axes is None:
        return []
    size = _size(scene)
    box = getattr(problem, "world", None)
    solid = isinstance(box, BoxWorld) and layout.indices[:3] == (0, 1, 2)
    # The obstacles as far as they are in the part that is to be shown, in a plane as flat boxes.
    x_min, y_min, x_max, y_max = scene.limits
    if solid and box is not None:
        lows = np.maximum(box.obstacles[:, :3], (x_min, x_min, y_min))
        highs = np.minimum(box.obstacles[:, 3:], (x_max, x_max, y_max))
        markers = _cuboids(zip(lows, highs, strict=True), frame)
    else:
        half = 0.5 * _THICKNESS * size
        corners = [
            (
                _in_space(np.maximum(obstacle[:2], (x_min, y_min)), axes, -half),
                _in_space(np.minimum(obstacle[2:], (x_max, y_max)), axes, half),
            )
            for obstacle in scene.obstacles
        ]
        markers = _cuboids(corners, frame)
    for name, places in (("landmark", scene.points), ("goal", scene.goal)):
        if places is None:
            continue
        for place in places.reshape(-1, 2):
            pose = (*_in_space(place, axes), 0.0, 0.0, 0.0, 1.0)
            diameter = (0.02 if name == "goal" else 0.012) * size
            markers.append(
                Marker("SPHERE", frame, name, pose, (diameter, diameter, diameter), _GOAL)
            )
    for body_frame, color in ((estimate_frame, _ESTIMATE), (truth_frame, _TRUTH)):
        if body_frame is None:
            continue
        if solid and box is not None:
            faded = (*color[:3], 0.45)
            markers.append(
                Marker("CUBE", body_frame, "body", scale=box.size, color=faded,
                       moves_with_frame=True)
            )  # fmt: skip
        elif len(body := body_corners(scene)):
            markers.append(
                Marker(
                    "LINE_STRIP",
                    body_frame,
                    f"body_{body_frame}",
                    scale=(_LINE * size, 0.0, 0.0),
                    color=color,
                    points=tuple(_in_space(corner, axes) for corner in (*body, body[0])),
                    moves_with_frame=True,
                )
            )
    return markers


def sensing_markers(
    problem: Problem, layout: PoseLayout, frame: str, belief: Belief, sensing_action: int
) -> list[Marker]:
    """Return what says which sensing action was chosen, at the middle of the belief.

    Its label always; and, if it is the name of a coordinate of the pose (``x`` of ``x (m)``), an
    arrow along that axis or an arc about it.
    """
    scene: Scene | None = checked.scene(problem)
    spread = np.sqrt(np.trace(layout.covariance(belief)[:3, :3]))
    size = _size(scene) if scene is not None else 10.0 * max(float(spread), 0.1)
    middle = layout.poses(estimate(belief))[:3]
    label = sensing_labels(problem)[sensing_action]
    word = _sensed_coordinate(problem, layout, label)
    reach = _ARROW * size
    # Of an arrow: the shaft's and the head's diameter, and the head's length.
    arrow = (0.01 * size, 0.025 * size, 0.03 * size)
    markers = []
    if word in ("x", "y", "z"):
        along = np.eye(3)[POSE_COORDINATES.index(word)] * reach
        markers.append(
            Marker("ARROW", frame, "sensed", scale=arrow, color=_SENSED,
                   points=(tuple(middle - along), tuple(middle + along)))
        )  # fmt: skip
    elif word is not None:
        turn = np.linspace(-0.75 * np.pi, 0.75 * np.pi, _ARC_POINTS)
        axis = POSE_COORDINATES.index(word) - 3
        arc = np.zeros((_ARC_POINTS, 3))
        arc[:, (axis + 1) % 3] = 0.5 * reach * np.cos(turn)
        arc[:, (axis + 2) % 3] = 0.5 * reach * np.sin(turn)
        markers.append(
            Marker("LINE_STRIP", frame, "sensed", scale=(2.0 * _LINE * size, 0.0, 0.0),
                   color=_SENSED, points=tuple(map(tuple, middle + arc)))
        )  # fmt: skip
    else:
        # In the place of the one before, which was of another kind perhaps.
        markers.append(
            Marker("SPHERE", frame, "sensed", (*middle, 0.0, 0.0, 0.0, 1.0), arrow[:1] * 3, _SENSED)
        )
    where = (*(middle + _up(layout) * 1.3 * reach), 0.0, 0.0, 0.0, 1.0)
    height = (0.0, 0.0, _TEXT * size)
    markers.append(
        Marker("TEXT_VIEW_FACING", frame, "label", where, height, _SENSED, text=f"sense {label}")
    )
    return markers


def _up(layout: PoseLayout) -> FloatArray:
    """Return the unit vector that points up on a screen: y in a plane, z in space."""
    return np.asarray(np.eye(3)[1 if layout.indices[2] is None else 2])


def _sensed_coordinate(problem: Problem, layout: PoseLayout, label: str) -> str | None:
    """Return which coordinate of the pose a sensing action is named after."""
    names = [each.split(" (")[0] for each in state_labels(problem)]
    if len(names) != problem.state_size or label not in names:
        return None
    index = names.index(label)
    return POSE_COORDINATES[layout.indices.index(index)] if index in layout.indices else None


def _position_axes(scene: Scene, layout: PoseLayout) -> tuple[int, int] | None:
    """Return which axes of space the scene's plane has; None if it is none of positions."""
    first, second = (
        layout.indices.index(axis) if axis in layout.indices else 6 for axis in scene.axes
    )
    return (first, second) if first < 3 and second < 3 else None


def _size(scene: Scene) -> float:
    x_min, y_min, x_max, y_max = scene.limits
    return float(max(x_max - x_min, y_max - y_min))


def _in_space(place: Any, axes: tuple[int, int], depth: float = 0.0) -> tuple[float, ...]:
    point = [depth, depth, depth]
    point[axes[0]], point[axes[1]] = float(place[0]), float(place[1])
    return tuple(point)


def _cuboids(corners: Iterable[tuple[Any, Any]], frame: str) -> list[Marker]:
    markers = []
    for low, high in corners:
        x, y, z = np.subtract(high, low)
        if min(x, y, z) > 0.0:
            place = (*(0.5 * np.add(low, high)), 0.0, 0.0, 0.0, 1.0)
            markers.append(Marker("CUBE", frame, "obstacle", place, (x, y, z), _OBSTACLE))
    return markers
