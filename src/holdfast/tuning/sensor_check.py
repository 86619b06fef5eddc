"""Whether the sensors and the resolution let a choice be made at all.

For beliefs from simulated trials, each sensing action is tried: what it might show is drawn, the
belief is weighed by it, and what is left of the spread of each coordinate of the state and of the
task action is compared with what there was. So it shows which sensing action tells nothing, which
one another tells at least as well, and which one changes no task action by itself.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.circular import differences
from holdfast.planning.belief import Belief, update
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
from holdfast.tuning.contract_check import draw_observation, truths
from holdfast.tuning.findings import Inspection
from holdfast.tuning.trial_check import SensedBelief

__all__ = ["check_sensors"]

_SAMPLES = 8
"""Hypothetical observations of a sensing action from each belief."""

_HYPOTHESES = 32
_MOST_ACTIONS = 32

_BINS = 8
"""Of the values of a task action's coordinate, to see whether an observation changes them."""

_NOTHING = 0.02
"""Nats of information below which a sensing action tells nothing."""

_FEW_VALUES = 10
"""Of a coordinate in all trials, below which it is a kind and no number."""

_SCALES = 30.0
"""Between coordinates of the task action with one resolution for all."""

_RESOLUTION = "docs/problems.md#a-sharp-sensor-beside-a-weak-one"
_ONE_STEP = "docs/problems.md#your-own"


class _Gains(NamedTuple):
    """What sensing tells, for each of b beliefs and J sensing actions.

    Attributes
    ----------
    information : array of shape (b, J)
        About the state, in nats.
    of_actions : array of shape (b, J, action_size)
        About each coordinate of the task action, in nats, less what chance would show.
    states : array of shape (b, J, state_size)
        The share of the variance that is taken away; NaN where there is none.
    actions : array of shape (b, J, action_size)
        The same of the task actions.
    before : array of shape (b, action_size)
        Standard deviations of the task actions before sensing.
    """

    information: FloatArray
    of_actions: FloatArray
    states: FloatArray
    actions: FloatArray
    before: FloatArray


def check_sensors(inspection: Inspection, beliefs: list[SensedBelief]) -> None:
    """Look for sensing actions that tell nothing, or nothing that another does not tell."""
    problem = inspection.problem
    count = len(sensing_labels(problem))
    if not beliefs:
        return
    tried = np.arange(min(count, _MOST_ACTIONS))
    gains = _gains_of(inspection, beliefs, tried)
    if gains is None:
        return
    costs = sensing_costs(problem)
    silent = (gains.information.mean(axis=0) < _NOTHING) & (gains.information.max(axis=0) < 0.1)
    for action in np.flatnonzero(silent):
        free = costs[action] < costs.max()
        inspection.add(
            "information" if free else "warning",
            "sensors",
            f"{inspection.label(int(action))} tells nothing: "
            f"{gains.information[:, action].mean():.2g} nats in {len(gains.before)} beliefs of "
            "simulated trials",
            "If it stands for not sensing, selector.sensing_is_optional offers that for any "
            "problem. Else leave it out, or look at its noise.",
            "docs/problems.md#when-to-sense",
        )
    _report_dominated(inspection, gains, silent, costs)
    _report_useless(inspection, gains, silent)
    _check_resolution(inspection, gains)


