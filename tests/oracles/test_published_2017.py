"""The random selector's results of 2017 against an emulation of that implementation.

The rows are those that the logs of 2017 end with: of 1,000 trials the number of successes, and the
mean reward over the successful ones. Emulated are the filter's defects
(:mod:`tests.oracles.emulation_2017`); the worlds and policies are holdfast's own.

Two tests per row, both two-sided: Fisher's exact test of the numbers of successes, and a comparison
of the mean rewards as normal variables. The logs' summaries have no standard deviation, so that of
2017 is taken to be ours. Each quantity of a problem is tested at a family-wise level of 0.1 %, split
evenly over the problem's rows (Bonferroni). Were model and policies the same, a problem's tests
would fail by chance with a probability of at most 0.2 %, less since Fisher's test is conservative;
all tests of this file together with at most 0.9 %. The seed is the year, chosen before any result
was seen.

`peg_in_hole_2d` agrees in all five rows. So does `multitier_peg_in_hole_2d` in the six rows that were
logged with today's holes. The logs of its other three rows name other holes: (3, 6), (-3, 0), (0, -6)
with tolerances 0.3, 0.2, 0.1 on September 4, and (4, 6), (-4, 0), (0, -6) with 0.2, 0.15, 0.1 in a
map of half-size 15 on September 7; so those rows say nothing about today's problem.

The mean reward of `capsule_robot`
----------------------------------
Its successes agree, its mean reward does not: -0.15 here, -7.549 in 2017 (standard deviation of the
first 210 logged trials: 5.0). The log shows that another model ran. Its list of parameters has ``dt =
0.1`` and no ``step_size``, which the published source has instead. And its steps were about ten
times smaller: a trial's mean sensing time in the log is the sum of ceil(n / 11) times, divided by
floor((n + 1) / 11), for n steps. At the 139 steps that a trial takes here the two counts would
differ by one in thirteen for most values of n and not at all for the others, hence the logged
times by 3 % (standard deviation) for that reason alone; they vary by 1.2 % (the first
hundreds of the state-entropy trials), as they can only from about n = 400 on. (In the logs of
`peg_in_hole_2d` short trials do show the effect.) That fits a step of dt * 0.1, at which n is 1,400.

Variants of the model were tried until one would give 1,000 successes and the mean -7.549. For
u = target - estimate, the variants below execute 0.1 times "limited" and punish a collision of the
new state + "looked at"; "norm" and "each" limit the norm or each component to 0.1. 1,000 trials, seed
2017 (300 and seed 1 where marked *), 11 steps between observations:

======================================  =========  ===========  =========  =====
limited, gains along and across         looked at  successes %  mean       sd
======================================  =========  ===========  =========  =====
norm of u, 1 and 1 *                    executed   94.7         -0.40      1.5
norm of u, 1 and 1 *                    limited    94.7         -4.38      12.8
norm of u, 1 and 1                      u          94.1         -8.15      5.1
norm of u, 1 and 1, from the old state  u          94.0         -5.86      4.2
each of u, 1 and 1 *                    limited    100.0        -3.49      3.1
each of u, 1 and 1                      u          100.0        -9.64      5.9
each of u, 1 and 1, from the old state  u          100.0        -6.54      4.5
not limited, 1 and 1 (n = 156) *        u          99.7         -9.97      5.0
not limited, 0.1 u, 1 and 1             u          99.4         -8.38      5.6
norm of gain * u, 0.1 and 1             gain * u   99.9         -8.64      5.3
norm of gain * u, 0.2 and 1             gain * u   98.8         -6.48      4.4
each of gain * u, 0.1 and 1             gain * u   99.9         -8.29      5.1
each of gain * u, 0.2 and 1             gain * u   99.9         -7.06      4.5
each of gain * u, 0.25 and 1            gain * u   99.9         -7.14      4.7
======================================  =========  ===========  =========  =====

Also tried, without agreement: the action unscaled by ``dt``; noise scaled by ``dt`` or by its root;
other gains and step limits; other radii of the via points; advancing the stage by the distance along
the axis alone; sliding along walls; punishing a step for which the noise was redrawn.

So the logged reward has the size and spread that arise when a collision is looked for at the new
state plus the full commanded action, in steps ten times smaller. But no variant that takes its gains
from the published configuration (1 and 1) gives both the successes and the mean, and gains that do
would be fitted: the log does not have them, and more than one choice passes. None is therefore put
into the emulation. The mean reward of this row is an expected failure below, and the row supports the
successes only.
"""

