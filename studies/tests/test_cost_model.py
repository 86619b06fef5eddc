"""What a decision would take on other cores: known parts come back, and crossings are found."""

import math

import numpy as np
import pytest

from studies.cost_model import Curve, Scaling, break_even, busy_cores, parallel_share


def scaling(share: float = 0.9, pieces: int = 9) -> Scaling:
    """Return times of N / 1,000 ms, with 10 % to each side, of which a share is divided."""
    particles = np.array([100.0, 1000.0, 10_000.0, 100_000.0])
    shares = np.array([share, share - 0.1, min(share + 0.1, 1.0)])
    return Scaling(
        particles,
        np.outer([1.0, 0.9, 1.1], particles / 1000),
        np.tile(shares[:, np.newaxis], particles.size),
        pieces,
    )


def curve(particles: list[float], values: list[float]) -> Curve:
    return Curve(np.array(particles), np.array(values))


class TestShare:
    @pytest.mark.parametrize("serial", [0.0, 0.3, 5.0])
    @pytest.mark.parametrize("threads", [(1, 2), (1, 2, 4, 8)])
    def test_known_parts_come_back(self, serial: float, threads: tuple[int, ...]) -> None:
        divided = 2.0
        times = {number: serial + divided / number for number in threads}
        assert parallel_share(times) == pytest.approx(divided / (serial + divided))

    def test_it_stays_a_share(self) -> None:
        assert parallel_share({1: 1.0, 2: 1.2}) == 0.0
        assert parallel_share({1: 1.0, 2: 0.4}) == 1.0


def test_pieces_bound_the_gain() -> None:
    assert busy_cores(8, 9) == 4.5
    assert busy_cores(8, 16) == 8.0
    assert busy_cores(36, 30) == 30.0
    assert busy_cores(1, 30) == 1.0


class TestScaling:
    def test_deciding_ahead_hides_what_fits(self) -> None:
        # Elsewhere it always fits into 50 ms; here it takes N / 1,000 - 50 ms longer.
        found = break_even(scaling().saved_ms(1, 9, ahead_ms=50.0), 20.0)
        assert found == pytest.approx(70_000, 2e-3)
        assert scaling().saved_ms(1, 9, ahead_ms=101.0) is None
        assert math.isnan(break_even(None, 20.0))


class TestBreakEven:
    def test_no_crossing(self) -> None:
        assert math.isnan(break_even(curve([100.0, 1000.0], [1.0, 5.0]), 20.0))

    def test_it_can_be_before_the_first(self) -> None:
        assert break_even(curve([100.0, 1000.0], [30.0, 500.0]), 20.0) == 100.0

    def test_the_last_crossing_counts(self) -> None:
        crossing = curve([100.0, 1000.0, 10_000.0, 100_000.0], [1.0, 100.0, 1.0, 100.0])
        assert break_even(crossing, 10.0) == pytest.approx(10**4.5)


def test_a_curve_ends_where_it_was_measured() -> None:
    crossing = curve([100.0, 10_000.0], [1.0, 100.0])
    found = crossing.at(np.array([50.0, 100.0, 1000.0, 10_000.0, 20_000.0]))
    np.testing.assert_allclose(found, [np.nan, 1.0, 10.0, 100.0, np.nan])
