"""How fast this machine is, and how long a problem's functions take on it.

A service that starts is awaited, so the first takes a millisecond or two, and so does the second,
once for each session. Both count the processor's time of this thread alone: other work on the
machine makes nothing look costly. Of several tries the shortest counts.
"""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Callable
from time import thread_time
from typing import Any

import numpy as np

from holdfast import _kernel
from holdfast.errors import HoldfastError
from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.estimators import KernelEstimator, NearestNeighbor, kernel_estimator, scaled
from holdfast.problems import checked
from holdfast.problems.attributes import has_batched_likelihoods, has_general_observations, has_own
from holdfast.problems.problem import Problem
from holdfast.protocol.decision_cost import TYPICAL_PROBLEM, CallCost, ProblemCost

_REFERENCE_S = 0.46e-3
"""Time of :func:`_work` on the machine on which the cost model's constants were measured."""

_TRIES = 3
_LEAST, _MOST = 0.5, 20.0
_FEW, _MANY = 16, 272
"""States of which a function is asked, to tell what a call takes from what a state takes."""

_MOST_ACTIONS = 16
"""Bound on the sensing actions that are measured."""

_BATCH = 8
"""Observations whose likelihoods are evaluated together, where a problem can."""

_SLOW_S = 0.3e-3
"""A function that takes longer is called once."""


def measure_slowness() -> float:
    """Return how many times as long this machine takes as the one of the cost model."""
    places = np.linspace(-1.0, 1.0, 3 * 300)
    points = np.ascontiguousarray(np.cos(17.0 * places).reshape(300, 3))
    rows = np.ascontiguousarray(-np.square(np.subtract.outer(places[:12], points[:, 0])) * 20.0)
    estimator = kernel_estimator(NearestNeighbor(5, 1e-3), 3)
    points = np.ascontiguousarray(scaled(points, estimator))
    own = functools.partial(_work, points, rows, estimator)
    return min(_MOST, max(_LEAST, _shortest(own, math.inf) / _REFERENCE_S))


def _work(points: FloatArray, rows: FloatArray, estimator: KernelEstimator) -> None:
    """Compute as a decision does: half of it in the kernel, half in Python and NumPy."""
    _kernel.entropies(points, rows, True, *estimator.parameters, 1, (1.0,), estimator.prior, True)
    for row in rows:
        for _ in range(4):
            np.searchsorted(np.cumsum(row), row[:8])
            np.where(row < 0.0, row, 0.0).reshape(-1, 3)


def measure_problem(problem: Problem) -> ProblemCost:
    """Return how long a problem's functions take; of one that fails, what is typical.

    A function that is slow is asked once, of few states: a robot chooses the problem's model.

    Raises HoldfastError if no initial state can be drawn. The decision that is asked for would fail
    as well, but only after as many attempts for each of its particles.
    """
    own: dict[str, Any] = {}
    refused: HoldfastError | None = None
    # The decision that is asked for will raise any other error again.
    with contextlib.suppress(Exception):
        try:
            one_s = _shortest(lambda: _drawn(problem, 1))
        except HoldfastError as error:
            refused = error
        else:
            _measure(problem, one_s, own)
    if refused is not None:
        raise refused
    return TYPICAL_PROBLEM._replace(**own)


def _drawn(problem: Problem, count: int) -> FloatArray:
    """Return some initial states, the same each time."""
    return checked.initial_states(problem, stream(0, 0, 0, Purpose.INITIAL_BELIEF), count)


