"""What it costs to look at the actions still to come: path entropy beside action entropy."""

from __future__ import annotations

import functools
from collections.abc import Callable

import msgspec
import numpy as np

from benchmarks.beliefs import recorded_trial, settings_for
from benchmarks.common import THREADS, Context, decide, evenly_spread, threads_in_words
from benchmarks.measure import alternate, ratio_of_turns
from benchmarks.report import Bar, Result, Table, milliseconds, paragraph
from holdfast.planning.policy_path import path_points
from holdfast.planning.settings import PlanningSettings, path_steps
from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.multitier_peg_in_hole_2d import MultitierPegInHole2D
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.peg_in_hole_3d import PegInHole3D

__all__ = ["path_entropy"]

# What was asked for: four offsets, a whole decision.
RATIO_BAR = 3.0
SIZES = (100, 300, 1000)

_PROBLEMS = (PegInHole2D, MultitierPegInHole2D, CapsuleRobot, PegInHole3D)


def path_entropy(context: Context) -> Result:
    """Time decisions by both in turns, on beliefs of a trial; and the ways alone."""
    number, turns = (3, 3) if context.quick else (10, 12)
    rows, bars = [], []
    cases = [
        (make, num_particles, threads)
        for make in _PROBLEMS
        for num_particles in SIZES
        for threads in THREADS
    ]
    ratios: dict[tuple[int, int], list[float]] = {}
    for done, (make, num_particles, threads) in enumerate(cases):
        problem = make()
        settings = settings_for(num_particles, threads)
        along = _along_the_path(settings)
        offsets = path_steps(along)
        states = evenly_spread(recorded_trial(problem, settings)[0], number)
        seconds: dict[str, list[float]] = {}
        found = []
        for state in states:
            follow = functools.partial(
                problem.world.follow,
                problem._path_policy.own,
                state.belief.states,
                state.stage,
                offsets,
                threads=threads,
            )
            calls: dict[str, Callable[[], object]] = {
                "action": decide(problem, settings, state),
                "path": decide(problem, along, state),
                "points": functools.partial(
                    path_points, problem, along, state.belief.states, state.stage
                ),
                "contact": functools.partial(follow, tolerance=problem._collision_tolerance),
                "free": functools.partial(follow, tolerance=0.0),
            }
            timed = alternate(calls, turns, 3)
            for name, times in timed.items():
                seconds.setdefault(name, []).append(float(np.median(times)))
            found.append(ratio_of_turns(timed["path"], timed["action"]))
        rows.append(
            [
                problem.name,
                str(num_particles),
                str(threads),
                *[milliseconds(float(np.median(times))) for times in seconds.values()],
                f"{np.median(found):.2f}",
                f"{min(found):.2f} to {max(found):.2f}",
            ]
        )
        ratios.setdefault((num_particles, threads), []).append(float(np.median(found)))
        context.progress((done + 1) / len(cases))
    for (num_particles, threads), of_problems in ratios.items():
        bars.append(
            Bar(
                f"path over action entropy, {num_particles} particles, "
                f"{threads_in_words(threads)}, median problem",
                float(np.median(of_problems)),
                RATIO_BAR,
                "times",
            )
        )
    return Result(
        [
            paragraph(
                f"""Whole decisions with `selector.method` path_entropy (offsets {offsets}) and
                action_entropy, in turns on the same beliefs of a trial. In milliseconds, medians
                over {number} beliefs: a decision by either; the points of all offsets; and the ways
                alone, stopped at contact (as they are) and not stopped."""
            ),
            Table(
                (
                    "problem",
                    "particles",
                    "threads",
                    "action entropy",
                    "path entropy",
                    "points",
                    "ways",
                    "ways without contact",
                    "ratio",
                    "range",
                ),
                rows,
            ),
        ],
        bars,
    )


def _along_the_path(settings: PlanningSettings) -> PlanningSettings:
    selector = msgspec.structs.replace(settings.selector, method="path_entropy")
    return msgspec.structs.replace(settings, selector=selector)
