"""Whether the likelihood fits the observations: simulation-based calibration.

Draw a state from some belief, draw what a sensor shows there, and ask the posterior how much of it
lies below that state, in any order of the states. If the likelihood is that of the draws, the
answer is uniform between 0 and 1 (Talts, Betancourt, Simpson, Vehtari and Gelman, "Validating
Bayesian inference algorithms with simulation-based calibration", 2018). A belief of particles is a
prior that is known exactly, so nothing is approximate here: the posterior is the weights, and among
equal states chance decides.

Three orders are used: each coordinate of the state, the same times the observation, which finds a
likelihood that ignores it, and the likelihood itself, which finds most (Modrák and others,
"Simulation-based calibration checking for Bayesian computation: the choice of test quantities
shapes sensitivity", 2023). A likelihood in place of its logarithm hardly weighs, so the true state,
which is likely, lies above nearly all others.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from holdfast.numerics.arrays import FloatArray, IntArray
from holdfast.numerics.circular import differences
from holdfast.planning.belief import Belief, uniform_weights, update
from holdfast.problems import checked
from holdfast.problems.attributes import (
    circular_observation,
    has_general_observations,
    sensing_labels,
)
from holdfast.tuning.contract_check import draw_observation, kolmogorov_p
from holdfast.tuning.findings import CHECKS, CONTRACT, Finding, Inspection, spread_out

__all__ = ["Calibration", "calibrate", "check_likelihoods", "remedy_of"]

_REPLICATES = 300
"""Simulated observations of a sensing action from each kind of belief."""

_PARTICLES = 200
_CLOUDS = 10
"""Beliefs that come of one state each."""

_MOST_COORDINATES = 8
_MOST_ACTIONS = 64

_INITIAL, _CLOUD, _WHICH, _SHOWN, _TIES = 16, 17, 18, 19, 20

_GAINS = 0.1
"""Nats by which the true state's posterior must grow for a remedy to be named."""


class Calibration(NamedTuple):
    """What simulated observations of one sensing action lead to.

    Attributes
    ----------
    log_likelihoods : array of shape (r, n)
        Of each simulated observation in each particle's state, up to a constant of the observation.
    truths : array of shape (r,)
        Which particle the observation was drawn in.
    states : array of shape (r, n, state_size)
    shown : array of shape (r, observation_size)
    """

    log_likelihoods: FloatArray
    truths: IntArray
    states: FloatArray
    shown: FloatArray


def check_likelihoods(inspection: Inspection) -> None:
    """Test for each sensing action whether its samples follow its likelihood."""
    problem = inspection.problem
    count = len(sensing_labels(problem))
    late = inspection.deadline(0.45)
    function = "log_likelihood" if has_general_observations(problem) else "observation_mean"
    untried = 0
    beliefs_of = list(_beliefs(inspection))
    for action in range(min(count, _MOST_ACTIONS)):
        if late():
            untried = count - action
            break
        with inspection.part():
            for kind, beliefs in beliefs_of:
                found = inspection.ask(
                    function,
                    lambda beliefs=beliefs, action=action: calibrate(  # type: ignore[misc]
                        inspection, action, beliefs, late
                    ),
                    "likelihood",
                )
                _test(inspection, action, kind, found, function)
    if untried:
        inspection.add(
            "information",
            "likelihood",
            f"the likelihoods of {untried} of {count} sensing actions were not tested: the time "
            "for this check was over",
            "Give it more (--budget).",
        )


