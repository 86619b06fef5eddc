"""Intervals and tests: against closed forms, and how often they err."""

import math

import numpy as np
import pytest
from scipy import stats

from holdfast.errors import InvalidValueError
from holdfast.journal.tables import wilson_interval
from studies import statistics


def test_mean_interval_is_students() -> None:
    values = np.array([1.0, 2.0, 4.0, np.nan, 5.0])
    interval = statistics.mean_interval(values)
    low, high = stats.t.interval(0.95, 3, loc=3.0, scale=stats.sem([1.0, 2.0, 4.0, 5.0]))
    assert interval == pytest.approx((3.0, low, high))


def test_mean_interval_of_few() -> None:
    assert all(math.isnan(number) for number in statistics.mean_interval(np.array([np.nan])))
    assert statistics.mean_interval(np.array([2.0])) == (2.0, -math.inf, math.inf)


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    # 2,000 intervals of 95 %: fewer than 1,850 or more than 1,950 of them have a probability below
    # 1e-6 (binomial).
    samples = np.random.default_rng(3).normal(1.0, 2.0, size=(2000, 12))
    held = sum(each.low <= 1.0 <= each.high for each in map(statistics.mean_interval, samples))
    assert 1850 <= held <= 1950


def test_paired_difference_takes_the_worlds_out() -> None:
    generator = np.random.default_rng(5)
    worlds = generator.normal(0.0, 100.0, size=400)
    first = worlds + 1.0 + generator.normal(0.0, 1.0, size=400)
    interval, p_value = statistics.paired_difference(first, worlds)
    assert interval.low < 1.0 < interval.high
    assert interval.high - interval.low < 0.25
    assert p_value < 1e-9
    assert statistics.paired_difference(worlds, worlds) == ((0.0, 0.0, 0.0), 1.0)
    with pytest.raises(InvalidValueError, match="400 and 399"):
        statistics.paired_difference(worlds, worlds[1:])


def test_trials_that_begin_in_the_goal_do_not_take_part_in_ratios() -> None:
    """They take no step whatever is sensed, and have no ratio."""
    first = np.array([0.0, 12.0, 20.0, 0.0, 9.0])
    second = np.array([0.0, 24.0, 30.0, 0.0, 18.0])
    moved = first > 0.0
    found = statistics.paired_difference(statistics.log_steps(first), statistics.log_steps(second))
    assert found == statistics.paired_difference(np.log(first[moved]), np.log(second[moved]))
    assert found[0].low < math.log(0.55) < found[0].high
    assert 0.0 < found[1] < 0.05
    # Where no step is taken at all there is nothing to compare, which is not the same as no
    # difference.
    interval, p_value = statistics.paired_difference(
        *(statistics.log_steps(np.zeros(3)) for _ in range(2))
    )
    assert all(map(math.isnan, (*interval, p_value)))


def test_the_same_world_begins_in_the_goal_for_both() -> None:
    first, second = (statistics.log_steps(np.array(steps)) for steps in ([3.0, 0.0], [3.0, 5.0]))
    with pytest.raises(InvalidValueError, match="pair 1 has one number"):
        statistics.paired_difference(first, second)


def test_paired_rates_are_mcnemars() -> None:
    first = np.array([True] * 8 + [False] + [True] * 50)
    second = np.array([False] * 8 + [True] + [True] * 50)
    interval, p_value = statistics.paired_rates(first, second)
    assert interval.value == pytest.approx(7 / 59)
    # Of 9 trials 8 go one way: 2 (1 + 9) / 2^9.
    assert p_value == pytest.approx(20 / 512)
    assert statistics.paired_rates(first, first)[1] == 1.0


def test_agreement() -> None:
    assert statistics.agreement_of_rates(810, 1000, 809, 1000) > 0.9
    assert statistics.agreement_of_rates(900, 1000, 809, 1000) < 1e-7
    values = np.linspace(-10.0, 10.0, 801)
    assert statistics.agreement_of_means(values, 0.0, 800) == pytest.approx(1.0)
    assert statistics.agreement_of_means(values, 3.0, 800) < 1e-9
    assert math.isnan(statistics.agreement_of_means(values[:1], 0.0, 800))


def test_the_difference_of_two_rates_has_newcombes_interval() -> None:
    # The first example of Newcombe's table II (1998): 56 of 70 and 48 of 80.
    first, second = (
        statistics.Interval(successes / trials, *wilson_interval(successes, trials))
        for successes, trials in ((56, 70), (48, 80))
    )
    assert statistics.independent_difference(first, second) == pytest.approx(
        (0.2, 0.0524, 0.3339), abs=5e-5
    )


