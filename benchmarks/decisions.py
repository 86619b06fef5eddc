"""The time of one sensing decision: alone, against its peers and under other conditions."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import msgspec
import numpy as np

from benchmarks import literal
from benchmarks.beliefs import default_settings, recorded_trial, settings_for
from benchmarks.common import (
    SIZES,
    THREADS,
    Context,
    child,
    decide,
    evenly_spread,
    threads_in_words,
)
from benchmarks.measure import alternate, ratio_of_turns
from benchmarks.report import Bar, Result, Table, milliseconds, paragraph
from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import PlanningSettings, SelectorSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import Problem

__all__ = [
    "busy_machine",
    "decision",
    "default_decision",
    "estimators",
    "floor",
    "instruction_sets",
    "ratio",
]


# What was asked for.
DECISION_BARS_MS = {100: 0.15, 500: 0.5}
RATIO_BAR = 100.0
FIRST_IMPLEMENTATION_MS = {100: 14.0, 500: 89.0}

EQUAL = 1e-9


def default_decision(context: Context) -> Result:
    """Time one decision by the default and by the published method, in turns."""
    problem = PegInHole2D()
    number, turns = (3, 3) if context.quick else (10, 20)
    rows = []
    cases = [(size, threads) for size in SIZES for threads in THREADS]
    for done, (num_particles, threads) in enumerate(cases):
        ways = {
            "default": default_settings(num_particles, threads),
            "published": settings_for(num_particles, threads),
        }
        states = evenly_spread(recorded_trial(problem, ways["default"])[0], number)
        medians: dict[str, list[float]] = {way: [] for way in ways}
        fastest: dict[str, list[float]] = {way: [] for way in ways}
        for state in states:
            calls = {way: decide(problem, settings, state) for way, settings in ways.items()}
            for way, times in alternate(calls, turns, 3).items():
                medians[way].append(float(np.median(times)))
                fastest[way].append(float(times.min()))
        shown = [
            value
            for way in ways
            for value in (
                float(np.median(medians[way])),
                max(medians[way]),
                float(np.median(fastest[way])),
            )
        ]
        rows.append([str(num_particles), str(threads), *map(milliseconds, shown)])
        context.progress((done + 1) / len(cases))
    return Result(
        [
            paragraph(
                f"""`Planner.choose_sensing_action`, peg_in_hole_2d, three sensing actions, in
                milliseconds: by the default (`path_entropy`, prior neighbours) and by the published
                method, whose times all following sections have (`action_entropy`, nearest
                neighbours). On each of {number} beliefs of a trial of the default both are called
                {3 * turns} times in turns; a belief's time is its median, and the fastest call
                tells what an undisturbed machine would need."""
            ),
            Table(
                (
                    "particles",
                    "threads",
                    *[
                        f"{way}, {what}"
                        for way in ("default", "published")
                        for what in ("median belief", "worst belief", "fastest")
                    ],
                ),
                rows,
            ),
        ]
    )


def decision(context: Context) -> Result:
    """Time one decision, again and again on each belief of a trial and once in place."""
    problem = PegInHole2D()
    turns, repetitions = (4, 5) if context.quick else (40, 5)
    trials = 2 if context.quick else 10
    repeated, in_place, bars = [], [], []
    for done, num_particles in enumerate(SIZES):
        settings = {threads: settings_for(num_particles, threads) for threads in THREADS}
        states, _ = recorded_trial(problem, settings[1])
        states = evenly_spread(states, 5) if context.quick else states
        medians: dict[int, list[float]] = {threads: [] for threads in THREADS}
        minima: dict[int, list[float]] = {threads: [] for threads in THREADS}
        pooled: dict[int, list[FloatArray]] = {threads: [] for threads in THREADS}
        for number, state in enumerate(states):
            calls = {str(threads): decide(problem, settings[threads], state) for threads in THREADS}
            for name, times in alternate(calls, turns, repetitions).items():
                medians[int(name)].append(float(np.median(times)))
                minima[int(name)].append(float(times.min()))
                pooled[int(name)].append(times.ravel())
            context.progress((done + 0.8 * (number + 1) / len(states)) / len(SIZES))
        own: dict[int, list[float]] = {threads: [] for threads in THREADS}
        for trial in range(trials):
            for threads in THREADS:
                own[threads] += recorded_trial(problem, settings[threads], trial)[1]
        context.progress((done + 1) / len(SIZES))

        for threads in THREADS:
            label = [str(num_particles), str(threads)]
            shown = [
                medians[threads][0],
                float(np.median(medians[threads])),
                max(medians[threads]),
                float(np.percentile(np.concatenate(pooled[threads]), 99)),
                float(np.median(minima[threads])),
                max(minima[threads]),
            ]
            repeated.append(label + [milliseconds(value) for value in shown])
            shown = [
                float(np.median(own[threads])),
                float(np.percentile(own[threads], 99)),
                min(own[threads]),
            ]
            label.append(str(len(own[threads])))
            in_place.append(label + [milliseconds(value) for value in shown])
        if num_particles in DECISION_BARS_MS:
            last = THREADS[-1]
            of_beliefs = {
                "median belief": float(np.median(medians[last])),
                "worst belief": max(medians[last]),
                "in place, median": float(np.median(own[last])),
            }
            bars += [
                Bar(
                    f"published method, {num_particles} particles, {threads_in_words(last)}, "
                    f"{what}",
                    value * 1e3,
                    DECISION_BARS_MS[num_particles],
                    "ms",
                )
                for what, value in of_beliefs.items()
            ]
    first = ", ".join(f"{ms:g} ms at {n} particles" for n, ms in FIRST_IMPLEMENTATION_MS.items())
    return Result(
        [
            paragraph(
                f"""`Planner.choose_sensing_action`, peg_in_hole_2d, `action_entropy` with nearest
                neighbours, J = 3, M = 10, k = 5, commanded actions, in milliseconds. The beliefs
                are those of all sensing steps of one trial. On each the call is repeated
                {turns * repetitions} times, the numbers of threads in turns; a belief's time is its
                median, the 99th percentile is that of all calls, and the fastest call of a belief
                tells what an undisturbed machine would need. The first C++ implementation took
                {first}, on another machine."""
            ),
            Table(
                (
                    "particles",
                    "threads",
                    "initial belief",
                    "median belief",
                    "worst belief",
                    "99 %",
                    "fastest, median belief",
                    "fastest, worst belief",
                ),
                repeated,
            ),
            paragraph(
                f"""The same call once, in place, between the other steps of {trials} trials: caches
                are cold and the second thread may be asleep."""
            ),
            Table(("particles", "threads", "decisions", "median", "99 %", "minimum"), in_place),
        ],
        bars,
    )


def ratio(context: Context) -> Result:
    """Compare with Algorithm 2 as it is written, in turns."""
    problem = PegInHole2D()
    sizes = (100, 500) if context.quick else SIZES
    number, turns = (3, 2) if context.quick else (8, 5)
    peers = {
        "literal": literal.literal_entropy,
        "same estimate": literal.nearest_neighbor_entropy,
        "tuned": literal.tuned_nearest_neighbor_entropy,
    }
    rows, bars = [], []
    for done, num_particles in enumerate(sizes):
        settings = {threads: settings_for(num_particles, threads) for threads in THREADS}
        states = evenly_spread(recorded_trial(problem, settings[1])[0], number)
        seconds: dict[str, list[float]] = {peer: [] for peer in peers}
        ratios: dict[tuple[str, int], list[float]] = {
            (peer, threads): [] for peer in peers for threads in THREADS
        }
        for at, state in enumerate(states):
            calls: dict[str, Callable[[], object]] = {}
            for peer, entropy in peers.items():
                if peer != "literal":
                    _require_equal(problem, settings[1], state, entropy)
                calls[peer] = functools.partial(
                    literal.choose_sensing_action, problem, settings[1], state, entropy
                )
            for threads in THREADS:
                calls[str(threads)] = decide(problem, settings[threads], state)
            timed = alternate(calls, turns, {name: 1 if name in peers else 10 for name in calls})
            for peer in peers:
                seconds[peer].append(float(np.median(timed[peer])))
                for threads in THREADS:
                    ratios[peer, threads].append(ratio_of_turns(timed[peer], timed[str(threads)]))
            context.progress((done + (at + 1) / len(states)) / len(sizes))
        for threads in THREADS:
            row = [str(num_particles), str(threads)]
            for peer in peers:
                own = ratios[peer, threads]
                row += [
                    milliseconds(float(np.median(seconds[peer]))),
                    f"{np.median(own):.0f}",
                    f"{min(own):.0f} to {max(own):.0f}",
                ]
            rows.append(row)
            if num_particles == 500:
                bars.append(
                    Bar(
                        f"literal over holdfast, 500 particles, {threads_in_words(threads)}",
                        float(np.median(ratios["literal", threads])),
                        RATIO_BAR,
                        "times",
                        at_least=True,
                    )
                )
    return Result(
        [
            paragraph(
                f"""The peer is `benchmarks/literal.py`: Algorithm 2 step by step with NumPy and
                SciPy's cKDTree, one posterior after the other, on one thread. "Literal" keeps
                every particle of non-zero weight in its trees, as the published algorithm does.
                Part of the gain over it is that holdfast leaves out particles of negligible
                weight; "same estimate" does that, too, and gives holdfast's entropies to
                {EQUAL:g} from the same random draws; "tuned" does so without Python's lists. A
                ratio is the time of the peer over that of holdfast, the median over
                turns within one run; given are its median and its range over {number} beliefs of a
                trial."""
            ),
            Table(
                (
                    "particles",
                    "threads",
                    *[title for peer in peers for title in (f"{peer}, ms", "ratio", "range")],
                ),
                rows,
            ),
        ],
        bars,
    )


def _require_equal(
    problem: Problem, settings: PlanningSettings, state: PlanningState, entropy: literal.Entropy
) -> None:
    """Refuse to compare the times of different work."""
    _, info = Planner(problem, settings).choose_sensing_action(state)
    _, entropies = literal.choose_sensing_action(problem, settings, state, entropy)
    if info.entropies is None or not (np.abs(info.entropies - entropies) <= EQUAL).all():
        raise RuntimeError(f"entropies {info.entropies} and, literally, {entropies}: not the same")


def floor(context: Context) -> Result:
    """Compare with the cost of the kernel's own inner operations."""
    problem = PegInHole2D()
    sizes = (100, 500) if context.quick else (*SIZES, 2000)
    number, turns = (3, 3) if context.quick else (12, 10)
    rows = []
    for done, num_particles in enumerate(sizes):
        settings = settings_for(num_particles, 1)
        found = []
        for state in evenly_spread(recorded_trial(problem, settings)[0], number):
            _, info = Planner(problem, settings).choose_sensing_action(state)
            call = decide(problem, settings, state)
            table = np.empty((turns, 3))
            for turn in range(turns):
                table[turn] = (
                    _kernel.measure_exp(num_particles, 50),
                    _kernel.measure_visit(num_particles, problem.action_size, 2),
                    np.median(alternate({"": call}, 1, 5)[""]),
                )
            exp_s, visit_s, own_s = table.T
            floor_s = info.likelihoods * exp_s + info.visits * visit_s
            found.append(
                [
                    float(np.median(exp_s)) * 1e9,
                    float(np.median(visit_s)) * 1e9,
                    float(info.likelihoods),
                    float(info.visits),
                    float(np.median(floor_s)) * 1e3,
                    float(np.median(own_s)) * 1e3,
                    float(np.median(own_s / floor_s)),
                ]
            )
        middle = np.median(found, axis=0)
        rows.append(
            [
                str(num_particles),
                f"{middle[0]:.2f}",
                f"{middle[1]:.2f}",
                f"{middle[2]:,.0f}",
                f"{middle[3]:,.0f}",
                f"{middle[4]:.3g}",
                f"{middle[5]:.3g}",
                f"{middle[6]:.1f}",
                f"{max(row[6] for row in found):.1f}",
            ]
        )
        context.progress((done + 1) / len(sizes))
    return Result(
        [
            paragraph(
                """One thread. The floor is (likelihoods evaluated x one vectorised exp) +
                (distances looked at x one visit of a neighbour). The two costs are measured in the
                same turns, on as many numbers as there are particles; a visit is that of the
                pair-by-pair loop, weighing included. Medians over beliefs of a trial. Where
                posteriors share a tree, one distance serves up to 32 of them, each with sums of
                its own, so a ratio of 1 is out of reach there. Above the floor are also the Python
                call, building the tree, logarithms, and drawing the observations."""
            ),
            Table(
                (
                    "particles",
                    "exp, ns",
                    "visit, ns",
                    "likelihoods",
                    "visits",
                    "floor, ms",
                    "decision, ms",
                    "ratio",
                    "worst",
                ),
                rows,
            ),
        ]
    )


