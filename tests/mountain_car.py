"""A problem for gymnasium's car in a valley, and who may be killed there; tests copy this file."""

import os
import signal
from pathlib import Path
from typing import Any

import numpy as np

import holdfast as hf

CONFIGURATION = """
problem: mountain_car:Car
particle_filter: {num_particles: 30}
active_sensing: {num_observation_samples: 2, num_cores: 1}
simulator: {num_trials: 2, max_steps: 200, seed: 3, sensing_intervals: 2}
environment:
  object: gymnasium
  arguments:
    env_id: MountainCarContinuous-v0
    sensing: [[0], [1]]
    sensing_noise: [0.05, 0.01]
    success: mountain_car:at_the_top
"""


class Car(hf.ProblemBase):
    name = "car"
    state_size, action_size = 2, 1
    sensing_actions = ("position", "speed")
    resolution = 0.1
    motion_variance = np.zeros(1)

    def initial_states(self, stream: Any, count: int) -> Any:
        return np.array([-0.5, 0.0]) + np.array([0.05, 0.0]) * stream.normal((count, 2))

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        return states + np.array([0.01, 0.002]) * stream.normal(states.shape)

    def observation_mean(self, states: Any, sensing_action: int) -> Any:
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: Any, sensing_action: int) -> Any:
        return np.array([(0.05, 0.01)[sensing_action] ** 2])

    def policy(self, states: Any, stage: Any) -> Any:
        return np.where(states[..., 1:] >= 0.0, 1.0, -1.0)

    def is_goal(self, states: Any) -> Any:
        return states[..., 0] > 0.45


def at_the_top(environment: Any, observation: Any, info: Any) -> bool:
    # Where a test asks for it, the robot's process is killed once in each of these moves.
    count = environment.get_wrapper_attr("_elapsed_steps")
    killed = Path(f"killed-{count}")
    if count in (17, 40) and Path("kills").exists() and not killed.exists():
        killed.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return bool(observation[0] >= 0.45)
