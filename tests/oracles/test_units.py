"""What of a choice depends on the units of the coordinates, as docs/results.md says.

The same peg, once with its angle in radians, once in tenths of a radian. The same beliefs, the same
policy; so what is chosen ought to be the same.
"""

from __future__ import annotations

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from holdfast import planning
from holdfast.planning import PlanningState
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import FloatArray, IntArray, ProblemBase
from holdfast.randomness import Stream
from holdfast.runtime.environment import SimulatedEnvironment
from holdfast.settings import PlanningSettings, SelectorSettings

SCALE = np.array([1.0, 1.0, 10.0])
PEG = PegInHole2D()


class InTenthsOfARadian(ProblemBase):
    """States and actions have another unit in their third coordinate; observations do not."""

    state_size = action_size = 3
    sensing_actions = PEG.sensing_actions
    num_stages = PEG.num_stages
    resolution = PEG.resolution
    motion_variance = PEG.motion_variance * SCALE**2

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return np.asarray(PEG.initial_states(stream, count) * SCALE)

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        return np.asarray(PEG.move(states / SCALE, actions / SCALE, stream) * SCALE)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return PEG.observation_mean(states / SCALE, sensing_action)

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return PEG.observation_variance(states / SCALE, sensing_action)

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return np.asarray(PEG.policy(states / SCALE, stage) * SCALE)

    def next_stage(self, estimates: FloatArray, stage: int | IntArray) -> int | IntArray:
        return PEG.next_stage(estimates / SCALE, stage)

    def is_goal(self, states: FloatArray) -> npt.NDArray[np.bool_]:
        return PEG.is_goal(states / SCALE)


@pytest.fixture(scope="module")
def states() -> list[PlanningState]:
    """The states of a few trials in which something was sensed."""
    settings = PlanningSettings()
    found = []
    for trial in range(12):
        environment = SimulatedEnvironment(PEG, 7, trial)
        state = planning.initial_state(PEG, settings, 7, trial)
        while not environment.is_done() and state.step < 200:
            if planning.needs_sensing(settings, state):
                found.append(state)
                action, _ = planning.choose_sensing_action(PEG, settings, state)
                shown = environment.perform_sensing(action)
                state, _ = planning.observe(PEG, settings, state, action, shown)
            task_action, _ = planning.choose_task_action(PEG, settings, state)
            environment.perform(task_action)
            state = planning.advance(PEG, settings, state, task_action)
    return found


def share_of_other_choices(states: list[PlanningState], selector: SelectorSettings) -> float:
    """Return how many choices are others where the angle has the other unit."""
    settings = msgspec.structs.replace(PlanningSettings(), selector=selector)
    scaled = InTenthsOfARadian()
    others = 0
    for state in states:
        there = state._replace(
            belief=state.belief._replace(states=np.ascontiguousarray(state.belief.states * SCALE))
        )
        here, _ = planning.choose_sensing_action(PEG, settings, state)
        chosen, _ = planning.choose_sensing_action(scaled, settings, there)
        others += here != chosen
    return others / len(states)


def test_the_mixture_does_not_depend_on_units(states: list[PlanningState]) -> None:
    assert len(states) > 80
    for method in ("action_entropy", "state_entropy"):
        selector = SelectorSettings(method=method, estimator="gaussian_mixture_upper")
        assert share_of_other_choices(states, selector) == 0.0


def test_neighbours_and_the_covariance_depend_on_units(states: list[PlanningState]) -> None:
    """Distances add squared metres and squared radians, as a trace does."""
    default, covariance = (
        share_of_other_choices(states, SelectorSettings(method=method))
        for method in ("action_entropy", "action_covariance")
    )
    # The shares that docs/results.md tells.
    assert f"{100.0 * default:.0f} % and {100.0 * covariance:.0f} %" == "22 % and 13 %"
