"""The example examples/mujoco_peg: what its planner believes, and, where MuJoCo is, its robot."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from holdfast.config.loader import Configuration, load
from holdfast.planning.outcome import Ending
from holdfast.planning.planner import Planner
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.trial import run_trial

EXAMPLE = Path(__file__).parents[2] / "examples" / "mujoco_peg"
PEGS = ("2d", "3d")
HALF_LENGTH = 0.03

needs_mujoco = pytest.mark.skipif(
    importlib.util.find_spec("mujoco") is None, reason="mujoco is not installed"
)


def configuration_of(peg: str, **arguments: Any) -> Configuration:
    file = EXAMPLE / f"peg_{peg}.yaml"
    if not arguments:
        return load(file)
    own = load(file).environment.arguments
    return load(file, overrides={"environment.arguments": {**own, **arguments}})


def pose(peg: str, x: float, tip: float) -> np.ndarray[Any, Any]:
    """Return a pose beside the middle of the hole, with the tip so high above its mouth."""
    height = tip + HALF_LENGTH
    return np.array([x, height, 0.0] if peg == "2d" else [x, 0.0, height])


@needs_mujoco
@pytest.mark.parametrize("peg", PEGS)
class TestRobot:
    def test_an_encoder_reads_the_same_share_too_much(self, peg: str) -> None:
        robot: Any = load_environment(configuration_of(peg, encoder_noise=0.0))(1)
        before = robot._data.qpos.copy()
        motions = [robot.perform(np.array([-0.003, 0.0, 0.0])).motion for _ in range(10)]
        moved = robot._data.qpos - before
        share = np.sum(motions, axis=0)[0] / moved[0]
        assert abs(share - 1.0) > 0.001
        np.testing.assert_allclose(share, robot._scale[0], rtol=1e-9)
        # The servo brings the encoder to where it was told, less its friction.
        np.testing.assert_allclose(np.sum(motions, axis=0)[0], -0.03, atol=0.001)

    def test_pressed_on_the_ground_it_feels_it_and_breaks(self, peg: str) -> None:
        robot: Any = load_environment(configuration_of(peg, force_noise=0.0))(0)
        down = pose(peg, 0.0, 0.0) - pose(peg, 0.0, 0.003)
        free = robot.perform(down)
        assert np.abs(free.observation).max() < 3.0
        while not (done := robot.is_done()):
            pressed = robot.perform(down)
        assert pressed.observation[-1] > 20.0
        assert np.abs(pressed.motion).max() < 0.001
        assert isinstance(done, Ending)
        assert done.outcome == "failed"
        assert "N at the wrist" in done.reason

    def test_its_own_limit_is_neither_success_nor_failure(self, peg: str) -> None:
        robot: Any = load_environment(configuration_of(peg, time_limit=2))(0)
        for _ in range(2):
            assert robot.is_done() is False
            robot.perform(np.zeros(3))
        assert robot.is_done().outcome == "truncated"

    def test_moves_show_what_they_are_told_to_show(self, peg: str) -> None:
        robot: Any = load_environment(configuration_of(peg, encoders=False, force=False))(0)
        assert robot.perform(np.zeros(3)) == (None, None, None)

    def test_the_peg_gets_into_the_hole(self, peg: str) -> None:
        """Of 200 trials 198 or more did; fewer than 7 of 10 are one in a million."""
        configuration = configuration_of(peg)
        planner = Planner(configuration.problem, configuration.planning)
        make = load_environment(configuration)
        results = [run_trial(planner, 0, trial, environment=make(trial)) for trial in range(10)]
        assert sum(result.success for result in results) >= 7
        again = run_trial(planner, 0, 3, environment=make(3))
        assert again.digest == results[3].digest
