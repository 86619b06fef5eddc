"""How sure a number is, and whether two numbers differ.

Runs are compared *paired*: two selectors see the same worlds, because seed and trial name every
random number. The difference of two means over the same trials has a far smaller interval than the
means themselves.

Times have long tails, so they are summarised by medians. The interval of a median needs no
assumption about the distribution.

SciPy takes a second to import, so each function imports what it needs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.errors import InvalidValueError
from holdfast.journal.tables import wilson_interval
from holdfast.numerics.arrays import BoolArray, FloatArray

if TYPE_CHECKING:
    import pandas as pd

    from studies.tables import Cell


_LEVEL = 0.95
_LARGEST_EXPONENT = 700.0
_RESAMPLES = 1000
_FEWEST_CLUSTERS = 10
"""With fewer there are too few distinct resamples, and the interval is too short."""


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float


def exactly(value: float) -> Interval:
    """Return a number that is no estimate, or whose interval is not known."""
    return Interval(value, value, value)


@cache
def _students_quantile(freedom: int) -> float:
    from scipy import stats

    return float(stats.t.ppf(0.5 + 0.5 * _LEVEL, freedom))


def _students(mean: float, error: float, freedom: int) -> Interval:
    half = _students_quantile(freedom) * error
    return Interval(mean, mean - half, mean + half)


def mean_interval(values: FloatArray) -> Interval:
    """Return the mean of independent values with Student's interval; NaN is left out.

    NaN where there are no values; without bounds for a single one.
    """
    values = values[~np.isnan(values)]
    if values.size == 0:
        return exactly(math.nan)
    mean = float(values.mean())
    if values.size == 1:
        return Interval(mean, -math.inf, math.inf)
    return _students(mean, _standard_error(values), values.size - 1)


def _standard_error(values: FloatArray) -> float:
    return float(values.std(ddof=1)) / math.sqrt(values.size)


def log_steps(steps: FloatArray) -> FloatArray:
    """Return the logarithms of numbers of steps, whose paired differences are ratios.

    A trial that begins in the goal takes no step in any run of the same worlds. It has no ratio,
    and says nothing about how runs differ: here it is NaN, and is left out. A constant added to all
    numbers would keep it, but would draw the ratios of all other trials towards 1.
    """
    return np.log(np.where(steps == 0.0, math.nan, steps))


def paired_difference(first: FloatArray, second: FloatArray) -> tuple[Interval, float]:
    """Return the mean of ``first - second`` over the same trials, and how likely it is by chance.

    NaN in both of a pair leaves a trial out; in one alone, or for other numbers of trials, it is an
    InvalidValueError. The p-value is that of Student's paired test, two-sided; 1 if all differences
    are zero, NaN for a single pair or none. If all are equal otherwise, they say nothing about how
    they scatter: that of the sign test.
    """
    from scipy import stats

    if first.shape != second.shape:
        raise InvalidValueError(f"{first.size} and {second.size} trials cannot be paired")
    unpaired = np.isnan(first) != np.isnan(second)
    if np.any(unpaired):
        raise InvalidValueError(
            f"pair {int(np.argmax(unpaired))} has one number alone: the trials are not of the same "
            "worlds"
        )
    difference = (first - second)[~np.isnan(first)]
    if difference.size and not np.any(difference):
        return exactly(0.0), 1.0
    interval = mean_interval(difference)
    if difference.size < 2:
        return interval, math.nan
    error = _standard_error(difference)
    if error == 0.0:
        return interval, 2.0 * 0.5**difference.size
    return interval, float(2.0 * stats.t.sf(abs(interval.value) / error, difference.size - 1))


def paired_rates(first: BoolArray, second: BoolArray) -> tuple[Interval, float]:
    """Return the difference of two rates over the same trials, and how likely it is by chance.

    The interval is Student's, of the differences of single trials. The p-value is that of McNemar's
    exact test: of the trials in which one alone succeeded, each is as likely to be the first's as
    the second's.
    """
    from scipy import stats

    interval, _ = paired_difference(first.astype(np.float64), second.astype(np.float64))
    first_alone = int(np.count_nonzero(first & ~second))
    either_alone = int(np.count_nonzero(first != second))
    if either_alone == 0:
        return interval, 1.0
    return interval, float(stats.binomtest(first_alone, either_alone).pvalue)


def rate_interval(successes: int, trials: int, factor: float = 1.0) -> Interval:
    """Return a rate with Wilson's interval, times a factor."""
    ends = (successes / trials, *wilson_interval(successes, trials))
    return Interval(*(factor * end for end in ends))


