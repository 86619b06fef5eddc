"""The four problems' numbers, their settings, and how problems are found by name."""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from holdfast.errors import InvalidValueError, ProblemError, UnknownProblemError
from holdfast.problems import registry
from holdfast.problems.capsule_robot import CapsuleRobot, CapsuleRobotModel, CapsuleRobotPlanner
from holdfast.problems.multitier_peg_in_hole_2d import (
    Hole,
    MultitierPegInHole2D,
    MultitierPegInHole2DModel,
)
from holdfast.problems.peg_in_hole_2d import PegInHole2D, PegInHole2DModel
from holdfast.problems.peg_in_hole_3d import PegInHole3D, PegInHole3DModel
from holdfast.problems.problem import ProblemBase
from holdfast.randomness import Purpose, stream

STREAM = stream(5, 0, 0, Purpose.INITIAL_BELIEF)


def action(problem: Any, *state: float, stage: int = 0) -> list[float]:
    return [float(value) for value in problem.policy(np.array(state), stage)]


class TestPegInHole2D:
    problem = PegInHole2D()

    def test_policy_uses_more_coordinates_the_nearer_it_is(self) -> None:
        limit = np.arcsin(0.1)
        assert action(self.problem, 0.51, 3.0, 0.05) == [-0.51, 0.0, 0.0]
        assert action(self.problem, -0.49, 3.0, limit + 1e-6) == [0.49, 0.0, -limit - 1e-6]
        assert action(self.problem, 0.49, 3.0, limit - 1e-6) == [-0.49, -3.0, -limit + 1e-6]
        assert action(self.problem, 0.49, 3.0, -limit + 1e-6) == [-0.49, -3.0, limit - 1e-6]
        assert action(self.problem, 0.6, 3.0, 0.01) == [-0.6, 0.0, 0.0]

    def test_each_component_is_limited_on_its_own(self) -> None:
        np.testing.assert_array_equal(
            self.problem.execute(np.array([-3.0, 0.05, 0.2])), [-0.1, 0.05, 0.1]
        )

    def test_reward_is_minus_the_norm(self) -> None:
        reward = self.problem.reward(np.zeros(3), np.array([0.1, -0.1, 0.05]))
        assert reward == pytest.approx(-0.15)

    def test_goal(self) -> None:
        states = np.array([[0.09, -0.09, 0.0], [0.1, 0.0, 0.0], [0.0, -0.1, 0.0], [0.0, 0.11, 0.0]])
        assert self.problem.is_goal(states).tolist() == [True, False, False, False]

    def test_the_hole_fits_the_peg_with_the_tolerance(self) -> None:
        free = np.array([[0.09, -0.09, 0.0], [-0.09, 0.0, 0.0], [4.0, 1.0, 0.0]])
        blocked = np.array([[0.11, 0.0, 0.0], [0.0, -0.11, 0.0], [4.0, 0.99, 0.0]])
        assert not self.problem.world.collides(free).any()
        assert self.problem.world.collides(blocked).all()

    def test_observations(self) -> None:
        state = np.array([1.0, 2.0, 3.0])
        for i in range(3):
            assert self.problem.observation_mean(state, i).tolist() == [i + 1.0]
            assert self.problem.observation_variance(state, i).tolist() == [0.001]

    @pytest.mark.parametrize("sensing_action", [-1, 3])
    def test_a_sensing_action_that_is_none(self, sensing_action: int) -> None:
        with pytest.raises(InvalidValueError, match=f"sensing action: {sensing_action}"):
            self.problem.observation_mean(np.zeros(3), sensing_action)
        with pytest.raises(InvalidValueError, match=f"sensing action: {sensing_action}"):
            self.problem.observation_variance(np.zeros(3), sensing_action)

    def test_initial_spread(self) -> None:
        # x is the one coordinate that the ground hardly cuts off.
        states = self.problem.initial_states(STREAM, 20_000)
        assert states[:, 0].mean() == pytest.approx(4.0, abs=5 * np.sqrt(2.0 / 20_000))
        assert states[:, 0].var() == pytest.approx(2.0, rel=5 * np.sqrt(2.0 / 20_000))

    def test_resolution_is_the_geometric_mean_of_the_deviations(self) -> None:
        assert self.problem.resolution == pytest.approx(0.1)
        model = PegInHole2DModel(motion_cov=(0.01, 0.04, 0.0016))
        assert PegInHole2D(model).resolution == pytest.approx((0.1 * 0.2 * 0.04) ** (1 / 3))
        still = PegInHole2DModel(motion_cov=(0.0, 0.04, 0.0))
        assert PegInHole2D(still).resolution == pytest.approx(0.2)
        assert PegInHole2D(PegInHole2DModel(motion_cov=(0.0, 0.0, 0.0))).resolution > 0.0

    def test_a_start_in_the_ground_is_refused_with_its_keys(self) -> None:
        model = PegInHole2DModel(init_mean=(5.0, -20.0, 0.0), init_cov=(0.1, 0.1, 0.1))
        with pytest.raises(InvalidValueError, match=r"init_mean.*init_cov.*7 of 7"):
            PegInHole2D(model).initial_states(STREAM, 7)


