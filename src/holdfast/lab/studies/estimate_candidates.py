"""Ways of turning a belief into one state, to choose among; holdfast itself has three of them.

Some look at the states alone: the mean, a likely place. Others look at what the policy would do in
each particle's state: what most of them agree on is done.

Where each particle would be compared with each other, a few stand for all as candidates, at even
shares of the weight: the time then grows with the number of particles, not its square.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from holdfast import _kernel, numerics
from holdfast.lab.errors import TaskError
from holdfast.lab.studies.trial_batches import run_trials_of
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.circular import differences
from holdfast.planning.belief import Belief, estimate
from holdfast.planning.planner import Planner, PlanningState
from holdfast.problems import checked
from holdfast.problems.attributes import circular_states
from holdfast.problems.problem import Problem

__all__ = ["CANDIDATES", "run_estimates"]

_PICKED = 50
"""Particles that may be chosen."""

_VOTES = 1.0
"""In resolutions: so near an action has to be to count as the same."""


def _mean(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    del stage
    return estimate(belief, "mean", circular_states(problem))


def _most_likely(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    del problem, stage
    return estimate(belief, "most_likely")


def _heaviest_mode(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    del stage
    return estimate(belief, "heaviest_mode", circular_states(problem))


def _nearest_particle(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    """Return the particle nearest to the mean."""
    del stage
    points = _standardised(problem, belief)
    away = _squares(points, np.zeros((1, points.shape[1])))
    return np.array(belief.states[int(away.argmin())])


def _medoid(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    """Return the particle that is nearest to all, by the sum of distances."""
    del stage
    return _least(belief, np.sqrt(_of_picked(belief, _standardised(problem, belief))))


def _densest_particle(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    """Return the particle with the greatest estimated density; bandwidth by Silverman."""
    del stage
    points = _standardised(problem, belief)
    count, size = points.shape
    bandwidth = numerics.exp(numerics.log(4.0 / ((size + 2) * count)) / (size + 4))
    squares = _of_picked(belief, points)
    return _least(belief, -numerics.exp(-0.5 * squares / (bandwidth * bandwidth)))


def _action_medoid(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    """Return the particle whose action is nearest to all actions, by the sum of distances."""
    return _least(belief, np.sqrt(_of_picked(belief, _actions(problem, belief, stage))))


def _action_vote(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    """Return the particle whose action most of the weight agrees on.

    Source: Simmons and Koenig, "Probabilistic robot navigation in partially observable
    environments", IJCAI 1995, section 4 (action voting), with actions that are not discrete.
    """
    squares = _of_picked(belief, _actions(problem, belief, stage))
    return _least(belief, -(squares <= _VOTES * _VOTES).astype(np.float64))


Candidate = Callable[[Problem, Belief, int], FloatArray]

CANDIDATES: Mapping[str, Candidate] = {
    "mean": _mean,
    "most_likely": _most_likely,
    "nearest_particle": _nearest_particle,
    "medoid": _medoid,
    "densest_particle": _densest_particle,
    "heaviest_mode": _heaviest_mode,
    "action_medoid": _action_medoid,
    "action_vote": _action_vote,
}
"""By name; each takes the problem, the belief and the stage."""


def _standardised(problem: Problem, belief: Belief) -> FloatArray:
    """Return the states about their mean, in standard deviations."""
    circular = circular_states(problem)
    points = differences(belief.states, estimate(belief, circular=circular), circular)
    deviations = np.sqrt(_kernel.weighted_sums(belief.weights, points * points))
    return np.asarray(points / np.where(deviations > 0.0, deviations, 1.0))


def _actions(problem: Problem, belief: Belief, stage: int) -> FloatArray:
    """Return what would be executed in each particle's state, in resolutions."""
    stages: int | IntArray = stage
    if problem.num_stages > 1:
        own = np.full(belief.weights.shape, stage, dtype=np.int64)
        stages = checked.next_stages(problem, belief.states, own)
    commanded = checked.policy(problem, belief.states, stages)
    return np.asarray(checked.executed_action(problem, commanded) / problem.resolution)


def _picked(belief: Belief) -> IntArray:
    at = (np.arange(_PICKED) + 0.5) / _PICKED
    # np.cumsum adds one by one, in order, unlike np.sum.
    found = np.searchsorted(np.cumsum(belief.weights), at, side="right")
    return np.asarray(np.minimum(found, belief.weights.shape[0] - 1), dtype=np.int64)


def _squares(points: FloatArray, places: FloatArray) -> FloatArray:
    total = np.zeros((points.shape[0], places.shape[0]))
    for coordinate in range(points.shape[1]):
        difference = np.subtract.outer(points[:, coordinate], places[:, coordinate])
        total += difference * difference
    return total


def _of_picked(belief: Belief, points: FloatArray) -> FloatArray:
    """Return the squared distances of all points from those that may be chosen, (n, picked)."""
    return _squares(points, points[_picked(belief)])


def _least(belief: Belief, losses: FloatArray) -> FloatArray:
    """Return the particle of the least mean loss; ``losses`` has the shape (n, picked)."""
    totals = _kernel.weighted_sums(belief.weights, np.ascontiguousarray(losses))
    return np.array(belief.states[_picked(belief)[int(totals.argmin())]])


class _CandidatePlanner(Planner):
    """A planner that takes a candidate for the state."""

    candidate: Candidate = staticmethod(_mean)

    def _estimate(self, state: PlanningState) -> tuple[FloatArray, int]:
        estimated = self.candidate(self.problem, state.belief, state.stage)
        return estimated, checked.next_stage(self.problem, estimated, state.stage)


def run_estimates(first_trial: int, candidate: str, **series: Any) -> Any:
    """Run some trials with a candidate; the function of tasks of the kind ``estimates``.

    What else it gets and what it returns is that of ``run_trials_of``; TaskError if there is no
    such candidate.
    """
    if candidate not in CANDIDATES:
        raise TaskError(f"candidate {candidate!r}: there are {', '.join(CANDIDATES)}")
    kind = type(
        "_Planner", (_CandidatePlanner,), {"candidate": staticmethod(CANDIDATES[candidate])}
    )
    return run_trials_of(first_trial, planner_class=kind, **series)