def _beliefs(inspection: Inspection) -> Iterator[tuple[str, list[FloatArray]]]:
    """Yield beliefs as wide as the initial one or the way, and as narrow as some moves."""
    problem, ask = inspection.problem, inspection.ask
    own = inspection.random(_INITIAL)
    states = ask("initial_states", lambda: checked.initial_states(problem, own, _PARTICLES))
    yield "the initial belief", [states]
    walk = inspection.walk
    if walk is None:
        return
    rows = walk.states.reshape(-1, walk.states.shape[-1])
    stages = walk.stages.reshape(-1)
    yield "states along the way", [rows[spread_out(_PARTICLES, len(rows))]]
    clouds = []
    moves = min(inspection.settings.sensing_interval + 1, 5)
    for number in range(_CLOUDS):
        at = (number * len(rows)) // _CLOUDS

        def spread(at: int = at, number: int = number) -> FloatArray:
            cloud = np.repeat(rows[at : at + 1], _PARTICLES // 2, axis=0)
            for step in range(moves):
                commanded = checked.policy(problem, rows[at], int(stages[at]))
                action = checked.executed_action(problem, commanded)
                noise = inspection.random(_CLOUD, number * 100 + step)
                cloud = checked.move(problem, cloud, action, noise)
            return cloud

        clouds.append(ask("move", spread))
    yield "beliefs that come of one state", clouds


def calibrate(
    inspection: Inspection, action: int, beliefs: list[FloatArray], late: Any = lambda: False
) -> Calibration:
    """Simulate observations of a sensing action in states of some beliefs, and weigh all states."""
    problem = inspection.problem
    which = inspection.random(_WHICH, action).random(_REPLICATES)
    rows, truths, states, observations = [], [], [], []
    for number in range(_REPLICATES):
        if late() and number >= 50:
            break
        belief = beliefs[number % len(beliefs)]
        truth = int(which[number] * len(belief))
        noise = inspection.random(_SHOWN + 2 * action, number)
        shown = draw_observation(problem, belief[truth], action, noise)
        rows.append(_log_likelihoods(problem, belief, action, shown))
        truths.append(truth)
        states.append(belief)
        # An angle is what it is on the circle: a turn more would tell what no posterior knows.
        angles = circular_observation(problem, action, shown.size)
        observations.append(differences(shown, np.zeros(shown.size), angles))
    return Calibration(np.array(rows), np.array(truths), np.array(states), np.array(observations))


def _log_likelihoods(
    problem: Any, states: FloatArray, action: int, shown: FloatArray
) -> FloatArray:
    if has_general_observations(problem):
        return checked.log_likelihood(problem, states, action, shown)
    belief = Belief(states, uniform_weights(len(states)))
    weights = update(problem, belief, action, shown)[0].weights
    with np.errstate(divide="ignore"):
        logarithms: FloatArray = np.log(weights)
    return logarithms


def _test(
    inspection: Inspection, action: int, kind: str, found: Calibration, function: str
) -> None:
    label = inspection.label(action)
    values, truths = found.log_likelihoods, found.truths
    own = values[np.arange(len(truths)), truths]
    if (own == -np.inf).any():
        inspection.add(
            "error",
            "likelihood",
            f"{function}, {label}: {int((own == -np.inf).sum())} of {len(own)} simulated "
            "observations are impossible (minus infinity) in the very state in which they were "
            "drawn",
            "sample_observation and log_likelihood must be of one distribution.",
            CONTRACT,
        )
        return
    weights = _posteriors(values)
    ties = inspection.random(_TIES, action).random(len(truths))
    quantities: list[tuple[str, FloatArray]] = [("likelihood", values)]
    away = found.shown - found.shown.mean(axis=0)
    for at in range(min(found.states.shape[-1], _MOST_COORDINATES)):
        own_states = found.states[..., at]
        quantities.append((inspection.coordinate(at), own_states))
        # The order turns with the observation, so that one which is ignored shows.
        quantities.append(
            (f"{inspection.coordinate(at)} times the observation", own_states * away[:, :1])
        )
    remedy: tuple[str, str] | None = None
    for name, quantity in quantities:
        places = _places(quantity, weights, truths, ties)
        for shape, numbers in (("place", places), ("distance from the middle", _folded(places))):
            p = _uniform_p(numbers)
            if p < 1e-3 and remedy is None:
                remedy = remedy_of(values, truths)
            seen, advice = remedy or ("", "")
            inspection.test(
                p,
                Finding(
                    "error",
                    "likelihood",
                    f"{function}, {label}: does not fit what is sampled. In {len(truths)} "
                    f"simulated observations from {kind}, the true state's {shape} among the "
                    f"particles by {name} is not uniform: mean {numbers.mean():.2f} instead of "
                    f"0.50{seen}",
                    advice
                    or "Compare log_likelihood with sample_observation (or observation_mean and "
                    "observation_variance of one state with those of many): both must be of one "
                    "distribution.",
                    CHECKS,
                ),
            )


def _posteriors(values: FloatArray) -> FloatArray:
    """Return the posteriors of uniform beliefs, shape (r, n)."""
    weights = np.exp(values - values.max(axis=1, keepdims=True))
    normal: FloatArray = weights / weights.sum(axis=1, keepdims=True)
    return normal


def _places(
    quantity: FloatArray, weights: FloatArray, truths: IntArray, ties: FloatArray
) -> FloatArray:
    """Return how much of each posterior lies below the true state; of equal ones, a share."""
    own = quantity[np.arange(len(truths)), truths][:, np.newaxis]
    below = np.where(quantity < own, weights, 0.0).sum(axis=1)
    equal = np.where(quantity == own, weights, 0.0).sum(axis=1)
    places: FloatArray = below + ties * equal
    return places


def _folded(places: FloatArray) -> FloatArray:
    """Return the distance from the middle, which is uniform, too, and shows a wrong width."""
    return np.abs(2.0 * places - 1.0)


def _uniform_p(numbers: FloatArray) -> float:
    """Return the p-value of Kolmogorov's test that numbers are uniform between 0 and 1."""
    ordered, count = np.sort(numbers), len(numbers)
    above = np.arange(1, count + 1) / count - ordered
    below = ordered - np.arange(count) / count
    return kolmogorov_p(float(max(above.max(), below.max())), count)


def remedy_of(values: FloatArray, truths: IntArray) -> tuple[str, str] | None:
    """Return what would make a likelihood fit better, in words, and what to do; None for nothing.

    What is tried is what people mistake: the likelihood for its logarithm, a sign, a width.
    """

    def fit(changed: FloatArray) -> float:
        own = _posteriors(changed)[np.arange(len(truths)), truths]
        return float(np.log(np.maximum(own, 1e-300)).mean())

    as_it_is = fit(values)
    finite = np.where(np.isfinite(values), values, np.finfo(float).min)
    found: list[tuple[float, str, str]] = []
    if (values >= 0.0).all():
        found.append(
            (
                fit(np.log(np.maximum(values, 1e-300))),
                ". It fits better if the logarithm of the result is taken: log_likelihood seems to "
                "return the likelihood",
                "Return the logarithm: numerics.log(likelihood).",
            )
        )
    found.append(
        (
            fit(-finite / 1e3 if np.abs(finite).max() > 1e300 else -finite),
            ". It fits better with the other sign",
            "The log-likelihood is greatest where the observation is likely: "
            "-0.5 * deviation * deviation.",
        )
    )
    powers = 2.0 ** np.arange(-12.0, 12.5, 0.5)
    fits = [fit(finite * power) if power < 1.0 else fit(values * power) for power in powers]
    best = int(np.argmax(fits))
    width = 1.0 / np.sqrt(powers[best])
    if not 0.8 < width < 1.25:
        found.append(
            (
                fits[best] - 0.01,
                f". It fits better if the noise is taken to be {width:.2g} times as wide",
                "A variance in place of a standard deviation, or the reverse? In a Gaussian's "
                "logarithm, -0.5 * (d / deviation)**2, and in stream.normal(loc, scale), the scale "
                "is the standard deviation.",
            )
        )
    gain, seen, advice = max(found)
    return (seen, advice) if gain > as_it_is + _GAINS else None