class TestMultitierPegInHole2D:
    problem = MultitierPegInHole2D()

    def test_policy_of_each_stage(self) -> None:
        assert action(self.problem, 0.0, 9.0, 0.02) == [4.0, 0.0, 0.0]
        assert action(self.problem, 3.6, 9.0, 0.3) == pytest.approx([0.4, 0.0, -0.3])
        # Down to y = 6 - 1 - 0.1 - 2.
        assert action(self.problem, 3.6, 9.0, 0.02) == pytest.approx([0.4, 2.9 - 9.0, -0.02])
        assert action(self.problem, 0.0, 3.0, 0.02, stage=1) == [-4.0, 0.0, 0.0]
        assert action(self.problem, 0.1, -4.0, 0.0, stage=2) == pytest.approx([-0.1, -5.1, 0.0])

    def test_the_stage_advances_below_the_plate(self) -> None:
        above, below = np.array([4.0, 2.91, 0.0]), np.array([4.0, 2.89, 0.0])
        assert self.problem.next_stage(above, 0) == 0
        assert self.problem.next_stage(below, 0) == 1
        assert self.problem.next_stage(below, 1) == 1  # the current stage's hole decides
        assert self.problem.next_stage(np.array([0.0, -11.0, 0.0]), 2) == 2  # the last one
        stages = np.array([0, 1, 2])
        states = np.tile([0.0, -3.2, 0.0], (3, 1))
        np.testing.assert_array_equal(self.problem.next_stage(states, stages), [1, 2, 2])

    def test_plates_holes_and_walls(self) -> None:
        holes = np.array([[4.05, 6.0, 0.0], [-4.05, 0.0, 0.0], [0.05, -6.0, 0.0]])
        assert not self.problem.world.collides(holes).any()
        aside = np.array([[4.15, 6.0, 0.0], [-4.15, 0.0, 0.0], [0.15, -6.0, 0.0]])
        assert self.problem.world.collides(aside).all()
        # The first plate is 1 thick, the peg 2 high.
        clear_of_it = np.array([[-9.0, 7.51, 0.0], [-9.0, 4.49, 0.0]])
        assert not self.problem.world.collides(clear_of_it).any()
        into_it = np.array([[-9.0, 7.49, 0.0], [-9.0, 4.51, 0.0]])
        assert self.problem.world.collides(into_it).all()
        walls = np.array([[11.51, 9.0, 0.0], [-11.51, 9.0, 0.0], [0.0, 11.01, 0.0], [0, -11.01, 0]])
        assert self.problem.world.collides(walls).all()
        assert not self.problem.world.collides(walls * [0.99, 0.99, 1.0]).any()

    def test_goal_is_below_the_last_hole(self) -> None:
        states = np.array([[0.05, -6.01, 0.0], [0.05, -5.99, 0.0], [0.11, -6.01, 0.0]])
        assert self.problem.is_goal(states).tolist() == [True, False, False]

    def test_a_hole_outside_of_the_map_is_refused(self) -> None:
        model = MultitierPegInHole2DModel(holes=(Hole(center=(0, 0)), Hole(center=(11.8, 6))))
        with pytest.raises(InvalidValueError, match=r"model\.holes\[1\].*map_dim"):
            MultitierPegInHole2D(model)

    def test_an_empty_map_is_refused(self) -> None:
        model = MultitierPegInHole2DModel(map_dim=(12, -12, -12, 12))
        with pytest.raises(InvalidValueError, match=r"model\.map_dim"):
            MultitierPegInHole2D(model)