def independent_difference(first: Interval, second: Interval) -> Interval:
    """Return ``first - second`` of two values that are independent, from their intervals.

    For two rates with Wilson's intervals that is Newcombe's interval; for two means, nearly
    Student's.

    Source: R. G. Newcombe, "Interval estimation for the difference between independent
    proportions: comparison of eleven methods", 1998, method 10.
    """
    difference = first.value - second.value
    return Interval(
        difference,
        difference - math.hypot(first.value - first.low, second.high - second.value),
        difference + math.hypot(first.high - first.value, second.value - second.low),
    )


def agreement_of_rates(successes: int, trials: int, others: int, other_trials: int) -> float:
    """Return the p-value of Fisher's exact test that two rates are the same."""
    from scipy import stats

    table = [[successes, trials - successes], [others, other_trials - others]]
    return float(stats.fisher_exact(table).pvalue)


def agreement_of_means(values: FloatArray, other_mean: float, other_count: int) -> float:
    """Return the p-value that a mean is one of which only the number of values is known.

    Both are taken as normal, with the standard deviation of our values; NaN if these are too few to
    have one, or all the same.
    """
    if values.size < 2 or other_count < 1:
        return math.nan
    error = float(np.std(values, ddof=1)) * math.sqrt(1 / values.size + 1 / other_count)
    if error == 0.0:
        return math.nan
    return math.erfc(abs(float(np.mean(values)) - other_mean) / error / math.sqrt(2.0))


def ratio_of(difference: Interval) -> Interval:
    """Return the ratio that a difference of logarithms stands for."""
    return Interval(*(math.exp(min(end, _LARGEST_EXPONENT)) for end in difference))


class RandomEffects(NamedTuple):
    """What an effect is over problems of which those that were tried are a sample."""

    mean: Interval
    """Mean of the effects over all such problems."""
    p_value: float
    """That this mean is zero."""
    deviation: float
    """Standard deviation of the effects between problems."""
    new_problem: Interval
    """The mean with the interval in which the effect of one more problem lies."""


def random_effects(effects: FloatArray, errors: FloatArray) -> RandomEffects:
    """Return the mean of effects that differ from problem to problem.

    The mean over given problems says nothing of other problems: its interval shrinks with the
    trials, however much problems differ. Here each effect is one that is drawn for its problem,
    seen with an error.

    The variance between problems is the one by which the effects scatter as much as they should
    (Paule and Mandel; preferred by Veroniki et al., "Methods to estimate the between-study variance
    and its uncertainty in meta-analysis", 2016). The interval of the mean is that of Hartung and
    Knapp (Knapp and Hartung, "Improved tests for a random effects meta-regression with a single
    covariate", 2003), never narrower than without their factor. This factor is 1 where the variance
    between problems is not zero: so Paule and Mandel chose the variance. The interval of a new
    problem: Higgins, Thompson and Spiegelhalter, "A re-evaluation of random-effects meta-analysis",
    2009, equation 12.

    statsmodels' ``combine_effects`` gives the same where it converges, but takes the variance for
    zero where its iteration overshoots, as it does for 5 of the 110 comparisons of ``selectors``.
    So the equation is solved here, by bracketing. InvalidValueError for fewer than three effects,
    or standard errors that are not above zero.
    """
    from scipy import optimize, stats

    count = effects.size
    if count < 3 or errors.shape != effects.shape or not np.all(errors > 0.0):
        raise InvalidValueError(
            f"{count} effects with errors {errors}: at least 3, each with an error above zero"
        )

    def weighted(variance: float) -> tuple[float, float, float]:
        """Return the mean, its variance, and how much too far the effects scatter."""
        weights = 1.0 / (errors * errors + variance)
        mean = float(weights @ effects / weights.sum())
        excess = float(weights @ (effects - mean) ** 2) - (count - 1)
        return mean, 1.0 / float(weights.sum()), excess

    between, high = 0.0, float(np.var(effects, ddof=1) + np.max(errors) ** 2)
    if weighted(0.0)[2] > 0.0:
        while weighted(high)[2] > 0.0:
            high *= 2.0
        between = float(optimize.brentq(lambda variance: weighted(variance)[2], 0.0, high))
    mean, variance, _ = weighted(between)
    return RandomEffects(
        _students(mean, math.sqrt(variance), count - 1),
        float(2.0 * stats.t.sf(abs(mean) / math.sqrt(variance), count - 1)),
        math.sqrt(between),
        _students(mean, math.sqrt(between + variance), count - 2),
    )


