"""``trials.csv``, a row for each trial, and ``summary.json``, one page about all of them.

Results are added one at a time, in the order of their trials, so that a run of millions of trials
needs no more memory than its sensing times.
"""

from __future__ import annotations

import hashlib
from array import array
from collections.abc import Iterable, Iterator
from typing import Any

import msgspec
import numpy as np

from holdfast.journal.fingerprint import EarlierCode
from holdfast.journal.timings import AnswerCounts, VerificationCounts
from holdfast.numerics.floating_mode import in_own_mode
from holdfast.planning.outcome import COUNTS, TRIAL_COLUMNS, TrialResult
from holdfast.printable import csv_rows

_NORMAL_QUANTILE_975 = 1.959963984540054


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """The content of ``summary.json``."""

    problem: str
    seed: int
    holdfast_version: str  # of the last part, if the run was resumed
    trials: int  # trials that the configuration asks for
    finished: int  # trials that are finished; all other numbers are about these
    # Trials that reached the goal, and that the environment ended as failed; the rest ran out of
    # steps.
    successes: int
    failures: int
    success_rate: float | None
    success_rate_interval_95: tuple[float, float] | None  # Wilson's interval
    mean_reward: float | None  # None if a finished trial has no reward
    mean_reward_of_successes: float | None  # earlier work reports this one
    # Arithmetic mean; ``compare --outcomes`` takes the geometric one, of which it shows ratios.
    mean_steps: float | None
    sensing_decisions: int
    missing_observations: int = 0  # sensing actions without an observation
    unexplained_observations: int  # observations that no particle explains
    # Times that the robot was found lost, and a sensing action suspect.
    lost: int = 0
    suspect_sensors: int = 0
    # The least number of different particles that an observation weighed, in any trial.
    fewest_distinct_particles: int | None = None
    recoveries: int  # times that the local service took over, in all processes of the run
    # See :class:`holdfast.journal.timings.AnswerCounts`; None without services.
    sensing_decisions_by_service: dict[str, int] | None = None
    task_answers_by_service: dict[str, int] | None = None
    longest_wait_ms: float | None = None
    # See :class:`holdfast.journal.timings.VerificationCounts`; None without services.
    verified_answers: int | None = None
    wrong_answers: dict[str, int] | None = None
    not_deterministic: int | None = None
    unverified_answers: int | None = None
    # Wall time of choosing a sensing action. Each decision counts once, as it was carried out, also
    # those of earlier processes of a run that was resumed.
    sensing_ms_median: float | None
    sensing_ms_p99: float | None
    wall_time_s: float  # over all parts of the run, without those that were killed
    # What other versions of holdfast decided before this one went on; only if one did.
    earlier_code: tuple[EarlierCode, ...] | msgspec.UnsetType = msgspec.UNSET
    # BLAKE2b-256 over the digests of the trials in order: equal exactly if all decisions of two
    # runs are.
    digest: str

    def to_json(self) -> str:
        """Return the summary as indented JSON."""
        return msgspec.json.format(msgspec.json.encode(self), indent=2).decode() + "\n"


def csv_lines(results: Iterable[TrialResult]) -> Iterator[str]:
    """Yield the lines of ``trials.csv``, the head first.

    Reading a number back gives the same number. None, such as the reward of a trial without one, is
    an empty cell.
    """
    yield from csv_rows(TRIAL_COLUMNS, map(trial_row, results))


def trial_row(result: TrialResult) -> tuple[object, ...]:
    """Return what a table has of a trial, in the order of ``TRIAL_COLUMNS``."""
    return tuple(getattr(result, column) for column in TRIAL_COLUMNS)


def wilson_interval(successes: int, trials: int) -> tuple[float, float]:
    """Return the 95 % interval for a rate, by Wilson's score.

    It is right near 0 and 1, too, and never leaves them.
    """
    z_squared = _NORMAL_QUANTILE_975**2
    rate = successes / trials
    centre = rate + z_squared / (2 * trials)
    spread = float(
        _NORMAL_QUANTILE_975
        * np.sqrt(rate * (1 - rate) / trials + z_squared / (4 * trials * trials))
    )
    scale = 1 + z_squared / trials
    low = 0.0 if successes == 0 else (centre - spread) / scale
    high = 1.0 if successes == trials else (centre + spread) / scale
    return low, high


def _mean(total: float | None, count: int) -> float | None:
    return None if total is None or not count else total / count


class SummaryBuilder:
    """Adds up results, in the order of their trials."""

    def __init__(self) -> None:
        self._sums = dict.fromkeys((*COUNTS, "success", "failed", "steps"), 0)
        self._finished = 0
        # Of all trials, and of the successful ones; None as soon as one has none.
        self._rewards: dict[bool, float | None] = {False: 0.0, True: 0.0}
        self._distinct: int | None = None
        self._sensing_ms = array("f")
        self._digest = hashlib.blake2b(digest_size=32)

    def add(self, result: TrialResult) -> None:
        """Add the next result."""
        self._finished += 1
        for name in self._sums:
            self._sums[name] += getattr(result, name)
        for of_successes in (False, True) if result.success else (False,):
            total = self._rewards[of_successes]
            if total is not None:
                total = None if result.reward is None else total + result.reward
            self._rewards[of_successes] = total
        if (distinct := result.fewest_distinct_particles) is not None:
            self._distinct = min(distinct, self._distinct or distinct)
        self._sensing_ms.extend(result.sensing_ms)
        self._digest.update(bytes.fromhex(result.digest))

    @in_own_mode
    def build(
        self,
        *,
        problem: str,
        seed: int,
        version: str,
        trials: int,
        wall_time_s: float,
        answers: AnswerCounts | None = None,
        verified: VerificationCounts | None = None,
        earlier_code: tuple[EarlierCode, ...] = (),
    ) -> RunSummary:
        """Return the summary."""
        count, sums = self._finished, self._sums
        successes = sums["success"]
        counts: dict[str, Any] = {name: sums[name] for name in COUNTS}
        median = p99 = None
        if self._sensing_ms:
            # As np.quantile, which imports NumPy's masked arrays.
            times = np.sort(np.frombuffer(self._sensing_ms, dtype=np.float32))
            at = np.array([0.5, 0.99]) * (len(times) - 1)
            quantiles = np.interp(at, np.arange(len(times)), times)
            median, p99 = (round(float(quantile), 4) for quantile in quantiles)
        return RunSummary(
            problem=problem,
            seed=seed,
            holdfast_version=version,
            trials=trials,
            finished=count,
            successes=successes,
            failures=sums["failed"],
            success_rate=successes / count if count else None,
            success_rate_interval_95=wilson_interval(successes, count) if count else None,
            mean_reward=_mean(self._rewards[False], count),
            mean_reward_of_successes=_mean(self._rewards[True], successes),
            mean_steps=sums["steps"] / count if count else None,
            **counts,
            fewest_distinct_particles=self._distinct,
            **{} if answers is None else answers._asdict(),
            **{} if verified is None else verified._asdict(),
            sensing_ms_median=median,
            sensing_ms_p99=p99,
            wall_time_s=round(wall_time_s, 3),
            earlier_code=earlier_code or msgspec.UNSET,
            digest=self._digest.hexdigest(),
        )