class TestCapsuleRobot:
    problem = CapsuleRobot()

    def test_policy_heads_for_the_target_of_the_stage(self) -> None:
        targets = [(4.5, 2.5), (4.5, 1.5), (0.5, 1.5), (0.5, 0.5), (4.5, 0.5)]
        for stage, (x, y) in enumerate(targets):
            assert action(self.problem, 1.0, 2.0, stage=stage) == pytest.approx([x - 1, y - 2])

    def test_gains_go_with_the_axis(self) -> None:
        problem = CapsuleRobot(state_space_planner=CapsuleRobotPlanner(gain_0=2.0, gain_1=3.0))
        assert action(problem, 4.0, 2.0, stage=0) == pytest.approx([2 * 0.5, 3 * 0.5])
        assert action(problem, 4.0, 2.0, stage=1) == pytest.approx([3 * 0.5, 2 * -0.5])

    def test_the_stage_advances_within_the_radius(self) -> None:
        assert self.problem.next_stage(np.array([4.41, 2.5]), 0) == 1
        assert self.problem.next_stage(np.array([4.39, 2.5]), 0) == 0
        assert self.problem.next_stage(np.array([4.43, 2.57]), 0) == 1
        assert self.problem.next_stage(np.array([4.42, 2.58]), 0) == 0
        assert self.problem.next_stage(np.array([4.5, 0.5]), 4) == 4

    def test_the_norm_is_limited(self) -> None:
        executed = self.problem.execute(np.array([[3.0, -4.0], [0.03, 0.04], [0.0, 0.0]]))
        np.testing.assert_allclose(executed, [[0.06, -0.08], [0.03, 0.04], [0.0, 0.0]], rtol=1e-15)

    def test_reward_looks_one_action_further(self) -> None:
        states = np.array([[2.0, 2.8], [2.0, 2.8], [2.0, 2.8]])
        actions = np.array([[0.0, 0.06], [0.0, 0.04], [0.1, 0.0]])
        assert self.problem.reward(states, actions).tolist() == [-1.0, 0.0, 0.0]

    def test_walls(self) -> None:
        beside = np.array([[0.16, 1.5], [2.0, 2.16], [2.0, 1.84], [4.16, 2.0], [0.84, 1.0]])
        assert not self.problem.world.collides(beside).any()
        into = np.array([[-0.02, 0], [0, -0.02], [0, 0.02], [-0.07, 0], [0.07, 0]])
        assert self.problem.world.collides(beside + into).all()

    def test_observations(self) -> None:
        state = np.array([1.0, 2.0])
        assert self.problem.observation_mean(state, 1).tolist() == [1.0, 2.0]
        assert self.problem.observation_variance(state, 0).tolist() == [1e-4, 1e-3]
        assert self.problem.observation_variance(state, 1).tolist() == [1e-3, 1e-4]
        with pytest.raises(InvalidValueError, match="sensing action: 2"):
            self.problem.observation_mean(state, 2)

    def test_goal(self) -> None:
        states = np.array([[4.5, 0.69], [4.5, 0.71], [4.35, 0.6]])
        assert self.problem.is_goal(states).tolist() == [True, False, True]

    def test_counts_must_match(self) -> None:
        with pytest.raises(InvalidValueError, match=r"model\.num_walls: 5.*walls has 6"):
            CapsuleRobot(CapsuleRobotModel(num_walls=5))
        with pytest.raises(InvalidValueError, match=r"num_via_points: 3.*via_points has 4"):
            CapsuleRobot(state_space_planner=CapsuleRobotPlanner(num_via_points=3))

    @pytest.mark.parametrize("end_1", [[1.0, 1.0], [0.0, 0.0]])
    def test_a_wall_must_be_along_an_axis(self, end_1: list[float]) -> None:
        walls = [{"end_0": [0.0, 0.0], "end_1": end_1}]
        with pytest.raises(InvalidValueError, match=r"model\.walls\[0\]"):
            CapsuleRobot.from_settings({"walls": walls}, {})


