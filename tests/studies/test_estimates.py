"""The study of estimates: its candidates, and what its report says of trials."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pandas as pd
import pytest

from holdfast.lab.errors import TaskError
from holdfast.lab.studies.cases import CASES
from holdfast.lab.studies.estimate_candidates import CANDIDATES, run_estimates
from holdfast.lab.studies.estimates import Estimates, Variant, variants
from holdfast.lab.studies.study import CHOICE, CLAIM, TRIALS, Scale
from holdfast.lab.studies.tasks import run_task
from holdfast.lab.studies.trial_batches import problem_of, run_trials_of
from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import Belief

PARTICLES = ("most_likely", "nearest_particle", "medoid", "densest_particle")


def belief_of(name: str, count: int = 80) -> tuple[Any, Belief]:
    problem: Any = problem_of(name)
    own = stream(3, 0, 0, Purpose.INITIAL_BELIEF)
    weights = own.substream(9).uniform(count) + 0.1
    return problem, Belief.weighted(problem.initial_states(own, count), weights)


@pytest.mark.parametrize("candidate", CANDIDATES)
@pytest.mark.parametrize(
    "name", ["peg_in_hole_2d", "capsule_robot", "holdfast.lab.studies.westward:Westward"]
)
def test_each_candidate_estimates_a_state(candidate: str, name: str) -> None:
    problem, belief = belief_of(name)
    found = CANDIDATES[candidate](problem, belief, 0)
    assert found.shape == (problem.state_size,)
    assert np.isfinite(found).all()
    if candidate in PARTICLES or candidate.startswith("action"):
        assert (belief.states == found).all(axis=1).any()


def test_candidates_find_what_they_are_named_after() -> None:
    """Of a line: a heavy heap about 0, a light one about 10, and one particle between them."""
    problem: Any = problem_of("holdfast.lab.studies.corridor:Corridor")
    heap = np.linspace(-0.2, 0.2, 41)
    states = np.concatenate([heap + 2.0, [6.0], heap[:21] + 10.0])[:, np.newaxis]
    belief = Belief.uniform(states)
    found = {name: float(own(problem, belief, 0)[0]) for name, own in CANDIDATES.items()}
    assert found["nearest_particle"] == 6.0
    assert found["mean"] == pytest.approx(states.mean())
    for name in ("medoid", "densest_particle", "heaviest_mode", "action_vote", "action_medoid"):
        assert found[name] < 3.0, name


def test_the_mean_decides_as_the_planner_does() -> None:
    cell = ("peg in hole", Variant())
    series = msgspec.to_builtins(Estimates().series(cell, CLAIM, Scale(quick=True), 2))
    series |= {"first_trial": 0, "num_trials": 2}
    candidate = run_estimates(**series)
    assert series.pop("candidate") == "mean"
    assert candidate["digest"].tolist() == run_trials_of(**series)["digest"].tolist()
    with pytest.raises(TaskError, match="candidate 'median': there are mean, "):
        run_estimates(candidate="median", **series)


def test_all_candidates_are_tried() -> None:
    assert {each.estimate for each in variants()} == set(CANDIDATES)
    assert variants()[0] == Variant()


def test_the_report_of_made_up_trials() -> None:
    """With the heaviest mode each trial takes half the steps, and one in ten more succeeds."""
    study = Estimates()
    rows = []
    for purpose in (CHOICE, CLAIM):
        cells = study.judged_cells if purpose == CLAIM else study.cells
        for cell in cells(Scale()):
            for trial in range(20):
                better = cell[1].estimate == "heaviest_mode"
                steps = 50 + trial if better else 2 * (50 + trial)
                success = better or trial % 10 > 0
                names = dict(zip(study.columns, study.names(cell), strict=True))
                rows.append(
                    {"purpose": purpose, **names, "trial": trial, "success": success}
                    | {"steps": steps, "reward": 0.0, "sensing_decisions": 5, "step_limit": 500}
                    | {"steps_to_goal": float(steps), "median_sensing_ms": 1.0}
                )
    report = study.report_of({TRIALS: pd.DataFrame(rows)})
    together = report.summary["together"].set_index(["estimate", "resampling"])
    assert together.loc[("heaviest_mode", 1.0), "steps_ratio"] == pytest.approx(0.5)
    assert together.loc[("heaviest_mode", 1.0), "success_gain"] == pytest.approx(0.1)
    assert together.loc[("mean", 0.5), "steps_ratio"] == pytest.approx(1.0)
    assert len(report.summary["choosing_together"]) == len(variants()) - 1
    assert len(report.numbers) == 2 * len(together)


def test_its_tasks_run() -> None:
    study = Estimates()
    assert {case.name for case in CASES} > {"peg in hole", "light and dark"}
    first = study.tasks(Scale(quick=True))[0]
    assert len(run_task(first)) == 2
