"""How sure a number is, and whether two differ: what each sentence about results rests on.

Runs are compared *paired*: two ways of choosing see the same worlds, because every random number is
named by seed and trial. A difference of two means over the same trials has a far smaller interval
than the means themselves.

SciPy takes a second to import, so that is done where it is needed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from holdfast.errors import InvalidValueError

if TYPE_CHECKING:
    from holdfast.experiments.tables import Cell, Table

__all__ = [
    "Interval",
    "RandomEffects",
    "across_problems",
    "add_adjusted",
    "agreement_of_means",
    "agreement_of_rates",
    "as_it_is",
    "cells_across_problems",
    "cells_of",
    "logarithms_of_steps",
    "mean_interval",
    "paired_difference",
    "paired_rates",
    "random_effects",
    "ratio_of",
    "smallest_levels",
]

FloatArray = npt.NDArray[np.float64]
BoolArray = npt.NDArray[np.bool_]

_LEVEL = 0.95

_LARGEST_EXPONENT = 700.0


class Interval(NamedTuple):
    """An estimate with its 95 % interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.3g} [{self.low:.3g}, {self.high:.3g}]"


def mean_interval(values: FloatArray) -> Interval:
    """Return the mean of independent values with Student's interval.

    Parameters
    ----------
    values : array
        NaN for none, which is left out.

    Returns
    -------
    Interval
        NaN where there are no values; without bounds for a single one.
    """
    from scipy import stats

    values = values[~np.isnan(values)]
    if values.size == 0:
        return Interval(math.nan, math.nan, math.nan)
    mean = float(values.mean())
    if values.size == 1:
        return Interval(mean, -math.inf, math.inf)
    error = float(values.std(ddof=1)) / math.sqrt(values.size)
    half = float(stats.t.ppf(0.5 + 0.5 * _LEVEL, values.size - 1)) * error
    return Interval(mean, mean - half, mean + half)


def logarithms_of_steps(steps: FloatArray) -> FloatArray:
    """Return the logarithms of numbers of steps, whose paired differences are ratios.

    A trial that begins in the goal takes no step, whatever would have been sensed. So it takes none
    in any run of the same worlds: it has no ratio, and says nothing about how runs differ. It is
    left out, here as NaN. A constant added to all numbers would keep it, but would draw the ratios
    of all other trials towards 1.

    Parameters
    ----------
    steps : array
        Not negative.

    Returns
    -------
    array
        NaN where there is no step.
    """
    return np.log(np.where(steps == 0.0, math.nan, steps))


def paired_difference(first: FloatArray, second: FloatArray) -> tuple[Interval, float]:
    """Return the mean of ``first - second`` over the same trials, and how likely it is by chance.

    Parameters
    ----------
    first, second : array of shape (trials,)
        NaN in both for a trial that is left out.

    Returns
    -------
    Interval
        NaN if no trial is left.
    p_value : float
        Of Student's paired test, two-sided; 1 if all differences are zero, NaN for a single pair
        or none. If all are equal otherwise, they say nothing about how they scatter: that of the
        sign test.

    Raises
    ------
    InvalidValueError
        If they are not as many, or one of a pair alone is NaN.
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
    if difference.size == 0:
        return mean_interval(difference), math.nan
    if not np.any(difference):
        return Interval(0.0, 0.0, 0.0), 1.0
    interval = mean_interval(difference)
    if difference.size == 1:
        return interval, math.nan
    error = float(difference.std(ddof=1)) / math.sqrt(difference.size)
    if error == 0.0:
        return interval, 2.0 * 0.5**difference.size
    return interval, float(2.0 * stats.t.sf(abs(interval.value) / error, difference.size - 1))


def paired_rates(first: BoolArray, second: BoolArray) -> tuple[Interval, float]:
    """Return the difference of two rates over the same trials, and how likely it is by chance.

    Returns
    -------
    Interval
        By Student's interval of the differences of single trials.
    p_value : float
        Of McNemar's exact test: of the trials in which one alone succeeded, each is as likely to be
        the first's as the second's.
    """
    from scipy import stats

    interval, _ = paired_difference(first.astype(np.float64), second.astype(np.float64))
    first_alone = int(np.count_nonzero(first & ~second))
    either_alone = int(np.count_nonzero(first != second))
    if either_alone == 0:
        return interval, 1.0
    return interval, float(stats.binomtest(first_alone, either_alone).pvalue)


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
    """What an effect is over problems of which those that were tried are a sample.

    Attributes
    ----------
    mean : Interval
        Mean of the effects over all such problems.
    p_value : float
        That this mean is zero.
    deviation : float
        Standard deviation of the effects between problems.
    new_problem : Interval
        The mean with the interval in which the effect of one more problem lies.
    """

    mean: Interval
    p_value: float
    deviation: float
    new_problem: Interval


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

    Parameters
    ----------
    effects : array of shape (problems,)
    errors : array of shape (problems,)
        Their standard errors, above zero.

    Raises
    ------
    InvalidValueError
        For fewer than three problems, or an error that is not above zero.
    """
    from scipy import stats

    count = effects.size
    if count < 3 or errors.shape != effects.shape or not np.all(errors > 0.0):
        raise InvalidValueError(
            f"{count} effects with errors {errors}: at least 3, each with an error above zero"
        )
    own = errors * errors

    def scatter(variance: float) -> float:
        weights = 1.0 / (own + variance)
        mean = float(weights @ effects / weights.sum())
        return float(weights @ (effects - mean) ** 2)

    between = 0.0
    if scatter(0.0) > count - 1:
        low, high = 0.0, float(np.var(effects, ddof=1)) + float(own.max())
        while scatter(high) > count - 1:
            low, high = high, 2.0 * high
        for _ in range(200):
            between = 0.5 * (low + high)
            low, high = (between, high) if scatter(between) > count - 1 else (low, between)
    weights = 1.0 / (own + between)
    mean = float(weights @ effects / weights.sum())
    error = 1.0 / math.sqrt(float(weights.sum()))
    half = float(stats.t.ppf(0.5 + 0.5 * _LEVEL, count - 1)) * error
    wide = float(stats.t.ppf(0.5 + 0.5 * _LEVEL, count - 2)) * math.hypot(math.sqrt(between), error)
    return RandomEffects(
        Interval(mean, mean - half, mean + half),
        float(2.0 * stats.t.sf(abs(mean) / error, count - 1)),
        math.sqrt(between),
        Interval(mean, mean - wide, mean + wide),
    )


