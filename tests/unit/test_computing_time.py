"""How long computations are expected to take."""

import pytest

from holdfast.protocol.computing_time import _TYPICAL_INERTIA, ExpectedTime


def test_one_that_others_made_longer_counts_little_and_a_shorter_one_at_once() -> None:
    time = ExpectedTime()
    assert time.typical_s == float("inf")
    for computed_s in (0.004, 0.0003, 0.005):
        time.learn(computed_s)
    assert 0.0003 < time.typical_s < 0.001
    time.learn(0.0002)
    assert time.typical_s == 0.0002


def test_what_has_become_longer_is_known_to_be_after_a_while() -> None:
    time = ExpectedTime()
    time.learn(0.0003)
    for _ in range(20):
        time.learn(0.004)
    assert time.typical_s > 0.002


def test_the_mean_follows_and_one_outlier_moves_it_little() -> None:
    time = ExpectedTime(0.001)
    time.learn(60.0)
    assert time.mean_s == pytest.approx(0.001 + 0.013 / 8.0)
    for _ in range(80):
        time.learn(0.002)
    assert time.mean_s == pytest.approx(0.002, rel=1e-2)


def test_a_longer_one_moves_what_is_typical_by_a_part_of_the_difference() -> None:
    time = ExpectedTime(0.001)
    time.learn(0.004)
    assert time.typical_s == 0.004
    time.learn(0.012)
    grown = time.typical_s
    assert grown == pytest.approx(0.004 + 0.008 / _TYPICAL_INERTIA)
    time.learn(grown)
    assert time.typical_s == grown
