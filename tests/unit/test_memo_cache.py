"""A planner with a memo cache: the same states, each computed once."""

import numpy as np
import pytest

from holdfast.numerics.arrays import FloatArray
from holdfast.numerics.randomness import Stream
from holdfast.planning.planner import Planner, PlanningState, digest
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.robot import memo_cache
from holdfast.robot.memo_cache import MemoCache, MemoizingPlanner

SETTINGS = PlanningSettings(particle_filter=ParticleFilterSettings(num_particles=20))


class CountingProblem(PegInHole2D):
    """Counts how often it moves particles."""

    moves = 0

    def move(self, states: FloatArray, action: FloatArray, random: Stream) -> FloatArray:
        type(self).moves += 1
        return super().move(states, action, random)


@pytest.fixture(autouse=True)
def _count() -> None:
    CountingProblem.moves = 0


def walked(planner: Planner, trial: int = 0) -> list[PlanningState]:
    """Return the states of a sensing step and the task actions after it."""
    states = [planner.init(5, trial)]
    states.append(planner.observe(states[-1], 0, [0.3])[0])
    for _ in range(8):
        states.append(planner.advance(states[-1], planner.choose_task_action(states[-1])[0]))
    return states


def test_two_planners_with_one_cache_compute_each_state_once() -> None:
    kept = MemoCache()
    one, other = (MemoizingPlanner(CountingProblem(), SETTINGS, kept) for _ in range(2))
    first, second = walked(one), walked(other)
    assert all(a is b for a, b in zip(first, second, strict=True))
    assert CountingProblem.moves == 8
    actions, ahead = other.plan_until_sensing(first[1], 8)
    assert ahead is first[-1]
    assert len(actions) == 8
    assert CountingProblem.moves == 8


def test_its_states_are_those_of_a_planner_without_a_cache() -> None:
    planner = MemoizingPlanner(PegInHole2D(), SETTINGS, MemoCache())
    for _ in range(2):
        for state, plain in zip(
            walked(planner), walked(Planner(PegInHole2D(), SETTINGS)), strict=True
        ):
            assert planner.digest(state) == digest(plain)


def test_what_was_sensed_or_done_otherwise_leads_elsewhere() -> None:
    planner = MemoizingPlanner(PegInHole2D(), SETTINGS, MemoCache())
    state = planner.init(5, 0)
    assert planner.init(5, 1) is not state
    seen = planner.observe(state, 0, [0.3])[0]
    assert planner.observe(state, 0, [0.4])[0] is not seen
    assert planner.observe(state, 1, [0.3])[0] is not seen
    moved = planner.advance(seen, np.array([0.1, 0.0, 0.0]))
    assert planner.advance(seen, np.array([-0.1, 0.0, 0.0])) is not moved


def test_it_keeps_no_more_than_some_hundred_results_and_no_large_states(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept = MemoCache()
    planner = MemoizingPlanner(CountingProblem(), SETTINGS, kept)
    monkeypatch.setattr(memo_cache, "_MAX_RESULTS", 10)
    for trial in range(5):
        walked(planner, trial)
    assert len(kept._results) == len(kept._keys) == 10
    monkeypatch.setattr(memo_cache, "_LARGE_BYTES", 10)
    kept = MemoCache()
    planner = MemoizingPlanner(CountingProblem(), SETTINGS, kept)
    state = planner.init(5, 0)
    assert planner.init(5, 0) is not state
    assert planner.digest(state) == digest(planner.init(5, 0))
    assert not kept._results
