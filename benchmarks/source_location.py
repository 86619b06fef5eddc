"""Source location: where to listen next for two sources, by the information that is gained.

Two sources in the plane, each N(0, I), are heard together: log z = log(0.1 + sum of
1 / (1e-4 + d**2)) + N(0, 0.5**2), d the distance of a source from the place where one
listens. After 30 places the information about both sources is bounded by the sequential prior
contrastive estimate, sPCE (Foster, Ivanova, Malik and Rainforth, "Deep adaptive design: amortizing
sequential Bayesian experimental design", ICML 2021, section 6.1), here with L = 1,000,000
contrastive draws, as there: in nats, at most log(L + 1) = 13.8.

The task is to know, so the policy is the identity. At each step 40 places are on offer: 20 drawn
from the prior, 20 near sources of the belief's particles. ::

    python -m benchmarks.source_location --out docs/results/other_worlds/source_location.csv
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from benchmarks import trial_table
from holdfast import numerics
from holdfast.numerics.arrays import BoolArray, FloatArray, IntArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.planner import Planner
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.problems.problem import ProblemBase

COLUMNS = ("spce", "error_m", "decision_s")
STEPS, BACKGROUND, NEAREST, DEVIATION = 30, 0.1, 1e-4, 0.5
CONTRASTS, IN_EACH = 1_000_000, 100_000
PARTICLES, PLACES, NEARBY = 1000, 40, 0.2

WAYS: Mapping[str, SelectorSettings | None] = {
    "default": SelectorSettings(),
    "state entropy": SelectorSettings(method="state_entropy"),
    "action covariance": SelectorSettings(method="action_covariance"),
    "random of those on offer": SelectorSettings(method="random"),
    "random of the prior": None,
}
"""The last one is the random baseline of the paper."""


def signal(sources: FloatArray, places: FloatArray) -> FloatArray:
    """Return the logarithm of the expected signal; ``sources`` are (..., 4)."""
    first, second = sources[..., :2] - places, sources[..., 2:] - places
    heard = BACKGROUND + 1.0 / (NEAREST + (first * first)[..., 0] + (first * first)[..., 1])
    heard = heard + 1.0 / (NEAREST + (second * second)[..., 0] + (second * second)[..., 1])
    return np.asarray(np.log(heard))


class Sources(ProblemBase):
    """States are two places, the one further to the left first; ``places`` are those on offer."""

    name = "source_location"
    state_size = action_size = 4
    sensing_actions: Sequence[str] = tuple(f"place {number}" for number in range(PLACES))
    resolution = 0.05
    motion_variance = np.full(4, 0.05**2)
    static_parameters = (0, 1, 2, 3)
    places: FloatArray

    def initial_states(self, stream: Stream, count: int) -> FloatArray:
        drawn = stream.normal((count, 4))
        right = drawn[:, 0] > drawn[:, 2]
        return np.where(right[:, np.newaxis], drawn[:, [2, 3, 0, 1]], drawn)

    def move(self, states: FloatArray, actions: FloatArray, stream: Stream) -> FloatArray:
        del actions, stream
        return states.copy()

    def observation_mean(self, states: FloatArray, sensing_action: int) -> FloatArray:
        place = self.places[sensing_action]
        first, second = states[..., :2] - place, states[..., 2:] - place
        near = NEAREST + first[..., 0] ** 2 + first[..., 1] ** 2
        other = NEAREST + second[..., 0] ** 2 + second[..., 1] ** 2
        return np.asarray(numerics.log(BACKGROUND + 1.0 / near + 1.0 / other)[..., np.newaxis])

    def observation_variance(self, states: FloatArray, sensing_action: int) -> FloatArray:
        del states, sensing_action
        return np.array([DEVIATION**2])

    def policy(self, states: FloatArray, stage: int | IntArray) -> FloatArray:
        del stage
        return states.copy()

    def is_goal(self, states: FloatArray) -> BoolArray:
        return np.zeros(states.shape[:-1], dtype=bool)


def run(way: str, seed: int, trial: int) -> Mapping[str, Any]:
    """Listen 30 times, and return the information, the error of the mean, and the time."""
    world = np.random.default_rng([seed, trial])
    truth, noise = world.normal(size=4), world.normal(size=STEPS)
    offers = world.normal(size=(STEPS, PLACES, 2))
    picks = world.random((STEPS, PLACES))
    selector = WAYS[way]
    problem = Sources()
    settings = PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=PARTICLES, resampling_threshold=0.5),
        active_sensing=ActiveSensingSettings(num_cores=1),
        selector=selector or SelectorSettings(method="random"),
        sensing_interval=0,
    )
    planner = Planner(problem, settings)
    state = planner.init(seed, trial)
    places, heard = np.empty((STEPS, 2)), np.empty(STEPS)
    seconds = 0.0
    for step in range(STEPS):
        began = time.process_time()
        problem.places = offers[step].copy()
        if selector is not None:
            states, weights = state.belief
            chosen = np.searchsorted(np.cumsum(weights), picks[step, ::2])
            near = states[np.minimum(chosen, PARTICLES - 1)].reshape(-1, 2, 2)
            sources = near[np.arange(PLACES // 2), np.arange(PLACES // 2) % 2]
            problem.places[::2] = sources + NEARBY * offers[step, ::2]
            index, _ = planner.choose_sensing_action(state)
        else:
            index = 1
        seconds += time.process_time() - began
        places[step] = problem.places[index]
        heard[step] = signal(truth, places[step]) + DEVIATION * noise[step]
        state, _ = planner.observe(state, index, heard[step : step + 1])
        state = planner.advance(state, np.zeros(4))
    found = planner.estimate(state).reshape(2, 2)
    errors = [np.linalg.norm(found - true, axis=1).mean() for true in _both_orders(truth)]
    return {
        "spce": spce(truth, places, heard, np.random.default_rng([seed, trial, 1])),
        "error_m": min(errors),
        "decision_s": seconds / STEPS,
    }


def _both_orders(truth: FloatArray) -> list[FloatArray]:
    pair = truth.reshape(2, 2)
    return [pair, pair[::-1]]


def spce(
    truth: FloatArray,
    places: FloatArray,
    heard: FloatArray,
    draws: np.random.Generator,
    contrasts: int = CONTRASTS,
) -> float:
    """Return log p(heard | truth) less that of its mean over the truth and draws of the prior."""

    def log_likelihood(sources: FloatArray) -> FloatArray:
        total = np.zeros(len(sources), dtype=sources.dtype)
        for place, one in zip(places.astype(sources.dtype), heard, strict=True):
            off = (signal(sources, place) - sources.dtype.type(one)) / sources.dtype.type(DEVIATION)
            total -= off * off / 2
        return total

    own = float(log_likelihood(truth[np.newaxis])[0])
    sums = [1.0]
    for begin in range(0, contrasts, IN_EACH):
        count = min(IN_EACH, contrasts - begin)
        others = log_likelihood(draws.normal(size=(count, 4)).astype(np.float32))
        sums.append(float(np.exp(others.astype(np.float64) - own).sum()))
    return float(np.log(contrasts + 1.0) - np.log(sum(sums)))


def cells_of(seed: int) -> list[trial_table.Cell]:
    return [trial_table.Cell({"way": way}, partial(run, way, seed)) for way in WAYS]


if __name__ == "__main__":
    out = trial_table.main(__doc__, "runs/source_location/trials.csv", 30, cells_of, COLUMNS)
    print(trial_table.ranked(out, COLUMNS[0], COLUMNS[1:]))
