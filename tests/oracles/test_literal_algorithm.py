"""The kernel against Algorithm 2 as it is written (benchmarks/literal.py), on the same draws.

The two share the problem's functions and the random numbers, and no more: SciPy's k-d tree and
digamma on one side, the kernel on the other. So the benchmark's ratio is one of equal work.
"""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import literal
from tests.oracles.reference_entropy import nearest_neighbor_entropy

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import Belief
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


@pytest.mark.parametrize("deviation", [0.3, 0.05, 0.002])
@pytest.mark.parametrize("num_particles", [30, pytest.param(1200, marks=pytest.mark.slow)])
def test_concentrated_beliefs(deviation: float, num_particles: int) -> None:
    problem, settings = PegInHole2D(), settings_of(num_particles)
    draws = stream(5, 0, 0, Purpose.INITIAL_BELIEF)
    states = np.array([0.0, 1.0, 0.0]) + deviation * draws.normal((num_particles, 3))
    weights = draws.substream(1).uniform(num_particles)
    state = PlanningState(5, 0, 0, 0, False, Belief.weighted(states, weights))
    entropies = assert_same_decision(problem, settings, state)
    if deviation > 0.01:  # below the noise of an observation there is nothing to tell apart
        assert np.ptp(entropies) > 1e-3


def test_copies_of_particles_and_of_actions() -> None:
    """After resampling many particles are equal; far from the hole actions differ in x alone."""
    problem, settings = PegInHole2D(), settings_of(120)
    draws = stream(6, 0, 0, Purpose.INITIAL_BELIEF)
    states = np.array([0.5, 1.0, 0.0]) + 0.3 * draws.normal((12, 3))
    belief = Belief.uniform(np.repeat(states, 10, axis=0))
    assert_same_decision(problem, settings, PlanningState(6, 0, 0, 0, False, belief))


@pytest.mark.parametrize("estimate", ESTIMATES)
@pytest.mark.parametrize("resolution", [1e-3, 0.25])
def test_literal_entropy_is_the_reference_with_ties(
    resolution: float, estimate: literal.Entropy
) -> None:
    """Points on a grid of powers of two: distances tie, also with the resolution, exactly."""
    draws = stream(7, 0, 0, Purpose.INITIAL_BELIEF)
    points = np.floor(draws.uniform((60, 2)) * 12.0) / 8.0
    weights = draws.substream(1).uniform(60)
    mine = estimate(points, weights / weights.sum(), 5, resolution)
    reference = nearest_neighbor_entropy(points, weights / weights.sum(), 5, resolution)
    assert mine == pytest.approx(reference, abs=TOLERANCE)


def test_number_of_samples_and_neighbors() -> None:
    problem = PegInHole2D()
    settings = msgspec.structs.replace(
        settings_of(150),
        active_sensing=ActiveSensingSettings(
            num_cores=1, num_observation_samples=4, num_nearest_neighbors=9
        ),
    )
    assert_same_decision(problem, settings, Planner(problem, settings).init(seed=1, trial=0))


def test_a_resolution_for_each_coordinate() -> None:
    problem = PegInHole2D()
    settings = msgspec.structs.replace(
        settings_of(80),
        selector=SelectorSettings(
            method="action_entropy", estimator="nearest_neighbor", resolution=(0.1, 0.02, 0.5)
        ),
    )
    assert_same_decision(problem, settings, Planner(problem, settings).init(seed=1, trial=0))
