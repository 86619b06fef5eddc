"""The trials of a configuration that are not yet finished, on one core or on several."""

from __future__ import annotations

from collections.abc import Callable, Collection

from holdfast.config.loader import Configuration
from holdfast.planning.outcome import TrialResult
from holdfast.robot.lost_values import LostValues
from holdfast.robot.trial_pool import Arm, TrialPool


def run_trials(
    configuration: Configuration,
    jobs: int,
    finished: Collection[int],
    on_result: Callable[[TrialResult], None],
    observer: LostValues | None = None,
) -> list[tuple[str, ...]]:
    """Run the trials of a configuration that are not ``finished``, in at most ``jobs`` processes.

    ``on_result`` is called in this process with each result as soon as it is there, in any order.
    Returns which values each of these trials has lost (:class:`LostValues`).
    Raises what :meth:`TrialPool.run` raises; KeyboardInterrupt after the workers have been ended.
    """
    num_trials = configuration.simulator.num_trials
    remaining = num_trials - sum(1 for trial in finished if 0 <= trial < num_trials)
    arm, lost = Arm.of(configuration), []
    with TrialPool(jobs, expected=remaining, observer=observer) as pool:
        for done in pool.run((arm, trial) for trial in range(num_trials) if trial not in finished):
            on_result(done.result)
            lost.append(done.lost_values)
    return lost
