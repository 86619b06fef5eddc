"""How sure a median is, without a word about how times are distributed.

Times have long tails: a mean of them says little, and Student's interval of it less. The median's
interval needs no distribution at all: how many of n independent values lie below the true median is
binomial, so two of the ordered values enclose it with a probability that can be counted out. Values
that come in groups, as the decisions of one run do, are not independent; there whole groups are
drawn anew (the bootstrap).
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from holdfast.errors import InvalidValueError
from holdfast.experiments.statistics import Interval

__all__ = ["median_interval", "median_interval_of_groups"]

FloatArray = npt.NDArray[np.float64]

_LEVEL = 0.95
_RESAMPLES = 1000
_LARGEST_ARRAY = 2_000_000
_FEWEST_GROUPS = 10
"""Of fewer there are too few ways to draw them anew, and the interval is too short."""


def median_interval(values: FloatArray) -> Interval:
    """Return the median of independent values with the interval of two ordered ones.

    Parameters
    ----------
    values : array
        NaN for none, which is left out.

    Returns
    -------
    Interval
        NaN where there are no values; without bounds for fewer than six, among which no two enclose
        the median with a probability of 95 %.
    """
    ordered = np.sort(values[~np.isnan(values)])
    count = ordered.size
    if count == 0:
        return Interval(math.nan, math.nan, math.nan)
    middle = float(np.median(ordered))
    rank = _rank(count)
    if rank == 0:
        return Interval(middle, -math.inf, math.inf)
    return Interval(middle, float(ordered[rank - 1]), float(ordered[count - rank]))


def _rank(count: int) -> int:
    """Return the largest rank from both ends that holds the level; 0 if none does."""
    below = 0.0
    rank = 0
    for successes in range(count // 2):
        log_choose = (
            math.lgamma(count + 1) - math.lgamma(successes + 1) - math.lgamma(count - successes + 1)
        )
        below += math.exp(log_choose - count * math.log(2.0))
        if below > 0.5 * (1.0 - _LEVEL):
            break
        rank = successes + 1
    return rank


def median_interval_of_groups(values: FloatArray, groups: FloatArray) -> Interval:
    """Return the median of values that come in groups, with the interval of the bootstrap.

    Groups are drawn with replacement, each with all of its values, by a generator with a fixed
    seed; the interval is that of the medians' middle 95 %.

    Parameters
    ----------
    values : array of shape (n,)
        NaN for none, which is left out.
    groups : array of shape (n,)
        Equal for values of the same group.

    Returns
    -------
    Interval
        NaN where there are no values; without bounds for fewer than ten groups.

    Raises
    ------
    InvalidValueError
        If they are not as many.
    """
    if values.shape != groups.shape:
        raise InvalidValueError(f"{values.size} values and {groups.size} groups")
    known = ~np.isnan(values)
    values, groups = values[known], groups[known]
    if values.size == 0:
        return Interval(math.nan, math.nan, math.nan)
    middle = float(np.median(values))
    _, numbers = np.unique(groups, return_inverse=True)
    count = int(numbers.max()) + 1
    if count < _FEWEST_GROUPS:
        return Interval(middle, -math.inf, math.inf)
    order = np.argsort(values, kind="stable")
    ordered, numbers = values[order], numbers[order]
    chance = np.random.default_rng(0)
    times = chance.multinomial(count, np.full(count, 1.0 / count), size=_RESAMPLES)
    medians = np.empty(_RESAMPLES)
    some = max(1, _LARGEST_ARRAY // values.size)
    for first in range(0, _RESAMPLES, some):
        reached = np.cumsum(times[first : first + some][:, numbers], axis=1)
        middles = np.argmax(2 * reached >= reached[:, -1:], axis=1)
        medians[first : first + some] = ordered[middles]
    low, high = np.quantile(medians, [0.5 - 0.5 * _LEVEL, 0.5 + 0.5 * _LEVEL])
    return Interval(middle, float(low), float(high))
