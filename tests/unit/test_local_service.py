"""When the local service is launched again, and how often a late question is asked twice."""

import random

import pytest

from holdfast.planning.settings import OffloadSettings, RecoverySettings
from holdfast.protocol.local_service import HedgingBudget, RestartPolicy


class TestRestartPolicy:
    def test_a_process_that_answers_is_not_replaced(self) -> None:
        launches = RestartPolicy(RecoverySettings(relaunch_delay_ms=100.0))
        launches.want(0.0)
        assert launches.begin(0.0) == 1
        launches.failed(1.0)
        assert launches.is_due(1.0)
        launches.succeeded()
        assert not launches.pending
        assert not launches.is_due(10.0)

    @pytest.mark.parametrize("seed", range(20))
    def test_a_launch_is_overdue_when_it_was_said_to_be(self, seed: int) -> None:
        # On the bit: who is woken at the time that was asked for must find that it has come.
        draw = random.Random(seed)
        for _ in range(500):
            launches = RestartPolicy(RecoverySettings(launch_timeout_ms=draw.uniform(1.0, 5000.0)))
            now = draw.uniform(0.0, 10.0)
            launches.want(now)
            assert launches.is_due(now)
            launches.begin(now)
            at = launches.next_wakeup(present=False)
            assert at is not None
            assert launches.overdue_launch_age_s(at, present=False) is not None

    @pytest.mark.parametrize("begun_at", [0.0, 7.0])
    def test_a_long_life_makes_up_for_failures(self, begun_at: float) -> None:
        launches = RestartPolicy(RecoverySettings(relaunch_delay_ms=100.0))
        assert launches.appeared(begun_at) is None  # it was there before
        launches.want(begun_at)
        launches.failed(begun_at)
        launches.begin(begun_at)
        launches.failed(begun_at)
        launches.begin(begun_at)
        assert launches.appeared(begun_at + 1.0) == 1.0
        launches.ended(begun_at + 5.0)
        assert launches.is_due(begun_at + 5.0)  # at once, as after the first failure

    def test_a_short_life_does_not(self) -> None:
        launches = RestartPolicy(RecoverySettings(relaunch_delay_ms=100.0))
        launches.want(0.0)
        for _ in range(3):
            launches.begin(0.0)
            launches.ended(0.5)
        assert launches.next_wakeup(present=False) == pytest.approx(0.5 + 0.2)

    def test_a_long_start_is_no_long_life(self) -> None:
        launches = RestartPolicy(RecoverySettings(relaunch_delay_ms=500.0))
        launches.want(0.0)
        for _ in range(3):
            launches.begin(0.0)
            launches.appeared(4.0)
            launches.ended(4.0)
        assert launches.next_wakeup(present=False) == 4.0 + 1.0

    def test_one_that_was_not_seen_in_time_gets_more_time_the_next_time(self) -> None:
        """On a machine where a start takes longer than the limit, one comes up nevertheless."""
        launches = RestartPolicy(RecoverySettings(launch_timeout_ms=5000.0))
        allowed_s = []
        now = 0.0
        for _ in range(6):
            launches.begin(now)
            overdue_at = launches.next_wakeup(present=False)
            assert overdue_at is not None
            assert launches.overdue_launch_age_s(overdue_at - 0.001, present=False) is None
            assert launches.overdue_launch_age_s(overdue_at, present=False) is not None
            allowed_s.append(overdue_at - now)
            now = overdue_at
            launches.failed(now, late=True)
        assert allowed_s == [5.0, 10.0, 20.0, 40.0, 40.0, 40.0]
        launches.succeeded()
        launches.begin(now)
        assert launches.next_wakeup(present=False) == now + 5.0

    def test_one_that_has_ended_gets_no_more_time(self) -> None:
        launches = RestartPolicy(RecoverySettings(launch_timeout_ms=5000.0))
        for _ in range(3):
            launches.begin(0.0)
            launches.ended(0.5)
        launches.begin(1.0)
        assert launches.next_wakeup(present=False) == 6.0

    def test_pauses_double_up_to_a_factor_of_32(self) -> None:
        launches = RestartPolicy(RecoverySettings(relaunch_delay_ms=100.0))
        assert launches.next_wakeup(present=False) is None  # nothing is wanted yet
        assert launches.overdue_launch_age_s(1e9, present=False) is None
        launches.want(0.0)
        pauses = []
        for _ in range(9):
            launches.begin(0.0)
            launches.failed(10.0)
            launches.failed(11.0)  # one that is to be launched cannot fail
            due = launches.next_wakeup(present=False)
            assert due is not None
            pauses.append(round(due - 10.0, 9))
        assert pauses == [0.0, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 3.2, 3.2]

    def test_a_life_of_a_second_is_none_yet(self) -> None:
        for lived_s, pause_s in ((1.0, 0.2), (1.125, 0.0)):
            launches = RestartPolicy(RecoverySettings(relaunch_delay_ms=100.0))
            for _ in range(2):
                launches.begin(0.0)
                launches.failed(0.0)
            launches.begin(0.0)
            launches.appeared(4.0)
            launches.ended(4.0 + lived_s)
            assert launches.next_wakeup(present=False) == 4.0 + lived_s + pause_s


def test_a_question_is_late_after_the_deadline_if_the_robot_waits_for_it() -> None:
    budget = HedgingBudget(OffloadSettings(decision_deadline_ms=20.0))
    assert budget.due_at(1.0) == pytest.approx(1.02)
    assert budget.due_at(None) is None
    assert HedgingBudget(OffloadSettings()).due_at(1.0) is None


def test_in_the_long_run_the_share_of_hedges_is_bounded() -> None:
    budget = HedgingBudget(OffloadSettings(decision_deadline_ms=20.0, max_hedged_share=0.25))
    asked = 1.0
    hedges = 0
    for _ in range(400):
        budget.earn()
        if budget.due_at(asked) is not None:
            budget.spend()
            hedges += 1
    assert 100 <= hedges <= 103
