"""The problems of ``examples/two_ends.py`` for a robot that goes to the likelier end.

Their policies take a bit's mean for the bit: where it is near 0 the robot waits between the ends,
and runs out of steps. One that takes its sign decides at any rate, and is right half of the time
where it knows nothing. What to sense matters as much, and success differs less. ::

    python -m benchmarks.likelier_end --out docs/results/other_worlds/likelier_end.csv
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks import trial_table
from holdfast.planning.planner import Planner
from holdfast.robot.trial import run_trial
from studies import statistics, two_ends
from studies.myopic import CASES, WAYS

NAMES = ("problem", "way")
COLUMNS = ("outcome", "cost")
PROBLEMS = {"two cues": two_ends.TwoCues, "T maze": two_ends.TMaze, "sorting": two_ends.Sorting}
SHOWN = ("random", "default", "expected return, 8 looks")


def likelier(kind: type[Any]) -> Any:
    """Return a problem of a kind whose policy and ends take the sign of what decides."""

    class Likelier(kind):  # type: ignore[misc]
        def sign(self, states: Any) -> Any:
            return np.where(super().sign(states) < 0.0, -1.0, 1.0)

    return Likelier()


def _run(name: str, way: str, seed: int, trial: int) -> Mapping[str, Any]:
    case, interval = CASES[name]
    planning = case.series(WAYS[way], interval, seed=seed, num_trials=2).planning
    planner = Planner(likelier(PROBLEMS[name]), planning)
    result = run_trial(planner, seed, trial, max_steps=case.max_steps)
    return {"outcome": result.outcome, "cost": result.steps if result.success else case.max_steps}


def cells_of(seed: int) -> list[trial_table.Cell]:
    return [
        trial_table.Cell({"problem": name, "way": way}, partial(_run, name, way, seed))
        for name in PROBLEMS
        for way in SHOWN
    ]


def table(path: Path) -> str:
    """Write the differences from random sensing beside the trials, and return them in Markdown."""
    rows: list[dict[str, Any]] = []
    lines = ["| problem | way | success less random | cost less random |", "|---|---|---|---|"]
    cells = trial_table.read(path, NAMES)
    for (name, way), own in cells.items():
        pair = (own, cells[name, SHOWN[0]])
        gain, _ = statistics.paired_rates(
            *((each["outcome"] == "succeeded").to_numpy() for each in pair)
        )
        cost, _ = statistics.paired_difference(*(each["cost"].to_numpy(float) for each in pair))
        row = {"problem": name, "way": way, "trials": len(own)}
        rows.append(
            row | statistics.cells_of("success_gain", gain) | statistics.cells_of("cost", cost)
        )
        words = (name, way, trial_table.shown(gain, 3), trial_table.shown(cost, 1))
        lines.append(f"| {' | '.join(words)} |")
    pd.DataFrame(rows).to_csv(path.with_name(f"{path.stem}_summary.csv"), index=False)
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(trial_table.main(__doc__, "runs/likelier_end.csv", 100, cells_of, COLUMNS)))