def across_problems(
    pairs: Sequence[tuple[FloatArray, FloatArray]], least_difference: float
) -> RandomEffects:
    """Return how two ways differ over problems, from a number of each trial in some of them.

    NaN in both of a pair leaves a trial out. ``least_difference`` is that by which two trials can
    differ. Where no trial differs, the error is that of Agresti and Min's estimate ("Simple
    improved confidence intervals for comparing matched proportions", 2005), which adds half a pair
    that differs in either direction; no error is below that.
    """
    differences = [(first - second)[~np.isnan(first)] for first, second in pairs]
    errors = [
        max(least_difference / (each.size + 2), _standard_error(each) if each.size > 1 else 0.0)
        for each in differences
    ]
    return random_effects(np.array([each.mean() for each in differences]), np.array(errors))


def cells_of(name: str, interval: Interval) -> dict[str, Cell]:
    """Return an interval as cells of a row: ``name``, ``name_low``, ``name_high``.

    A bound that does not exist, or the mean of nothing, is NaN.
    """
    ends = zip(("", "_low", "_high"), interval, strict=True)
    return {f"{name}{end}": value if math.isfinite(value) else math.nan for end, value in ends}


def interval_in(row: Mapping[str, Any], name: str, factor: float = 1.0) -> Interval:
    """Return the interval that :func:`cells_of` wrote into a row, times a factor."""
    return Interval(*(factor * float(row[f"{name}{end}"]) for end in ("", "_low", "_high")))


def holm(p_values: npt.ArrayLike) -> FloatArray:
    """Return p-values adjusted for their number, by Holm's method.

    Calling significant what is below a level here makes any error at all with a probability of at
    most that level, whatever the dependence between the tests.

    Source: S. Holm, "A simple sequentially rejective multiple test procedure", 1979.
    """
    given = np.asarray(p_values, dtype=np.float64)
    order = np.argsort(given)
    raised = np.maximum.accumulate(given[order] * np.arange(given.size, 0, -1))
    adjusted = np.empty(given.size)
    adjusted[order] = np.minimum(raised, 1.0)
    return adjusted


def add_adjusted(table: pd.DataFrame, *columns: str, compared: Any = None) -> None:
    """Add Holm-adjusted p-values to a table; ``steps_p_value`` gives ``steps_adjusted_p_value``.

    ``compared`` says which rows are comparisons (default: all); the others get 1.
    """
    rows = np.ones(len(table), dtype=np.bool_) if compared is None else np.asarray(compared)
    for column in columns:
        adjusted = np.ones(rows.size)
        adjusted[rows] = holm(table[column][rows])
        table[column.replace("p_value", "adjusted_p_value")] = adjusted


def median_interval(values: npt.ArrayLike) -> Interval:
    """Return the median of independent values with the interval between two order statistics.

    The number of values below the true median is binomial, so two of the ordered values enclose it
    with a known probability. NaN is left out. NaN without values; without bounds for fewer than
    six, of which no two enclose the median with a probability of 95 %.
    """
    from scipy import stats

    known = np.asarray(values, dtype=np.float64)
    known = known[~np.isnan(known)]
    if known.size == 0:
        return exactly(math.nan)
    median = float(np.median(known))
    low, high = stats.quantile_test(known, q=median).confidence_interval(_LEVEL)
    if math.isnan(low):
        return Interval(median, -math.inf, math.inf)
    return Interval(median, float(low), float(high))


def clustered_median_interval(values: FloatArray, clusters: FloatArray) -> Interval:
    """Return the median of values in clusters, with the percentile interval of the bootstrap.

    The decisions of one run are not independent, so whole runs are resampled, from a fixed seed.
    Values and clusters of shape (n,); NaN is left out. NaN without values; without bounds for fewer
    than ten clusters.
    """
    known = ~np.isnan(values)
    values, clusters = values[known], clusters[known]
    groups = [values[clusters == name] for name in np.unique(clusters)]
    middle = float(np.median(values)) if values.size else math.nan
    if not groups:
        return exactly(middle)
    if len(groups) < _FEWEST_CLUSTERS:
        return Interval(middle, -math.inf, math.inf)
    drawn = np.random.default_rng(0).integers(len(groups), size=(_RESAMPLES, len(groups)))
    medians = [np.median(np.concatenate([groups[each] for each in row])) for row in drawn]
    low, high = np.percentile(medians, [50.0 * (1.0 - _LEVEL), 50.0 * (1.0 + _LEVEL)])
    return Interval(middle, float(low), float(high))
