"""The actions of the policy along each particle's own path.

Two particles may need the same action now and different ones later: both go to the axis of the
hole, and only above it the angle matters. So every particle is followed by itself, without noise,
as the policy would lead it if its state were known, and the actions at several steps of that path
count. Sensing does not move the state, so the paths are computed once for a decision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from holdfast import _kernel
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics.arrays import FloatArray, IntArray, in_brief
from holdfast.numerics.randomness import NoiseFreeStream
from holdfast.planning import interruption
from holdfast.planning.estimators import LARGEST, first_unbounded
from holdfast.planning.settings import PlanningSettings, path_steps, unfit_for_the_method
from holdfast.problems import checked
from holdfast.problems.attributes import has_own
from holdfast.problems.problem import Problem

_STEP = ("policy", "limit_action", "move", "expected_move", "next_stage")
"""Functions that a step of the path calls."""

_MOST_DRAWS = 1000
"""Bound on the draws of a move without noise: one that exceeds it waits for another number."""


class PathPoints(NamedTuple):
    """The actions of all particles at each of K offsets, shape (K, N, action_size).

    ``factors`` are the weights of the entropies at the offsets.
    """

    points: FloatArray
    factors: tuple[float, ...]


def path_points(
    problem: Problem, settings: PlanningSettings, states: FloatArray, stage: int
) -> PathPoints:
    """Follow every particle along its own noise-free path under the policy.

    A step is the policy's action for the particle's state and stage, limited by ``limit_action``,
    the motion without noise, and the next stage. All particles begin in one stage. Of the settings,
    ``selector.path_offsets``, ``path_unit``, ``path_discount`` and ``actions`` count.

    Raises InvalidValueError if the offsets do not increase, reach too far, or the horizon is above
    1; ProblemError if a function of the problem breaks its contract.
    """
    if (unfit := unfit_for_the_method(settings)) is not None:
        (section, key), reason = unfit
        raise InvalidValueError(f"{section}.{key} {reason}")
    offsets, threads = path_steps(settings), settings.active_sensing.num_cores
    way = problem, states, stage, offsets, threads
    if has_own(problem, "_path_actions", ("expected_path", *_STEP)):
        points = checked.path_actions(*way)
    else:
        points = checked.policy(problem, *_followed(*way))
    if settings.selector.actions == "executed":
        points = checked.executed_action(problem, points)
    if (bad := first_unbounded(points.reshape(-1, points.shape[-1]))) is not None:
        states_at, _ = _followed(*way)
        row, particle = divmod(bad, states.shape[0])
        if not np.isfinite(states_at[row, particle]).all():
            raise ProblemError(
                f"following the policy of {problem.name} without noise (policy, limit_action, "
                f"move) led from the state {in_brief(states[particle])} in {offsets[row]} steps to "
                f"{in_brief(states_at[row, particle])}: every coordinate must be finite"
            )
        raise ProblemError(
            f"policy of {problem.name} returned {in_brief(points[row, particle])} in "
            f"state {in_brief(states_at[row, particle])}, {offsets[row]} steps on: every "
            f"coordinate must be finite and at most {LARGEST:g}"
        )
    selector = settings.selector
    return PathPoints(points, _factors(selector.path_offsets, selector.path_discount))


def _followed(
    problem: Problem, states: FloatArray, stage: int, offsets: tuple[int, ...], threads: int
) -> tuple[FloatArray, int | IntArray]:
    """Return the states at each offset, shape (K, N, state_size), and the stages there, (K, N)."""
    if has_own(problem, "expected_path", _STEP):
        states_at, stages_at = checked.expected_path(problem, states, stage, offsets, threads)
        # An integer is faster than equal stages for all: most policies then select once.
        first = int(stages_at.flat[0])
        if problem.num_stages == 1 or _kernel.all_integers_within(stages_at, first, first):
            return states_at, first
        return states_at, stages_at
    states_at = np.empty((len(offsets), *states.shape))
    stages_at = np.full(states_at.shape[:2], stage, dtype=np.int64)
    several_stages = problem.num_stages > 1
    stages = stages_at[0].copy()
    step = 0
    for number, offset in enumerate(offsets):
        while step < offset:
            interruption.check()
            own_stages = stages if several_stages else stage
            actions = checked.executed_action(problem, checked.policy(problem, states, own_stages))
            noise_free = NoiseFreeStream(_MOST_DRAWS)
            states = checked.expected_move(problem, states, actions, noise_free)
            if several_stages:
                stages = checked.next_stages(problem, states, stages)
            step += 1
        states_at[number] = states
        stages_at[number] = stages
    states_at.setflags(write=False)
    return states_at, stages_at if several_stages else stage


def nats_of_halving(settings: PlanningSettings) -> float:
    """Return by how much the score falls if the spread of one coordinate is halved, in nats.

    An entropy falls by log 2. ``path_entropy`` adds up several, by default 1 + 1/2 of them.
    """
    own = settings.selector
    weights = _factors(own.path_offsets, own.path_discount)
    return float(np.log(2.0)) * (sum(weights) if own.method == "path_entropy" else 1.0)


def _factors(offsets: tuple[int, ...], discount: float) -> tuple[float, ...]:
    """Return ``discount**offset`` by multiplication, which has the same bits everywhere."""
    factors, factor, before = [], 1.0, 0
    for offset in offsets:
        for _ in range(offset - before if discount < 1.0 else 0):
            factor *= discount
        before = offset
        factors.append(factor)
    return tuple(factors)