def across_problems(
    pairs: Sequence[tuple[FloatArray, FloatArray]], least_difference: float
) -> RandomEffects:
    """Return how two ways differ over problems, from their trials in some of them.

    Parameters
    ----------
    pairs : sequence of (array, array)
        Of each problem: a number of each trial, of one way and of the other; NaN in both for a
        trial that is left out.
    least_difference : float
        By which two trials can differ. Where no trial differs, the error is that of Agresti and
        Min's estimate ("Simple improved confidence intervals for comparing matched proportions",
        2005), which adds half a pair that differs in either direction; no error is below that.
    """
    effects, errors = [], []
    for first, second in pairs:
        difference = (first - second)[~np.isnan(first)]
        least = least_difference / (difference.size + 2)
        scatter = float(difference.std(ddof=1)) if difference.size > 1 else 0.0
        effects.append(float(difference.mean()))
        errors.append(max(least, scatter / math.sqrt(difference.size)))
    return random_effects(np.array(effects), np.array(errors))


def as_it_is(difference: Interval) -> Interval:
    """Return a difference that is shown as such."""
    return difference


def cells_across_problems(
    pairs: Sequence[tuple[FloatArray, FloatArray]],
    least_difference: float,
    shown: Callable[[Interval], Interval],
) -> dict[str, Cell]:
    """Return the cells of how two ways differ over these problems, and over all such problems.

    Parameters
    ----------
    pairs : sequence of (array, array)
        Of each problem: a number of each trial, of one way and of the other.
    least_difference : float
        See :func:`across_problems`.
    shown : callable
        What is shown of a difference.

    Returns
    -------
    dict
        ``mean``: over these problems, of the trials that all have; ``expected``: over all such
        problems; ``new_problem``: in one more; ``deviation_between_problems`` as a difference.
    """
    fewest = min(own.size for own, _ in pairs)
    own, other = (np.mean([pair[which][:fewest] for pair in pairs], axis=0) for which in (0, 1))
    mean, p_value = paired_difference(own, other)
    found = across_problems(pairs, least_difference)
    new_low, new_high = shown(found.new_problem)[1:]
    return {
        "trials": fewest,
        **cells_of("mean", shown(mean)),
        "mean_p_value": p_value,
        "problems": len(pairs),
        **cells_of("expected", shown(found.mean)),
        "expected_p_value": found.p_value,
        "deviation_between_problems": found.deviation,
        "new_problem_low": new_low,
        "new_problem_high": new_high,
    }


def cells_of(name: str, interval: Interval) -> dict[str, float | None]:
    """Return an interval as cells of a row: ``name``, ``name_low``, ``name_high``.

    A bound that does not exist, or the mean of nothing, is None.
    """
    ends = zip(("", "_low", "_high"), interval, strict=True)
    return {f"{name}{end}": value if math.isfinite(value) else None for end, value in ends}


def smallest_levels(p_values: FloatArray) -> FloatArray:
    """Return p-values that are adjusted for being many, by Holm's method.

    To call significant what is below a level here errs in no case at all with a probability of at
    most that level, whatever the tests' dependence.

    Source: S. Holm, "A simple sequentially rejective multiple test procedure", 1979.
    """
    order = np.argsort(p_values)
    count = p_values.size
    stepped = p_values[order] * (count - np.arange(count))
    adjusted = np.empty(count)
    adjusted[order] = np.minimum(np.maximum.accumulate(stepped), 1.0)
    return adjusted


def add_adjusted(table: Table, *columns: str, compared: BoolArray | None = None) -> None:
    """Add p-values that are adjusted for the number of rows (:func:`smallest_levels`).

    Parameters
    ----------
    table : Table
    *columns : str
        Those that have p-values; what is added to ``steps_p_value`` is ``steps_adjusted_p_value``.
    compared : array of shape (rows,), optional
        Which rows are compared with something; the others get 1. All if None.
    """
    rows = np.ones(table.num_rows, dtype=np.bool_) if compared is None else compared
    for column in columns:
        adjusted = np.ones(rows.size)
        adjusted[rows] = smallest_levels(table.numbers(column)[rows])
        name = f"{column.removesuffix('p_value')}adjusted_p_value"
        table.columns[name] = [float(value) for value in adjusted]
