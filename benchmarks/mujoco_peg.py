"""The peg in MuJoCo: what encoders, force and the choice of looks are worth.

Each trial is one of ``examples/mujoco_peg``, run in process. ::

    python -m benchmarks.mujoco_peg --out docs/results/mujoco_peg/trials.csv

runs 200 trials of each setting on seed 2026 (a few minutes), goes on after Ctrl-C, and prints the
tables of ``docs/results/mujoco_peg.md``. Seed 1 chose the example's settings.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import trial_table
from holdfast.config.loader import load
from holdfast.lab.studies.statistics import mean_interval
from holdfast.planning.planner import Planner
from holdfast.robot.environment_maker import load_environment
from holdfast.robot.trial import run_trial

EXAMPLES = Path(__file__).parents[1] / "examples" / "mujoco_peg"
NAMES = ("peg", "a_move_shows", "method")
COLUMNS = ("outcome", "steps", "looks")
SHOWS: Mapping[str, dict[str, bool]] = {
    "encoders and force": {"encoders": True, "force": True},
    "encoders": {"encoders": True, "force": False},
    "nothing": {"encoders": False, "force": False},
}
METHODS = ("path_entropy", "random", "state_entropy")
"""The default first: it is compared with the others."""


def cells_of(seed: int) -> list[trial_table.Cell]:
    cells = []
    for peg in ("2-D", "3-D"):
        file = EXAMPLES / f"peg_{peg[0]}d.yaml"
        arguments = load(file).environment.arguments
        for shows, readings in SHOWS.items():
            for method in METHODS:
                configuration = load(
                    file,
                    overrides={
                        "environment.arguments": {**arguments, **readings},
                        "selector.method": method,
                        "simulator.seed": seed,
                        "active_sensing.num_cores": 1,
                    },
                )
                names = dict(zip(NAMES, (peg, shows, method), strict=True))
                cells.append(trial_table.Cell(names, partial(_run, configuration)))
    return cells


def _run(configuration: Any, trial: int) -> Mapping[str, Any]:
    planner = Planner(configuration.problem, configuration.planning)
    simulator = configuration.simulator
    result = run_trial(
        planner,
        simulator.seed,
        trial,
        max_steps=simulator.max_steps,
        environment=load_environment(configuration)(trial),
    )
    return dict(zip(COLUMNS, (result.outcome, result.steps, result.sensing_decisions), strict=True))


def tables(path: Path) -> str:
    """Return the tables in Markdown."""
    cells = trial_table.read(path, NAMES)
    default = METHODS[0]
    lines = [
        "| peg | a move shows | sensing | success (%) | failed | steps of successes | "
        "success of the default less its own (points) | steps of the default / its own |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for peg in ("2-D", "3-D"):
        for shows in SHOWS:
            for method in METHODS:
                own = cells[peg, shows, method]
                succeeded = own["outcome"] == "succeeded"
                words = [
                    *(peg, shows, method),
                    trial_table.shown(trial_table.rate(own), 1),
                    str(int((own["outcome"] == "failed").sum())),
                    trial_table.shown(mean_interval(own["steps"][succeeded].to_numpy(float)), 1),
                ]
                if method == default:
                    words += ["", ""]
                else:
                    gain, ratio = trial_table.compare(cells[peg, shows, default], own, "steps")
                    words += [trial_table.shown(gain, 1), trial_table.shown(ratio, 2)]
                lines.append(f"| {' | '.join(words)} |")
    lines += [
        "",
        "| peg | the default with | less with | success (points) | steps, ratio |",
        "|---|---|---|---|---|",
    ]
    for peg in ("2-D", "3-D"):
        for more, less in (("encoders and force", "encoders"), ("encoders", "nothing")):
            gain, ratio = trial_table.compare(
                cells[peg, more, default], cells[peg, less, default], "steps"
            )
            words = [peg, more, less, trial_table.shown(gain, 1), trial_table.shown(ratio, 2)]
            lines.append(f"| {' | '.join(words)} |")
    return "\n".join(lines)


if __name__ == "__main__":
    out = trial_table.main(__doc__, "runs/mujoco_peg/trials.csv", 200, cells_of, COLUMNS)
    print(tables(out))