class TestPegInHole3D:
    problem = PegInHole3D()

    def test_policy(self) -> None:
        assert action(self.problem, 2.0, -1.0, 3.0, 0.01, 0, 0) == [-2.0, 1.0, 0, 0, 0, 0]
        assert action(self.problem, 0.4, 0.4, 3.0, 0.01, 0, 0) == [-0.4, -0.4, 0, 0, 0, 0]
        tilted = action(self.problem, 0.3, 0.3, 3.0, 0.1, -0.05, 0.02)
        assert tilted == [-0.3, -0.3, 0.0, -0.1, 0.05, -0.02]
        upright = action(self.problem, 0.3, 0.3, 3.0, 0.05, -0.05, 0.02)
        assert upright == [-0.3, -0.3, -3.0, -0.05, 0.05, -0.02]

    def test_the_hole_fits_the_peg_with_the_tolerance(self) -> None:
        free = np.zeros((4, 6))
        free[1, 0] = free[2, 1] = 0.09
        free[3, 2] = -0.09
        assert not self.problem.world.collides(free).any()
        blocked = np.zeros((6, 6))
        blocked[0, 0] = blocked[1, 1] = 0.11
        blocked[2, 2] = -0.11
        blocked[3, 3] = blocked[4, 4] = blocked[5, 5] = 0.25
        assert self.problem.world.collides(blocked).all()

    def test_map(self) -> None:
        inside = np.zeros((4, 6))
        inside[:, 2] = 3.0
        inside[0, 0] = 5.49
        inside[1, 1] = -5.49
        inside[2, 2] = 4.99
        inside[3, :3] = [3.0, 3.0, 1.01]
        outside = inside.copy()
        outside[:3, :3] += [[0.02, 0, 0], [0, -0.02, 0], [0, 0, 0.02]]
        outside[3, 2] -= 0.02
        assert not self.problem.world.collides(inside).any()
        assert self.problem.world.collides(outside).all()

    def test_goal(self) -> None:
        states = np.zeros((4, 6))
        states[1, 0] = states[2, 1] = states[3, 2] = 0.11
        states[:, 3:] = 0.5
        assert self.problem.is_goal(states).tolist() == [True, False, False, False]

    def test_a_map_without_room_for_the_hole_is_refused(self) -> None:
        with pytest.raises(InvalidValueError, match=r"model\.map_dim"):
            PegInHole3D(PegInHole3DModel(map_dim=(0.5, 6.0, 6.0)))


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


PEGS: list[tuple[type[Any], int]] = [
    (PegInHole2D, 2),
    (MultitierPegInHole2D, 2),
    (PegInHole3D, 3),
]
"""With the number of coordinates of a translation; those after it are angles."""


@pytest.mark.parametrize(("peg", "positions"), PEGS)
@pytest.mark.parametrize("turned", [3.0, 3.2, -4.0, 6.3, -7.0])
def test_a_peg_is_turned_back_all_the_way(peg: type[Any], positions: int, turned: float) -> None:
    """Angles are not wrapped: after more than half a turn a peg goes back the way it came.

    A wrapped action would jump by a whole turn where the belief has particles on both sides of half
    a turn, and its entropy would be that of a choice that nobody has.
    """
    problem = peg()
    state = np.zeros(problem.state_size)
    if peg is MultitierPegInHole2D:
        state[0] = 4.0  # in the axis of the first hole, as the others' is at zero
    state[positions:] = turned
    commanded = problem.policy(state, 0)
    assert commanded[positions:].tolist() == [-turned] * (problem.state_size - positions)


