"""How long computations are expected to take."""

from __future__ import annotations

import pytest

from holdfast.protocol.expected_time import ExpectedTimes, TypicalTime


class TestTypicalTime:
    def test_one_that_others_made_longer_counts_little_and_a_shorter_one_at_once(self) -> None:
        typical = TypicalTime()
        assert typical.seconds == float("inf")
        for computed_s in (0.004, 0.0003, 0.005):
            typical.learn(computed_s)
        assert 0.0003 < typical.seconds < 0.001
        typical.learn(0.0002)
        assert typical.seconds == 0.0002

    def test_what_has_become_longer_is_known_to_be_after_a_while(self) -> None:
        typical = TypicalTime()
        typical.learn(0.0003)
        for _ in range(20):
            typical.learn(0.004)
        assert typical.seconds > 0.002

    @pytest.mark.parametrize("sensing", [True, False])
    def test_the_two_parts_of_an_answer_are_apart(self, *, sensing: bool) -> None:
        times = ExpectedTimes(4.0, 1e-3, 1e-3)
        times.learn(0.0003, sensing=sensing)
        typical = (times.typical_task, times.typical_sensing)
        assert {each.seconds for each in typical} == {0.0003, float("inf")}
        assert (times.typical_sensing.seconds == 0.0003) is sensing
