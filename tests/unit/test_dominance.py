"""Sensing actions that another one makes superfluous, and the estimator that leaves them out."""

from typing import Any

import numpy as np
import pytest

from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import Belief
from holdfast.planning.dominance import dominated
from holdfast.planning.sensing import choose_sensing_action
from holdfast.planning.settings import Estimator, PlanningSettings, SelectorSettings
from holdfast.problems.problem import ProblemBase

X, Y = stream(3, 0, 0, Purpose.HYPOTHESES).normal((2, 50))
FREE = np.zeros(2)


class Sensors(ProblemBase):
    """All coordinates but the last are actions; the sensors show single coordinates."""

    name = "sensors"
    resolution = 0.05

    def __init__(self, size: int, *shown: tuple[int, float]) -> None:
        self.state_size, self.action_size, self.shown = size + 1, size, shown
        self.sensing_actions = [str(each) for each in shown]
        self.motion_variance = np.full(size, 1e-3)

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return states[..., [self.shown[sensing_action][0]]]

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        return np.array([self.shown[sensing_action][1] ** 2])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        return -states[..., :-1]


def choices_of(problem: Any, estimator: Estimator) -> list[int]:
    selector = SelectorSettings(method="action_entropy", estimator=estimator)
    chosen = []
    for trial in range(50):
        drawn = stream(8, trial, 0, Purpose.INITIAL_BELIEF).normal((300, problem.state_size))
        names = (stream(8, trial, 0, each) for each in (Purpose.HYPOTHESES, Purpose.SELECTION))
        belief, settings = Belief.uniform(drawn), PlanningSettings(selector=selector)
        chosen.append(choose_sensing_action(problem, settings, belief, 0, *names)[0])
    return chosen


@pytest.mark.parametrize("size", [1, 2, 3, 6])
def test_no_dull_and_no_useless_sensor_wins(size: int) -> None:
    """The estimate alone takes the dull one of two sensors in most decisions, from 3 coordinates.

    And a mixture always takes the sharp sensor of what changes no action.
    """
    dull = Sensors(size, (0, 0.3), (0, 0.03))
    assert choices_of(dull, "prior_neighbors_undominated") == [1] * 50
    assert (sum(choices_of(dull, "prior_neighbors")) < 25) == (size >= 3)
    useless = Sensors(size, (0, 0.3), (size, 0.03))
    assert choices_of(useless, "prior_neighbors_undominated") == [0] * 50
    assert sum(choices_of(useless, "gaussian_mixture_upper")) > 40


@pytest.mark.parametrize(
    ("sizes", "means", "variances", "prices", "expected"),
    [
        ([1, 1], [X, 3.0 - 2.0 * X], [0.1, 0.5], FREE, [0, 1]),  # twice the signal, more noise
        ([1, 1], [X, 3.0 - 2.0 * X], [0.1, 0.3], FREE, [1, 0]),
        ([1, 1], [X, X], [0.1, 0.1], FREE, [0, 0]),  # neither is worse
        ([1, 1], [X, X], [0.1, 0.2], np.array([1.0, 0.0]), [0, 0]),  # a price of its own
        ([1, 1], [X, X * X], [0.1, 9.9], FREE, [0, 0]),  # cannot be made of it
        ([1, 1], [X, Y], [0.1, 9.9], FREE, [0, 0]),
        ([2, 1], [Y, X, X], [0.1, 0.1, 0.1], FREE, [0, 1]),  # a part of it
        ([2, 2], [X, Y, Y, X], [0.1, 0.2, 0.2, 0.3], FREE, [0, 1]),
        ([2, 2], [X, Y, Y, X], [0.1, 0.2, 0.1, 0.3], FREE, [0, 0]),
        ([1, 1], [0.0 * X, 0.0 * X], [0.1, 0.2], FREE, [0, 0]),  # nothing is left to tell
        ([1, 1], [X, X], [0.1 + 0.0 * X, 0.2 + Y * Y], FREE, [0, 0]),  # the noise tells something
    ],
)
def test_dominated(
    sizes: list[int], means: Any, variances: Any, prices: FloatArray, expected: list[int]
) -> None:
    spread = np.array(variances).reshape(sum(sizes), -1)
    assert dominated(sizes, np.array(means), spread, prices).astype(int).tolist() == expected
