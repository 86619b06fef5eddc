"""A pool of processes, as a user of Python makes one, goes on with trials."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import pytest

import holdfast as hf
from holdfast.errors import MessageError
from holdfast.problems.registry import BUILT_IN

BEFORE, AFTER = 10, 20


def go_on(
    planner: hf.Planner, world: hf.SimulatedEnvironment, state: hf.PlanningState, steps: int
) -> tuple[hf.SimulatedEnvironment, hf.PlanningState, list[bytes]]:
    """Return world and state after so many steps, and the digests on the way."""
    digests = []
    for _ in range(steps):
        if planner.needs_sensing(state):
            action, _ = planner.choose_sensing_action(state)
            state, _ = planner.observe(state, action, world.perform_sensing(action))
        task_action, _ = planner.choose_task_action(state)
        world.perform(task_action)
        state = planner.advance(state, task_action)
        digests.append(planner.digest(state))
    return world, state, digests


def refuse(code: str) -> None:
    """Raise an error whose constructor takes two arguments."""
    raise MessageError(code, "no message")


@pytest.fixture(scope="module")
def pool() -> Iterator[ProcessPoolExecutor]:
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as made:
        yield made


@pytest.mark.parametrize("name", BUILT_IN)
def test_a_trial_goes_on_in_another_process(name: str, pool: ProcessPoolExecutor) -> None:
    planner = hf.Planner(hf.make(name), particles=30)
    world, state = hf.SimulatedEnvironment(planner.problem, 3), planner.init(3)
    world, state, _ = go_on(planner, world, state, BEFORE)
    there, reached, digests = pool.submit(go_on, planner, world, state, AFTER).result()
    here, own, expected = go_on(planner, world, state, AFTER)
    assert digests == expected
    assert there.state.tolist() == here.state.tolist()
    assert planner.digest(reached) == planner.digest(own)
    # Back here it is a belief that nobody changes, and a world that goes on.
    assert not reached.belief.weights.flags.writeable
    assert go_on(planner, there, reached, 3)[2] == go_on(planner, here, own, 3)[2]


def test_trials_with_a_configuration(pool: ProcessPoolExecutor) -> None:
    planner = hf.Planner(hf.make("peg_in_hole_2d"), particles=30)
    found = pool.map(hf.run_trial, [planner] * 2, [7, 8])
    assert [each.digest for each in found] == [
        hf.run_trial(planner, seed).digest for seed in (7, 8)
    ]


def test_errors_come_home(pool: ProcessPoolExecutor) -> None:
    with pytest.raises(MessageError, match="no message") as caught:
        pool.submit(refuse, "malformed").result()
    assert caught.value.code == "malformed"