def instruction_sets(context: Context) -> Result:
    """Time the same decisions with each instruction set that this processor has."""
    available = [name for name in ("baseline", "avx2", "avx512") if _runs_here(name)]
    sizes = [100, 500]
    turns = 1 if context.quick else 3
    request = {
        "kind": "decisions",
        "sizes": sizes,
        "threads": 1,
        "num_beliefs": 4 if context.quick else 10,
        "turns": 20 if context.quick else 100,
    }
    seconds: dict[str, list[list[float]]] = {name: [] for name in available}
    hashes = set()
    for turn in range(turns):
        for at, name in enumerate(available):
            found = child(request, HOLDFAST_SIMD=name)
            seconds[name].append([found["medians"][str(size)] for size in sizes])
            hashes.add(found["hash"])
            context.progress((turn + (at + 1) / len(available)) / turns)
    rows = []
    for name in available:
        times = np.median(seconds[name], axis=0)
        faster = np.median(np.array(seconds["baseline"]) / np.array(seconds[name]), axis=0)
        rows.append(
            [
                name,
                *[milliseconds(float(value)) for value in times],
                *[f"{value:.2f}" for value in faster],
            ]
        )
    same = (
        "All gave the same entropies, bit for bit."
        if len(hashes) == 1
        else "**They did not give the same entropies.**"
    )
    return Result(
        [
            paragraph(
                f"""One thread, median over beliefs of a trial, in milliseconds; a process for each
                set, in turns. {same}"""
            ),
            Table(
                (
                    "set",
                    *[f"{size} particles" for size in sizes],
                    *[f"times baseline, {size}" for size in sizes],
                ),
                rows,
            ),
        ]
    )


