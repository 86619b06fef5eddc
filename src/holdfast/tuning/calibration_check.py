"""Whether the likelihood fits the observations: simulation-based calibration.

Draw a state from some belief, draw what a sensor shows there, and ask the posterior how much of it
lies below that state, in any order of the states. If the likelihood is that of the draws, the
answer is uniform between 0 and 1 (Talts, Betancourt, Simpson, Vehtari and Gelman, "Validating
Bayesian inference algorithms with simulation-based calibration", 2018). A belief of particles is a
prior that is known exactly, so nothing is approximate here: the posterior is the weights, and among
equal states chance decides.

The orders are by each coordinate of the state, by the same times the observation, which finds a
likelihood that ignores it, and by the likelihood itself, which finds most (Modrák and others,
"Simulation-based calibration checking for Bayesian computation", 2023).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

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
from holdfast.tuning.contract_check import acted, draw_observation
from holdfast.tuning.findings import CheckEndedError, Inspection, spread_out

_REPLICATES = 300  # simulated observations of a sensing action from each kind of belief
_PARTICLES = 200
_CLOUDS = 10  # beliefs that come of one state each
_MOST_COORDINATES, _MOST_ACTIONS = 8, 64
_INITIAL, _CLOUD, _WHICH, _SHOWN, _TIES = 16, 17, 18, 19, 20  # trial numbers of the streams here
_GAINS = 0.1  # nats by which the true state's posterior must grow for a remedy to be named

_Calibration = tuple[FloatArray, IntArray, FloatArray, FloatArray]
"""Log-likelihoods of r observations in n particles each, (r, n), up to a constant of each
observation; the true particles, (r,); all particles' states, (r, n, state_size); the observations,
(r, observation_size)."""


def check_likelihoods(inspection: Inspection) -> None:
    """Test for each sensing action whether its samples follow its likelihood."""
    problem, late = inspection.problem, inspection.deadline(0.45, "likelihood")
    function = "log_likelihood" if has_general_observations(problem) else "observation_mean"
    kinds = list(_beliefs(inspection))
    for action in range(min(len(sensing_labels(problem)), _MOST_ACTIONS)):
        if late():
            return
        with contextlib.suppress(CheckEndedError):
            for kind, beliefs in kinds:
                found = inspection.ask(
                    function, _calibrate, inspection, action, beliefs, late, check="likelihood"
                )
                ties = inspection.random(_TIES, action).random((len(found[1]), 1))
                about = f"{function}, {inspection.label(action)}"
                _test(inspection, about, kind, found, ties)


def _beliefs(inspection: Inspection) -> Iterator[tuple[str, list[FloatArray]]]:
    """Yield beliefs as wide as the initial one or the way, and as narrow as some moves."""
    problem, ask, walk = inspection.problem, inspection.ask, inspection.walk
    own = inspection.random(_INITIAL)
    initial = ask("initial_states", checked.initial_states, problem, own, _PARTICLES)
    yield "the initial belief", [initial]
    if walk is None:
        return
    count = len(walk.states)
    yield "states along the way", [walk.states[spread_out(_PARTICLES, count)]]

    def spread(at: int, number: int) -> FloatArray:
        cloud = np.tile(walk.states[at], (_PARTICLES // 2, 1))
        action = acted(problem, walk.states[at], int(walk.stages[at]))
        for step in range(min(inspection.settings.sensing_interval + 1, 5)):
            own = inspection.random(_CLOUD, number * 100 + step)
            cloud = checked.move(problem, cloud, action, own)
        return cloud

    clouds = [ask("move", spread, each * count // _CLOUDS, each) for each in range(_CLOUDS)]
    yield "beliefs that come of one state", clouds


def _calibrate(
    inspection: Inspection, action: int, beliefs: list[FloatArray], late: Callable[[], bool]
) -> _Calibration:
    """Simulate observations of a sensing action in states of some beliefs, and weigh all states."""
    problem = inspection.problem
    which = inspection.random(_WHICH, action).random(_REPLICATES)
    found: list[tuple[Any, ...]] = []
    for number in range(_REPLICATES):
        if late() and number >= 50:
            break
        belief = beliefs[number % len(beliefs)]
        truth = int(which[number] * len(belief))
        own = inspection.random(_SHOWN + 2 * action, number)
        shown = draw_observation(problem, belief[truth], action, own)
        # An angle is what it is on the circle: a turn more would tell what no posterior knows.
        angles = circular_observation(problem, action, shown.size)
        on_circle = differences(shown, np.zeros(shown.size), angles)
        found.append((_log_likelihoods(problem, belief, action, shown), truth, belief, on_circle))
    values, truths, states, shown = (np.array(part) for part in zip(*found, strict=True))
    return values, truths, states, shown


def _log_likelihoods(
    problem: Any, states: FloatArray, action: int, shown: FloatArray
) -> FloatArray:
    if has_general_observations(problem):
        return checked.log_likelihood(problem, states, action, shown)
    belief = Belief(states, uniform_weights(len(states)))
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(update(problem, belief, action, shown)[0].weights))


def _test(
    inspection: Inspection, about: str, kind: str, found: _Calibration, ties: FloatArray
) -> None:
    (values, truths, states, shown), count = found, len(found[1])
    if impossible := int((values[np.arange(count), truths] == -np.inf).sum()):
        seen = f"{about}: {impossible} of {count} simulated observations are impossible (minus "
        seen += "infinity) in the very state in which they were drawn"
        advice = "sample_observation and log_likelihood must be of one distribution."
        inspection.add("error", "likelihood", seen, advice)
        return
    weights = _posteriors(values)
    quantities: list[tuple[str, FloatArray]] = [("likelihood", values)]
    away = shown - shown.mean(axis=0)
    for at in range(min(states.shape[-1], _MOST_COORDINATES)):
        name, own = inspection.coordinate(at), states[..., at]
        # The second order turns with the observation, so that one which is ignored shows.
        quantities += [(name, own), (f"{name} times the observation", own * away[:, :1])]
    remedy = None
    usual = "Compare sample_observation with log_likelihood (observation_mean and "
    usual += "observation_variance of one state with those of many): of one distribution."
    for name, quantity in quantities:
        # How much of each posterior lies below the true state; of what is equal, a share.
        own = quantity[np.arange(count), truths][:, np.newaxis]
        places = (weights * ((quantity < own) + ties * (quantity == own))).sum(axis=1)
        # The distance from the middle is uniform, too, and shows a wrong width.
        folded = np.abs(2.0 * places - 1.0)
        for shape, numbers in (("place", places), ("distance from the middle", folded)):
            p = uniform_p(numbers)
            if p < 1e-3 and remedy is None:
                remedy = remedy_of(values, truths)
            better, advice = remedy or ("", usual)
            seen = (
                f"{about}: does not fit what is sampled. In {count} simulated observations from "
                f"{kind}, the true state's {shape} among the particles by {name} is not uniform: "
                f"mean {numbers.mean():.2f} instead of 0.50{better}"
            )
            inspection.test(p, "likelihood", seen, advice)


def _posteriors(values: FloatArray) -> FloatArray:
    """Return the posteriors of uniform beliefs, shape (r, n)."""
    weights = np.exp(values - values.max(axis=1, keepdims=True))
    normal: FloatArray = weights / weights.sum(axis=1, keepdims=True)
    return normal


def uniform_p(numbers: FloatArray) -> float:
    """Return the p-value of Kolmogorov's test that numbers are uniform between 0 and 1.

    The approximation is that of Stephens (1970), Journal of the Royal Statistical Society B 32.
    """
    count = len(numbers)
    above = np.arange(1, count + 1) / count - np.sort(numbers)
    distance = max(above.max(), (1.0 / count - above).max())
    scaled = (np.sqrt(count) + 0.12 + 0.11 / np.sqrt(count)) * distance
    if scaled < 0.3:
        return 1.0
    terms = np.arange(1, 101)
    total = 2.0 * np.sum((-1.0) ** (terms - 1) * np.exp(-2.0 * terms**2 * scaled**2))
    return float(min(1.0, max(0.0, total)))


def remedy_of(values: FloatArray, truths: IntArray) -> tuple[str, str] | None:
    """Return what would make a likelihood fit better, in words, and what to do; None for nothing.

    What is tried is what people mistake: the likelihood for its logarithm, a sign, a width.
    """

    def fit(changed: FloatArray) -> float:
        own = _posteriors(changed)[np.arange(len(truths)), truths]
        return float(np.log(np.maximum(own, 1e-300)).mean())

    finite = np.where(np.isfinite(values), values, np.finfo(float).min)
    negative = -finite / 1e3 if np.abs(finite).max() > 1e300 else -finite
    advice = "The log-likelihood is greatest where the observation is likely: -0.5 * deviation**2."
    found = [(fit(negative), ". It fits better with the other sign", advice)]
    if likely := bool((values >= 0.0).all()):  # a log-likelihood hardly ever is
        seen = ". It fits better if the logarithm of the result is taken: log_likelihood seems to "
        seen += "return the likelihood"
        advice = "Return the logarithm: numerics.log(likelihood)."
        found.append((fit(np.log(np.maximum(values, 1e-300))), seen, advice))
    powers = 2.0 ** np.arange(-12.0, 12.5, 0.5)
    fits = [fit(finite * power) if power < 1.0 else fit(values * power) for power in powers]
    best = int(np.argmax(fits))
    width = 1.0 / np.sqrt(powers[best])
    if not 0.8 < width < 1.25:
        seen = f". It fits better if the noise is taken to be {width:.2g} times as wide"
        advice = "A variance in place of a standard deviation, or the reverse? Both in "
        advice += "-0.5 * (d / deviation)**2 and in stream.normal(loc, scale) it is the deviation."
        found.append((fits[best] - 0.01, seen, advice))
    gain, seen, advice = max(found)
    return (seen, advice) if gain > fit(values) + _GAINS * (not likely) else None
