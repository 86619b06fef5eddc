"""What a look is expected to gain, next to the truth: the bias that decides whether to sense.

Where not to sense is a choice, an entropy after a look is compared with that of the belief as it
is. A sharp look leaves few particles, and the belief has all of them; so an error that depends on
their number no longer cancels. Here the belief is normal with a standard deviation of 1 m in both
coordinates, the action is y, and a look shows y (its gain is known: half the logarithm of
1 + 1 / variance) or x (which gains nothing)::

    python -m benchmarks.gain_bias

takes a minute. Means over beliefs, with the standard deviation from one decision to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import get_args

import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, Stream, stream
from holdfast.planning.belief import Belief
from holdfast.planning.sensing import choose_sensing_action
from holdfast.planning.settings import (
    ActiveSensingSettings,
    Estimator,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.problem import ProblemBase

COUNTS = (100, 300, 1000)
DEVIATIONS = (0.02, 0.1, 0.5)
BELIEFS = 60
SEED = 6201


class Plane(ProblemBase):
    """The action is y; the sensing actions show x and y."""

    name = "plane"
    state_size = 2
    action_size = 1
    sensing_actions: Sequence[str] = ("x", "y")
    resolution = 0.01
    motion_variance = np.array([1e-4])

    def __init__(self, deviation: float) -> None:
        self.variance = np.array([deviation**2])

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        return stream.normal((count, 2))

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        del actions, stream
        return states

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., sensing_action : sensing_action + 1]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        del states, sensing_action
        return self.variance

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        del stage
        return -states[..., 1:]

    def is_goal(self, states: FloatArray) -> BoolArray:
        return np.zeros(states.shape[:-1], dtype=np.bool_)


def gains_of(deviation: float, count: int, estimator: Estimator) -> FloatArray:
    """Return the gains of looking along x and along y, in nats, shape (BELIEFS, 2)."""
    problem = Plane(deviation)
    settings = PlanningSettings(
        active_sensing=ActiveSensingSettings(num_cores=1),
        selector=SelectorSettings(
            method="action_entropy", estimator=estimator, sensing_is_optional=True
        ),
    )
    gains = []
    for number in range(BELIEFS):
        drawn, hypotheses, selection = (
            stream(SEED, number, 0, purpose)
            for purpose in (Purpose.INITIAL_BELIEF, Purpose.HYPOTHESES, Purpose.SELECTION)
        )
        belief = Belief.uniform(problem.initial_states(drawn, count))
        _, info = choose_sensing_action(problem, settings, belief, 0, hypotheses, selection)
        assert info.entropies is not None
        gains.append(info.entropies[2] - info.entropies[:2])
    return np.array(gains)


def main() -> None:
    print("estimator, particles, deviation of a look: gain of x (truth 0), gain of y (truth)")
    for estimator in get_args(Estimator):
        for count in COUNTS:
            for deviation in DEVIATIONS:
                gains = gains_of(deviation, count, estimator)
                mean, spread = gains.mean(axis=0), gains.std(axis=0, ddof=1)
                truth = 0.5 * np.log(1.0 + 1.0 / deviation**2)
                print(
                    f"{estimator:23}{count:5} {deviation:5}: {mean[0]:+.2f} +- {spread[0]:.2f}   "
                    f"{mean[1]:+.2f} +- {spread[1]:.2f} ({truth:.2f})",
                    flush=True,
                )


if __name__ == "__main__":
    main()
