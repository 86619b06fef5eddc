"""How long it takes to choose a sensing action, on beliefs from the middle of a task.

The time of a decision depends on the belief: few particles of a wide one survive a hypothetical
observation, nearly all of a narrow one. So trials are run once with a moderate number of particles,
and their history of observations and actions is replayed to beliefs of other sizes. All of these
approximate the same posteriors; only their size differs.

Numbers of threads are timed in turns, so that other load on the machine meets all of them. The time
that a thread waited for a core is subtracted; the system counts it. A second thread that comes late
cannot be corrected for, so the gain of threads is read from the fastest repetitions.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd

from holdfast.errors import InvalidValueError
from holdfast.planning.inputs import ActingRecord, Record, Sensed, encode_floats
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.settings import (
    ActiveSensingSettings,
    ParticleFilterSettings,
    PlanningSettings,
    SelectorSettings,
)
from holdfast.planning.tracking import Trial
from holdfast.problems.problem import Problem
from holdfast.robot.trial import SensingStep, TaskStep, TrialObserver, run_trial
from studies.cost_model import parallel_share
from studies.trial_batches import problem_of

_HISTORY_PARTICLES = 500
"""Particles of the trials whose history is replayed."""

_MAX_STEPS = 200
_MOST_REPETITIONS = 15
_PLACES = (0.25, 0.5, 0.75)
"""In a trial's sensing decisions, from which its belief is taken: one of each trial, so that all
beliefs are independent."""

_SCHEDULING = Path("/proc/thread-self/schedstat")

_FEWER = 2.0 / 3.0
"""Share of the beliefs where there is no time for all: six of nine, enough for an interval."""


class Measurement(msgspec.Struct, frozen=True, kw_only=True):
    """What is timed: decisions of one kind, over numbers of particles."""

    problem: str
    num_sensing_actions: int  # J: the first so many of the problem's
    estimator: str = "nearest_neighbor"
    num_observation_samples: int = 10  # M
    horizon: int = 1
    particles: tuple[int, ...] = (100, 300, 1000)  # rising
    threads: tuple[int, ...] = (1, 2)  # 1 and at least one more
    num_trials: int = 9  # from each comes one belief
    seed: int = 0
    repeat_s: float = 0.5  # for about so long decisions of one number of particles are repeated
    least_repetitions: int = 3  # of each decision, however long it takes
    limit_s: float = 8.0
    """If these take longer, fewer beliefs are taken; if that does not help, this number of
    particles is left out, and all above it."""


class _Kept(TrialObserver):
    def __init__(self) -> None:
        self.records: list[Record] = []

    def sensed(self, step: SensingStep) -> None:
        self.records.append(step.sensed)

    def acted(self, step: TaskStep) -> None:
        acting = ActingRecord(step.state.step, encode_floats(step.executed))
        self.records += [acting, step.moved]


def measure_sensing(**measurement: Any) -> pd.DataFrame:
    """Time decisions; the function of tasks of the kind ``sensing_times``.

    It gets the fields of :class:`Measurement`.

    Returns
    -------
    DataFrame
        A row for each belief and number of threads. ``median_ms`` and ``fastest_ms`` are those of
        so many ``repetitions``, less what they waited for cores that others had. ``share`` is the
        part that is divided among threads, of the fastest ones: whatever else the machine does
        delays several threads sooner than one.
    """
    wanted = msgspec.convert(measurement, Measurement)
    problem = problem_of(wanted.problem)
    problem.sensing_actions = problem.sensing_actions[: wanted.num_sensing_actions]
    histories = [
        history_of(problem, _settings(wanted, _HISTORY_PARTICLES, 0), wanted.seed, trial)
        for trial in range(wanted.num_trials)
    ]
    tables: list[pd.DataFrame] = []
    fewest_s = 0.0
    for last, particles in zip((1, *wanted.particles), wanted.particles, strict=False):
        # A decision takes at least as much longer as there are more particles.
        if wanted.least_repetitions * fewest_s * particles / last > wanted.limit_s:
            break
        deciding = _Deciding(problem, wanted, particles)
        states = [
            state_in(problem, deciding.settings[1], wanted.seed, trial, history)
            for trial, history in enumerate(histories)
        ]
        states = deciding.few_enough(states)
        if not states:
            break
        timed, round_s = deciding.timed(states)
        tables.append(timed.assign(particles=particles))
        fewest_s = _FEWER * round_s
    if not tables:
        raise InvalidValueError(
            f"particles {wanted.particles[0]}: a round of decisions takes longer than limit_s "
            f"{wanted.limit_s:g}"
        )
    return pd.concat(tables, ignore_index=True)


def history_of(problem: Problem, settings: PlanningSettings, seed: int, trial: int) -> list[Record]:
    """Run a trial; return its observations and moves, in order."""
    kept = _Kept()
    run_trial(Planner(problem, settings), seed, trial, max_steps=_MAX_STEPS, observer=kept)
    return kept.records


def state_in(
    problem: Problem,
    settings: PlanningSettings,
    seed: int,
    trial: int,
    history: Sequence[Record],
) -> PlanningState:
    """Replay a trial's history to another belief; return its state before one sensing decision.

    By the trial's number it is a quarter, half or three quarters through: neither the first belief,
    which nothing has narrowed yet, nor the last.
    """
    sensed = [at for at, record in enumerate(history) if isinstance(record, Sensed)]
    left = int(_PLACES[trial % len(_PLACES)] * len(sensed))
    track = Trial(Planner(problem, settings), seed, trial)
    for record in history[: sensed[left]]:
        track.take(record)
    return track.state


def _settings(wanted: Measurement, particles: int, threads: int) -> PlanningSettings:
    return PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=particles),
        active_sensing=ActiveSensingSettings(
            num_observation_samples=wanted.num_observation_samples,
            horizon=wanted.horizon,
            num_cores=threads,
        ),
        selector=msgspec.convert(
            {"method": "action_entropy", "estimator": wanted.estimator}, SelectorSettings
        ),
    )


class _Deciding:
    """Decisions with one number of particles, on each number of threads."""

    def __init__(self, problem: Problem, wanted: Measurement, particles: int) -> None:
        self._problem = problem
        self._wanted = wanted
        self.settings = {
            threads: _settings(wanted, particles, threads) for threads in wanted.threads
        }

    def few_enough(self, states: list[PlanningState]) -> list[PlanningState]:
        """Return as many of the beliefs as there is time for: all, fewer, or none."""
        middle = states[len(states) // 2]
        one_s = sum(self._decision_s(threads, middle) for threads in self.settings)
        for some in (states, states[: round(_FEWER * len(states))]):
            if self._wanted.least_repetitions * one_s * len(some) <= self._wanted.limit_s:
                return some
        return []

    def timed(self, states: Sequence[PlanningState]) -> tuple[pd.DataFrame, float]:
        """Return the rows of some beliefs, and what a round of all of them takes in seconds."""
        taken: list[dict[int, list[float]]] = [{p: [] for p in self.settings} for _ in states]
        round_s = 0.0
        repetitions = 1
        repetition = 0
        collects = gc.isenabled()
        gc.disable()
        try:
            while repetition < repetitions:
                order = list(self.settings)[:: 1 if repetition % 2 == 0 else -1]
                for state, times in zip(states, taken, strict=True):
                    for threads in order:
                        times[threads].append(self._decision_s(threads, state))
                repetition += 1
                if repetition == 1:
                    round_s = sum(seconds for times in taken for (seconds,) in times.values())
                    affordable = min(int(self._wanted.repeat_s / round_s), _MOST_REPETITIONS)
                    repetitions = max(affordable, self._wanted.least_repetitions)
        finally:
            if collects:
                gc.enable()
        rows = [
            {
                "belief": belief,
                "step": state.step,
                "threads": threads,
                "median_ms": 1e3 * float(np.median(seconds)),
                "fastest_ms": 1e3 * min(seconds),
                "repetitions": repetitions,
                "share": parallel_share({each: min(found) for each, found in times.items()}),
            }
            for belief, (state, times) in enumerate(zip(states, taken, strict=True))
            for threads, seconds in times.items()
        ]
        return pd.DataFrame(rows), round_s

    def _decision_s(self, threads: int, state: PlanningState) -> float:
        """Return what a decision takes, less what its thread waited for a core others had."""
        delayed_ns = _delayed_ns()
        start = time.perf_counter()
        Planner(self._problem, self.settings[threads]).choose_sensing_action(state)
        elapsed_s = time.perf_counter() - start
        return max(elapsed_s - 1e-9 * (_delayed_ns() - delayed_ns), 1e-9)


def _delayed_ns() -> int:
    """Return how long this thread could have run but had no core (Linux; 0 elsewhere)."""
    try:
        return int(_SCHEDULING.read_bytes().split()[1])
    except (OSError, IndexError, ValueError):
        return 0
