"""How the end of a process is told, and how soon the next one starts."""

import itertools
import signal

from holdfast.runtime.process_ends import how_it_ended, restart_delay_s, signal_name


def test_by_name_or_by_number() -> None:
    assert signal_name(signal.SIGKILL) == "SIGKILL"
    unnamed = signal.SIGRTMIN + 6
    assert signal_name(unnamed) == f"signal {unnamed:d}"


def test_an_exit_code_or_a_signal() -> None:
    assert how_it_ended(2) == "ended with exit code 2"
    assert how_it_ended(-signal.SIGKILL) == "was ended by SIGKILL"


def test_a_first_death_costs_nothing_and_later_ones_ever_more() -> None:
    delays = [restart_delay_s(early_ends, 1.0, 30.0) for early_ends in range(100)]
    assert delays[:4] == [0.0, 0.0, 1.0, 2.0]
    assert delays[-1] == 30.0
    assert all(one <= other for one, other in itertools.pairwise(delays))


def test_a_process_may_fail_for_days() -> None:
    # As an integer 2**1024 is no float any more.
    assert restart_delay_s(10_000, 0.2, 30.0) == 30.0
