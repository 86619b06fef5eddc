"""Medians and their intervals: against SciPy's binomial, and by how often they hold."""

import math

import numpy as np
import pytest
from scipy import stats

from studies.statistics import clustered_median_interval, median_interval


@pytest.mark.parametrize("count", [6, 7, 10, 50, 201, 3000])
def test_the_ranks_are_those_of_the_binomial(count: int) -> None:
    values = np.random.default_rng(0).permutation(count).astype(float)
    found = median_interval(values)
    # The largest number of values that may be left out at either end.
    rank = int(stats.binom.ppf(0.025, count, 0.5))
    assert (found.low, found.high) == (rank - 1, count - rank)
    assert found.value == np.median(values)
    inside = stats.binom.cdf(count - rank, count, 0.5) - stats.binom.cdf(rank - 1, count, 0.5)
    assert inside >= 0.95


def test_few_values() -> None:
    assert all(map(math.isnan, median_interval(np.array([np.nan]))))
    few = median_interval(np.array([3.0, 1.0, np.nan, 2.0, 4.0, 5.0]))
    assert few == (3.0, -math.inf, math.inf)
    assert median_interval(np.arange(6.0))[1:] == (0.0, 5.0)


def test_the_interval_holds_the_truth_as_often_as_it_says() -> None:
    # Of 9 values it holds the median with 96.1 %: fewer than 925 or more than 986 of 1,000 have
    # a probability below 1e-5 (binomial); one rank further in or out it is 82 % or 99.6 %.
    samples = np.random.default_rng(7).exponential(size=(1000, 9))
    held = sum(f.low <= math.log(2.0) <= f.high for f in map(median_interval, samples))
    assert 925 <= held <= 986


def test_groups_are_drawn_whole() -> None:
    """Values of a group that say the same are one value: the interval is that of the groups."""
    chance = np.random.default_rng(1)
    medians = chance.exponential(size=40)
    values = np.repeat(medians, 50)
    groups = np.repeat(np.arange(40.0), 50)
    found = clustered_median_interval(values, groups)
    alone = median_interval(values)
    assert found.low <= found.value <= found.high
    assert found.high - found.low > 3.0 * (alone.high - alone.low)
    assert found == clustered_median_interval(values, groups)


def test_it_holds_as_often_as_it_says() -> None:
    """Of 100 intervals 95 are to hold; binomial standard deviation 2.2, and a bootstrap over 30
    groups may miss some more: below 85 it is wrong. Without groups 74 hold."""
    chance = np.random.default_rng(2)
    held = 0
    for _ in range(100):
        groups = np.repeat(np.arange(30.0), 4)
        values = np.repeat(chance.normal(size=30), 4) + 0.3 * chance.normal(size=120)
        found = clustered_median_interval(values, groups)
        held += found.low <= 0.0 <= found.high
    assert held >= 85


def test_few_groups_and_wrong_ones() -> None:
    few = clustered_median_interval(np.arange(100.0), np.repeat(np.arange(4.0), 25))
    assert few == (49.5, -math.inf, math.inf)
    assert math.isnan(clustered_median_interval(np.array([np.nan]), np.zeros(1)).value)