def test_holm_are_holms() -> None:
    # In order 0.01, 0.02, 0.03, 0.5: times 4, 3, 2, 1, and never less than the one before.
    np.testing.assert_allclose(
        statistics.holm(np.array([0.03, 0.5, 0.01, 0.02])), [0.06, 0.5, 0.04, 0.06]
    )
    assert statistics.holm(np.array([0.9, 0.8])).max() == 1.0


def test_means_of_equal_values_are_not_compared() -> None:
    assert math.isnan(statistics.agreement_of_means(np.full(3, -2.0), -2.5, 800))
    assert math.isnan(statistics.agreement_of_means(np.array([-2.0]), -2.5, 800))


def test_ratios_of_differences_of_logarithms() -> None:
    difference = statistics.Interval(math.log(0.5), math.log(0.25), math.log(2.0))
    assert statistics.ratio_of(difference) == pytest.approx((0.5, 0.25, 2.0))
    assert statistics.cells_of(
        "ratio", statistics.ratio_of(statistics.Interval(0.0, -math.inf, 1e6))
    ) == {"ratio": 1.0, "ratio_low": 0.0, "ratio_high": pytest.approx(math.exp(700.0))}
    missing = statistics.cells_of("mean", statistics.Interval(math.nan, -math.inf, math.inf))
    assert list(missing) == ["mean", "mean_low", "mean_high"]
    assert all(map(math.isnan, missing.values()))  # type: ignore[arg-type]


EFFECTS = np.array([0.61, 0.10, -0.23, 0.18, 0.05, 0.72, 0.30, 0.44])
ERRORS = np.array([0.11, 0.09, 0.14, 0.20, 0.06, 0.08, 0.10, 0.31])


@pytest.mark.parametrize("spread", [1.0, 0.1])
def test_random_effects_are_those_of_statsmodels(spread: float) -> None:
    """Where problems differ, and where they differ no more than their errors."""
    meta_analysis = pytest.importorskip("statsmodels.stats.meta_analysis")
    effects = spread * EFFECTS
    found = statistics.random_effects(effects, ERRORS)
    theirs = meta_analysis.combine_effects(
        effects, ERRORS**2, method_re="iterated", use_t=True, atol=1e-14, maxiter=1000
    )
    assert found.deviation == pytest.approx(math.sqrt(max(theirs.tau2, 0.0)), abs=1e-6)
    assert (found.deviation > 0.0) == (spread == 1.0)
    assert found.mean.value == pytest.approx(theirs.mean_effect_re, rel=1e-6)
    error = max(theirs.sd_eff_w_re, theirs.sd_eff_w_re_hksj)
    half = stats.t.ppf(0.975, EFFECTS.size - 1) * error
    assert found.mean.high - found.mean.value == pytest.approx(half, rel=1e-5)
    assert found.p_value == pytest.approx(
        2.0 * stats.t.sf(abs(theirs.mean_effect_re) / error, EFFECTS.size - 1), rel=1e-4
    )
    wide = stats.t.ppf(0.975, EFFECTS.size - 2) * math.sqrt(max(theirs.tau2, 0.0) + error**2)
    assert found.new_problem.high - found.mean.value == pytest.approx(wide, rel=1e-5)


def test_intervals_over_problems_hold_what_they_promise() -> None:
    """2,000 drawn samples of eight problems, with one more problem each."""
    generator = np.random.default_rng(17)
    runs, covered, predicted = 2000, 0, 0
    for _ in range(runs):
        errors = generator.uniform(0.05, 0.3, size=8)
        effects = 0.5 + 0.3 * generator.normal(size=8) + errors * generator.normal(size=8)
        found = statistics.random_effects(effects, errors)
        covered += found.mean.low < 0.5 < found.mean.high
        predicted += found.new_problem.low < 0.5 + 0.3 * generator.normal() < found.new_problem.high
    # The promise is 95 % and an approximation; with 2,000 runs, 2.5 points are five deviations.
    assert covered / runs == pytest.approx(0.95, abs=0.025)
    assert predicted / runs == pytest.approx(0.95, abs=0.035)


def test_problems_in_which_nothing_differs_have_an_error_too() -> None:
    same = np.ones(98)
    half = np.repeat([0.0, 1.0], 49)
    found = statistics.across_problems([(same, same), (same, same), (same, half)], 1.0)
    assert found.deviation > 0.1
    assert found.new_problem.low < found.mean.low < found.mean.value < found.mean.high
    found = statistics.across_problems([(same, same)] * 3, 1.0)
    # Three errors of 1 / 100.
    assert found.mean.high == pytest.approx(stats.t.ppf(0.975, 2) * 0.01 / math.sqrt(3.0))
    assert found.p_value == 1.0
    with pytest.raises(InvalidValueError, match="2 effects"):
        statistics.across_problems([(same, same)] * 2, 1.0)
