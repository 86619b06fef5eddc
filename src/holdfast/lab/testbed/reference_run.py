"""The reference run: the same trials without services, links or faults, in this process.

It takes the shortest way there is, so nothing that a fault can break has a part in it. Runs with
faults are compared with it, and its length says how long they will be.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from holdfast.config.loader import Configuration, load
from holdfast.lab.testbed.world import WitnessedWorld
from holdfast.outcome import TrialResult
from holdfast.planning import Planner
from holdfast.recording.run_directory import RunDirectory
from holdfast.robot.environment import Environment
from holdfast.robot.trial import run_trial

__all__ = ["ReferenceRun", "make_reference_run"]

_MAX_TRIALS = 1000


class ReferenceRun(NamedTuple):
    """A reference run.

    Attributes
    ----------
    configuration : Configuration
        With as many trials as were needed.
    took_s : float
        Of the computation.
    """

    configuration: Configuration
    steps_of_trials: tuple[int, ...]
    took_s: float


def make_reference_run(
    out: Path,
    write_configuration: Callable[[int], Path],
    min_steps: int,
    performed: Path | None = None,
) -> ReferenceRun:
    """Run trials until there are enough steps, and write the directory of the run.

    Raises
    ------
    OutputError
        If something cannot be written.
    """
    configuration = load(write_configuration(_MAX_TRIALS))
    planner = Planner(configuration.problem, configuration.planning)
    began = time.perf_counter()
    results: list[TrialResult] = []
    with contextlib.ExitStack() as worlds:

        def world(trial: int) -> Environment | None:
            if performed is None:
                return None
            made = WitnessedWorld(
                str(performed), configuration.problem, configuration.simulator.seed, trial
            )
            worlds.callback(made.close)
            return made

        while sum(result.steps for result in results) < min_steps:
            trial = len(results)
            results.append(
                run_trial(
                    planner,
                    configuration.simulator.seed,
                    trial,
                    max_steps=configuration.simulator.max_steps,
                    environment=world(trial),
                )
            )
    took_s = time.perf_counter() - began
    configuration = load(write_configuration(len(results)))
    with RunDirectory.create(out, configuration) as directory:
        for result in results:
            directory.add(result)
        directory.write_tables(took_s)
    return ReferenceRun(configuration, tuple(result.steps for result in results), took_s)
