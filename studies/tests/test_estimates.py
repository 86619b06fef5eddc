"""The study of estimates: its candidates, and what its report says of trials."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest

from holdfast.numerics.randomness import Purpose, stream
from holdfast.planning.belief import Belief
from studies.cases import CASES
from studies.errors import TaskError
from studies.estimate_candidates import CANDIDATES, run_estimates
from studies.estimates import Estimates, Variant, variants
from studies.study import CLAIM, Scale
from studies.tasks import run_task
from studies.trial_batches import problem_of, run_trials_of

PARTICLES = ("most_likely", "nearest_particle", "medoid", "densest_particle")


def belief_of(name: str, count: int = 80) -> tuple[Any, Belief]:
    problem: Any = problem_of(name)
    own = stream(3, 0, 0, Purpose.INITIAL_BELIEF)
    weights = own.substream(9).uniform(count) + 0.1
    return problem, Belief.weighted(problem.initial_states(own, count), weights)


@pytest.mark.parametrize("candidate", CANDIDATES)
@pytest.mark.parametrize("name", ["peg_in_hole_2d", "capsule_robot", "studies.westward:Westward"])
def test_each_candidate_estimates_a_state(candidate: str, name: str) -> None:
    problem, belief = belief_of(name)
    found = CANDIDATES[candidate](problem, belief, 0)
    assert found.shape == (problem.state_size,)
    assert np.isfinite(found).all()
    if candidate in PARTICLES or candidate.startswith("action"):
        assert (belief.states == found).all(axis=1).any()


def test_candidates_find_what_they_are_named_after() -> None:
    """Of a line: a heavy heap about 0, a light one about 10, and one particle between them."""
    problem: Any = problem_of("studies.corridor:Corridor")
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


def test_its_tasks_run() -> None:
    study = Estimates()
    assert {case.name for case in CASES} > {"peg in hole", "light and dark"}
    first = study.tasks(Scale(quick=True))[0]
    assert len(run_task(first)) == 2
