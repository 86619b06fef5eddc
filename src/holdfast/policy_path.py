"""What the policy will do along each particle's own way.

Two particles may ask for the same action now and for different ones later: both go to the axis of
the hole, and only above it the angle matters. So follow every particle for itself, without noise,
as the policy would lead it if its state were known, and look at the actions at several steps of
that way. Sensing does not move the state: the ways are the same whatever is sensed, and they are
computed once for a decision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast import contract
from holdfast.entropy import LARGEST, first_unbounded
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.problems.problem import Problem
from holdfast.randomness import NOISE_FREE
from holdfast.settings import PlanningSettings, path_steps, unfit_for_path_entropy

__all__ = ["PathPoints", "path_points"]

FloatArray = npt.NDArray[np.float64]


class PathPoints(NamedTuple):
    """The actions along the particles' ways.

    Attributes
    ----------
    points : array of shape (K, N, action_size)
        The actions of all particles at each of the K offsets.
    factors : tuple of float
        What the entropy at each offset counts, K of them.
    """

    points: FloatArray
    factors: tuple[float, ...]


def path_points(
    problem: Problem, settings: PlanningSettings, states: FloatArray, stage: int
) -> PathPoints:
    """Follow every particle along its own noise-free way under the policy.

    In each step the policy is asked for the particle's state and stage, its action limited by
    ``execute``, the state moved by it without noise, and the stage followed.

    Parameters
    ----------
    problem : Problem
    settings : PlanningSettings
        ``selector.path_offsets``, ``path_unit``, ``path_discount`` and ``actions`` count.
    states : array of shape (N, state_size)
    stage : int
        Of all particles, to begin with.

    Raises
    ------
    InvalidValueError
        If the offsets do not increase, reach too far, or the horizon is above 1.
    ProblemError
        If a function of the problem breaks its contract.
    """
    if (unfit := unfit_for_path_entropy(settings)) is not None:
        (section, key), reason = unfit
        raise InvalidValueError(f"{section}.{key} {reason}")
    offsets = path_steps(settings)
    executed = settings.selector.actions == "executed"
    points = np.empty((len(offsets), states.shape[0], problem.action_size))
    several_stages = problem.num_stages > 1
    stages: int | npt.NDArray[np.int64] = stage
    if several_stages:
        stages = np.full(states.shape[0], stage, dtype=np.int64)
    step = 0
    for row, offset in zip(points, offsets, strict=True):
        while step < offset:
            actions = problem.execute(problem.policy(states, stages))
            states = contract.expected_move(problem, states, actions, NOISE_FREE)
            if several_stages:
                stages = contract.next_stages(problem, states, stages)
            step += 1
        actions = contract.policy(problem, states, stages)
        row[...] = contract.executed_action(problem, actions) if executed else actions
        if (bad := first_unbounded(row)) is not None:
            raise ProblemError(
                f"policy of {problem.name} returned {contract.in_brief(row[bad])} in state "
                f"{contract.in_brief(states[bad])}, {offset} steps on: every coordinate must be "
                f"finite and at most {LARGEST:g}"
            )
    return PathPoints(points, _factors(offsets, settings.selector.path_discount))


def _factors(offsets: tuple[int, ...], discount: float) -> tuple[float, ...]:
    """Return ``discount**offset`` by multiplication, which has the same bits everywhere."""
    factors = []
    factor = 1.0
    step = 0
    for offset in offsets:
        for _ in range(offset - step if discount < 1.0 else 0):
            factor *= discount
        step = offset
        factors.append(factor)
    return tuple(factors)
