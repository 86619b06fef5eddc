"""What many particles, samples and sensing actions cost."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from benchmarks.beliefs import (
    SEED,
    concentrated_state,
    recorded_trial,
    settings_for,
    with_sensing,
)
from benchmarks.common import THREADS, Context, child, decide, threads_in_words
from benchmarks.measure import alternate, fitted_exponent
from benchmarks.report import Bar, Result, Table, milliseconds, paragraph
from holdfast.planning.planner import Planner, PlanningState
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.peg_in_hole_3d import PegInHole3D

__all__ = ["growth", "large"]

# What was asked for.
LARGE_BAR_S = 1.0
LARGE_BAR_GB = 1.0


def large(context: Context) -> Result:
    """A hundred thousand particles, in processes of their own."""
    num_particles = 100_000
    beliefs: dict[str, dict[str, Any]] = {
        "initial belief": {"deviation": None},
        "deviation 0.3": {"deviation": 0.3},
        "deviation 0.1": {"deviation": 0.1},
        "deviation 0.05": {"deviation": 0.05},
        "deviation 0.03": {"deviation": 0.03},
        "heavy tails, 0.05": {"deviation": 0.05, "heavy_tails": True},
        "in space, 0.3": {"deviation": 0.3, "in_space": True},
        "in space, 0.01": {"deviation": 0.01, "in_space": True},
        "path entropy, 0.03": {"deviation": 0.03, "default": True},
        "path entropy in space, heavy tails, 0.05": {
            "deviation": 0.05,
            "in_space": True,
            "heavy_tails": True,
            "default": True,
        },
    }
    processes = 1 if context.quick else 3
    seconds: dict[str, list[float]] = {label: [] for label in beliefs}
    peaks = dict.fromkeys(beliefs, 0)
    visits = dict.fromkeys(beliefs, 0)
    before = 0
    for process in range(processes):
        for at, (label, belief) in enumerate(beliefs.items()):
            found = child(
                {
                    "kind": "large",
                    "num_particles": num_particles,
                    **belief,
                    "threads": THREADS[-1],
                    "turns": 1 if context.quick else 2,
                }
            )
            seconds[label] += found["seconds"]
            peaks[label] = max(peaks[label], found["peak_bytes"])
            before = max(before, found["peak_before_bytes"])
            visits[label] = found["visits"]
            context.progress((process + (at + 1) / len(beliefs)) / processes)
    rows = [
        [
            label,
            f"{np.median(seconds[label]):.3g}",
            f"{min(seconds[label]):.3g}",
            f"{max(seconds[label]):.3g}",
            f"{visits[label] / 1e6:.0f}",
            f"{peaks[label] / 1e6:.0f}",
        ]
        for label in beliefs
    ]
    bars = [
        Bar(f"100,000 particles, {label}", float(np.median(seconds[label])), LARGE_BAR_S, "s")
        for label in beliefs
    ]
    bars.append(
        Bar("100,000 particles, peak memory", max(peaks.values()) / 1e9, LARGE_BAR_GB, "GB")
    )
    return Result(
        [
            paragraph(
                f"""M = 10, J = 3, {threads_in_words(THREADS[-1])}. Beside the initial belief,
                Gaussian ones around (0, 1, 0), the peg above the hole, with one standard deviation
                for all coordinates: the narrower, the more particles survive a hypothetical
                observation, and the more of them lie within the resolution (0.1) of each other.
                Heavy tails are those of Student's t distribution with two degrees of freedom, in
                space J = 6, and path entropy, the default, takes two sets of actions.
                Entropies are those of a sample (docs/decisions/many_entropies.md).
                Peak memory is that of the whole process, which before the decision has
                {before / 1e6:.0f} MB."""
            ),
            Table(
                (
                    "belief",
                    "median, s",
                    "minimum, s",
                    "maximum, s",
                    "visits, million",
                    "peak, MB",
                ),
                rows,
            ),
        ],
        bars,
    )


def growth(context: Context) -> Result:
    """How the cost grows with particles, samples and sensing actions."""
    budget_s = 0.1 if context.quick else 1.5
    threads = THREADS[-1]
    problem = PegInHole2D()

    def initial(num_particles: int) -> PlanningState:
        return Planner(problem, settings_for(num_particles, threads)).init(SEED, 0)

    columns: dict[str, Callable[[int], PlanningState]] = {
        "initial belief": initial,
        "deviation 0.3": lambda num_particles: concentrated_state(num_particles, 0.3),
        "deviation 0.1": lambda num_particles: concentrated_state(num_particles, 0.1),
    }
    sizes = [100, 300, 1_000, 3_000, 10_000, 30_000, 100_000]
    if context.quick:
        sizes = sizes[:-2]
    upper = sizes[-3:]
    rows = [[f"{size:,}"] for size in sizes]
    exponents, upper_exponents = ["exponent"], [f"exponent from {upper[0]:,} on"]
    for done, state_of in enumerate(columns.values()):
        seconds = _within_budget(
            {
                str(size): decide(problem, settings_for(size, threads), state_of(size))
                for size in sizes
            },
            budget_s,
        )
        for row, own in zip(rows, seconds, strict=True):
            row.append(milliseconds(own))
        exponents.append(f"{fitted_exponent(sizes, seconds):.2f}")
        upper_exponents.append(f"{fitted_exponent(upper, seconds[-3:]):.2f}")
        context.progress((done + 1) / 5)
    particles = Table(("particles", *columns), [*rows, exponents, upper_exponents])

    # A belief from the middle of a trial: neither spread over the map nor in the hole.
    settings = settings_for(500, threads)
    recorded, _ = recorded_trial(problem, settings)
    middle = recorded[len(recorded) // 2]
    numbers = [1, 2, 5, 10, 20, 50, 100]
    samples = _grown(
        "samples M",
        numbers,
        [
            decide(problem, with_sensing(settings, num_observation_samples=number), middle)
            for number in numbers
        ],
        budget_s,
    )
    context.progress(4 / 5)

    in_space, _ = recorded_trial(PegInHole3D(), settings)
    middle = in_space[len(in_space) // 2]
    numbers = [1, 2, 3, 4, 5, 6]
    calls = []
    for number in numbers:
        part = PegInHole3D()
        part.sensing_actions = part.sensing_actions[:number]
        calls.append(decide(part, settings, middle))
    actions = _grown("sensing actions J", numbers, calls, budget_s)
    context.progress(1.0)
    return Result(
        [
            paragraph(
                f"""Median times in milliseconds, {threads_in_words(threads)}, and the b of the
                fitted a n^b. With the particles (M = 10, J = 3; the belief initial, or Gaussian
                around (0, 1, 0)):"""
            ),
            particles,
            "With the hypothetical observations (500 particles, J = 3, middle of a trial):",
            samples,
            paragraph(
                """With the sensing actions (peg_in_hole_3d with the first J of its six, 500
                particles, M = 10, middle of a trial):"""
            ),
            actions,
        ]
    )


def _grown(
    what: str, numbers: list[int], calls: list[Callable[[], object]], budget_s: float
) -> Table:
    """Time calls that differ in one number."""
    named = {str(number): call for number, call in zip(numbers, calls, strict=True)}
    seconds = _within_budget(named, budget_s)
    rows = [[name, milliseconds(own)] for name, own in zip(named, seconds, strict=True)]
    return Table((what, "ms"), [*rows, ["exponent", f"{fitted_exponent(numbers, seconds):.2f}"]])


def _within_budget(
    calls: Mapping[str, Callable[[], object]], budget_s: float, turns: int = 3
) -> list[float]:
    """Return each call's median time, of as many repetitions as its share of time allows."""
    once = {name: float(np.median(times)) for name, times in alternate(calls, 1).items()}
    repetitions = {
        name: int(np.clip(budget_s / (turns * seconds), 1, 100)) for name, seconds in once.items()
    }
    timed = alternate(calls, turns, repetitions)
    return [float(np.median(timed[name])) for name in calls]
