"""The beliefs that decisions are timed on.

A decision's cost depends on the belief: a wide one leaves few particles to a hypothetical
observation, a narrow one nearly all. So a trial is run and its belief at every sensing step is
kept: from the initial one over spread ones to those with the peg in the hole.
"""

from __future__ import annotations

import time
from typing import Any

import msgspec
import numpy as np

from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import Belief
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings, SelectorSettings
from holdfast.problems.problem import Problem
from holdfast.robot.environment import SimulatedEnvironment

__all__ = [
    "concentrated_state",
    "default_settings",
    "recorded_trial",
    "settings_for",
    "with_sensing",
]

SEED = 0
MAX_STEPS = 500


def settings_for(num_particles: int, threads: int, **sensing: Any) -> PlanningSettings:
    """Return the published settings (nearest neighbours, M = 10, k = 5), changed as asked."""
    settings = PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=num_particles),
        selector=SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
    )
    return with_sensing(settings, num_cores=threads, **sensing)


def default_settings(num_particles: int, threads: int) -> PlanningSettings:
    """Return what a user has who sets neither method nor estimator."""
    particle_filter = ParticleFilterSettings(num_particles=num_particles)
    return with_sensing(PlanningSettings(particle_filter=particle_filter), num_cores=threads)


def with_sensing(settings: PlanningSettings, **sensing: Any) -> PlanningSettings:
    """Return settings with other values in the section ``active_sensing``."""
    changed = msgspec.structs.replace(settings.active_sensing, **sensing)
    return msgspec.structs.replace(settings, active_sensing=changed)


def recorded_trial(
    problem: Problem,
    settings: PlanningSettings,
    trial: int = 0,
    *,
    seed: int = SEED,
    max_steps: int = MAX_STEPS,
) -> tuple[list[PlanningState], list[float]]:
    """Run a trial; return its state before each sensing decision and what the decision took.

    Returns
    -------
    states : list of PlanningState
    seconds : list of float
        Each decision made once, where it belongs, in between everything else that a trial does.
    """
    planner = Planner(problem, settings)
    state = planner.init(seed, trial)
    environment = SimulatedEnvironment(problem, seed, trial)
    states, seconds = [], []
    while not environment.is_done() and state.step < max_steps:
        if planner.needs_sensing(state):
            states.append(state)
            start = time.perf_counter()
            sensing_action, _ = planner.choose_sensing_action(state)
            seconds.append(time.perf_counter() - start)
            observation = environment.perform_sensing(sensing_action)
            state, _ = planner.observe(state, sensing_action, observation)
        task_action, _ = planner.choose_task_action(state)
        environment.perform(task_action)
        state = planner.advance(state, task_action)
    return states, seconds


def concentrated_state(
    num_particles: int, deviation: float, *, in_space: bool = False, heavy_tails: bool = False
) -> PlanningState:
    """Return a Gaussian belief around (0, 1, 0): the peg above the hole, about to be lowered.

    In space around (0, 0, 1, 0, 0, 0). With heavy tails the particles follow Student's t
    distribution with two degrees of freedom.
    """
    centre = np.array([0.0, 0.0, 1.0, 0.0, 0.0, 0.0] if in_space else [0.0, 1.0, 0.0])
    draws = stream(SEED, 0, 0, Purpose.INITIAL_BELIEF)
    deviations = deviation * draws.normal((num_particles, len(centre)))
    if heavy_tails:
        # The root of a mean of two squares.
        squares = draws.substream(1).normal((num_particles, 2)) ** 2
        deviations = deviations / np.sqrt(0.5 * (squares[:, :1] + squares[:, 1:]))
    return PlanningState(SEED, 0, 0, 0, False, Belief.uniform(centre + deviations))
