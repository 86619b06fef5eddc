"""What a decision would take on other cores: known parts come back, and crossings are found."""

import math

import numpy as np
import pytest

from holdfast.errors import InvalidValueError
from holdfast.lab.studies.cost_model import (
    Curve,
    Scaling,
    break_even,
    busy_cores,
    parallel_share,
    power_law,
)
from holdfast.lab.studies.statistics import Interval


def scaling(share: float = 0.9, pieces: int | None = None) -> Scaling:
    """Return times of N / 1,000 ms, with 10 % to each side, of which a share is divided."""
    particles = (100, 1000, 10_000, 100_000)
    return Scaling(
        particles,
        tuple(Interval(n / 1000, 0.9 * n / 1000, 1.1 * n / 1000) for n in particles),
        tuple(Interval(share, share - 0.1, min(share + 0.1, 1.0)) for _ in particles),
        pieces,
    )


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

    @pytest.mark.parametrize(
        ("times", "message"),
        [
            ({2: 1.0}, "1 and one more"),
            ({1: 1.0}, "1 and one more"),
            ({1: 1.0, 2: 0.0}, "positive"),
        ],
    )
    def test_too_little_is_refused(self, times: dict[int, float], message: str) -> None:
        with pytest.raises(InvalidValueError, match=message):
            parallel_share(times)


def test_pieces_bound_the_gain() -> None:
    assert busy_cores(8, 9) == 4.5
    assert busy_cores(8, 16) == 8.0
    assert busy_cores(36, 30) == 30.0
    assert busy_cores(36, None) == 36.0
    assert busy_cores(1, 30) == 1.0
    with pytest.raises(InvalidValueError, match="0 cores"):
        busy_cores(0, None)


class TestPowerLaw:
    def test_known_laws_come_back(self) -> None:
        sizes = np.array([10.0, 100.0, 1000.0])
        factor, exponent = power_law(sizes, 3.0 * sizes**1.4)
        assert factor == pytest.approx(3.0)
        assert exponent == pytest.approx((1.4, 1.4, 1.4), abs=1e-6)
        _, (value, low, high) = power_law(sizes[:2], sizes[:2])
        assert value == pytest.approx(1.0)
        assert (low, high) == (-math.inf, math.inf)

    def test_the_interval_holds_the_exponent_as_often_as_it_says(self) -> None:
        generator = np.random.default_rng(11)
        sizes = np.geomspace(10.0, 1e5, 8)
        held = 0
        for noise in generator.normal(0.0, 0.3, size=(1000, 8)):
            _, exponent = power_law(sizes, sizes**1.2 * np.exp(noise))
            held += exponent.low <= 1.2 <= exponent.high
        # Below 915 or above 980 of 1,000 at 95 %: probability below 1e-5 (binomial).
        assert 915 <= held <= 980

    def test_what_has_no_logarithm_is_refused(self) -> None:
        with pytest.raises(InvalidValueError, match="1 sizes"):
            power_law(np.array([2.0, 2.0]), np.array([1.0, 1.0]))
        with pytest.raises(InvalidValueError, match="positive"):
            power_law(np.array([1.0, 2.0]), np.array([0.0, 1.0]))


class TestScaling:
    def test_cores_shorten_their_part(self) -> None:
        assert scaling().on_cores(1).values == pytest.approx((0.1, 1.0, 10.0, 100.0))
        assert scaling().on_cores(9).values == pytest.approx((0.02, 0.2, 2.0, 20.0))
        assert scaling(pieces=10).on_cores(9).values[1] == pytest.approx(0.1 + 0.9 / 5.0)

    def test_the_band_holds_the_line(self) -> None:
        least, most = scaling(pieces=10).band(9)
        line = scaling(pieces=10).on_cores(9)
        assert least.values == pytest.approx([n / 9000 for n in line.particles])
        assert most.values == pytest.approx([n / 1000 * (0.2 + 0.8 / 5) for n in line.particles])
        assert all(low < x < high for low, x, high in zip(least[1], line[1], most[1], strict=True))

    def test_the_break_even_of_known_curves(self) -> None:
        # 0.9 (1 - 1/9) N / 1,000 ms are saved, so 20 ms at 25,000 particles.
        assert break_even(scaling().saved_ms(1, 9), 20.0).particles == pytest.approx(25_000, 1e-3)
        # With 2 cores against 18: 0.9 (1/2 - 1/18).
        found = break_even(scaling().saved_ms(2, 18), 20.0)
        assert found.particles == pytest.approx(50_000, 1e-3)
        ends = [break_even(each.saved_ms(1, 9), 20.0).particles for each in scaling().bounds()]
        assert ends == pytest.approx(
            [20 / (0.9 * 0.8 * 8 / 9) * 1e3, 20 / (1.1 * 8 / 9) * 1e3, 20 / (8 / 9) * 1e3], 1e-3
        )

    def test_deciding_ahead_hides_what_fits(self) -> None:
        # Elsewhere it always fits into 50 ms; here it takes N / 1,000 - 50 ms longer.
        found = break_even(scaling().saved_ms(1, 9, ahead_ms=50.0), 20.0)
        assert found.particles == pytest.approx(70_000, 2e-3)
        assert scaling().saved_ms(1, 9, ahead_ms=101.0) is None
        assert break_even(None, 20.0).particles is None


class TestBreakEven:
    def test_no_crossing_is_said(self) -> None:
        below = Curve((100.0, 1000.0), (1.0, 5.0))
        found = break_even(below, 20.0)
        assert found.particles is None
        assert found.words == "not up to 1,000 particles, where 5 ms are saved and 20 ms paid"
        assert break_even(None, 20.0) == (
            None,
            "not within what was measured: nothing is saved there",
        )

    def test_it_can_be_before_the_first(self) -> None:
        above = Curve((100.0, 1000.0), (30.0, 500.0))
        assert break_even(above, 20.0) == (100.0, "at 100 particles or fewer")

    def test_the_last_crossing_counts(self) -> None:
        curve = Curve((100.0, 1000.0, 10_000.0, 100_000.0), (1.0, 100.0, 1.0, 100.0))
        found = break_even(curve, 10.0)
        assert found.particles == pytest.approx(10**4.5)
        assert found.words == "from 32,000 particles on"

    def test_a_path_costs_something(self) -> None:
        with pytest.raises(InvalidValueError, match="0 ms: must be positive"):
            break_even(None, 0)


def test_a_curve_ends_where_it_was_measured() -> None:
    curve = Curve((100.0, 10_000.0), (1.0, 100.0))
    found = curve.at(np.array([50.0, 100.0, 1000.0, 10_000.0, 20_000.0]))
    np.testing.assert_allclose(found, [np.nan, 1.0, 10.0, 100.0, np.nan])
