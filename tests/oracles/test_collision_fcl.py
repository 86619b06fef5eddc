"""Collision against FCL (Pan, Chitta and Manocha, 2012), a library of robotics.

Both sides round, so poses that all but touch are left out: a pose counts when FCL gives the same
answer with the body's sizes larger and smaller by 2e-6. At most one pose in a thousand may be
left out, and the 9,000 compared must hold many of both answers.
"""

from __future__ import annotations

from functools import partial

import fcl
import numpy as np
import pytest

from holdfast.numerics.arrays import BoolArray, FloatArray
from holdfast.numerics.geometry import BoxWorld, DiscWorld, RectangleWorld
from holdfast.numerics.randomness import Purpose, stream

NUM_POSES = 3000
MARGIN = 2e-6
fresh = partial(stream, 3, 0, 0, Purpose.WORLD_MOTION)  # anew at each call

RECTANGLES = [(-3.0, -2.0, -1.0, -1.5), (0.5, -1.0, 0.7, 2.0), (-2.0, 1.0, -1.0, 2.0)]
BOXES = [
    (-3.0, -2.0, -1.0, -1.0, -1.5, 1.0),
    (0.5, -1.0, -2.0, 0.7, 2.0, 0.3),
    (-2.0, 1.0, 0.0, -1.0, 2.0, 3.0),
]


def rotation(yaw: float, pitch: float, roll: float) -> FloatArray:
    def turn(angle: float, i: int, j: int) -> FloatArray:
        matrix = np.eye(3)
        matrix[i, i] = matrix[j, j] = np.cos(angle)
        matrix[i, j], matrix[j, i] = -np.sin(angle), np.sin(angle)
        return matrix

    return turn(yaw, 0, 1) @ turn(pitch, 2, 0) @ turn(roll, 1, 2)


def box(low: FloatArray, high: FloatArray) -> fcl.CollisionObject:
    return fcl.CollisionObject(
        fcl.Box(*(high - low).tolist()), fcl.Transform(np.eye(3), 0.5 * (low + high))
    )


def fcl_collides(
    geometry: fcl.CollisionGeometry, poses: FloatArray, obstacles: list[fcl.CollisionObject]
) -> BoolArray:
    """Answer for poses (x, y, z, yaw, pitch, roll)."""
    answers = np.zeros(len(poses), dtype=bool)
    for n, pose in enumerate(poses):
        body = fcl.CollisionObject(geometry, fcl.Transform(rotation(*pose[3:]), pose[:3]))
        answers[n] = any(
            fcl.collide(body, obstacle, fcl.CollisionRequest(), fcl.CollisionResult()) > 0
            for obstacle in obstacles
        )
    return answers


def compare(
    ours: BoolArray,
    smaller: fcl.CollisionGeometry,
    larger: fcl.CollisionGeometry,
    poses: FloatArray,
    obstacles: list[fcl.CollisionObject],
) -> None:
    expected = fcl_collides(smaller, poses, obstacles)
    clear = expected == fcl_collides(larger, poses, obstacles)
    assert clear.mean() > 0.999
    assert 0.1 < expected.mean() < 0.9
    np.testing.assert_array_equal(ours[clear], expected[clear])


def flat_obstacles() -> list[fcl.CollisionObject]:
    return [box(np.array([x0, y0, -4.0]), np.array([x1, y1, 4.0])) for x0, y0, x1, y1 in RECTANGLES]


def test_disc() -> None:
    positions = fresh().substream(0).normal((NUM_POSES, 2)) * 2.0
    poses = np.zeros((NUM_POSES, 6))
    poses[:, :2] = positions
    ours = DiscWorld(0.4, RECTANGLES).collides(positions)
    compare(ours, fcl.Sphere(0.4 - MARGIN), fcl.Sphere(0.4 + MARGIN), poses, flat_obstacles())


def test_rectangle() -> None:
    states = fresh().substream(1).normal((NUM_POSES, 3)) * np.array([2.0, 2.0, 3.0])
    poses = np.zeros((NUM_POSES, 6))
    poses[:, [0, 1, 3]] = states
    ours = RectangleWorld(0.6, 1.4, RECTANGLES).collides(states)
    smaller = fcl.Box(0.6 - MARGIN, 1.4 - MARGIN, 1.0)
    larger = fcl.Box(0.6 + MARGIN, 1.4 + MARGIN, 1.0)
    compare(ours, smaller, larger, poses, flat_obstacles())


@pytest.mark.parametrize("angle_scale", [3.0, 0.05], ids=["any angles", "nearly parallel"])
def test_box(angle_scale: float) -> None:
    poses = fresh().substream(2).normal((NUM_POSES // 2, 6))
    poses *= np.array([2.0] * 3 + [angle_scale] * 3)
    ours = BoxWorld((0.6, 1.0, 1.6), BOXES).collides(poses)
    smaller = fcl.Box(0.6 - MARGIN, 1.0 - MARGIN, 1.6 - MARGIN)
    larger = fcl.Box(0.6 + MARGIN, 1.0 + MARGIN, 1.6 + MARGIN)
    obstacles = [box(np.array(limits[:3]), np.array(limits[3:])) for limits in BOXES]
    compare(ours, smaller, larger, poses, obstacles)
