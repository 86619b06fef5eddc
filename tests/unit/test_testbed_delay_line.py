"""Late and lost datagrams: what a line does to packets, and what it never does."""

from __future__ import annotations

import pytest

from holdfast.errors import InvalidValueError
from holdfast.lab.testbed.wide_area import DelayLine


class TestDelayLine:
    def test_everything_comes_later_and_in_order(self) -> None:
        line: DelayLine[int] = DelayLine(0.5, 0.0, "seed")
        assert line.due == float("inf")
        line.put(1, 10.0)
        line.put(2, 10.25)
        assert line.due == 10.5
        assert line.take(10.49) == []
        assert line.take(10.5) == [1]
        assert line.due == 10.75
        line.put(3, 10.6)
        assert line.take(20.0) == [2, 3]
        assert line.lost == 0

    def test_a_share_is_lost_and_the_seed_says_which(self) -> None:
        def arrived(seed: str) -> list[int]:
            line: DelayLine[int] = DelayLine(0.0, 0.2, seed, capacity=10_000)
            for number in range(10_000):
                line.put(number, 0.0)
            found = line.take(0.0)
            assert line.lost == 10_000 - len(found)
            return found

        found = arrived("a")
        # 2,000 expected, standard deviation 40: five of them, 6 in 10 million by chance, were the
        # seed not fixed.
        assert abs(10_000 - len(found) - 2000) < 200
        assert found == sorted(found) == arrived("a")
        assert found != arrived("b")

    def test_all_or_nothing(self) -> None:
        for loss, expected in ((0.0, 50), (1.0, 0)):
            line: DelayLine[int] = DelayLine(0.0, loss, "seed")
            for number in range(50):
                line.put(number, 0.0)
            assert len(line.take(0.0)) == expected

    def test_a_full_line_loses_what_comes(self) -> None:
        line: DelayLine[int] = DelayLine(1.0, 0.0, "seed", capacity=3)
        for number in range(5):
            line.put(number, 0.0)
        assert line.take(1.0) == [0, 1, 2]
        assert line.lost == 2

    @pytest.mark.parametrize(
        ("delay_s", "loss", "message"),
        [
            (-1.0, 0.0, "delay_s -1.0: must be from 0 to 60"),
            (float("nan"), 0.0, "delay_s nan"),
            (61.0, 0.0, "delay_s 61.0"),
            (0.0, 1.5, "loss 1.5: must be from 0 to 1"),
        ],
    )
    def test_what_is_out_of_bounds(self, delay_s: float, loss: float, message: str) -> None:
        with pytest.raises(InvalidValueError, match=message):
            DelayLine(delay_s, loss, "seed")