def _measure(problem: Any, one_s: float, own: dict[str, Any]) -> None:
    random = stream(0, 0, 0, Purpose.INITIAL_BELIEF)
    few, many = (np.repeat(_drawn(problem, 1), count, axis=0) for count in (_FEW, _MANY))
    own["initial"] = CallCost(0.0, one_s)
    if one_s < _SLOW_S:
        began = thread_time()
        try:
            few, many = _drawn(problem, _FEW), _drawn(problem, _MANY)
            own["initial"] = _measured(lambda states: _drawn(problem, len(states)), few, many)
        except HoldfastError:
            # Some found no place, where a belief of few may: what it took to try counts.
            own["initial"] = CallCost(0.0, (thread_time() - began) / _FEW)
    own["act"] = _measured(
        lambda states: problem.limit_action(problem.policy(states, 0)), few, many
    )
    action = problem.limit_action(problem.policy(few[0], 0))
    own["move"] = _measured(lambda states: problem.move(states, action, random.anew()), few, many)
    own["stage"] = CallCost(0.0, 0.0)
    if problem.num_stages > 1:
        own["stage"] = _measured(
            lambda states: problem.next_stage(states, _stages(states)), few, many
        )
    if has_own(problem, "expected_path", ("policy", "limit_action", "move", "next_stage")):
        path = _measured(lambda states: problem.expected_path(states, 0, (0, 8), 1), few, many)
        own["path_step"] = CallCost(path.call_s, path.state_s / 8.0)
    count = len(problem.sensing_actions)
    asked = range(0, count, 1 + count // _MOST_ACTIONS)
    sensed = [_sensed(problem, number, few, many) for number in asked]
    own["sense"] = CallCost(
        max(cost.call_s for cost, _ in sensed), max(cost.state_s for cost, _ in sensed)
    )
    own["observation_size"] = max(size for _, size in sensed)
    if hasattr(problem, "known_state_return"):
        own["known_return"] = _measured(
            lambda states: problem.known_state_return(states, _stages(states)), few, many
        )

    def judge(states: FloatArray) -> None:
        problem.reward(states, np.broadcast_to(action, (len(states), action.size)))
        checked.ends(problem, states)

    own["judge"] = _measured(judge, few, many)


def _sensed(problem: Any, number: int, few: FloatArray, many: FloatArray) -> tuple[CallCost, int]:
    """Return what the predictions of a sensing action take, and the size of its observation."""
    if not has_general_observations(problem):

        def predict(states: FloatArray) -> None:
            problem.observation_mean(states, number)
            problem.observation_variance(states, number)

        size = int(problem.observation_mean(few, number).shape[-1])
        return _measured(predict, few, many), size
    random = stream(0, 0, 0, Purpose.HYPOTHESES)
    shown = checked.sample_observation(problem, few[0], number, random)
    together, judge, judged = 1, problem.log_likelihood, shown
    if has_batched_likelihoods(problem):
        together, judge = _BATCH, problem.log_likelihoods
        judged = np.repeat(shown[np.newaxis], _BATCH, axis=0)

    def sense(states: FloatArray) -> None:
        for _ in range(together):
            problem.sample_observation(states[0], number, random.anew())
        judge(states, number, judged)

    cost = _measured(sense, few, many)
    return CallCost(cost.call_s / together, cost.state_s / together), shown.size


def _measured(call: Callable[[FloatArray], object], few: FloatArray, many: FloatArray) -> CallCost:
    """Return what a call takes and what each state, from calls with few states and with many."""
    few_s = _shortest(lambda: call(few))
    if few_s > _SLOW_S:
        return CallCost(0.0, few_s / len(few))
    state_s = max(0.0, _shortest(lambda: call(many)) - few_s) / (len(many) - len(few))
    return CallCost(max(0.0, few_s - len(few) * state_s), state_s)


def _stages(states: FloatArray) -> IntArray:
    return np.zeros(len(states), dtype=np.int64)


def _shortest(call: Callable[[], object], slow_s: float = _SLOW_S) -> float:
    """Return the seconds of the shortest of some calls; of a slow one, of the first."""
    shortest = math.inf
    for _ in range(_TRIES):
        began = thread_time()
        call()
        shortest = min(shortest, thread_time() - began)
        if shortest > slow_s:
            break
    return shortest
