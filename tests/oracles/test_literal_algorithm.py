"""The kernel against Algorithm 2 as it is written (benchmarks/literal.py), on the same draws.

The two share the problem's functions and the random numbers, and no more: SciPy's k-d tree and
digamma on one side, the kernel on the other. So the benchmark's ratio is one of equal work.
"""

import numpy as np
import pytest
from benchmarks import literal

from holdfast.numerics.arrays import FloatArray
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.peg_in_hole_3d import PegInHole3D
from holdfast.problems.problem import Problem
from holdfast.robot.environment import SimulatedEnvironment

# The sum of some thousand terms of about 10 nats, each with a relative error of a few 1e-15.
TOLERANCE = 1e-9

ESTIMATES = [literal.nearest_neighbor_entropy, literal.tuned_nearest_neighbor_entropy]


def settings_of(num_particles: int) -> PlanningSettings:
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=num_particles),
        active_sensing=ActiveSensingSettings(num_cores=1),
        selector=SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    )


def assert_same_decision(
    problem: Problem, settings: PlanningSettings, state: PlanningState
) -> FloatArray:
    index, info = Planner(problem, settings).choose_sensing_action(state)
    assert info.entropies is not None
    for estimate in ESTIMATES:
        literal_index, entropies = literal.choose_sensing_action(problem, settings, state, estimate)
        np.testing.assert_allclose(info.entropies, entropies, rtol=0.0, atol=TOLERANCE)
        best = np.sort(entropies)
        if best[1] - best[0] > 2.0 * TOLERANCE:
            assert index == literal_index
    return info.entropies


@pytest.mark.parametrize("problem", [PegInHole2D(), PegInHole3D()], ids=["2d", "3d"])
@pytest.mark.parametrize("num_particles", [50, 200])
def test_every_decision_of_a_trial(problem: Problem, num_particles: int) -> None:
    settings = settings_of(num_particles)
    planner = Planner(problem, settings)
    state = planner.init(seed=11, trial=2)
    environment = SimulatedEnvironment(problem, seed=11, trial=2)
    decisions = 0
    while not environment.is_done() and state.step < 60:
        if planner.needs_sensing(state):
            assert_same_decision(problem, settings, state)
            action, _ = planner.choose_sensing_action(state)
            decisions += 1
            observation = environment.perform_sensing(action)
            state, _ = planner.observe(state, action, observation)
        task_action, _ = planner.choose_task_action(state)
        environment.perform(task_action)
        state = planner.advance(state, task_action)
    assert decisions >= 5
