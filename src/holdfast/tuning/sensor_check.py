"""Whether the sensors and the resolution let a choice be made at all.

For beliefs from simulated trials, each sensing action is tried: what it might show is drawn, the
belief is weighed by it, and what is left of the spread of each coordinate of the state and of the
task action is compared with what there was. So it shows which sensing action tells nothing, which
one another tells at least as well, and which one changes no task action by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.circular import differences
from holdfast.planning.belief import update
from holdfast.planning.planner import PlanningState
from holdfast.planning.policy_path import nats_of_halving
from holdfast.planning.settings import UNINFORMED_METHODS
from holdfast.problems import checked
from holdfast.problems.attributes import (
    circular_actions,
    circular_states,
    has_general_observations,
    resolution_of,
    sensing_costs,
    sensing_labels,
)
from holdfast.tuning.contract_check import draw_observation
from holdfast.tuning.findings import Inspection, Walk

_SAMPLES = 8  # hypothetical observations of a sensing action from each belief
_HYPOTHESES = 32  # trial number of the first of the streams here
_MOST_ACTIONS = 32
_BINS = 8  # of a task action's coordinate, to see whether an observation changes it
_NOTHING = 0.02  # nats of information below which a sensing action tells nothing
FEW_VALUES = 10  # of a coordinate, below which it is a kind and no number
_SCALES = 30.0  # between coordinates of the task action with one resolution for all


class _Gains(NamedTuple):
    """What sensing tells, for each of b beliefs and J sensing actions."""

    information: FloatArray  # about the state, in nats, (b, J)
    of_actions: FloatArray  # about each coordinate of the task action, less what chance shows
    states: FloatArray  # the share of each variance that is taken away; NaN where there is none
    before: FloatArray  # standard deviations of the task actions before sensing


def check_sensors(inspection: Inspection) -> None:
    """Look for sensing actions that tell nothing, or nothing that another does not tell."""
    problem, walk, beliefs = inspection.problem, inspection.walk, inspection.beliefs
    costs = sensing_costs(problem)
    _check_prices(inspection, costs)
    if not beliefs or walk is None:
        return
    gains = _gains_of(inspection)
    silent = (gains.information.mean(axis=0) < _NOTHING) & (gains.information.max(axis=0) < 0.1)
    for action in np.flatnonzero(silent).tolist():
        told = gains.information[:, action].mean()
        seen = f"{inspection.label(action)} tells nothing: "
        advice = "Leave it out, or look at its noise. If it stands for not sensing, "
        advice += "selector.sensing_is_optional offers that for any problem."
        if told > 0.1 * _NOTHING:
            seen = f"{inspection.label(action)} tells little each time: "
            advice = "Leave it out if others show that. If it alone shows what decides, compare "
            advice += "selector.method: expected_return and rollout_sensing_steps: 8 with random."
        seen += f"{told:.2g} nats in {len(beliefs)} belief{'s' * (len(beliefs) != 1)} of simulated "
        seen += "trials"
        free = costs[action] < costs.max()
        inspection.add("information" if free else "warning", "sensors", seen, advice)
    _report_dominated(inspection, gains, silent, costs)
    selector = inspection.settings.selector
    given = None if selector.method == "state_entropy" else selector.resolution
    own = inspection.ask("resolution", lambda: resolution_of(problem, given, of_states=False))
    resolution = np.broadcast_to(np.asarray(own, dtype=np.float64), (problem.action_size,))
    _report_useless(inspection, gains, silent, resolution)
    _check_resolution(inspection, gains, resolution, walk)


def _check_prices(inspection: Inspection, costs: FloatArray) -> None:
    """Warn of prices that the method does not weigh."""
    selector = inspection.settings.selector
    weighs = selector.nats_per_cost > 0.0 or selector.method == "expected_return"
    # Of equal prices each choice pays the same, unless it is not to sense.
    matter = np.ptp(costs) > 0.0 or (selector.sensing_is_optional and costs.any())
    if weighs or not matter or selector.method in UNINFORMED_METHODS:
        return
    seen = f"sensing has prices ({_written(costs)}), but {selector.method} does not weigh them: "
    seen += "selector.nats_per_cost is 0"
    worth = f"{nats_of_halving(inspection.settings):.2f} (the nats that it gains) / the price that "
    worth += "halving the uncertainty of one coordinate is worth"
    if selector.method == "action_covariance":
        worth = "how much smaller the trace of the covariance must become for a price of 1"
    advice = f"Set selector.nats_per_cost to {worth}, or selector.method: expected_return."
    inspection.add("warning", "prices", seen, advice)


def _gains_of(inspection: Inspection) -> _Gains:
    """Draw what each sensing action might show of each belief, and say what it tells."""
    problem, ask = inspection.problem, inspection.ask
    late = inspection.deadline(0.2, "sensors")
    function = "log_likelihood" if has_general_observations(problem) else "observation_mean"
    rows: list[list[tuple[Any, ...]]] = []
    before = []
    for number, state in enumerate(inspection.beliefs):
        if late() and rows:
            break
        points, weights = state.belief.states, state.belief.weights
        actions = ask("policy", checked.policy, problem, points, state.stage)
        before.append(np.sqrt(_variances(actions, weights, circular_actions(problem))))
        bins = _binned(differences(actions, actions[0], circular_actions(problem)))
        spread = _variances(points, weights, circular_states(problem))
        rows.append([])
        for action in range(min(len(sensing_labels(problem)), _MOST_ACTIONS)):
            found = ask(function, _posteriors, inspection, state, action, number)
            left = [_variances(points, each, circular_states(problem)) for each in found]
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.where(spread > 0.0, 1.0 - np.mean(left, axis=0) / spread, np.nan)
            divergence = np.mean([_divergence(each, weights) for each in found])
            told = np.mean([_told(bins, each, weights) for each in found], axis=0)
            rows[-1].append((divergence, told, share))
    information, of_actions, states = (
        np.array([[each[part] for each in row] for row in rows]) for part in range(3)
    )
    return _Gains(information, of_actions, states, np.array(before))


def _posteriors(
    inspection: Inspection, state: PlanningState, action: int, number: int
) -> list[FloatArray]:
    """Return the weights after some hypothetical observations."""
    problem, belief = inspection.problem, state.belief
    own = inspection.random(_HYPOTHESES + action, number)
    ends = np.cumsum(belief.weights)
    # Stratified: a few draws then stand for the whole belief.
    places = (np.arange(_SAMPLES) + own.random(_SAMPLES)) / _SAMPLES * ends[-1]
    found = []
    for sample, truth in enumerate(np.minimum(np.searchsorted(ends, places), len(ends) - 1)):
        shown = draw_observation(problem, belief.states[truth], action, own.substream(sample))
        found.append(update(problem, belief, action, shown)[0].weights)
    return found


def _divergence(after: FloatArray, before: FloatArray) -> float:
    """Return the relative entropy of two weightings, in nats."""
    kept = after > 0.0
    return float((after[kept] * np.log(after[kept] / before[kept])).sum())


def _binned(values: FloatArray) -> IntArray:
    """Return in which of a few bins, about equally full, each value of each coordinate lies."""
    bins = np.empty(values.shape, dtype=np.int64)
    for at, own in enumerate(values.T):
        # A bin ends with the value of an edge, so that equal values share one.
        edges = np.unique(np.quantile(own, np.arange(1, _BINS) / _BINS, method="lower"))
        bins[:, at] = np.searchsorted(edges, own, side="left")
    return bins


def _told(bins: IntArray, after: FloatArray, before: FloatArray) -> FloatArray:
    """Return what an observation tells about binned values, less what it would of shuffled ones.

    Few particles that an observation leaves fill bins unevenly, whatever it tells.
    """
    shuffled = bins[np.random.default_rng(0).permutation(len(bins))]

    def told(own: IntArray) -> float:
        left, had = (np.bincount(own, each, _BINS) for each in (after, before))
        return _divergence(np.asarray(left, np.float64), np.asarray(had, np.float64))

    return np.array([told(bins[:, at]) - told(shuffled[:, at]) for at in range(bins.shape[1])])


def _variances(points: FloatArray, weights: FloatArray, circular: Sequence[int]) -> FloatArray:
    """Return weighted variances, without bias for few effective particles."""
    apart = differences(points, points[int(weights.argmax())], circular)
    square: FloatArray = weights @ (apart - weights @ apart) ** 2
    # All the weight on one particle leaves no spread.
    share = 1.0 - float((weights**2).sum())
    return square / share if share > 1e-9 else np.zeros_like(square)


def _report_dominated(
    inspection: Inspection, gains: _Gains, silent: BoolArray, costs: FloatArray
) -> None:
    """Report a sensing action if another one is at least as sharp everywhere, and no dearer."""
    told, known = gains.information, np.isfinite(gains.states)
    shares = np.where(known, gains.states, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    for worse in np.flatnonzero(~silent).tolist():
        for better in range(len(shares)):
            if better == worse or costs[better] > costs[worse]:
                continue
            left = (1.0 - shares[worse]) / np.maximum(1.0 - shares[better], 1e-9)
            apart = np.where(known[:, worse], gains.states[:, worse] - gains.states[:, better], 0.0)
            # What neither of them shows scatters, as an observation leaves few particles. What the
            # worse one shows beyond chance, the better one must show beyond doubt.
            chance = 2.0 * apart.std(axis=0) / np.sqrt(len(apart))
            own = np.where(known[:, worse], gains.states[:, worse], 0.0)
            shown = own.mean(axis=0) > 0.02 + 2.0 * own.std(axis=0) / np.sqrt(len(own))
            if (
                shown.any()
                and (apart.mean(axis=0) + chance < 0.02)[shown].all()
                and (told[:, better] >= told[:, worse] - _NOTHING).mean() > 0.95
                and (apart.mean(axis=0) < 0.02 + chance).all()
                and np.quantile(apart, 0.95, axis=0).max() < 0.3
                and left.max() > 1.25
            ):
                seen = f"{inspection.label(worse)} is dominated: {inspection.label(better)} shows "
                seen += "the same at least as sharply and is no dearer "
                seen += f"({told[:, better].mean():.2g} and {told[:, worse].mean():.2g} nats)"
                advice = "Leave it out, or give the better one its price (sensing_costs): "
                advice += "estimates of entropy from few particles may take the worse one."
                inspection.add("warning", "sensors", seen, advice)
                break


def _report_useless(
    inspection: Inspection, gains: _Gains, silent: BoolArray, resolution: FloatArray
) -> None:
    """Report what tells something, but nothing that changes the next task action."""
    # Where all actions are the same in practice there is nothing to change.
    matters = gains.before > 0.3 * resolution
    count = len(gains.before)
    if not matters.any():
        return
    told = np.where(matters[:, np.newaxis, :], gains.of_actions, 0.0).max(axis=2)
    for action in np.flatnonzero(~silent).tolist():
        own, whole = told[:, action], float(gains.information[:, action].mean())
        most = own.mean() + 2.0 * own.std() / np.sqrt(count)
        if most < max(2.0 * _NOTHING, 0.03 * whole) and own.mean() < 0.15 * whole:
            seen = f"{inspection.label(action)} changes no task action by itself: it tells "
            seen += f"{whole:.2g} nats about the state and {max(own.mean(), 0.0):.2g} about the "
            seen += f"next task action, in {count} belief{'s' * (count != 1)} of simulated trials"
            advice = "If it counts later, or only together with another one, looking one step "
            advice += "ahead never chooses it: compare with selector.method: expected_return and "
            advice += "rollout_sensing_steps: 8, and with random. Else leave it out."
            inspection.add("warning", "sensors", seen, advice)


def _check_resolution(
    inspection: Inspection, gains: _Gains, resolution: FloatArray, walk: Walk
) -> None:
    """Compare the resolution with the spread of task actions, their noise and the goal."""
    method = inspection.settings.selector.method
    widest, spread = gains.before.max(axis=0), np.median(gains.before, axis=0)
    if (widest > 0.0).any() and (resolution > 3.0 * widest).all():
        seen = f"resolution is {_written(resolution)}, and the task actions of a belief never "
        seen += f"differ by more than a standard deviation of {widest.max():.3g}: to the entropy "
        seen += "all of them are the same, and no sensing action is better than another"
        noise = _written(np.sqrt(np.asarray(inspection.problem.motion_variance)))
        advice = "Let it be what the task tolerates, of the order of the goal's size or of the "
        advice += f"motion noise ({noise})."
        blind = method in UNINFORMED_METHODS
        inspection.add("warning" if blind else "error", "resolution", seen, advice)
        return
    if np.ptp(resolution) == 0.0 and (spread > 0.0).any():
        most, least = spread.argmax(), np.where(spread > 0.0, spread, np.inf).argmin()
        if spread[most] > _SCALES * spread[least]:
            seen = f"coordinates {most} and {least} of the task action have standard deviations of "
            seen += f"{spread[most]:.3g} and {spread[least]:.3g} in a typical belief, and one "
            seen += f"resolution, {resolution[0]:.3g}"
            advice = "Give each its own, in its own unit: resolution = np.array([...])."
            inspection.add("warning", "units", seen, advice)
    if method not in ("path_entropy", "action_entropy"):
        return
    tolerance = _tolerance(inspection, walk)
    # Entropy counts what is known well enough, beside what is not. Of each coordinate the sensing
    # action counts that tells most about it.
    best = np.maximum(gains.of_actions.mean(axis=0).max(axis=0), 0.0)
    known = (spread < tolerance) & (resolution < 0.7 * spread) & (best > 0.3)
    # Far below the resolution it was not found: the policy stops before it.
    unknown = (spread > tolerance) & (tolerance > 0.3 * resolution)
    sharp, weak = np.where(known, best, -1.0).argmax(), np.where(unknown, best, np.inf).argmin()
    if not (known.any() and unknown.any()) or best[sharp] < 1.5 * best[weak]:
        return
    seen = f"coordinate {sharp} of the task action is known to {spread[sharp]:.2g} before sensing, "
    seen += f"well enough for the goal, which tolerates about {tolerance[sharp]:.2g}; but its "
    seen += f"resolution is {resolution[sharp]:.2g}, so one look at it gains {best[sharp]:.2g} "
    seen += f"nats, and a look at coordinate {weak}, known to {spread[weak]:.2g} where about "
    seen += f"{tolerance[weak]:.2g} is needed, at most {best[weak]:.2g}"
    advice = "Entropy prefers the first. Let resolution be what the task tolerates "
    advice += f"({_written(tolerance)}), and compare with expected_return and with random."
    inspection.add("warning", "resolution", seen, advice)


def _tolerance(inspection: Inspection, walk: Walk) -> FloatArray:
    """Return how far each task action may be off at the goal, about; 0 for what is not known."""
    problem, ask = inspection.problem, inspection.ask
    rows = walk.states
    at_goal = ask("is_goal", checked.truths, problem, "is_goal", rows)
    goals, stages = rows[at_goal][:50], walk.stages[at_goal][:50]
    tolerated = np.full(problem.action_size, np.inf)
    if len(goals) < 3:
        return np.zeros(problem.action_size)
    base = ask("policy", checked.policy, problem, goals, stages)
    for at in range(rows.shape[1]):
        if len(np.unique(rows[:, at])) < FEW_VALUES:
            continue  # a bit or a kind has no width
        apart = np.zeros(rows.shape[1])
        apart[at] = 4.0 * rows[:, at].std()
        low, high = 0.0, 1.0
        for _ in range(20):
            width = 0.5 * (low + high)
            beside = np.concatenate([goals - width * apart, goals + width * apart])
            inside = ask("is_goal", checked.truths, problem, "is_goal", beside)
            low, high = (width, high) if inside.mean() > 0.5 else (low, width)
        if 0.0 < low < 0.97:
            asked = ask("policy", checked.policy, problem, goals + low * apart, stages)
            change = np.median(np.abs(differences(asked, base, circular_actions(problem))), axis=0)
            tolerated = np.where(change > 1e-9, np.minimum(tolerated, change), tolerated)
    return np.where(np.isfinite(tolerated), tolerated, 0.0)


def _written(values: FloatArray) -> str:
    return ", ".join(f"{float(value):.2g}" for value in np.atleast_1d(values))
