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
from holdfast.randomness import NoiseFreeStream
from holdfast.settings import PlanningSettings, path_steps, unfit_for_path_entropy

__all__ = ["PathPoints", "path_points"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]

_STEP = ("policy", "execute", "move", "expected_move", "next_stage")
"""What a step of the way is made of."""


_MOST_DRAWS = 1000
"""Of a move without noise: one that draws more often waits for another number."""


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
    threads = settings.active_sensing.num_cores
    states_at, stages_at = _followed(problem, states, stage, offsets, threads)
    points = contract.policy(problem, states_at, stages_at)
    if settings.selector.actions == "executed":
        points = contract.executed_action(problem, points)
    if (bad := first_unbounded(points.reshape(-1, points.shape[-1]))) is not None:
        row, particle = divmod(bad, states.shape[0])
        raise ProblemError(
            f"policy of {problem.name} returned {contract.in_brief(points[row, particle])} in "
            f"state {contract.in_brief(states_at[row, particle])}, {offsets[row]} steps on: every "
            f"coordinate must be finite and at most {LARGEST:g}"
        )
    selector = settings.selector
    return PathPoints(points, _factors(selector.path_offsets, selector.path_discount))


def _followed(
    problem: Problem, states: FloatArray, stage: int, offsets: tuple[int, ...], threads: int
) -> tuple[FloatArray, int | IntArray]:
    """Return the states at each offset, shape (K, N, state_size), and the stages there, (K, N)."""
    if contract.has_own(problem, "expected_path", _STEP):
        states_at, stages_at = contract.expected_path(problem, states, stage, offsets, threads)
        # One stage for all is the same, and most policies look it up once then.
        first = stages_at.flat[0]
        return states_at, int(first) if (stages_at == first).all() else stages_at
    states_at = np.empty((len(offsets), *states.shape))
    stages_at = np.full(states_at.shape[:2], stage, dtype=np.int64)
    several_stages = problem.num_stages > 1
    stages = stages_at[0].copy()
    step = 0
    for number, offset in enumerate(offsets):
        while step < offset:
            own_stages = stages if several_stages else stage
            actions = contract.executed_action(
                problem, contract.policy(problem, states, own_stages)
            )
            noise_free = NoiseFreeStream(_MOST_DRAWS)
            states = contract.expected_move(problem, states, actions, noise_free)
            if several_stages:
                stages = contract.next_stages(problem, states, stages)
            step += 1
        states_at[number] = states
        stages_at[number] = stages
    states_at.setflags(write=False)
    return states_at, stages_at if several_stages else stage


def _factors(offsets: tuple[int, ...], discount: float) -> tuple[float, ...]:
    """Return ``discount**offset`` by multiplication, which has the same bits everywhere."""
    factors = []
    factor = 1.0
    before = 0
    for offset in offsets:
        for _ in range(offset - before if discount < 1.0 else 0):
            factor *= discount
        before = offset
        factors.append(factor)
    return tuple(factors)
