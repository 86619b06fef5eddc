"""How fast this machine is, and how long a problem's functions take on it.

A service that starts is awaited, so the first takes a millisecond or two, and so does the second,
once for each session. Both count the processor's time of this thread alone: other work on the
machine makes nothing look costly. Of several tries the shortest counts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from time import thread_time
from typing import Any

import numpy as np

from holdfast import _kernel, checked
from holdfast.arrays import FloatArray
from holdfast.estimators import KernelEstimator, NearestNeighbor, kernel_estimator, scaled
from holdfast.problem_attributes import has_general_observations, has_own
from holdfast.problems.problem import Problem
from holdfast.protocol.decision_cost import TYPICAL_PROBLEM, CallCost, ProblemCost
from holdfast.randomness import Purpose, Stream, stream

__all__ = ["measure_problem", "measure_slowness"]

_REFERENCE_S = 0.58e-3
"""Of :func:`_work` on the machine on which the constants of the cost model were measured."""

_TRIES = 3
_LEAST, _MOST = 0.5, 20.0
_FEW, _MANY = 16, 272
"""States of which a function is asked, to tell what a call takes from what a state takes."""

_NOTHING = CallCost(0.0, 0.0)


def measure_slowness() -> float:
    """Return how many times as long this machine takes as the one of the cost model."""
    places = np.linspace(-1.0, 1.0, 3 * 300)
    points = np.ascontiguousarray(np.cos(17.0 * places).reshape(300, 3))
    rows = np.ascontiguousarray(-np.square(np.subtract.outer(places[:15], points[:, 0])) * 20.0)
    estimator = kernel_estimator(NearestNeighbor(5, 1e-3), 3)
    points = np.ascontiguousarray(scaled(points, estimator))
    own = functools.partial(_work, points, rows, estimator)
    return min(_MOST, max(_LEAST, _shortest(own) / _REFERENCE_S))


def _work(points: FloatArray, rows: FloatArray, estimator: KernelEstimator) -> None:
    """Compute as a decision does: half of it in the kernel, half in Python and NumPy."""
    _kernel.entropies(points, rows, True, *estimator.parameters, 1, (1.0,), estimator.prior)
    for row in rows:
        for _ in range(4):
            np.searchsorted(np.cumsum(row), row[:8])
            np.where(row < 0.0, row, 0.0).reshape(-1, 3)


def measure_problem(problem: Problem) -> ProblemCost:
    """Return how long a problem's functions take; of one that fails, what is typical."""
    own: dict[str, Any] = {}
    try:
        _measure(problem, own)
    except Exception:  # noqa: BLE001, S110 - whoever asks for a decision gets the error
        pass
    return TYPICAL_PROBLEM._replace(**own)


def _measure(problem: Any, own: dict[str, Any]) -> None:
    random = stream(0, 0, 0, Purpose.INITIAL_BELIEF)
    few, many = (_initial_states(problem, random, count) for count in (_FEW, _MANY))

    def measured(call: Callable[[FloatArray], object]) -> CallCost:
        few_s, many_s = (_shortest(functools.partial(call, states)) for states in (few, many))
        state_s = max(0.0, many_s - few_s) / (_MANY - _FEW)
        return CallCost(max(0.0, few_s - _FEW * state_s), state_s)

    own["initial"] = measured(lambda states: problem.initial_states(random, len(states)))
    own["act"] = measured(lambda states: problem.execute(problem.policy(states, 0)))
    action = problem.execute(problem.policy(few[0], 0))
    own["move"] = measured(lambda states: problem.move(states, action, random))
    own["stage"] = _NOTHING
    if problem.num_stages > 1:
        own["stage"] = measured(
            lambda states: problem.next_stage(states, np.zeros(len(states), dtype=np.int64))
        )
    if has_own(problem, "expected_path", ("policy", "execute", "move", "next_stage")):
        path = measured(lambda states: problem.expected_path(states, 0, (0, 8), 1))
        own["path_step"] = CallCost(path.call_s, path.state_s / 8.0)
    senses = range(len(problem.sensing_actions))
    costs, sizes = [], []
    for action_number in senses:
        if has_general_observations(problem):
            shown = checked.sample_observation(problem, few[0], action_number, random)
            sizes.append(shown.size)
            costs.append(
                measured(
                    lambda states, j=action_number, shown=shown: (  # type: ignore[misc]
                        problem.sample_observation(states[0], j, random),
                        problem.log_likelihood(states, j, shown),
                    )
                )
            )
        else:
            sizes.append(problem.observation_mean(few, action_number).shape[-1])
            costs.append(
                measured(
                    lambda states, j=action_number: (  # type: ignore[misc]
                        problem.observation_mean(states, j),
                        problem.observation_variance(states, j),
                    )
                )
            )
    own["sense"] = CallCost(max(c.call_s for c in costs), max(c.state_s for c in costs))
    own["observation_size"] = int(max(sizes))
    if hasattr(problem, "known_state_return"):
        own["known_return"] = measured(
            lambda states: problem.known_state_return(states, np.zeros(len(states), dtype=np.int64))
        )
    actions = problem.execute(problem.policy(many, 0))
    own["judge"] = measured(
        lambda states: (problem.reward(states, actions[: len(states)]), problem.is_goal(states))
    )


def _initial_states(problem: Any, random: Stream, count: int) -> FloatArray:
    drawn = problem.initial_states(random, count)
    states = checked.states_of(problem, "initial_states", drawn, (count, problem.state_size))
    return states


def _shortest(call: Callable[[], object]) -> float:
    """Return the seconds of the shortest of some calls."""
    found = []
    for _ in range(_TRIES):
        began = thread_time()
        call()
        found.append(thread_time() - began)
    return min(found)
