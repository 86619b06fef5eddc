"""Samples against likelihood: how often a right problem is accused, and what a wrong one needs."""

import numpy as np
from tests.unit.test_problem_check import Rover

from holdfast.planning.settings import PlanningSettings
from holdfast.tuning.calibration_check import check_likelihoods, remedy_of, uniform_p
from holdfast.tuning.findings import FALSE_ALARM_RATE, Finding, Inspection


def least_p(seed: int) -> float:
    """Return the least p-value of all tests of a right problem, times their number."""
    least: list[float] = []

    class Noted(Inspection):
        def test(self, p: float, check: str, seen: str, advice: str) -> None:
            least.append(p)

    inspection = Noted(Rover(), PlanningSettings(), 100, seed, 1e6)
    check_likelihoods(inspection)
    return min(least) * len(least)


def test_the_false_alarm_rate_is_kept() -> None:
    # By Bonferroni each is below 0.2 with a probability of at most 0.2: of 40, more than 18 with
    # one below 1e-4.
    assert sum(least_p(seed) < 0.2 for seed in range(40)) <= 18


def test_p_values_of_uniform_numbers_are_uniform() -> None:
    generator = np.random.default_rng(1)
    p = np.array([uniform_p(generator.random(100)) for _ in range(400)])
    # Of 400, 40 are expected below 0.1; 5 standard deviations are 30.
    assert 10 <= (p < 0.1).sum() <= 70
    # Tables: the distance is 0.134 with a probability of 0.05, for n = 100.
    assert abs(uniform_p(np.clip(np.arange(0.5, 100.0) / 100.0 + 0.129, 0.0, 1.0)) - 0.05) < 0.005


def test_each_test_has_its_share_of_the_false_alarms() -> None:
    def judged(*values: float) -> list[Finding]:
        inspection = Inspection(Rover(), PlanningSettings(), 100, 0, 10.0)
        for number, p in enumerate(values):
            inspection.test(p, "likelihood", f"{number}: seen", "do")
        inspection.judge_tests()
        return [each for each in inspection.findings if each.severity == "error"]

    assert judged(*[1.0] * 9, 1.1 * FALSE_ALARM_RATE / 10) == []
    (found,) = judged(*[1.0] * 9, 0.9 * FALSE_ALARM_RATE / 10)
    assert found.seen == "9: seen (p = 9e-05, of 10 tests)"


def test_remedies() -> None:
    generator = np.random.default_rng(2)
    states = generator.normal(size=(200, 100))
    truths = generator.integers(100, size=200)
    shown = states[np.arange(200), truths] + 0.3 * generator.normal(size=200)
    right = -0.5 * ((shown[:, np.newaxis] - states) / 0.3) ** 2
    assert remedy_of(right, truths) is None
    three = np.arange(100) % 3
    named = np.where(generator.random(200) < 0.5, truths % 3, generator.integers(3, size=200))
    for wrong, words in (
        (np.exp(right), "logarithm"),
        (np.where(named[:, np.newaxis] == three, 2 / 3, 1 / 6), "logarithm"),
        (-right, "other sign"),
        (right * 9.0, "times as wide"),
        (right / 9.0, "times as wide"),
    ):
        remedy = remedy_of(wrong, truths)
        assert remedy is not None
        assert words in remedy[0]
