"""The reference run: the same trials without services, links or faults, in this process.

It takes the shortest way there is, so nothing that a fault can break has a part in it. Runs with
faults are compared with it, and its length says how long they will be.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from holdfast.config.loader import Configuration, load
from holdfast.journal.run_directory import RunDirectory
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.robot.trial import run_trial
from holdfast.runtime.files import write_atomically
from holdfast_lab.testbed.world import WitnessedWorld

_MAX_TRIALS = 1000


class ReferenceRun(NamedTuple):
    """A reference run, the configuration of all runs of as many trials, and what it took."""

    configuration: Configuration
    steps_of_trials: tuple[int, ...]
    took_s: float


def make_reference_run(
    out: Path,
    path: Path,
    document: Mapping[str, Any],
    min_steps: int,
    performed: Path | None = None,
    *,
    comment: str = "",
) -> ReferenceRun:
    """Run trials until there are enough steps; write the configuration and the run's directory.

    ``path`` gets the document, with the number of trials, as a configuration that begins with the
    comment; ``performed`` the performed task actions: see :mod:`~holdfast_lab.testbed.world`.
    Raises OutputError if something cannot be written.
    """

    def configure(num_trials: int) -> Configuration:
        simulator = {"num_trials": num_trials, **document["simulator"]}
        text = yaml.safe_dump({**document, "simulator": simulator}, sort_keys=False)
        write_atomically(path, comment + text)
        return load(path)

    configuration = configure(_MAX_TRIALS)
    problem, simulator = configuration.problem, configuration.simulator
    planner = Planner(problem, configuration.planning)
    began = time.perf_counter()
    results: list[TrialResult] = []
    while sum(result.steps for result in results) < min_steps:
        trial = len(results)
        with contextlib.ExitStack() as stack:
            world = None
            if performed is not None:
                world = WitnessedWorld(str(performed), problem, simulator.seed, trial)
                stack.callback(world.close)
            results.append(
                run_trial(
                    planner,
                    simulator.seed,
                    trial,
                    max_steps=simulator.max_steps,
                    environment=world,
                    lost=configuration.lost,
                )
            )
    took_s = time.perf_counter() - began
    configuration = configure(len(results))
    with RunDirectory.create(out, configuration) as directory:
        for result in results:
            directory.add(result)
        directory.write_tables(took_s)
    return ReferenceRun(configuration, tuple(result.steps for result in results), took_s)
