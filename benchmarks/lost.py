"""How often a robot is called lost, rightly and wrongly, and how soon: for docs/decisions/lost.md.

``python -m benchmarks.lost alarms`` runs undisturbed trials, ``delays`` trials in which the robot
is carried back to its start or a sensor sticks, ``recovery`` such trials with each ``on_lost``. An
alarm is false if the belief of that moment has the truth within its 99.9 % ellipsoid; else the
filter has lost the robot by itself, as few particles do.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy import stats

from holdfast.config.loader import Configuration, load
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.circular import differences
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.lost import LostTest
from holdfast.planning.outcome import MoveResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import LostSettings, OnLost
from holdfast.problems.attributes import circular_states
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import SensingStep, TrialObserver, run_trial

EXAMPLES = Path(__file__).parents[1] / "examples"
PROBLEMS = (
    "peg_in_hole_2d",
    "peg_in_hole_3d",
    "capsule_robot",
    "multitier_peg_in_hole_2d",
    "light_dark_room",
)
ON_LOST: tuple[OnLost, ...] = ("continue", "reinitialise")
MAX_STEPS = 400
"""Limit of a trial with trouble, which may never end."""


class Seen(NamedTuple):
    """An observation: what the tests get, and what they are not told."""

    step: int
    sensing_action: int
    within_gate: bool
    deviations: float
    is_sound: bool
    after_trouble: bool


class Troubled(SimulatedEnvironment):
    """At a step from 10 to 39 the robot is carried back to its start, or a sensor sticks."""

    def __init__(self, configuration: Configuration, seed: int, trial: int, trouble: str) -> None:
        super().__init__(configuration.problem, seed, trial)
        draws = np.random.default_rng([seed, trial, 19])
        self.at = int(draws.integers(10, 40)) if trouble != "none" else None
        self.dead = int(draws.integers(len(configuration.problem.sensing_actions)))
        self.trouble = trouble
        self.start = stream(seed, trial, 1, Purpose.WORLD_INITIAL_STATE)
        self.problem = configuration.problem
        self.stuck: FloatArray | None = None

    @property
    def has_begun(self) -> bool:
        return self.at is not None and self.step >= self.at

    def perform(self, task_action: FloatArray) -> float | MoveResult | None:
        shown = super().perform(task_action)
        if self.step == self.at and self.trouble == "carried":
            self.state = np.array(self.problem.initial_states(self.start, 1)[0])
        return shown

    def perform_sensing(self, sensing_action: int) -> FloatArray:
        shown = super().perform_sensing(sensing_action)
        if self.trouble == "dead" and self.has_begun and sensing_action == self.dead:
            self.stuck = np.asarray(shown) if self.stuck is None else self.stuck
            return self.stuck
        return shown


class Watch(TrialObserver):
    """Keeps what is seen in a trial."""

    def __init__(self, world: Troubled) -> None:
        self.world = world
        self.seen: list[Seen] = []

    def sensed(self, step: SensingStep) -> None:
        info, world = step.observation_info, self.world
        states, weights = step.before.belief
        angles = circular_states(world.problem)
        away = differences(states, world.state, angles)
        mean = weights @ away
        spread = away - mean
        covariance = (weights[:, None] * spread).T @ spread + 1e-12 * np.eye(len(mean))
        squared = float(mean @ np.linalg.solve(covariance, mean))
        self.seen.append(
            Seen(
                step.before.step,
                step.sensing_action,
                info.within_gate,
                info.mahalanobis_distance or 0.0,
                squared <= stats.chi2.isf(1e-3, len(mean)),
                world.has_begun,
            )
        )


class Run:
    """So many observations in a row, of whatever sensing action, outside some gate."""

    def __init__(self, length: int, is_outside: Callable[[Seen], bool]) -> None:
        self.length, self.is_outside, self.count = length, is_outside, 0

    def __call__(self, seen: Seen) -> str | None:
        self.count = self.count + 1 if self.is_outside(seen) else 0
        if self.count < self.length:
            return None
        self.count = 0
        return "lost"


class Sum:
    """The test that is used."""

    def __init__(self, rate: float) -> None:
        self.test = LostTest(rate)

    def __call__(self, seen: Seen) -> str | None:
        found = self.test.observed(seen.sensing_action, seen.within_gate)
        if found is None:
            return None
        return "lost" if found.kind == "lost" else f"sensor {found.sensing_action}"


Test = Callable[[Seen], str | None]
DESIGNS: dict[str, Callable[[], Test]] = {
    "run of 5 over 8 sigma": lambda: Run(5, lambda seen: seen.deviations > 8.0),
    "run of 5 outside the gate": lambda: Run(5, lambda seen: not seen.within_gate),
    "run of 3 outside the gate": lambda: Run(3, lambda seen: not seen.within_gate),
    **{f"cumulative sum, {rate:g}": partial(Sum, rate) for rate in (1e-2, 1e-3, 1e-4)},
}


def trials(
    name: str, particles: int, method: str, trouble: str, observations: int, seed: int
) -> list[tuple[Troubled, list[Seen]]]:
    configuration = load(EXAMPLES / f"{name}.yaml")
    planner = Planner(
        configuration.problem,
        configuration.planning,
        particles=particles,
        method=method,  # type: ignore[arg-type]
    )
    most = configuration.simulator.max_steps
    found: list[tuple[Troubled, list[Seen]]] = []
    count = 0
    while count < observations:
        world = Troubled(configuration, seed, len(found), trouble)
        watch = Watch(world)
        steps = most if trouble == "none" else min(most, MAX_STEPS)
        run_trial(planner, seed, len(found), max_steps=steps, environment=world, observer=watch)
        found.append((world, watch.seen))
        count += len(watch.seen)
    return found


def alarms(options: argparse.Namespace) -> None:
    print("| problem | N | observations | trials | outside | design | alarms | false | bound |")
    for name in options.problems:
        for particles in options.particles:
            ran = trials(name, particles, options.method, "none", options.observations, 5)
            seen = [each for _, trial in ran for each in trial]
            sound = [each for each in seen if each.is_sound]
            outside = np.mean([not each.within_gate for each in seen])
            outside_sound = np.mean([not each.within_gate for each in sound])
            for design, make in DESIGNS.items():
                total = false = 0
                for _, trial in ran:
                    test = make()
                    for each in trial:
                        if test(each) is not None:
                            total += 1
                            false += each.is_sound
                rate = float(design.split(", ")[1]) if ", " in design else None
                bound = "" if rate is None else f"{rate * len(seen):.3g}"
                print(
                    f"| {name} | {particles} | {len(seen)} | {len(ran)} | {outside:.2%}, sound "
                    f"{outside_sound:.2%} | {design} | {total} | {false} | {bound} |",
                    flush=True,
                )


def delays(options: argparse.Namespace) -> None:
    print(
        "| problem | N | trouble | trials | design | found | median observations, steps | named |"
    )
    for name in options.problems:
        for particles in options.particles:
            for trouble in ("carried", "dead"):
                ran = trials(name, particles, options.method, trouble, options.observations, 6)
                ran = [each for each in ran if any(seen.after_trouble for seen in each[1])]
                for design, make in DESIGNS.items():
                    counts, steps, named = [], [], {"lost": 0, "right": 0, "wrong": 0}
                    for world, trial in ran:
                        assert world.at is not None
                        test, after, first = make(), 0, True
                        for each in trial:
                            verdict = test(each)
                            after += each.after_trouble
                            if verdict is None or not each.after_trouble or not first:
                                continue
                            first = False
                            counts.append(after)
                            steps.append(each.step - world.at)
                            right = verdict == f"sensor {world.dead}"
                            named[
                                "lost" if verdict == "lost" else "right" if right else "wrong"
                            ] += 1
                    median = f"{np.median(counts):g}, {np.median(steps):g}" if counts else ""
                    print(
                        f"| {name} | {particles} | {trouble} | {len(ran)} | {design} | "
                        f"{len(counts)} | {median} | {named} |",
                        flush=True,
                    )


def recovery(options: argparse.Namespace) -> None:
    print("| problem | N | trouble | trials | continue | reinitialise | difference |")
    for name in options.problems:
        configuration = load(EXAMPLES / f"{name}.yaml")
        most = configuration.simulator.max_steps
        for particles in options.particles:
            planner = Planner(
                configuration.problem,
                configuration.planning,
                particles=particles,
                method=options.method,
            )
            for trouble in ("none", "carried", "dead"):
                won: dict[str, list[bool]] = {}
                for on_lost in ON_LOST:
                    won[on_lost] = [
                        run_trial(
                            planner,
                            7,
                            trial,
                            max_steps=most if trouble == "none" else min(most, MAX_STEPS),
                            environment=Troubled(configuration, 7, trial, trouble),
                            lost=LostSettings(on_lost=on_lost, false_alarm_rate=options.rate),
                        ).success
                        for trial in range(options.trials)
                    ]
                difference = np.array(won["reinitialise"], float) - np.array(won["continue"], float)
                error = 1.96 * difference.std(ddof=1) / np.sqrt(len(difference))
                print(
                    f"| {name} | {particles} | {trouble} | {options.trials} | "
                    f"{np.mean(won['continue']):.1%} | {np.mean(won['reinitialise']):.1%} | "
                    f"{100 * difference.mean():+.1f} points (+-{100 * error:.1f}) |",
                    flush=True,
                )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("alarms", "delays", "recovery"))
    parser.add_argument("--problems", nargs="+", default=PROBLEMS)
    parser.add_argument("--particles", nargs="+", type=int, default=[300, 3000])
    parser.add_argument("--method", default="random")
    parser.add_argument("--observations", type=int, default=20_000)
    parser.add_argument("--trials", type=int, default=200)
    parser.add_argument("--rate", type=float, default=1e-4)
    options = parser.parse_args()
    {"alarms": alarms, "delays": delays, "recovery": recovery}[options.what](options)


if __name__ == "__main__":
    main()
