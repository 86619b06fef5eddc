"""What a drawing of a scene consists of, whatever draws it: its part, obstacles and outlines.

A :class:`~holdfast.problems.problem.Scene` says what there is in a plane. Here is what of it to
show, in plain numbers, for figures (matplotlib) and reports (Vega-Lite).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from holdfast.numerics.arrays import FloatArray
from holdfast.problems.problem import Scene

NARROWEST, WIDEST = 1.0, 1.35
"""Least and largest width of what is shown, by its height."""

_ROOM_FOR_A_MARK = 0.02
"""From its centre to the end of the drawn part, by the size of that."""

_DISC_CORNERS = 48


def shown_part(scene: Scene, points: Sequence[FloatArray]) -> FloatArray:
    """Return the part of the plane that has all marks and all that happened within the limits."""
    limits = limits_of(scene)
    low, high = limits[:2], limits[2:]
    happened = np.concatenate([*points, _marks(scene)])
    if not len(happened):
        return limits
    margin = 0.12 * (happened.max(axis=0) - happened.min(axis=0)).max()
    lower = np.clip(happened.min(axis=0) - margin, low, high)
    upper = np.clip(happened.max(axis=0) + margin, low, high)
    # A flat part is made higher and a narrow one wider, to fill the space that there is.
    width, height = upper - lower
    for axis, missing in ((1, width / WIDEST - height), (0, height * NARROWEST - width)):
        if missing > 0.0:
            lower[axis] = max(lower[axis] - 0.5 * missing, low[axis])
            upper[axis] = min(upper[axis] + 0.5 * missing, high[axis])
    return np.concatenate([lower, upper]) if np.all(upper > lower) else limits


def _marks(scene: Scene) -> FloatArray:
    """Return the goal and the places of interest, shape ``(m, 2)``."""
    places = [each for each in (scene.goal, scene.points) if each is not None]
    return np.concatenate([np.empty((0, 2)), *(each.reshape(-1, 2) for each in places)])


def limits_of(scene: Scene) -> FloatArray:
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


def obstacles_within(scene: Scene) -> FloatArray:
    """Return the obstacles, cut to a little more than what is shown, shape ``(m, 4)``.

    Some obstacles reach to the end of the world.
    """
    low, high = np.split(limits_of(scene), 2)
    reach = 0.05 * (high - low).max()
    lower = np.clip(scene.obstacles[:, :2], low - reach, high + reach)
    upper = np.clip(scene.obstacles[:, 2:], low - reach, high + reach)
    return np.hstack([lower, upper])[(upper > lower).all(axis=1)]


def walls_at(scene: Scene, state: FloatArray) -> FloatArray:
    """Return the walls that a state places, shape ``(m, 4)``."""
    placed = [
        np.add(rectangle, 2 * [0.0 if axis is None else state[axis] for axis in axes])
        for axes, rectangle in scene.walls
    ]
    return np.array(placed, dtype=np.float64).reshape(-1, 4)


def body_corners(scene: Scene) -> FloatArray:
    """Return the corners of the body about its centre, shape ``(p, 2)``; none without a body."""
    body = np.empty((0, 2)) if scene.body is None else np.asarray(scene.body, dtype=np.float64)
    if body.ndim == 0:
        turn = np.linspace(0.0, 2.0 * np.pi, _DISC_CORNERS, endpoint=False)
        body = body * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    return body


def outline(scene: Scene, state: FloatArray) -> FloatArray:
    """Return the corners of the body in a state."""
    angle = 0.0 if scene.angle is None else float(state[scene.angle])
    cosine, sine = np.cos(angle), np.sin(angle)
    x, y = body_corners(scene).T
    turned = np.stack([cosine * x - sine * y, sine * x + cosine * y], axis=1)
    return np.asarray(turned + state[list(scene.axes)], dtype=np.float64)
