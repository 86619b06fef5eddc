"""What ``holdfast check`` finds, and how often it is wrong: ``python -m benchmarks.check_power``.

The wrong problems of tests/unit/test_problem_check.py, with several seeds each: in how many checks
the defect is named. Right problems with many seeds: in how many an error is found, which no right
problem should have, and which warnings. A sensor that is noisier or less noisy than its likelihood
says. And methods that are exactly as good as random sensing: how often they are called worse.
"""

from __future__ import annotations

import importlib
import re
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
from tests.unit.test_problem_check import WRONG, Gaussian, Rover, check, kind_of

from holdfast.planning.planner import Planner
from holdfast.robot.trial import run_trial
from holdfast.tuning.verdict import mean_difference

RIGHT = (
    "two_ends:Sorting",
    "two_ends:TwoCues",
    "corridor_doors:CorridorDoors",
    "wrapping_heading:WrappingHeading",
    "",  # the rover of the tests
)
FIRST_SEED, WRONG_SEEDS, RIGHT_SEEDS = 1000, 2, 54


def wrong() -> None:
    """Count in how many checks each wrong problem is named."""
    named: dict[str, int] = {}
    for kind, (severity, name, pattern) in WRONG.items():
        found = [check(kind_of(kind)(), seed=FIRST_SEED + n) for n in range(WRONG_SEEDS)]
        named[kind] = sum(
            any(
                each.check == name and each.severity == severity and re.search(pattern, each.seen)
                for each in findings
            )
            for findings in found
        )
    missed = {kind: count for kind, count in named.items() if count < WRONG_SEEDS}
    always = len(named) - len(missed)
    print(f"wrong: {always} of {len(named)} named in {WRONG_SEEDS} checks each; else {missed}")


def right() -> None:
    """Count the errors and warnings of right problems, as many of each as there are seeds."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    errors, warned, checks = 0, Counter[str](), 0
    for seed in range(FIRST_SEED, FIRST_SEED + RIGHT_SEEDS):
        for name in RIGHT:
            module, _, kind = name.partition(":")
            problem = getattr(importlib.import_module(module), kind)() if name else Rover()
            found = check(problem, seed=seed)
            checks += 1
            errors += any(each.severity == "error" for each in found)
            warned.update({f"{name} {each.check}" for each in found if each.severity == "warning"})
        print(f"right: errors in {errors} of {checks} checks, warnings {dict(warned)}", flush=True)


def widths() -> None:
    """Count in how many of 10 checks a wrong width of the noise is found."""
    for factor in (0.5, 0.8, 1.2, 1.5):

        class Wider(Rover):
            width = factor * Rover.deviation

            def sample_observation(self, state: Any, sensing_action: int, stream: Any) -> Any:
                return state[sensing_action] + self.width * stream.normal((1,))

        found = [check(Wider(), seed=FIRST_SEED + n) for n in range(10)]
        named = sum(
            any(each.check == "likelihood" for each in one if each.severity == "error")
            for one in found
        )
        print(f"width: noise {factor} times as wide is found in {named} of 10")


def method(pairs: tuple[int, ...] = (10, 20, 50, 100), resampled: int = 400) -> None:
    """Count how often random sensing is called worse than random sensing in other trials."""
    planner = Planner(Gaussian(), method="random")
    results = [run_trial(planner, 1, trial, max_steps=200) for trial in range(400)]
    costs = np.array([float(each.steps if each.success else 200) for each in results])
    generator = np.random.default_rng(0)
    for count in pairs:
        worse = 0
        for _ in range(resampled):
            own, other = generator.choice(costs, (2, count))
            worse += mean_difference(own - other)[1][0] > 0.0
        print(f"method: equal ones are called worse in {worse / resampled:.1%} of {count} pairs")


if __name__ == "__main__":
    for part in sys.argv[1:] or ["wrong", "widths", "method", "right"]:
        globals()[part]()
