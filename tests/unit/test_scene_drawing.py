"""What of a scene is drawn, and where."""

import numpy as np

from holdfast.problems.problem import Scene
from holdfast.reports.scene_drawing import (
    body_corners,
    obstacles_within,
    outline,
    shown_part,
    walls_at,
)


def test_obstacles_end_a_little_beyond_what_is_shown() -> None:
    scene = Scene((0, 1), (0, 0, 10, 4), obstacles=[(-1e9, -1e9, 2, 1), (20, 0, 30, 1)])
    assert obstacles_within(scene).tolist() == [[-0.5, -0.5, 2.0, 1.0]]
    part = shown_part(scene, [np.array([[1.0, 1.0], [2.0, 3.0]])])
    np.testing.assert_allclose(part, [0.26, 0.76, 2.74, 3.24])


def test_walls_and_the_body_are_where_the_state_says() -> None:
    scene = Scene(
        (0, 1),
        (0, 0, 4, 4),
        body=[(1, 0), (0, 1)],
        angle=2,
        walls=[((None, 3), (2, -0.5, 2.1, 0.5)), ((0, None), (0, 0, 1, 1))],
    )
    state = np.array([1.0, 2.0, 0.5 * np.pi, 3.0])
    assert walls_at(scene, state).tolist() == [[2.0, 2.5, 2.1, 3.5], [1.0, 0.0, 2.0, 1.0]]
    np.testing.assert_allclose(outline(scene, state), [(1, 3), (0, 2)], atol=1e-15)
    disc = body_corners(Scene((0, 1), (0, 0, 1, 1), body=0.5))
    np.testing.assert_allclose(np.hypot(*disc.T), 0.5)