def _mean(values: FloatArray) -> FloatArray:
    """Return the means over beliefs, without those in which there was nothing to tell."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    mean: FloatArray = total / np.maximum(known.sum(axis=0), 1)
    return mean


def _gains_of(
    inspection: Inspection, beliefs: list[SensedBelief], tried: IntArray
) -> _Gains | None:
    problem, ask = inspection.problem, inspection.ask
    late = inspection.deadline(0.2)
    function = "log_likelihood" if has_general_observations(problem) else "observation_mean"
    angles, turns = circular_states(problem), circular_actions(problem)
    rows: list[list[tuple[float, FloatArray, FloatArray, FloatArray]]] = []
    before = []
    for number, (belief, stage) in enumerate(beliefs):
        if late():
            break
        actions = ask("policy", lambda b=belief, s=stage: checked.policy(problem, b.states, s))  # type: ignore[misc]
        own_actions = _variances(actions, belief.weights, turns)
        before.append(np.sqrt(own_actions))
        bins = _binned(differences(actions, actions[0], turns))
        row = []
        for action in tried:
            found = ask(
                function,
                lambda b=belief, a=int(action), n=number: _posteriors(inspection, b, a, n),  # type: ignore[misc]
            )
            row.append(
                (
                    float(np.mean([_divergence(each, belief.weights) for each in found])),
                    np.mean([_told(bins, each, belief.weights) for each in found], axis=0),
                    _share(belief.states, belief.weights, found, angles),
                    _share(actions, belief.weights, found, turns),
                )
            )
        rows.append(row)
    if not rows:
        return None
    told, of_actions, states, actions = (
        np.array([[each[part] for each in row] for row in rows]) for part in range(4)
    )
    return _Gains(told, of_actions, states, actions, np.array(before))


def _divergence(after: FloatArray, before: FloatArray) -> float:
    """Return the relative entropy of two weightings, in nats."""
    kept = after > 0.0
    return float((after[kept] * np.log(after[kept] / before[kept])).sum())


def _binned(values: FloatArray) -> IntArray:
    """Return in which of a few bins, about equally full, each value of each coordinate lies."""
    bins = np.empty(values.shape, dtype=np.int64)
    for at in range(values.shape[1]):
        # A bin ends with the value of an edge, so that equal values share one.
        edges = np.unique(np.quantile(values[:, at], np.arange(1, _BINS) / _BINS, method="lower"))
        bins[:, at] = np.searchsorted(edges, values[:, at], side="left")
    return bins


def _told(bins: IntArray, after: FloatArray, before: FloatArray) -> FloatArray:
    """Return what an observation tells about binned values, less what it would of shuffled ones.

    Few particles that an observation leaves fill bins unevenly, whatever it tells.
    """
    order = np.random.default_rng(0).permutation(len(bins))
    told = np.empty(bins.shape[1])
    for at in range(bins.shape[1]):
        found = []
        for own in (bins[:, at], bins[order, at]):
            masses = [
                np.asarray(np.bincount(own, weights, minlength=_BINS), dtype=np.float64)
                for weights in (after, before)
            ]
            found.append(_divergence(masses[0], masses[1]))
        told[at] = found[0] - found[1]
    return told


def _share(
    points: FloatArray, weights: FloatArray, found: list[FloatArray], circular: Any
) -> FloatArray:
    """Return the share of each variance that observations take away; NaN where there is none."""
    own = _variances(points, weights, circular)
    left = np.mean([_variances(points, each, circular) for each in found], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(own > 0.0, 1.0 - left / own, np.nan)


def _posteriors(
    inspection: Inspection, belief: Belief, action: int, number: int
) -> list[FloatArray]:
    """Return the weights after some hypothetical observations."""
    problem = inspection.problem
    own = inspection.random(_HYPOTHESES + action, number)
    ends = np.cumsum(belief.weights)
    # Stratified: a few draws then stand for the whole belief.
    places = (np.arange(_SAMPLES) + own.random(_SAMPLES)) / _SAMPLES * ends[-1]
    found = []
    for sample, place in enumerate(places):
        truth = min(int(np.searchsorted(ends, place)), len(ends) - 1)
        noise = own.substream(sample)
        shown = draw_observation(problem, belief.states[truth], action, noise)
        found.append(update(problem, belief, action, shown)[0].weights)
    return found


def _variances(points: FloatArray, weights: FloatArray, circular: Any) -> FloatArray:
    """Return weighted variances, without bias for few effective particles."""
    origin = points[int(weights.argmax())]
    apart = differences(points, origin, circular)
    mean = weights @ apart
    square = weights @ (apart - mean) ** 2
    # All the weight on one particle leaves no spread.
    share = 1.0 - float((weights**2).sum())
    variances: FloatArray = square / share if share > 1e-9 else np.zeros_like(square)
    return variances


def _report_dominated(
    inspection: Inspection, gains: _Gains, silent: Any, costs: FloatArray
) -> None:
    """Report a sensing action if another one is at least as sharp everywhere, and no dearer."""
    problem = inspection.problem
    exact = not has_general_observations(problem)
    shares, told = _mean(gains.states), gains.information
    for worse in range(len(shares)):
        if silent[worse]:
            continue
        for better in range(len(shares)):
            if better == worse or costs[better] > costs[worse]:
                continue
            if exact:
                times = _sharper(inspection, better, worse)
                seen = f"the standard deviations are {times or 0:.3g} times as large"
                dominated = times is not None and times > 1.05
            else:
                more = (told[:, better] >= told[:, worse] - _NOTHING).mean()
                left = (1.0 - shares[worse]) / np.maximum(1.0 - shares[better], 1e-9)
                dominated = bool(
                    more > 0.95
                    and (shares[better] >= shares[worse] - 0.02).all()
                    and np.nanmax(gains.states[:, worse] - gains.states[:, better]) < 0.3
                    and left.max() > 1.25
                )
                seen = (
                    f"{told[:, better].mean():.2g} nats and {told[:, worse].mean():.2g} in "
                    f"{len(told)} beliefs of simulated trials"
                )
            if dominated:
                inspection.add(
                    "warning",
                    "sensors",
                    f"{inspection.label(worse)} is dominated: {inspection.label(better)} shows "
                    f"the same at least as sharply and is no dearer ({seen})",
                    "Leave it out, or give the better one its price (sensing_costs): estimates of "
                    "entropy from few particles may take the worse one.",
                    "docs/problems.md#when-to-sense",
                )
                break


def _sharper(inspection: Inspection, better: int, worse: int) -> float | None:
    """Return how many times as wide the noise of a Gaussian sensor is; None if not everywhere.

    Each coordinate that it shows must be one that the other shows, up to a factor and an offset.
    """
    problem, walk = inspection.problem, inspection.walk
    if walk is None:
        return None
    rows = walk.states.reshape(-1, walk.states.shape[-1])
    rows = rows[:: max(1, len(rows) // 200)]
    predicted = []
    for action in (better, worse):
        mean, variance = inspection.ask(
            "observation_mean",
            lambda action=action: checked.prediction(problem, rows, action),  # type: ignore[misc]
        )
        predicted.append((mean, np.broadcast_to(variance, mean.shape)))
    (sharp, sharp_variance), (blunt, blunt_variance) = predicted
    times = np.inf
    widest = 0.0
    for column in range(blunt.shape[1]):
        found = None
        for other in range(sharp.shape[1]):
            slope = _slope(sharp[:, other], blunt[:, column])
            if slope is None:
                continue
            ratios = np.sqrt(blunt_variance[:, column] / (slope**2 * sharp_variance[:, other]))
            found = ratios if found is None else np.maximum(found, ratios)
        if found is None:
            return None
        times, widest = min(times, float(found.min())), max(widest, float(np.median(found)))
    return widest if times >= 1.0 - 1e-9 else None


def _slope(of: FloatArray, what: FloatArray) -> float | None:
    """Return the slope of a straight line that ``what`` is over ``of``; None if it is none."""
    x, y = of - of.mean(), what - what.mean()
    if not x.any() or not y.any():
        return None
    slope = float((x * y).sum() / (x * x).sum())
    straight = slope != 0.0 and np.abs(y - slope * x).max() <= 1e-9 * np.abs(y).max()
    return slope if straight else None


def _report_useless(inspection: Inspection, gains: _Gains, silent: Any) -> None:
    """Report what tells something, but nothing that changes the next task action."""
    own_resolution = _resolution(inspection)
    # Where all actions are the same in practice there is nothing to change.
    matters = gains.before > 0.3 * own_resolution
    if not matters.any():
        inspection.add(
            "information",
            "sensors",
            f"in none of {len(gains.before)} beliefs of simulated trials do the task actions "
            "differ by more than a third of the resolution: what is sensed may not matter here",
        )
        return
    told = np.where(matters[:, np.newaxis, :], gains.of_actions, 0.0).max(axis=2)
    for action in np.flatnonzero(~silent):
        own, whole = told[:, action], float(gains.information[:, action].mean())
        error = own.std() / np.sqrt(len(own))
        little = max(2.0 * _NOTHING, 0.03 * whole)
        if own.mean() + 2.0 * error < little and own.mean() < 0.15 * whole:
            inspection.add(
                "warning",
                "sensors",
                f"{inspection.label(int(action))} changes no task action by itself: it tells "
                f"{whole:.2g} nats about the state and "
                f"{max(own.mean(), 0.0):.2g} about the next task action, in {len(own)} beliefs of "
                "simulated trials",
                "If it counts later, or only together with another one, looking one step ahead "
                "never chooses it: compare with selector.method: expected_return and "
                "rollout_looks: 8, and with random. Else leave it out.",
                _ONE_STEP,
            )


def _resolution(inspection: Inspection) -> FloatArray:
    """Return the resolution of each coordinate of a task action."""
    problem, given = inspection.problem, inspection.settings.selector.resolution
    if inspection.settings.selector.method == "state_entropy":
        given = None
    own = inspection.ask("resolution", lambda: resolution_of(problem, given, of_states=False))
    return np.broadcast_to(np.asarray(own, dtype=np.float64), (problem.action_size,))


def _check_resolution(inspection: Inspection, gains: _Gains) -> None:
    """Compare the resolution with the spread of task actions, their noise and the goal."""
    problem = inspection.problem
    resolution = _resolution(inspection)
    blind = inspection.settings.selector.method in UNINFORMED_METHODS
    widest, spread = gains.before.max(axis=0), np.median(gains.before, axis=0)
    if (widest > 0.0).any() and (resolution > 3.0 * widest).all():
        inspection.add(
            "warning" if blind else "error",
            "resolution",
            f"resolution is {_written(resolution)}, and the task actions of a belief never differ "
            f"by more than a standard deviation of {widest.max():.3g}: to the entropy all of them "
            "are the same, and no sensing action is better than another",
            "Let it be what the task tolerates, of the order of the goal's size or of the motion "
            f"noise ({_written(np.sqrt(np.asarray(problem.motion_variance)))}).",
            _RESOLUTION,
        )
        return
    active = np.flatnonzero(spread > 0.0)
    if np.ptp(resolution) == 0.0 and len(active) > 1:
        most, least = active[spread[active].argmax()], active[spread[active].argmin()]
        if spread[most] > _SCALES * spread[least]:
            inspection.add(
                "warning",
                "units",
                f"coordinates {most} and {least} of the task action have standard deviations of "
                f"{spread[most]:.3g} and {spread[least]:.3g} in a typical belief, and one "
                f"resolution, {resolution[0]:.3g}",
                "Give each coordinate a resolution in its own unit: resolution = "
                "np.array([...]), one number for each.",
                _RESOLUTION,
            )
    _compare_with_goal(inspection, gains, resolution, spread)


def _compare_with_goal(
    inspection: Inspection, gains: _Gains, resolution: FloatArray, spread: FloatArray
) -> None:
    """Warn where entropy counts what is known well enough, beside what is not."""
    if inspection.settings.selector.method not in ("path_entropy", "action_entropy"):
        return
    tolerance = _tolerance(inspection)
    if tolerance is None:
        return
    # Of the sensing action that tells most about each coordinate.
    best = np.maximum(gains.of_actions.mean(axis=0).max(axis=0), 0.0)
    known = (spread < tolerance) & (resolution < 0.7 * spread) & (best > 0.3)
    # Far below the resolution it was not found: the policy stops before it.
    unknown = (spread > tolerance) & (tolerance > 0.3 * resolution)
    if not known.any() or not unknown.any():
        return
    sharp, weak = (
        int(np.where(known, best, -1.0).argmax()),
        int(np.where(unknown, best, np.inf).argmin()),
    )
    if best[sharp] < 1.5 * best[weak]:
        return
    inspection.add(
        "warning",
        "resolution",
        f"coordinate {sharp} of the task action is known to {spread[sharp]:.2g} before sensing, "
        f"well enough for the goal, which tolerates about {tolerance[sharp]:.2g}; but its "
        f"resolution is {resolution[sharp]:.2g}, so one look at it gains {best[sharp]:.2g} nats, "
        f"and a look at coordinate {weak}, known to {spread[weak]:.2g} where about "
        f"{tolerance[weak]:.2g} is needed, at most {best[weak]:.2g}",
        "Entropy prefers the first. Let resolution be what the task tolerates "
        f"({_written(tolerance)}), and compare with selector.method: expected_return and with "
        "random.",
        _RESOLUTION,
    )


def _tolerance(inspection: Inspection) -> FloatArray | None:
    """Return how far a task action may be off at the goal, about; None if no goal was reached."""
    problem, walk, ask = inspection.problem, inspection.walk, inspection.ask
    if walk is None:
        return None
    rows = walk.states.reshape(-1, walk.states.shape[-1])
    stages = walk.stages.reshape(-1)
    at_goal = ask("is_goal", lambda: truths(problem, "is_goal", rows))
    goals, stages = rows[at_goal][:50], stages[at_goal][:50]
    if len(goals) < 3:
        return None
    spread = rows.std(axis=0)
    base = ask("policy", lambda: checked.policy(problem, goals, stages))
    turns = circular_actions(problem)
    tolerated = np.full(problem.action_size, np.inf)

    def moved(at: int, by: float) -> FloatArray:
        states = goals.copy()
        states[:, at] += by
        return states

    for at in range(rows.shape[1]):
        if len(np.unique(rows[:, at])) < _FEW_VALUES:
            continue  # a bit or a kind has no width
        widths = []
        for sign in (-1.0, 1.0):
            low, high = 0.0, 4.0 * float(spread[at])
            for _ in range(20):
                middle = 0.5 * (low + high)
                there = moved(at, sign * middle)
                inside = ask("is_goal", lambda states=there: truths(problem, "is_goal", states))  # type: ignore[misc]
                low, high = (middle, high) if inside.mean() > 0.5 else (low, middle)
            widths.append(low)
        width = float(np.mean(widths))
        if not 0.0 < width < 3.9 * float(spread[at]):
            continue
        beside = moved(at, width)
        asked = ask("policy", lambda states=beside: checked.policy(problem, states, stages))  # type: ignore[misc]
        change = np.median(np.abs(differences(asked, base, turns)), axis=0)
        tolerated = np.where(change > 1e-9, np.minimum(tolerated, change), tolerated)
    return (
        np.where(np.isfinite(tolerated), tolerated, 0.0) if np.isfinite(tolerated).any() else None
    )


def _written(values: FloatArray) -> str:
    return ", ".join(f"{float(value):.2g}" for value in np.atleast_1d(values))