def _runs_here(name: str) -> bool:
    done = subprocess.run(
        [sys.executable, "-c", "from holdfast import _kernel; print(_kernel.simd())"],
        env={**os.environ, "HOLDFAST_SIMD": name},
        capture_output=True,
        text=True,
        check=False,
    )
    return done.returncode == 0 and done.stdout.strip() == name


@contextmanager
def _busy_processes(number: int) -> Iterator[None]:
    """Keep cores busy meanwhile, one per process."""
    code = "while True: pass"
    processes = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(number)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def busy_machine(context: Context) -> Result:
    """Time decisions while another program wants a core, as on a robot one does."""
    sizes = [100, 500]
    turns = 1 if context.quick else 3
    conditions = [(others, threads) for others in (0, 1, 2) for threads in THREADS]
    found: dict[tuple[int, int], list[list[float]]] = {condition: [] for condition in conditions}
    for turn in range(turns):
        for at, (others, threads) in enumerate(conditions):
            with _busy_processes(others):
                times = child(
                    {
                        "kind": "decisions",
                        "sizes": sizes,
                        "threads": threads,
                        "num_beliefs": 4,
                        "turns": 20 if context.quick else 100,
                    }
                )
            found[others, threads].append(
                [
                    times[quantity][str(size)]
                    for size in sizes
                    for quantity in ("medians", "percentiles_99")
                ]
            )
            context.progress((turn + (at + 1) / len(conditions)) / turns)
    rows = [
        [
            str(others),
            str(threads),
            *[milliseconds(float(value)) for value in np.median(times, axis=0)],
        ]
        for (others, threads), times in found.items()
    ]
    return Result(
        [
            paragraph(
                """Milliseconds, median over four beliefs of a trial, while so many other processes
                compute without pause. The 99th percentile shows the system's time slices, which
                no program that shares its cores escapes; the median should not."""
            ),
            Table(
                (
                    "busy processes",
                    "threads",
                    *[f"{size} particles, {what}" for size in sizes for what in ("median", "99 %")],
                ),
                rows,
            ),
        ]
    )