@pytest.mark.parametrize(("peg", "positions"), PEGS)
def test_translations_and_rotations_have_limits_of_their_own(
    peg: type[Any], positions: int
) -> None:
    problem = peg.from_settings({}, {"translation_step_size": 0.3, "rotation_step_size": 0.02})
    angles = problem.action_size - positions
    limits = np.array([0.3] * positions + [0.02] * angles)
    np.testing.assert_array_equal(problem.execute(np.full(problem.action_size, 5.0)), limits)
    np.testing.assert_array_equal(problem.execute(np.full(problem.action_size, -5.0)), -limits)
    # What is within its own limit is left alone, also where the other one is smaller.
    np.testing.assert_array_equal(problem.execute(0.9 * limits), 0.9 * limits)


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


class TestRegistry:
    def test_names(self) -> None:
        assert set(registry.names()) >= {
            "capsule_robot",
            "multitier_peg_in_hole_2d",
            "peg_in_hole_2d",
            "peg_in_hole_3d",
        }

    def test_the_built_in_ones_are_registered_as_the_same(self) -> None:
        found = importlib.metadata.entry_points(group=registry.GROUP)
        values = {entry_point.name: entry_point.value for entry_point in found}
        assert registry.BUILT_IN.items() <= values.items()

    def test_finds_a_registered_class(self) -> None:
        assert registry.problem_class("peg_in_hole_2d") is PegInHole2D

    def test_finds_an_importable_class(self) -> None:
        name = "holdfast.problems.capsule_robot:CapsuleRobot"
        assert registry.problem_class(name) is CapsuleRobot

    def test_finds_a_file_in_the_directory(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sys, "path", sys.path.copy())
        (tmp_path / "a_problem_in_a_file.py").write_text("class Mine:\n    pass\n")
        name = "a_problem_in_a_file:Mine"
        with pytest.raises(UnknownProblemError, match="a_problem_in_a_file"):
            registry.problem_class(name)
        assert registry.problem_class(name, tmp_path).__name__ == "Mine"

    def test_an_unknown_name_is_answered_with_close_and_all_names(self) -> None:
        with pytest.raises(
            UnknownProblemError, match=r"peg_in_hole_2.*did you mean.*peg_in_hole_2d.*capsule_robot"
        ):
            registry.problem_class("peg_in_hole_2")

    def test_an_unknown_class(self) -> None:
        with pytest.raises(UnknownProblemError, match=r"has no PegInHole.*PegInHole2D"):
            registry.problem_class("holdfast.problems.peg_in_hole_2d:PegInHole")

    def test_not_a_class(self) -> None:
        with pytest.raises(UnknownProblemError, match="not a class but function"):
            registry.problem_class("holdfast.problems.registry:names")

    @pytest.mark.parametrize("name", ["", ":", "a:", ":b", "a b:c", "../a:b"])
    def test_not_a_name(self, name: str) -> None:
        with pytest.raises(UnknownProblemError):
            registry.problem_class(name)


class Minimal(ProblemBase):
    def __init__(self, size: float = 1.0) -> None:
        self.size = size


class TestProblemBase:
    def test_settings_become_keyword_arguments(self) -> None:
        assert Minimal.from_settings({"size": 3.0}, {}).size == 3.0
        assert Minimal.from_settings({}, {"size": 4.0}).size == 4.0

    def test_unknown_and_double_keys(self) -> None:
        with pytest.raises(ProblemError, match="colour"):
            Minimal.from_settings({"colour": 1}, {})
        with pytest.raises(ProblemError, match="size: given in both"):
            Minimal.from_settings({"size": 1.0}, {"size": 2.0})

    def test_defaults(self) -> None:
        problem = Minimal()
        assert problem.next_stage(np.zeros(3), 0) == 0
        assert problem.reward(np.zeros((4, 3)), np.zeros((4, 2))).shape == (4,)
        assert problem.scene() is None
        actions = np.ones(2)
        np.testing.assert_array_equal(problem.execute(actions), actions)
