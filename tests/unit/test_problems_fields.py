"""The bounds of the problems' settings, declared in holdfast.problems.rigid_body."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.multitier_peg_in_hole_2d import MultitierPegInHole2D
from holdfast.problems.peg_in_hole_2d import PegInHole2D, PegInHole2DModel

# The sections of the files of the earlier work, whose keys must all be accepted.
PEG_SETTINGS: tuple[dict[str, Any], dict[str, Any]] = (
    {
        "state_size": 3,
        "peg_width": 1,
        "peg_height": 2,
        "hole_tolerance": 0.1,
        "init_mean": [4, 2, 0],
        "init_cov": [2, 1, 1.57],
        "motion_cov": [0.01, 0.01, 0.01],
        "sensing_cov": 0.001,
        "collision_tol": 0.001,
    },
    {"translation_step_size": 0.1, "rotation_step_size": 0.1},
)


MULTITIER_SETTINGS: tuple[dict[str, Any], dict[str, Any]] = (
    {
        "peg_dim": [1, 2],
        "map_dim": [-12, -12, 12, 12],
        "init_mean": [0, 9, 0],
        "init_cov": [2, 1, 1.57],
        "init_seed": 0,
        "motion_cov": [0.01, 0.01, 0.01],
        "motion_seed": 0,
        "sensing_cov": 0.001,
        "sensing_seed": 0,
        "collision_tol": 1e-3,
        "holes": [
            {"center": [4, 6], "tol": 0.1, "depth": 1.0},
            {"center": [-4, 0], "tol": 0.1, "depth": 1.0},
            {"center": [0, -6], "tol": 0.1, "depth": 1.0},
        ],
    },
    {"translation_step_size": 0.1, "rotation_step_size": 0.1},
)


CAPSULE_SETTINGS: tuple[dict[str, Any], dict[str, Any]] = (
    {
        "robot_radius": 0.1,
        "init_mean": [0.5, 2.5],
        "init_cov": [0.01, 0.01],
        "motion_cov": [1e-3, 1e-3],
        "sensing_covs": [[1e-4, 1e-3], [1e-3, 1e-4]],
        "collision_tol": 1e-3,
        "seed": 0,
        "num_walls": 6,
        "walls": [
            {"end_0": [0, 0], "end_1": [0, 3], "thickness": 0.1},
            {"end_0": [0, 3], "end_1": [5, 3], "thickness": 0.1},
            {"end_0": [5, 3], "end_1": [5, 0], "thickness": 0.1},
            {"end_0": [5, 0], "end_1": [0, 0], "thickness": 0.1},
            {"end_0": [0, 2], "end_1": [4, 2], "thickness": 0.1},
            {"end_0": [1, 1], "end_1": [5, 1], "thickness": 0.1},
        ],
        "dt": 0.1,
        "goal": {"center": [4.5, 0.5], "radius": 0.2, "axis": 0},
    },
    {
        "gain_0": 1,
        "gain_1": 1,
        "num_via_points": 4,
        "step_size": 0.1,
        "via_points": [
            {"center": [4.5, 2.5], "radius": 0.1, "axis": 0},
            {"center": [4.5, 1.5], "radius": 0.1, "axis": 1},
            {"center": [0.5, 1.5], "radius": 0.1, "axis": 0},
            {"center": [0.5, 0.5], "radius": 0.1, "axis": 1},
        ],
    },
)


@pytest.mark.parametrize(
    ("problem_class", "settings"),
    [
        (PegInHole2D, PEG_SETTINGS),
        (MultitierPegInHole2D, MULTITIER_SETTINGS),
        (CapsuleRobot, CAPSULE_SETTINGS),
    ],
)
def test_the_earlier_works_settings_are_the_defaults(
    problem_class: Any, settings: tuple[dict[str, Any], dict[str, Any]]
) -> None:
    loaded, default = problem_class.from_settings(*settings), problem_class()
    for section in ("model", "state_space_planner"):
        given = msgspec.to_builtins(getattr(loaded, section))
        expected = msgspec.to_builtins(getattr(default, section))
        assert {key: value for key, value in given.items() if not key.startswith("num_")} == {
            key: value for key, value in expected.items() if not key.startswith("num_")
        }
    np.testing.assert_array_equal(loaded.world.obstacles, default.world.obstacles)


@pytest.mark.parametrize(
    ("model", "path"),
    [
        ({"peg_width": 0.0}, r"\$\.peg_width"),
        ({"motion_cov": [0.01, -0.01, 0.01]}, r"\$\.motion_cov\[1\]"),
        ({"init_cov": [1.0, 1.0]}, r"\$\.init_cov"),
        ({"init_mean": [0.0, float("nan"), 0.0]}, r"\$\.init_mean\[1\]"),
        ({"sensing_cov": 0.0}, r"\$\.sensing_cov"),
        ({"sensing_cov": float("inf")}, r"\$\.sensing_cov"),
        ({"collision_tol": 1.0}, r"\$\.collision_tol"),
        ({"collision_tol": 1e-13}, r">= 1e-12 .*\$\.collision_tol"),
        ({"state_size": 4}, r"\$\.state_size"),
        ({"peg_with": 1.0}, "peg_with"),
    ],
)
def test_settings_out_of_bounds(model: dict[str, Any], path: str) -> None:
    with pytest.raises(msgspec.ValidationError, match=path):
        PegInHole2D.from_settings(model, {})


def test_the_constructor_checks_too() -> None:
    with pytest.raises(InvalidValueError, match=r"model.*\$\.peg_height"):
        PegInHole2D(PegInHole2DModel(peg_height=-2.0))
