"""What few particles choose, next to many: the bias of the entropy estimates.

Beliefs are taken from runs with 4,000 particles, before a sensing decision. What 4,000 particles
and 100 hypothetical observations say of a belief is the reference. Some of the particles, drawn
without replacement, then choose in its place: how often do they choose the same, how many nats
(of the reference) does their choice lose, and by how much is the entropy after each sensing action
off, next to that after the others? ::

    python -m benchmarks.particle_bias --seed 6101

takes some minutes. Differences of losses are paired, belief by belief, with standard errors over
beliefs.
"""

from __future__ import annotations

import argparse
import time
from typing import NamedTuple

import numpy as np

from benchmarks.beliefs import recorded_trial, settings_for
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import Belief
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import PlanningSettings, SelectorSettings
from holdfast.problems.problem import Problem
from studies.cases import CASES
from studies.trial_batches import problem_of

MANY = 4000
WANTED = ("three plates", "tight hole", "passer-by", "busy room")
INTERVALS = (8, 14)
TRIALS = 6
IN_EACH_TRIAL = 5


class Rival(NamedTuple):
    """A way of choosing from few particles."""

    estimator: str
    particles: int
    observations: int


RIVALS = (
    Rival("nearest_neighbor", 100, 10),
    Rival("prior_neighbors", 100, 10),
    Rival("nearest_neighbor", 100, 40),
    Rival("prior_neighbors", 100, 40),
    Rival("nearest_neighbor", 300, 10),
    Rival("prior_neighbors", 300, 10),
    Rival("nearest_neighbor", 1000, 10),
    Rival("nearest_neighbor", 1000, 40),
)


class Choice(NamedTuple):
    """What one rival does for one belief: nats lost, errors of the entropies, seconds."""

    lost: float
    errors: FloatArray
    seconds: float


def settings_of(rival: Rival, sensing_interval: int = 8) -> PlanningSettings:
    settings = settings_for(rival.particles, 1, num_observation_samples=rival.observations)
    return PlanningSettings(
        particle_filter=settings.particle_filter,
        active_sensing=settings.active_sensing,
        selector=SelectorSettings(method="action_entropy", estimator=rival.estimator),  # type: ignore[arg-type]
        sensing_interval=sensing_interval,
    )


def beliefs_of(
    problem: Problem, interval: int, max_steps: int, seed: int, rng: np.random.Generator
) -> list[PlanningState]:
    """Return states before sensing decisions, a few of each trial."""
    settings = settings_of(Rival("nearest_neighbor", MANY, 10), interval)
    found: list[PlanningState] = []
    for trial in range(TRIALS):
        states, _ = recorded_trial(problem, settings, trial, seed=seed, max_steps=max_steps)
        kept = rng.choice(len(states), min(IN_EACH_TRIAL, len(states)), replace=False)
        found += [states[index] for index in sorted(kept)]
    return found


def entropies_of(
    problem: Problem, rival: Rival, state: PlanningState, seed: int
) -> tuple[FloatArray, float]:
    """Return the expected entropies and the seconds that they took, the better of two times."""
    state = state._replace(seed=seed)  # not the draws of the run that the belief comes from
    settings = settings_of(rival)
    seconds = []
    for _ in range(2):
        start = time.perf_counter()
        _, info = Planner(problem, settings).choose_sensing_action(state)
        seconds.append(time.perf_counter() - start)
    assert info.entropies is not None
    return info.entropies, min(seconds)


def compare(case_name: str, seed: int) -> dict[Rival, list[Choice]]:
    """Return what every rival chooses for the beliefs of a case."""
    case = next(case for case in CASES if case.name == case_name)
    problem = problem_of(case.problem, case.model)
    rng = np.random.default_rng(seed)
    choices: dict[Rival, list[Choice]] = {rival: [] for rival in RIVALS}
    for interval in INTERVALS:
        for state in beliefs_of(problem, interval, case.max_steps, seed, rng):
            many = Rival("nearest_neighbor", MANY, 100)
            reference, _ = entropies_of(problem, many, state, seed + 1)
            order = rng.permutation(MANY)
            for rival in RIVALS:
                few = np.sort(order[: rival.particles])
                belief = Belief.weighted(state.belief.states[few], state.belief.weights[few])
                found, seconds = entropies_of(
                    problem, rival, state._replace(belief=belief), seed + 2
                )
                lost = float(reference[int(found.argmin())] - reference.min())
                choices[rival].append(Choice(lost, found - reference, seconds))
    return choices


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, default=6101)
    seed = parser.parse_args().seed
    print(
        "estimator N M: same choice (%), nats lost, less than the first, ms; uneven errors (nats)"
    )
    differences: dict[Rival, list[FloatArray]] = {rival: [] for rival in RIVALS}
    for name in WANTED:
        choices = compare(name, seed)
        first = np.array([choice.lost for choice in choices[RIVALS[0]]])
        print(f"\n{name}, {len(first)} beliefs", flush=True)
        for rival in RIVALS:
            lost = np.array([choice.lost for choice in choices[rival]])
            less = first - lost
            differences[rival].append(less)
            errors = np.mean([choice.errors for choice in choices[rival]], axis=0)
            milliseconds = 1e3 * float(np.median([choice.seconds for choice in choices[rival]]))
            print(
                f"{rival.estimator:17}{rival.particles:5}{rival.observations:4}:"
                f"{100.0 * np.mean(lost == 0.0):4.0f} {lost.mean():7.3f} {less.mean():+7.3f} "
                f"+- {less.std(ddof=1) / np.sqrt(len(less)):.3f} {milliseconds:7.2f};  "
                + " ".join(f"{error:+.2f}" for error in errors - errors.mean())
            )
    print("\nnats less than the first, mean over the problems")
    for rival, each in differences.items():
        error = np.sqrt(sum(less.var(ddof=1) / len(less) for less in each)) / len(each)
        mean = np.mean([less.mean() for less in each])
        print(
            f"{rival.estimator:17}{rival.particles:5}{rival.observations:4}: "
            f"{mean:+.3f} +- {error:.3f}"
        )


if __name__ == "__main__":
    main()
