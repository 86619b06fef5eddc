"""The run that nothing disturbs: what a disturbed one is compared with.

It is made by the shortest way there is, in this process, without services, links or signals; so
whatever those can go wrong in, it has no part in.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

from holdfast.configuration import Configuration
from holdfast.outcome import TrialResult
from holdfast.recording.run_directory import RunDirectory
from holdfast.runtime.environment import Environment
from holdfast.runtime.trial import run_trial

__all__ = ["keep_undisturbed", "run_undisturbed"]


def run_undisturbed(
    configuration: Configuration,
    min_steps: int,
    environment_of: Callable[[int], Environment | None] = lambda _: None,
) -> tuple[list[TrialResult], float]:
    """Run trials until there are enough steps.

    Parameters
    ----------
    configuration : Configuration
        Its number of trials is the largest.
    min_steps : int
        Trials are added until they have as many task actions together.
    environment_of : callable
        Returns the world of a trial; None for a simulated one.

    Returns
    -------
    list of TrialResult, float
        The trials, and how long they took in seconds.
    """
    began = time.perf_counter()
    results: list[TrialResult] = []
    for trial in range(configuration.simulator.num_trials):
        results.append(
            run_trial(
                configuration.problem,
                configuration.planning,
                configuration.simulator,
                trial,
                environment_of(trial),
            )
        )
        if sum(result.steps for result in results) >= min_steps:
            break
    return results, time.perf_counter() - began


def keep_undisturbed(
    path: Path, configuration: Configuration, results: Sequence[TrialResult], took_s: float
) -> None:
    """Write the directory of a run.

    Parameters
    ----------
    path : Path
    configuration : Configuration
        With as many trials as there are results.
    results : sequence of TrialResult
    took_s : float

    Raises
    ------
    OutputError
        If it cannot be written.
    """
    with RunDirectory.create(path, configuration) as directory:
        for result in results:
            directory.add(result)
        directory.write_tables(took_s)
