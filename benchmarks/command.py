"""What a user waits for at the terminal."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import Context
from benchmarks.measure import alternate
from benchmarks.report import Bar, Result, Table, milliseconds, paragraph
from holdfast.runtime.machine import available_cores

__all__ = ["startup", "trials"]

# What was asked for.
NUM_TRIALS = 1000
TRIALS_BAR_S = 15.0
IMPORT_BAR_MS = 30.0
"""How much longer than NumPy's the import of the public face may take."""

CONFIGURATION = """\
problem: peg_in_hole_2d
particle_filter: {num_particles: 100}
selector: {method: action_entropy, estimator: nearest_neighbor}
simulator: {max_steps: 500, sensing_intervals: 8, seed: 0}
"""


def _holdfast(*arguments: str) -> None:
    command = Path(sys.executable).with_name("holdfast")
    code = "from holdfast.cli import main; main()"
    start = [str(command)] if command.exists() else [sys.executable, "-c", code]
    subprocess.run([*start, *arguments], check=True, capture_output=True)


def trials(context: Context) -> Result:
    """Run a thousand trials by the command, from start to exit."""
    number = NUM_TRIALS // 10 if context.quick else NUM_TRIALS
    runs = 1 if context.quick else 3
    walls = []
    summary: dict[str, Any] = {}
    with tempfile.TemporaryDirectory() as directory:
        configuration = Path(directory) / "peg_in_hole_2d.yaml"
        configuration.write_text(CONFIGURATION)
        for run in range(runs):
            out = Path(directory) / str(run)
            start = time.perf_counter()
            _holdfast("run", str(configuration), "--trials", str(number), "--out", str(out), "-q")
            walls.append(time.perf_counter() - start)
            summary = json.loads((out / "summary.json").read_text())
            context.progress((run + 1) / runs)
    wall = float(np.median(walls))
    low, high = summary["success_rate_interval_95"]
    rows = [
        ["wall time, median of the runs", f"{wall:.2f} s"],
        ["wall times", ", ".join(f"{own:.2f}" for own in walls) + " s"],
        ["per trial", f"{wall / number * 1e3:.2f} ms"],
        ["success rate", f"{summary['success_rate']:.1%} (95 %: {low:.1%} to {high:.1%})"],
        ["steps of a trial, mean", f"{summary['mean_steps']:.1f}"],
        ["sensing decisions", f"{summary['sensing_decisions']:,}"],
        ["sensing decision, median", f"{summary['sensing_ms_median']:.3g} ms"],
        ["sensing decision, 99 %", f"{summary['sensing_ms_p99']:.3g} ms"],
    ]
    bars = [Bar("1,000 trials", wall, TRIALS_BAR_S, "s")] if number == NUM_TRIALS else []
    return Result(
        [
            paragraph(
                f"""`holdfast run` with {number:,} trials of peg_in_hole_2d, from start to exit,
                its tables, journal and figure included: 100 particles, a sensing interval of 8, at
                most 500 steps, action entropy, one process per core ({available_cores()})."""
            ),
            Table(("what", "measured"), rows),
        ],
        bars,
    )


def startup(context: Context) -> Result:
    """Measure how long it takes until something can be done."""

    def python(code: str) -> Callable[[], object]:
        command = [sys.executable, "-c", code]
        return lambda: subprocess.run(command, check=True, capture_output=True)

    calls: dict[str, Callable[[], object]] = {
        "python, nothing": python("pass"),
        "import numpy": python("import numpy"),
        "import holdfast": python("import numpy, holdfast"),
        "import holdfast, and its Planner": python("import holdfast; holdfast.Planner"),
        "import holdfast, and every name": python("from holdfast import *"),
        "holdfast --help": lambda: _holdfast("--help"),
    }
    timed = alternate(calls, 3 if context.quick else 20)
    context.progress(1.0)
    medians = {name: float(np.median(own)) for name, own in timed.items()}
    more_ms = 1e3 * (medians["import holdfast, and its Planner"] - medians["import numpy"])
    return Result(
        [
            "A process each, from start to exit, in turns. `import holdfast` imports NumPy as well "
            "here; each name of it is imported when it is first used.",
            Table(
                ("what", "median, ms", "minimum, ms"),
                [
                    [name, milliseconds(medians[name]), milliseconds(float(own.min()))]
                    for name, own in timed.items()
                ],
            ),
        ],
        [Bar("import holdfast and its Planner, over NumPy", more_ms, IMPORT_BAR_MS, "ms")],
    )
