"""The random selector's results of 2017 against an emulation of that implementation.

The rows are those that the logs of 2017 end with: of 1,000 trials the number of successes, and the
mean reward over the successful ones. Emulated are the filter's defects
(:mod:`studies.emulation_2017`); the worlds and policies are holdfast's own.

Two tests per row, both two-sided: Fisher's exact test of the numbers of successes, and a comparison
of the mean rewards as normal variables. The table has no standard deviations, so that of 2017 is
taken to be ours. For each problem each quantity is tested at a family-wise level of 0.1 %, split
evenly over the rows (Bonferroni). If models and policies are the same, the slow tests of a problem
fail by chance with a probability of at most 0.2 %, and so do the quick ones. The seed is the year,
chosen before any result was seen.

`peg_in_hole_2d` agrees in all five rows. So does `multitier_peg_in_hole_2d` in eight of nine, where
two rows were logged with other holes and another map, which the logs name. The ninth, of September
4, came from an earlier version: its failed trials cost as much as its successful ones and so ended
early, while in all later logs, as here, they go on to the last step and cost two to three times
as much. With its holes our successes agree (746 and 739) and our mean reward does not (-44.2 and
-41.1); it is left out.

The mean reward of capsule_robot
--------------------------------
Its successes agree, its mean reward does not: -0.15 here, -7.549 in 2017, with a standard deviation
of 5.0 over the first 210 logged trials. The log shows that another model ran: it lists ``dt`` and
no ``step_size``, no gains and no via points, where the published source has the opposite, and the
scatter of its sensing times fits steps several times smaller. About 200 variants of steps, gains,
limits, noise and costs were tried; some pass the tests below, but each rests on something that
neither the logs nor the published source confirm, and among 200 to pass is no evidence. So the mean
reward is an expected failure below, and the row supports the successes alone.
"""

import functools
import math

import msgspec
import numpy as np
import pandas as pd
import pytest
from scipy import stats

from holdfast.numerics.arrays import FloatArray
from studies.emulation_2017 import run_emulation
from studies.published_2017 import PublishedRow, published_rows, series_of

SEED = 2017
FAMILY_WISE_LEVEL = 0.001
QUICK_TRIALS = 80


def random_rows(problem: str) -> list[PublishedRow]:
    return [
        row
        for row in published_rows()
        if row.covered and (row.problem, row.selector) == (problem, "random")
    ]


PEG_ROWS = random_rows("peg_hole_2d")
MULTITIER_ROWS = random_rows("multitier_peg_hole_2d")
(CAPSULE_ROW,) = random_rows("capsule_robot")


def label(row: PublishedRow) -> str:
    return f"{row.logged[:10]}-interval-{row.sensing_interval}"


@functools.cache
def emulated(row: PublishedRow, num_trials: int) -> pd.DataFrame:
    series = series_of(row, num_trials, SEED)
    return run_emulation(0, **msgspec.to_builtins(series))


def success_p_value(successes: int, num_trials: int, row: PublishedRow) -> float:
    table = [[successes, num_trials - successes], [row.successes, row.num_trials - row.successes]]
    return float(stats.fisher_exact(table).pvalue)


def reward_p_value(rewards: FloatArray, row: PublishedRow) -> float:
    """Compare the mean over our successful trials with the one of 2017, by the normal law."""
    deviation = float(np.std(rewards, ddof=1)) * math.sqrt(1 / rewards.size + 1 / row.successes)
    distance = abs(float(np.mean(rewards)) - row.mean_reward_of_successes)
    return math.erfc(distance / deviation / math.sqrt(2.0))


def check_successes(emulation: pd.DataFrame, row: PublishedRow, num_rows: int) -> None:
    count, num_trials = int(emulation["success"].sum()), len(emulation)
    level = FAMILY_WISE_LEVEL / num_rows
    assert success_p_value(count, num_trials, row) >= level, (
        f"{count} of {num_trials} trials succeed, in 2017 {row.successes} of {row.num_trials}"
    )


def check_rewards(emulation: pd.DataFrame, row: PublishedRow, num_rows: int) -> None:
    rewards = emulation["reward"][emulation["success"]].to_numpy()
    level = FAMILY_WISE_LEVEL / num_rows
    assert reward_p_value(rewards, row) >= level, (
        f"mean reward {np.mean(rewards):.3f} of {rewards.size} successful trials, in 2017 "
        f"{row.mean_reward_of_successes} of {row.successes}"
    )


@pytest.mark.parametrize("row", PEG_ROWS, ids=label)
def test_peg_in_hole_2d_in_few_trials(row: PublishedRow) -> None:
    emulation = emulated(row, QUICK_TRIALS)
    check_successes(emulation, row, len(PEG_ROWS))
    check_rewards(emulation, row, len(PEG_ROWS))


@pytest.mark.slow
@pytest.mark.parametrize("row", PEG_ROWS, ids=label)
def test_peg_in_hole_2d(row: PublishedRow) -> None:
    emulation = emulated(row, row.num_trials)
    check_successes(emulation, row, len(PEG_ROWS))
    check_rewards(emulation, row, len(PEG_ROWS))


@pytest.mark.slow
@pytest.mark.parametrize("row", MULTITIER_ROWS, ids=label)
def test_multitier_peg_in_hole_2d(row: PublishedRow) -> None:
    emulation = emulated(row, row.num_trials)
    check_successes(emulation, row, len(MULTITIER_ROWS))
    check_rewards(emulation, row, len(MULTITIER_ROWS))


def test_capsule_robot_successes() -> None:
    check_successes(emulated(CAPSULE_ROW, CAPSULE_ROW.num_trials), CAPSULE_ROW, 1)


@pytest.mark.xfail(
    reason="logged in 2017 by another version of the model; see this file's docstring",
    raises=AssertionError,
    strict=True,
)
def test_capsule_robot_mean_reward() -> None:
    check_rewards(emulated(CAPSULE_ROW, CAPSULE_ROW.num_trials), CAPSULE_ROW, 1)
