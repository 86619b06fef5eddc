"""When a run that has ended is started again, and how soon."""

from __future__ import annotations

import itertools
import signal

import pytest

from holdfast.cli.restart import delay_before, ends_for_good


@pytest.mark.parametrize("code", [0, 3, 5, 128 + 1, 128 + 2, 128 + 15])
def test_what_a_person_has_to_look_at_or_has_ended_is_not_started_again(code: int) -> None:
    assert ends_for_good(code)


@pytest.mark.parametrize("code", [1, 2, 4, 128 + 9, -signal.SIGKILL, -signal.SIGSEGV])
def test_a_death_and_a_failure_are_not_the_end(code: int) -> None:
    assert not ends_for_good(code)


def test_a_first_death_costs_nothing_and_later_ones_ever_more() -> None:
    delays = [delay_before(early_ends) for early_ends in range(100)]
    assert delays[:4] == [0.0, 0.0, 1.0, 2.0]
    assert delays[-1] == 30.0
    assert all(one <= other for one, other in itertools.pairwise(delays))
