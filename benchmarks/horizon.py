"""Steps ahead: all hypothetical beliefs at once, against one after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

from benchmarks.beliefs import recorded_trial, settings_for
from benchmarks.common import THREADS, Context, decide, evenly_spread
from benchmarks.measure import alternate, ratio_of_turns
from benchmarks.report import Result, Table, milliseconds, paragraph
from holdfast import _kernel
from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Stream
from holdfast.planning import sensing
from holdfast.planning.belief import Belief, estimate
from holdfast.planning.estimators import KernelEstimator, scaled
from holdfast.planning.settings import PlanningSettings
from holdfast.problems import checked
from holdfast.problems.problem import Problem
from studies.cases import CASES
from studies.trial_batches import problem_of

__all__ = ["horizon", "one_by_one"]


def one_by_one(
    problem: Problem,
    settings: PlanningSettings,
    states_now: FloatArray,
    weights: FloatArray,
    stage: int,
    hypotheses: Stream,
    estimator: KernelEstimator,
    points_of: Callable[[FloatArray, int], FloatArray],
) -> FloatArray:
    """Return what ``holdfast.planning.sensing._later_entropies`` returns."""
    horizon, discount = settings.active_sensing.horizon, settings.active_sensing.discount
    actions, samples, _ = weights.shape
    motion = hypotheses.substream(2)
    later = np.zeros((actions, samples))
    for j in range(actions):
        for i in range(samples):
            states, own_weights, own_stage = states_now, weights[j, i].copy(), stage
            factor = 1.0
            for step in range(1, horizon):
                belief = Belief(states, own_weights)
                estimated = estimate(belief, settings.particle_filter.estimate)
                own_stage = checked.next_stage(problem, estimated, own_stage)
                action = problem.limit_action(problem.policy(estimated, own_stage))
                states = problem.move(states, action, motion.substream(i).substream(step))
                factor *= discount
                points = points_of(states, own_stage)
                found, *_ = _kernel.entropies(
                    scaled(points, estimator),
                    own_weights.reshape(1, -1),
                    False,
                    *estimator.parameters,
                    1,
                    (1.0,),
                    estimator.prior,
                    True,
                )
                later[j, i] += factor * found[0]
    return later


@contextmanager
def _without_batches() -> Iterator[None]:
    together = sensing._later_entropies
    sensing._later_entropies = one_by_one
    try:
        yield
    finally:
        sensing._later_entropies = together


def horizon(context: Context) -> Result:
    """Time a decision with a horizon of 3, both ways in turns."""
    number, turns = (2, 3) if context.quick else (8, 10)
    names = ("peg in hole", "three plates", "light and dark", "busy room")
    cases = [case for case in CASES if case.name in names]
    rows = []
    for done, case in enumerate(cases):
        problem = problem_of(case.problem, case.model)
        for num_particles in (100, 500):
            near = settings_for(num_particles, 1)
            states = evenly_spread(recorded_trial(problem, near)[0], number)
            row = [case.name, str(num_particles)]
            for threads in THREADS:
                settings = settings_for(num_particles, threads, horizon=3)
                slow, fast, ratios = [], [], []
                for state in states:
                    decided = decide(problem, settings, state)

                    def alone(decided: Callable[[], object] = decided) -> object:
                        with _without_batches():
                            return decided()

                    times = alternate({"alone": alone, "together": decided}, turns)
                    slow.append(float(np.median(times["alone"])))
                    fast.append(float(np.median(times["together"])))
                    ratios.append(ratio_of_turns(times["alone"], times["together"]))
                row += [milliseconds(float(np.median(each))) for each in (slow, fast)]
                row.append(f"{float(np.median(ratios)):.2f}")
            rows.append(row)
        context.progress((done + 1) / len(cases))
    header = ["problem", "particles"]
    for threads in THREADS:
        header += [f"one by one, {threads} threads", "at once", "times as fast"]
    return Result(
        [
            paragraph(
                f"""A decision with `horizon: 3`, J sensing actions and M = 10, in milliseconds: the
                median over {number} beliefs of a trial. One by one is how it was computed before;
                its entropies have one thread, too. Light and dark has no
                `move_each`, so its beliefs are moved one after the other."""
            ),
            Table(header, rows),
        ]
    )