def estimators(context: Context) -> Result:
    """Compare nearest neighbour and Gaussian mixture, action and state entropy."""
    problem = PegInHole2D()
    number, turns = (3, 4) if context.quick else (10, 20)
    selectors = {
        f"{selector.method}, {selector.estimator}": selector
        for selector in (
            SelectorSettings(method="action_entropy", estimator="nearest_neighbor"),
            SelectorSettings(method="action_entropy", estimator="gaussian_mixture_upper"),
            SelectorSettings(method="action_entropy", estimator="gaussian_mixture_lower"),
            SelectorSettings(method="state_entropy", estimator="nearest_neighbor"),
            SelectorSettings(method="state_entropy", estimator="gaussian_mixture_upper"),
            SelectorSettings(method="state_entropy", estimator="gaussian_mixture_lower"),
        )
    }
    sizes = (100, 500)
    rows: dict[str, list[str]] = {label: [label] for label in selectors}
    for done, num_particles in enumerate(sizes):
        settings = settings_for(num_particles, THREADS[-1])
        states = evenly_spread(recorded_trial(problem, settings)[0], number)
        medians: dict[str, list[float]] = {label: [] for label in selectors}
        for at, state in enumerate(states):
            calls = {
                label: decide(problem, msgspec.structs.replace(settings, selector=selector), state)
                for label, selector in selectors.items()
            }
            for label, times in alternate(calls, turns, 3).items():
                medians[label].append(float(np.median(times)))
            context.progress((done + (at + 1) / len(states)) / len(sizes))
        for label, own in medians.items():
            rows[label] += [milliseconds(float(np.median(own))), milliseconds(max(own))]
    header = ["method, estimator"]
    for size in sizes:
        header += [f"{size} particles", "worst belief"]
    return Result(
        [
            paragraph(
                f"""{threads_in_words(THREADS[-1])}, median over {number} beliefs of a trial that
                nearest neighbours made, in milliseconds, all in turns."""
            ),
            Table(header, list(rows.values())),
        ]
    )
