"""Collision against FCL (Pan, Chitta and Manocha, 2012), a library of robotics.

Both sides round, so poses that all but touch are left out: a pose counts when FCL gives the same
answer with the body's sizes larger and smaller by 2e-6. At most one pose in a thousand may be
left out, and the 9,000 compared must hold many of both answers.
"""

from functools import partial

import fcl
import numpy as np
import pytest

from holdfast.numerics.arrays import BoolArray, FloatArray
from holdfast.numerics.geometry import FAR, BoxWorld, DiscWorld, RectangleWorld
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


def test_rectangle_close_to_contact() -> None:
    # A rough sine decides most tests. Where it might err, the exact one must: along ways into the
    # ground, whose large obstacles would enlarge any error of an angle, bisected to the contact.
    ground = np.array([(-FAR, -FAR, -0.6, 0.0), (0.6, -FAR, FAR, 0.0), (-0.6, -FAR, 0.6, -1.1)])
    world = RectangleWorld(1.0, 2.0, ground)
    half = np.array([0.5, 1.0])

    def gaps(states: FloatArray) -> FloatArray:
        sine, cosine = np.sin(states[:, 2]), np.cos(states[:, 2])
        axes = np.stack([np.ones_like(sine), 0 * sine, 0 * sine, np.ones_like(sine)], axis=1)
        axes = np.concatenate([axes, np.stack([cosine, sine, -sine, cosine], axis=1)], axis=1)
        axes = axes.reshape(-1, 4, 2)
        own = np.abs(axes @ axes[:, 2:].transpose(0, 2, 1)) @ half
        corners = ground[:, [0, 1, 0, 3, 2, 1, 2, 3]].reshape(-1, 4, 2)
        seen = corners[np.newaxis] - states[:, np.newaxis, np.newaxis, :2]
        along = np.einsum("noci,nai->noac", seen, axes)
        apart = np.maximum(along.min(axis=3), -along.max(axis=3)) - own[:, np.newaxis]
        return np.asarray(apart.max(axis=2).min(axis=1))

    begin, end = fresh().substream(3).normal((2, NUM_POSES, 3)) * np.array([2.0, 2.0, 1.5])
    begin[:, 1], end[:, 1] = 3.0, -2.0
    free, blocked = np.zeros((NUM_POSES, 1)), np.ones((NUM_POSES, 1))
    for _ in range(25):
        middle = 0.5 * (free + blocked)
        states = begin + middle * (end - begin)
        gap, collides = gaps(states), world.collides(states)
        clear = np.abs(gap) > 1e-8
        np.testing.assert_array_equal(collides[clear], (gap < 0.0)[clear])
        free = np.where(collides[:, np.newaxis], free, middle)
        blocked = np.where(collides[:, np.newaxis], middle, blocked)
    assert np.abs(gap).max() < 1e-5


@pytest.mark.parametrize("angle_scale", [3.0, 0.05], ids=["any angles", "nearly parallel"])
def test_box(angle_scale: float) -> None:
    poses = fresh().substream(2).normal((NUM_POSES // 2, 6))
    poses *= np.array([2.0] * 3 + [angle_scale] * 3)
    ours = BoxWorld((0.6, 1.0, 1.6), BOXES).collides(poses)
    smaller = fcl.Box(0.6 - MARGIN, 1.0 - MARGIN, 1.6 - MARGIN)
    larger = fcl.Box(0.6 + MARGIN, 1.0 + MARGIN, 1.6 + MARGIN)
    obstacles = [box(np.array(limits[:3]), np.array(limits[3:])) for limits in BOXES]
    compare(ours, smaller, larger, poses, obstacles)
