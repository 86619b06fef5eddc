"""What it gains to draw static parameters anew: ``python -m benchmarks.static_parameters``.

Three robots that have to learn something that does not move: where their target is, by looking
along either axis; where a beacon is, by its range and direction; what their drift is, by where it
takes them. Paired trials of 300 particles with random sensing: without ``static_parameters``, with
a little noise in their place (a hundredth of the initial spread a step), and with them. A trial
costs its steps, or 300 if it does not succeed.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.planner import Planner
from holdfast.planning.settings import PlanningSettings, SelectorSettings
from holdfast.problems.problem import ProblemBase
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import run_trial

SEED, MAX_STEPS = 12, 300
SETTINGS = PlanningSettings(selector=SelectorSettings(method="random"), sensing_interval=4)


class Target(ProblemBase):
    """Its own place x, y, and that of the target, which is seen along x or y."""

    name = "target"
    state_size, action_size = 4, 2
    sensing_actions: Sequence[str] = ("x", "y", "target along x", "target along y")
    variances: ClassVar[tuple[float, ...]] = (0.09, 0.09, 0.01, 0.01)
    resolution = 0.05
    start: ClassVar[tuple[float, ...]] = (0.0, 0.0, 4.0, 0.0)
    spread: ClassVar[tuple[float, ...]] = (0.3, 0.3, 2.0, 2.0)
    step, noise, near = 0.1, 0.02, 0.1

    def __init__(self, roughening: float = 0.0) -> None:
        self.motion_variance = np.full(2, self.noise**2)
        static = roughening * np.array(self.spread[2:])
        self._deviations = np.concatenate([[self.noise, self.noise], static])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return np.asarray(self.start + stream.normal((count, 4)) * np.array(self.spread))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        moved = states + self._deviations * stream.normal(states.shape)
        moved[..., :2] += actions + self.drift(states)
        return moved

    def drift(self, states: FloatArray) -> FloatArray:
        return 0.0 * states[..., :2]

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        seen = states[..., [sensing_action]]
        return seen if sensing_action < 2 else seen - states[..., [sensing_action - 2]]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        del states
        return np.array([self.variances[sensing_action]])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        del stage
        return states[..., 2:] - states[..., :2]

    def limit_action(self, actions: FloatArray) -> FloatArray:
        return np.clip(actions, -self.step, self.step)

    def is_goal(self, states: FloatArray) -> BoolArray:
        return np.asarray((np.abs(self.policy(states, 0)) < self.near).all(axis=-1))


class Beacon(Target):
    """The same, by the range and the direction."""

    name = "beacon"
    sensing_actions = ("range", "direction")
    variances = (0.04, 0.01)
    start = (0.0, 0.0, 0.0, 0.0)
    spread = (0.1, 0.1, 3.0, 3.0)
    step, near = 0.2, 0.2

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        away = states[..., 2:] - states[..., :2]
        ranges = np.sqrt(away[..., :1] * away[..., :1] + away[..., 1:] * away[..., 1:])
        return ranges if sensing_action == 0 else away[..., 1:] / np.maximum(ranges, 1e-9)


class Drift(Target):
    """To the origin, against a drift."""

    name = "drift"
    sensing_actions = ("x", "y")
    variances = (0.01, 0.01)
    start = (4.0, 2.0, 0.0, 0.0)
    spread = (1.0, 1.0, 0.08, 0.08)
    step, noise, near = 0.15, 0.05, 0.08

    def drift(self, states: FloatArray) -> FloatArray:
        return states[..., 2:]

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., [sensing_action]]

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        del stage
        return -states[..., :2] - states[..., 2:]

    def is_goal(self, states: FloatArray) -> BoolArray:
        return np.asarray((np.abs(states[..., :2]) < self.near).all(axis=-1))


def costs_of(problem: Target, trials: int) -> FloatArray:
    """Return the costs of trials in the world of the problem without roughening."""
    planner = Planner(problem, SETTINGS)
    costs = []
    for trial in range(trials):
        world = SimulatedEnvironment(type(problem)(), SEED, trial)
        result = run_trial(planner, SEED, trial, max_steps=MAX_STEPS, environment=world)
        costs.append(float(result.steps if result.success else MAX_STEPS))
    return np.array(costs)


def main(trials: int) -> None:
    """Print the means, and the differences from the first with 95 % intervals."""
    for kind in (Target, Beacon, Drift):
        plain = costs_of(kind(), trials)
        named = kind()
        named.static_parameters = (2, 3)
        print(f"{kind.name}: {plain.mean():.1f} steps")
        for way, problem in (("noise", kind(0.01)), ("static_parameters", named)):
            differences = costs_of(problem, trials) - plain
            half = 1.96 * differences.std(ddof=1) / np.sqrt(trials)
            mean = differences.mean()
            print(f"  {way}: {mean:+.1f} [{mean - half:.1f}, {mean + half:.1f}]", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 200)
