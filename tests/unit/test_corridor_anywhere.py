"""The example of a corridor in which a robot may be anywhere: the mean of its belief deadlocks."""

from __future__ import annotations

from pathlib import Path

import pytest

from holdfast.config.loader import load
from holdfast.planning.planner import Planner
from holdfast.robot.trial import run_trial

EXAMPLE = Path(__file__).parents[2] / "examples" / "corridor_anywhere.yaml"
TRIALS = 20


@pytest.mark.parametrize(("estimate", "least", "most"), [("mean", 6, 16), (None, 17, 20)])
def test_the_heaviest_mode_gets_there(estimate: str | None, least: int, most: int) -> None:
    """docs/decisions/estimates.md has the rates; these are the first trials of one seed."""
    changes = {} if estimate is None else {"particle_filter.estimate": estimate}
    example = load(EXAMPLE, overrides=changes)
    planner = Planner(example.problem, example.planning)
    limit = example.simulator.max_steps
    successes = sum(run_trial(planner, 3, n, max_steps=limit).success for n in range(TRIALS))
    assert least <= successes <= most