from __future__ import annotations

import csv
import functools
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from scipy import stats
from tests.oracles.emulation_2017 import Emulation, drawn_particle, emulate, likelihoods

from holdfast.problems.capsule_robot import CapsuleRobot
from holdfast.problems.multitier_peg_in_hole_2d import MultitierPegInHole2D
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.problems.problem import FloatArray, Problem

SEED = 2017
FAMILY_WISE_LEVEL = 0.001
QUICK_TRIALS = 150

PROBLEMS: dict[str, type[PegInHole2D] | type[MultitierPegInHole2D] | type[CapsuleRobot]] = {
    "peg_hole_2d": PegInHole2D,
    "multitier_peg_hole_2d": MultitierPegInHole2D,
    "capsule_robot": CapsuleRobot,
}
OTHER_HOLES = ("2017-09-04", "2017-09-06", "2017-09-07")


class Row(NamedTuple):
    """A row of the table of 2017."""

    problem: str
    logged: str
    sensing_interval: int
    max_steps: int
    num_trials: int
    num_particles: int
    successes: int
    mean_reward: float


def random_rows(problem: str) -> list[Row]:
    path = Path(__file__).parent / "data" / "original_results_2017.csv"
    with path.open(encoding="utf-8", newline="") as file:
        return [
            Row(
                entry["problem"],
                entry["logged"],
                int(entry["sensing_interval"]),
                int(entry["max_steps"]),
                int(entry["num_trials"]),
                int(entry["num_particles"]),
                int(entry["successes"]),
                float(entry["mean_reward_of_successes"]),
            )
            for entry in csv.DictReader(file)
            if entry["problem"] == problem and entry["selector"] == "random"
        ]


PEG_ROWS = random_rows("peg_hole_2d")
MULTITIER_ROWS = [
    row for row in random_rows("multitier_peg_hole_2d") if not row.logged.startswith(OTHER_HOLES)
]
(CAPSULE_ROW,) = random_rows("capsule_robot")


def label(row: Row) -> str:
    return f"{row.logged[:10]}-interval-{row.sensing_interval}"


@functools.cache
def emulated(
    problem: str, sensing_interval: int, max_steps: int, num_particles: int, num_trials: int
) -> Emulation:
    return emulate(
        PROBLEMS[problem](),
        sensing_interval=sensing_interval,
        max_steps=max_steps,
        num_trials=num_trials,
        num_particles=num_particles,
        seed=SEED,
    )


def emulated_row(row: Row, num_trials: int) -> Emulation:
    return emulated(row.problem, row.sensing_interval, row.max_steps, row.num_particles, num_trials)


def success_p_value(successes: int, num_trials: int, row: Row) -> float:
    table = [
        [successes, num_trials - successes],
        [row.successes, row.num_trials - row.successes],
    ]
    return float(stats.fisher_exact(table).pvalue)


def reward_p_value(rewards: FloatArray, row: Row) -> float:
    """Compare the mean over our successful trials with the one of 2017, by the normal law."""
    deviation = float(np.std(rewards, ddof=1)) * math.sqrt(1 / rewards.size + 1 / row.successes)
    return math.erfc(abs(float(np.mean(rewards)) - row.mean_reward) / deviation / math.sqrt(2.0))


def check_successes(emulation: Emulation, row: Row, num_rows: int) -> None:
    count, num_trials = int(emulation.successes.sum()), emulation.successes.size
    level = FAMILY_WISE_LEVEL / num_rows
    assert success_p_value(count, num_trials, row) >= level, (
        f"{count} of {num_trials} trials succeed, in 2017 {row.successes} of {row.num_trials}"
    )


def check_rewards(emulation: Emulation, row: Row, num_rows: int) -> None:
    rewards = emulation.rewards[emulation.successes]
    level = FAMILY_WISE_LEVEL / num_rows
    assert reward_p_value(rewards, row) >= level, (
        f"mean reward {np.mean(rewards):.3f} of {rewards.size} successful trials, in 2017 "
        f"{row.mean_reward} of {row.successes}"
    )


