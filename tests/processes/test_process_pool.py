"""A pool of processes, as a user of Python makes one, goes on with trials."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import pytest

import holdfast as hf
from holdfast.config.registry import BUILT_IN
from holdfast.errors import MessageError

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


def test_a_problem_of_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its class is found by its name, in the directory of the configuration."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "pool_peg", raising=False)
    for name, text in {
        "pool_peg.py": (
            "import pool_helper\nfrom holdfast.problems.peg_in_hole_2d import PegInHole2D\n"
            "class Peg(PegInHole2D):\n    resolution = 2.0 * pool_helper.HALF\n"
            "    def __init__(self): super().__init__(); self.resolution = Peg.resolution\n"
            "    @classmethod\n    def from_settings(cls, model, planner): return cls()\n"
        ),
        "pool_helper.py": "HALF = 0.05\n",
        "queue.py": "raise SystemExit\n",
        "peg.yaml": "problem: pool_peg:Peg\nparticle_filter: {num_particles: 30}\n",
    }.items():
        (tmp_path / name).write_text(text)
    configuration = hf.load_configuration(tmp_path / "peg.yaml")
    planner = hf.Planner(configuration.problem, configuration.planning)
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(hf.run_trial, planner, 3, max_steps=40).result()
    assert there.digest == hf.run_trial(planner, 3, max_steps=40).digest
