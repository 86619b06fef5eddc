"""When a run that has ended is started again."""

import signal

import pytest

from holdfast.cli.restart import ends_for_good


@pytest.mark.parametrize("code", [0, 3, 5, 128 + 1, 128 + 2, 128 + 15])
def test_what_a_person_has_to_look_at_or_has_ended_is_not_started_again(code: int) -> None:
    assert ends_for_good(code)


@pytest.mark.parametrize("code", [1, 2, 4, 128 + 9, -signal.SIGKILL, -signal.SIGSEGV])
def test_a_death_and_a_failure_are_not_the_end(code: int) -> None:
    assert not ends_for_good(code)