@pytest.mark.parametrize("row", PEG_ROWS, ids=label)
def test_peg_in_hole_2d_in_few_trials(row: Row) -> None:
    emulation = emulated_row(row, QUICK_TRIALS)
    check_successes(emulation, row, len(PEG_ROWS))
    check_rewards(emulation, row, len(PEG_ROWS))


@pytest.mark.slow
@pytest.mark.parametrize("row", PEG_ROWS, ids=label)
def test_peg_in_hole_2d(row: Row) -> None:
    emulation = emulated_row(row, row.num_trials)
    check_successes(emulation, row, len(PEG_ROWS))
    check_rewards(emulation, row, len(PEG_ROWS))


@pytest.mark.slow
@pytest.mark.parametrize("row", MULTITIER_ROWS, ids=label)
def test_multitier_peg_in_hole_2d(row: Row) -> None:
    emulation = emulated_row(row, row.num_trials)
    check_successes(emulation, row, len(MULTITIER_ROWS))
    check_rewards(emulation, row, len(MULTITIER_ROWS))


def test_capsule_robot_successes() -> None:
    check_successes(emulated_row(CAPSULE_ROW, CAPSULE_ROW.num_trials), CAPSULE_ROW, 1)


@pytest.mark.xfail(
    reason="logged in 2017 by another version of the model; see this file's docstring",
    raises=AssertionError,
    strict=True,
)
def test_capsule_robot_mean_reward() -> None:
    check_rewards(emulated_row(CAPSULE_ROW, CAPSULE_ROW.num_trials), CAPSULE_ROW, 1)


def test_the_table_has_the_rows_compared() -> None:
    assert [row.sensing_interval for row in PEG_ROWS] == [6, 4, 2, 0, 8]
    assert [row.sensing_interval for row in MULTITIER_ROWS] == [6, 12, 14, 14, 6, 4]
    assert {row.num_trials for row in [*PEG_ROWS, *MULTITIER_ROWS, CAPSULE_ROW]} == {1000}


@pytest.mark.parametrize("row", PEG_ROWS, ids=label)
def test_the_comparison_rejects_a_sound_filter(row: Row) -> None:
    # The success rate with a true systematic resampler is about 99 %.
    assert success_p_value(990, 1000, row) < FAMILY_WISE_LEVEL / len(PEG_ROWS)


def test_the_comparison_rejects_a_shifted_mean_and_keeps_the_same() -> None:
    row = next(row for row in PEG_ROWS if row.sensing_interval == 8)
    spread = np.linspace(-24.0, 24.0, row.successes)  # standard deviation 13.9, as logged rows have
    assert reward_p_value(row.mean_reward + spread, row) > 0.99
    assert reward_p_value(row.mean_reward + 4.0 + spread, row) < FAMILY_WISE_LEVEL / len(PEG_ROWS)


def test_trials_do_not_mix() -> None:
    # A world far from its particles, one at a particle: only the second trial's weights survive.
    problem: Problem = PegInHole2D()
    world = np.array([[4.0, 2.0, 0.0], [1.0, 3.0, 0.0]])
    particles = np.zeros((2, 3, 3))
    particles[:, :, 0] = [[-4.0, -3.0, -2.0], [5.0, 1.0, -5.0]]
    weights = likelihoods(problem, world, particles, 0, np.zeros((2, 1)))
    np.testing.assert_allclose(
        weights, [[0.0, 0.0, 0.0], [0.0, 1.0 / math.sqrt(2.0 * math.pi * 0.001), 0.0]]
    )
    np.testing.assert_array_equal(drawn_particle(weights, np.array([0.9, 0.5])), [0, 1])


def test_a_particle_is_drawn_in_proportion_to_its_weight() -> None:
    weights = np.array([0.5, 0.0, 1.5, 2.0])
    offsets = (np.arange(4000) + 0.5) / 4000
    drawn = drawn_particle(np.broadcast_to(weights, (4000, 4)), offsets)
    np.testing.assert_array_equal(np.bincount(drawn, minlength=4), [500, 0, 1500, 2000])
