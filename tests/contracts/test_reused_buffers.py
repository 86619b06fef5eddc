"""A problem may return the same buffer each time: what a function returned is copied as it comes.

Wrappers of simulators often do. Here every function of a problem, and the robot's environment,
writes its results into one buffer for each shape, which all of them share.
"""

from typing import Any

import msgspec
import numpy as np
import pytest
from tests.golden.sonar_room import SonarRoom
from tests.line_problem import Line

from holdfast.planning.outcome import MoveResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.attributes import PARAMETERS
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.problem import Problem
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import run_trial
from holdfast_lab.simulation.peg_with_encoders import PegWithEncoders


class Varying(Line):
    """Noise that depends on the state, and returns of its own."""

    def observation_variance(self, states: Any, sensing_action: int) -> Any:
        return 0.01 + 0.1 * np.abs(states[..., sensing_action : sensing_action + 1])

    def known_state_return(self, states: Any, stages: Any) -> Any:
        return -np.abs(states[:, 0])

    def is_failure(self, states: Any) -> Any:
        return states[..., 1] > 2.5

    def reinitial_states(self, states: Any, stream: Any) -> Any:
        return states + stream.normal(states.shape)


PROBLEMS: dict[str, type[Any]] = {
    "noise that varies": Varying,
    "shown moves": PegWithEncoders,
    "stages": CapsuleRobot,
    "general likelihood": type("Ranked", (SonarRoom,), {"rank_test": True}),
}

METHODS: dict[str, dict[str, Any]] = {
    "action_entropy": {"estimator": "nearest_neighbor", "actions": "executed"},
    "state_entropy": {},
    "action_covariance": {},
    "path_entropy": {},
    "expected_return": {"rollout_steps": 30, "rollout_reward": "steps"},
}


class Buffers:
    """Where results are written: one array for each shape and type."""

    def __init__(self) -> None:
        self._arrays: dict[tuple[tuple[int, ...], Any], Any] = {}

    def keep(self, found: Any) -> Any:
        if isinstance(found, tuple):
            return tuple(self.keep(each).copy() for each in found)
        if not isinstance(found, np.ndarray) or found.ndim == 0:
            return found
        key = (found.shape, found.dtype)
        buffer = self._arrays.setdefault(key, np.empty(*key))
        buffer[...] = found
        return buffer


def reusing(kind: type[Any], buffers: Buffers) -> Problem:
    """Return a problem whose functions all write into the same buffers."""

    def wrapped(function: str) -> Any:
        inner = getattr(kind, function)
        return lambda self, *arguments: buffers.keep(inner(self, *arguments))

    functions = {name: wrapped(name) for name in PARAMETERS if hasattr(kind, name)}
    made: Problem = type("Reusing", (kind,), functions)()
    return made


class ReusingRobot(SimulatedEnvironment):
    """A robot whose results are written into the same buffers, too."""

    buffers: Buffers

    def perform_sensing(self, sensing_action: int) -> Any:
        return self.buffers.keep(super().perform_sensing(sensing_action))

    def perform(self, task_action: Any) -> Any:
        shown = super().perform(task_action)
        task_action[...] = 99.0  # its argument is its own
        if isinstance(shown, MoveResult):
            return shown._replace(
                motion=self.buffers.keep(shown.motion),
                observation=self.buffers.keep(shown.observation),
            )
        return shown


def settings_of(method: str, **active_sensing: Any) -> PlanningSettings:
    sensing = msgspec.structs.replace(ActiveSensingSettings(num_cores=1), **active_sensing)
    return PlanningSettings(
        sensing_interval=2,
        particle_filter=ParticleFilterSettings(num_particles=50, resampling_threshold=0.7),
        active_sensing=sensing,
        selector=SelectorSettings(method=method, **METHODS[method]),  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("method", METHODS)
def test_a_reused_buffer_changes_nothing(name: str, method: str) -> None:
    kind = PROBLEMS[name]
    settings = settings_of(method)
    assert trial_of(kind, settings, reused=True) == trial_of(kind, settings, reused=False)


@pytest.mark.parametrize("name", PROBLEMS)
def test_nor_does_it_over_a_horizon(name: str) -> None:
    kind, settings = PROBLEMS[name], settings_of("action_entropy", horizon=2)
    assert trial_of(kind, settings, reused=True) == trial_of(kind, settings, reused=False)


def trial_of(kind: type[Any], settings: PlanningSettings, *, reused: bool) -> str:
    buffers = Buffers()
    problem = reusing(kind, buffers) if reused else kind()
    environment: Any = (ReusingRobot if reused else SimulatedEnvironment)(problem, 3, 1)
    environment.buffers = buffers
    planner = Planner(problem, settings)
    digest = run_trial(planner, 3, 1, max_steps=12, environment=environment).digest
    lost = planner.reinitialise(planner.init(3, 1))
    return digest + planner.digest(lost).hex()
