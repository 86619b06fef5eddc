"""The decisions of several states at once, each as if it were alone.

A brief decision is some small arrays and much Python around them. Where many robots with the same
problem and settings wait, their particles are stacked, and the problem's functions are called once
for all. What holds of single particles (a policy, a prediction, a move with the belief's own
stream) has the same bits in any company. That is sure of holdfast's own problems; a user's policy
may use a matrix product, whose bits depend on the number of rows (:func:`can_decide_together`).
What holds of a whole belief (estimate, weights, resampling, entropies) is computed for each alone.

What goes wrong raises as it does alone, without saying for which state.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from holdfast import _kernel
from holdfast.errors import InvalidValueError, ProblemError
from holdfast.numerics import reproducible as numerics
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning import interruption
from holdfast.planning.belief import Belief, estimate, finite, resample, reweighted
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.sensing import choose_sensing_action, predict
from holdfast.planning.settings import UNINFORMED_METHODS
from holdfast.problems import attributes, checked


def can_decide_together(planner: Planner) -> bool:
    """Tell whether the bits of a problem's functions do not depend on what else is asked.

    They do not for problems of holdfast's own, as far as these functions know their kind.
    """
    problem = planner.problem
    return (
        type(problem).__module__.startswith("holdfast.problems.")
        and attributes.has_own(problem, "move_each", ("move",))
        and not attributes.has_general_observations(problem)
        and not attributes.moves_give_observations(problem)
        and not attributes.static_parameters(problem)
    )


@in_own_mode
def observe_together(
    planner: Planner,
    states: Sequence[PlanningState],
    sensing_actions: Sequence[int],
    observations: Sequence[FloatArray],
) -> list[PlanningState]:
    """Return what :meth:`Planner.observe` does for each state, its action and its observation."""
    problem, after = planner.problem, list(states)
    count = planner.settings.particle_filter.num_particles
    threshold = planner.settings.particle_filter.resampling_threshold * count
    for action, rows in _alike(sensing_actions):
        interruption.check()
        chosen = attributes.sensing_action_of(problem, action)
        beliefs = [states[row].belief for row in rows]
        mean, variance = checked.prediction(problem, _stacked(beliefs), chosen)
        variances = variance if variance.ndim > 1 else itertools.repeat(variance)
        angles = attributes.circular_observation(problem, chosen, mean.shape[-1])
        for row, belief, shown, spread in zip(rows, beliefs, mean, variances, strict=False):
            observed, posterior = finite(observations[row]), np.empty(count)
            if observed.shape[0] != shown.shape[1]:
                raise InvalidValueError(f"observations that sensing action {action} does not give")
            found = _kernel.update_by_gaussian(*belief, observed, shown, spread, angles, posterior)
            if found is None:
                raise checked.unusable(problem, chosen, mean, variance)
            survivors, size = found[:2]
            state, belief = states[row], reweighted(belief, posterior, survivors)
            if threshold == count or size <= threshold:
                name = state.seed, state.trial, state.step, Purpose.RESAMPLING
                belief = resample(belief, stream(*name))
            after[row] = state._replace(sensed=True, belief=belief)
    return after


@in_own_mode
def plan_together(
    planner: Planner, states: Sequence[PlanningState], max_actions: int
) -> list[tuple[list[FloatArray], PlanningState]]:
    """Return what :meth:`Planner.plan_until_sensing` does for each state."""
    problem, settings = planner.problem, planner.settings
    kind, circular = settings.particle_filter.estimate, attributes.circular_states(problem)
    planned: list[list[FloatArray]] = [[] for _ in states]
    ahead = list(states)

    def goes_on(row: int) -> bool:
        return len(planned[row]) < max_actions and not planner.needs_sensing(ahead[row])

    while rows := [row for row in range(len(ahead)) if goes_on(row)]:
        interruption.check()
        own = [ahead[row] for row in rows]
        estimates = np.array([estimate(state.belief, kind, circular) for state in own])
        stages = np.array([state.stage for state in own])
        stages = checked.next_stages(problem, estimates, stages)
        actions = checked.executed_action(problem, checked.policy(problem, estimates, stages))
        if not numerics.all_finite(actions):
            raise ProblemError(f"policy of {problem.name} gives an action that is not finite")
        streams = [stream(each.seed, each.trial, each.step, Purpose.PREDICTION) for each in own]
        stacked = _stacked([state.belief for state in own])
        moved = checked.move_each(problem, stacked, actions, streams, threads=1)
        for row, state, stage, action, places in zip(
            rows, own, stages.tolist(), actions, moved, strict=True
        ):
            # A copy: a view would keep the places of all.
            places = places.copy()
            places.setflags(write=False)
            belief = Belief(places, state.belief.weights)
            step = state.step + 1
            ahead[row] = PlanningState(state.seed, state.trial, step, stage, False, belief)
            planned[row].append(action)
    return list(zip(planned, ahead, strict=True))


@in_own_mode
def choose_together(planner: Planner, states: Sequence[PlanningState]) -> list[int]:
    """Return what :meth:`Planner.choose_sensing_action` chooses in each state."""
    problem, settings = planner.problem, planner.settings
    if settings.selector.method in (*UNINFORMED_METHODS, "expected_return"):
        return [planner.choose_sensing_action(state)[0] for state in states]
    chosen = [0] * len(states)
    for stage, rows in _alike([state.stage for state in states]):
        beliefs = [states[row].belief for row in rows]
        together = _stacked(beliefs)
        predictions = predict(problem, settings, together.reshape(-1, together.shape[-1]), stage)
        for number, (row, belief) in enumerate(zip(rows, beliefs, strict=True)):
            state, size = states[row], len(belief.weights)
            chosen[row], _ = choose_sensing_action(
                problem,
                settings,
                belief,
                stage,
                stream(state.seed, state.trial, state.step, Purpose.HYPOTHESES),
                stream(state.seed, state.trial, state.step, Purpose.SELECTION),
                predictions=predictions.of(slice(number * size, (number + 1) * size)),
            )
    return chosen


def _stacked(beliefs: Sequence[Belief]) -> FloatArray:
    """Return the particles of beliefs, shape (B, N, state_size), read-only as they are."""
    stacked = np.array([belief.states for belief in beliefs])
    stacked.setflags(write=False)
    return stacked


def _alike(values: Sequence[int]) -> Iterator[tuple[int, list[int]]]:
    """Yield each value, and where it stands."""
    places: dict[int, list[int]] = {}
    for place, value in enumerate(values):
        places.setdefault(value, []).append(place)
    yield from places.items()
