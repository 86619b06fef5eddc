"""NIST's task board by touch: how many contacts until the peg is in.

The trials are those of ``examples/taskboard``, with the same boards for all ways of choosing what
to touch, and beside them the standard search: presses along a spiral, from where the board should
be, or from where one touch of each kind says that the hole is. ::

    python -m benchmarks.taskboard --out docs/results/taskboard/trials.csv

runs 60 trials of each (an hour), goes on after Ctrl-C, and prints the table of
``docs/results/taskboard.md``. Seed 0 and touches of boards at known places chose the settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import trial_table
from holdfast.config.loader import load
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.outcome import Ending
from holdfast.planning.planner import Planner
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.trial import run_trial
from studies.statistics import mean_interval

FILE = Path(__file__).parents[1] / "examples" / "taskboard" / "taskboard.yaml"
NAMES = ("way",)
COLUMNS = ("outcome", "contacts", "touches", "robot_seconds")
METHODS = ("path_entropy", "random", "state_entropy")
TOUCHES_THEN_SPIRAL, SPIRAL = "one touch of each kind, then a spiral", "a spiral"
FEW_TRIALS = 12
"""Trials of the spiral alone, which uses all contacts that a trial may have."""

SPACING_M = 0.0005
"""Distance of turns, and of presses along them: a press finds a hole within 0.35 mm."""


def configuration_of(seed: int, **changes: Any) -> Any:
    return load(FILE, overrides={"simulator.seed": seed, "active_sensing.num_cores": 1, **changes})


def cells_of(seed: int) -> list[trial_table.Cell]:
    chosen = [
        trial_table.Cell(
            {"way": method}, partial(_plan, configuration_of(seed, **{"selector.method": method}))
        )
        for method in METHODS
    ]
    arguments = {**load(FILE).environment.arguments, "touches_first": 0}
    plain = configuration_of(seed, **{"environment.arguments": arguments})
    return [
        *chosen,
        trial_table.Cell({"way": TOUCHES_THEN_SPIRAL}, partial(_search, plain, True)),
        trial_table.Cell({"way": SPIRAL}, partial(_search, plain, False), FEW_TRIALS),
    ]


def _plan(configuration: Any, trial: int) -> Mapping[str, Any]:
    environment: Any = load_environment(configuration)(trial)
    simulator = configuration.simulator
    result = run_trial(
        Planner(configuration.problem, configuration.planning),
        simulator.seed,
        trial,
        max_steps=simulator.max_steps,
        environment=environment,
    )
    return _row(environment, result.outcome, result.sensing_decisions)


def _search(configuration: Any, touching: bool, trial: int) -> Mapping[str, Any]:
    """Press along a spiral, about what the planner's belief says after one touch of each kind."""
    environment: Any = load_environment(configuration)(trial)
    planner = Planner(configuration.problem, configuration.planning)
    state = planner.init(configuration.simulator.seed, trial)
    touches = range(len(configuration.problem.sensing_actions)) if touching else range(0)
    middle = configuration.problem.policy(np.zeros(3), 0)
    for touch in touches:
        state, _ = planner.observe(state, touch, environment.perform_sensing(touch))
        middle, _ = planner.choose_task_action(state)
        state = planner.advance(state, middle)
    angle = 0.0
    while not (done := environment.is_done()):
        environment.perform(middle + _on_spiral(angle))
        angle += 2.0 * np.pi / max(1.0, np.hypot(1.0, angle))
    assert isinstance(done, Ending)
    return _row(environment, done.outcome, len(touches))


def _on_spiral(angle: float) -> FloatArray:
    radius = SPACING_M * angle / (2.0 * np.pi)
    return radius * np.array([np.cos(angle), np.sin(angle)])


def _row(environment: Any, outcome: str, touches: int) -> Mapping[str, Any]:
    seconds = round(environment.seconds, 2)
    return dict(zip(COLUMNS, (outcome, environment.contacts, touches, seconds), strict=True))


def tables(path: Path) -> str:
    """Return the table in Markdown."""
    cells = {way: trials for (way,), trials in trial_table.read(path, NAMES).items()}
    default = METHODS[0]
    lines = [
        "| way | trials | success (%) | failed | contacts of successes | robot time (s) | "
        "successes per 100 contacts | success of the default less its own (points) | "
        "contacts of the default / its own |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for way, own in cells.items():
        succeeded = own["outcome"] == "succeeded"
        won = own[succeeded]
        words = [
            way,
            str(len(own)),
            trial_table.shown(trial_table.rate(own), 1),
            str(int((own["outcome"] == "failed").sum())),
            trial_table.shown(mean_interval(won["contacts"].to_numpy(float)), 1),
            trial_table.shown(mean_interval(won["robot_seconds"].to_numpy(float)), 0),
            f"{100.0 * succeeded.sum() / own['contacts'].sum():.1f}",
        ]
        if way == default:
            words += ["", ""]
        else:
            gain, ratio = trial_table.compare(cells[default], own, "contacts")
            words += [trial_table.shown(gain, 1), trial_table.shown(ratio, 2)]
        lines.append(f"| {' | '.join(words)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    out = trial_table.main(__doc__, "runs/taskboard/trials.csv", 60, cells_of, COLUMNS)
    print(tables(out))
