"""The example of an agent that learns what to sense."""

import importlib.util
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium
import numpy as np
import pytest

import holdfast as hf

EXAMPLE = Path(__file__).parents[2] / "examples" / "learn_sensing.py"


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location("learn_sensing", EXAMPLE)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class OneOfFour(hf.ProblemBase):
    """A point on its way to 0; of its four sensors one sees anything."""

    name = "one_of_four"
    state_size = action_size = 1
    sensing_actions = ("fog", "dark", "dust", "clear")
    resolution = 0.01
    motion_variance = np.array([1e-4])

    def initial_states(self, stream: Any, count: int) -> Any:
        return 2.0 + stream.normal((count, 1))

    def move(self, states: Any, actions: Any, stream: Any) -> Any:
        return states + actions + 0.01 * stream.normal(states.shape)

    def observation_mean(self, states: Any, sensing_action: int) -> Any:
        return states

    def observation_variance(self, states: Any, sensing_action: int) -> Any:
        return np.array([1e-3 if sensing_action == 3 else 1e6])

    def policy(self, states: Any, stage: Any) -> Any:
        return -states

    def limit_action(self, actions: Any) -> Any:
        return np.clip(actions, -0.5, 0.5)

    def is_goal(self, states: Any) -> Any:
        return np.abs(states[..., 0]) < 0.02


def test_it_learns(example: ModuleType) -> None:
    """Of episodes of at most 40 steps it needs no more than 20, which no blind agent does."""
    environment = gymnasium.make(
        "holdfast_env:Problem-v0",
        problem=OneOfFour(),
        particles=30,
        sensing_interval=1,
        max_steps=40,
    ).unwrapped
    weights = example.learn(environment, generations=4, population=12, best=4, episodes=3)
    agents = [example.linear_agent(environment, weights), *(lambda _, n=n: n for n in range(4))]
    learned, *fixed = (
        -np.mean([example.total_reward(environment, agent, 2, trial) for trial in range(10)])
        for agent in agents
    )
    assert min(fixed[:3]) > 20.0 > fixed[3]
    assert learned < 20.0
