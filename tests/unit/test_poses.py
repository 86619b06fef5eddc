"""Beliefs as poses: what a problem says of its coordinates, and SciPy's rotations as the oracle."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from holdfast.config.registry import BUILT_IN, problem_class
from holdfast.errors import ProblemError
from holdfast.planning.belief import Belief, estimate
from holdfast.problems.problem import ProblemBase
from holdfast.reports.poses import pose_layout

RANDOM = np.random.default_rng(7)


def problem_with(pose: object, up: object = "z", state_size: int = 3) -> ProblemBase:
    problem = ProblemBase()
    problem.name = "mine"
    problem.state_size = state_size
    problem.pose = pose  # type: ignore[assignment]
    problem.up = up  # type: ignore[assignment]
    return problem


@pytest.mark.parametrize(
    ("name", "indices"),
    [
        ("peg_in_hole_2d", (0, 1, None, None, None, 2)),
        ("multitier_peg_in_hole_2d", (0, 1, None, None, None, 2)),
        ("capsule_robot", (0, 1, None, None, None, None)),
        ("peg_in_hole_3d", (0, 1, 2, 5, 4, 3)),
    ],
)
def test_built_in_problems_say_what_they_are(name: str, indices: tuple[int | None, ...]) -> None:
    layout = pose_layout(problem_class(name)())
    assert layout is not None
    assert layout.indices == indices
    assert name in BUILT_IN


def test_a_problem_that_says_nothing_has_no_poses() -> None:
    assert pose_layout(object()) is None
    assert pose_layout(ProblemBase()) is None
    assert pose_layout(problem_with((None, None))) is None


def test_rotation_is_about_z_then_y_then_x_of_the_body() -> None:
    layout = pose_layout(problem_class("peg_in_hole_3d")())
    assert layout is not None
    states = RANDOM.normal(size=(50, 4, 6)) * 3.0
    poses = layout.poses(states)
    assert poses.shape == (50, 4, 7)
    assert np.array_equal(poses[..., :3], states[..., :3])
    expected = Rotation.from_euler("ZYX", states[..., 3:].reshape(-1, 3))
    found = Rotation.from_quat(poses[..., 3:].reshape(-1, 4))
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(poses[..., 3:], axis=-1), 1.0, rtol=1e-15)


def test_yaw_alone_is_counter_clockwise() -> None:
    layout = pose_layout(problem_with(("x", "y", "yaw")))
    assert layout is not None
    pose = layout.poses([1.0, 2.0, np.pi / 2])
    np.testing.assert_allclose(pose, [1, 2, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-16)


def test_covariance_is_that_of_the_weighted_particles() -> None:
    layout = pose_layout(problem_with(("yaw", None, "x"), state_size=3))
    assert layout is not None
    belief = Belief.weighted(RANDOM.normal(size=(40, 3)), RANDOM.uniform(size=40))
    covariance = layout.covariance(belief)
    expected = np.cov(belief.states[:, [2, 0]].T, aweights=belief.weights, ddof=0)
    np.testing.assert_allclose(covariance[np.ix_([0, 5], [0, 5])], expected, atol=1e-15)
    assert np.array_equal(covariance, covariance.T)
    assert np.count_nonzero(covariance) == 4
    np.testing.assert_allclose(
        estimate(belief), np.average(belief.states, axis=0, weights=belief.weights)
    )


def test_the_covariance_of_a_heading_goes_round_the_circle() -> None:
    problem = problem_with(("yaw", "x"), state_size=2)
    turned = RANDOM.normal(size=(200, 2)) * [0.1, 1.0]
    west = turned + np.array([np.pi, 0.0])
    west[:, 0] = np.where(west[:, 0] > np.pi, west[:, 0] - 2.0 * np.pi, west[:, 0])
    problem.circular = (0,)
    layout = pose_layout(problem)
    assert layout is not None
    np.testing.assert_allclose(
        layout.covariance(Belief.uniform(west)),
        layout.covariance(Belief.uniform(turned)),
        atol=1e-12,
    )


@pytest.mark.parametrize(
    ("pose", "up", "message"),
    [
        ("xyz", "z", r"pose of mine is 'xyz': must be a sequence"),
        (3, "z", r"pose of mine is 3: must be a sequence"),
        (("x", "y", "z", "yaw"), "z", r"has 4 words: its state has 3 coordinates"),
        (("x", "theta"), "z", r"pose\[1\] of mine is 'theta': allowed are x, y, z, roll"),
        (("x", ["y"]), "z", r"pose\[1\] of mine is \['y'\]"),
        (("x", "yaw", "x"), "z", r"has x twice, at 0 and 2"),
        (("x",), "x", r"up of mine is 'x': allowed are y and z"),
        (("x",), ["z"], r"up of mine is \['z'\]: allowed are y and z"),
    ],
)
def test_what_cannot_be_is_refused(pose: object, up: object, message: str) -> None:
    with pytest.raises(ProblemError, match=message):
        pose_layout(problem_with(pose, up))
