"""The small parts of both machines, each alone: launches, late replies, lines of work."""

from __future__ import annotations

import random

import pytest
from tests.unit.test_session_service import Robot, make_problem

from holdfast.session.known_services import KnownService, KnownServices
from holdfast.session.launches import Launches
from holdfast.session.messages import Request, pack_opening
from holdfast.session.service_jobs import Job
from holdfast.session.service_limits import ServiceLimits
from holdfast.session.service_lines import Lines
from holdfast.session.service_sessions import ExpectedTimes, Session, Work
from holdfast.session.usual_time import UsualTime
from holdfast.settings import RecoverySettings


class TestLateReplies:
    """Of a service that is further away than the timeout is long."""

    @staticmethod
    def heard(*calls: tuple[float, float]) -> list[float | None]:
        service = KnownService("cloud", 0.25, late_after_s=0.25)
        return [service.note_first_reply(sent_at, now) for sent_at, now in calls]

    def test_the_third_in_a_row_is_told_once(self) -> None:
        calls = [(float(turn), turn + 0.4 - 0.01 * turn) for turn in range(9)]
        told = self.heard(*calls)
        assert told[2] == pytest.approx(0.38)
        assert [each for each in told if each is not None] == [told[2]]

    def test_one_in_time_begins_anew(self) -> None:
        late, in_time = [(0.0, 0.4), (1.0, 1.4)], [(2.0, 2.25)]
        assert self.heard(*late, *in_time, *late) == [None] * 5

    def test_what_waited_for_the_same_thing_counts_once(self) -> None:
        """A service stood still for a second, and then replies to all that it was asked."""
        assert self.heard(*((0.25 * call, 1.1) for call in range(4))) == [None] * 4

    def test_the_local_service_is_near(self) -> None:
        services = KnownServices(["cloud"], "local", 0.25)
        assert services.cloud[0].late_after_s == 0.25
        assert services.local is not None
        assert [services.local.note_first_reply(0.0, 9.0) for _ in range(9)] == [None] * 9


def test_a_busy_service_is_asked_again_soon_whatever_it_says() -> None:
    service = KnownService("cloud", 0.25)
    assert service.note_busy(2.0, 10.0) == 2.0
    assert service.note_busy(4_294_967.295, 10.0) == 5.0
    assert not service.usable(14.9)
    service.detector.appeared("b1")
    assert service.usable(15.0)


class TestLaunches:
    def test_a_process_that_answers_is_not_replaced(self) -> None:
        launches = Launches(RecoverySettings(relaunch_delay_ms=100.0))
        launches.want(0.0)
        launches.begin(0.0)
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
            launches = Launches(RecoverySettings(launch_timeout_ms=draw.uniform(1.0, 5000.0)))
            now = draw.uniform(0.0, 10.0)
            launches.want(now)
            assert launches.is_due(now)
            launches.begin(now)
            at = launches.next_wakeup(present=False)
            assert at is not None
            assert launches.overdue_s(at, present=False) is not None

    @pytest.mark.parametrize("begun_at", [0.0, 7.0])
    def test_a_long_life_makes_up_for_failures(self, begun_at: float) -> None:
        launches = Launches(RecoverySettings(relaunch_delay_ms=100.0))
        launches.want(begun_at)
        launches.failed(begun_at)
        launches.begin(begun_at)
        launches.failed(begun_at)
        launches.begin(begun_at)
        launches.ended(begun_at + 5.0)
        assert launches.is_due(begun_at + 5.0)  # at once, as after the first failure

    def test_a_short_life_does_not(self) -> None:
        launches = Launches(RecoverySettings(relaunch_delay_ms=100.0))
        launches.want(0.0)
        for _ in range(3):
            launches.begin(0.0)
            launches.ended(0.5)
        assert launches.next_wakeup(present=False) == pytest.approx(0.5 + 0.2)

    def test_one_that_was_not_seen_in_time_gets_more_time_the_next_time(self) -> None:
        """On a machine where a start takes longer than the limit, one comes up nevertheless."""
        launches = Launches(RecoverySettings(launch_timeout_ms=5000.0))
        allowed_s = []
        now = 0.0
        for _ in range(6):
            launches.begin(now)
            overdue_at = launches.next_wakeup(present=False)
            assert overdue_at is not None
            assert launches.overdue_s(overdue_at - 0.001, present=False) is None
            assert launches.overdue_s(overdue_at, present=False) is not None
            allowed_s.append(overdue_at - now)
            now = overdue_at
            launches.gave_up(now)
        assert allowed_s == [5.0, 10.0, 20.0, 40.0, 40.0, 40.0]
        launches.succeeded()
        launches.begin(now)
        assert launches.next_wakeup(present=False) == now + 5.0

    def test_one_that_has_ended_gets_no_more_time(self) -> None:
        launches = Launches(RecoverySettings(launch_timeout_ms=5000.0))
        for _ in range(3):
            launches.begin(0.0)
            launches.ended(0.5)
        launches.begin(1.0)
        assert launches.next_wakeup(present=False) == 6.0


class TestLines:
    """One worker; works named by the order in which they came."""

    def setup_method(self) -> None:
        self.lines = Lines(1, ServiceLimits(prefetch_patience_ms=20.0))
        self.now = 0.0

    def session(self, key: int) -> Session:
        robot = Robot(key=key)
        request = robot.request()
        return Session(
            (None, request.session), request, robot.opening, 1, ExpectedTimes(4.0, 0.001, 0.001)
        )

    def work(self, session: Session, name: bytes, since: float, *, prefetched: bool) -> Work:
        request: Request | None = None if prefetched else Robot().request()
        work = Work(session, name, sensing=True, request=request, state=None, size=10, since=since)
        self.lines.line_up(work)
        self.now = max(self.now, since)
        return work

    def run_one(self) -> tuple[bytes, Job]:
        work = self.lines.take(self.now)
        assert work is not None
        robot = Robot()
        job = Job(
            "sensing",
            None,
            make_problem,
            str,
            pack_opening(robot.opening),
            robot.opening.planning,
            5,
            ServiceLimits(),
            work.request,
            None,
        )
        self.lines.begin(work, job, 0.0)
        return work.digest, job

    def finish(self, job: Job) -> None:
        self.lines.let_go_on(self.lines.end(job).session)

    def test_those_that_robots_stand_still_for_go_first(self) -> None:
        self.work(self.session(1), b"ahead", 0.0, prefetched=True)
        self.work(self.session(2), b"awaited", 0.01, prefetched=False)
        assert self.run_one()[0] == b"awaited"

    def test_but_not_for_ever(self) -> None:
        self.work(self.session(1), b"ahead", 0.0, prefetched=True)
        self.work(self.session(2), b"awaited", 0.03, prefetched=False)
        assert self.run_one()[0] == b"ahead"

    @pytest.mark.parametrize("held", [False, True])
    def test_what_is_awaited_meanwhile_goes_first(self, held: bool) -> None:
        session = self.session(1)
        job = None
        if held:
            # Behind another one of the same robot.
            self.work(session, b"before", 0.0, prefetched=True)
            _, job = self.run_one()
        hastened = self.work(session, b"hastened", 0.0, prefetched=True)
        self.work(self.session(2), b"other", 0.001, prefetched=True)
        self.lines.hasten(hastened)
        if job is not None:
            self.finish(job)
        self.work(self.session(3), b"awaited", 0.002, prefetched=False)
        assert self.run_one()[0] == b"hastened"

    def test_a_robot_has_one_turn_at_a_time(self) -> None:
        session = self.session(1)
        self.work(session, b"first", 0.0, prefetched=False)
        name, job = self.run_one()
        assert name == b"first"
        self.work(session, b"second", 0.0, prefetched=False)
        self.work(self.session(2), b"other", 0.1, prefetched=False)
        self.finish(job)
        # It was held back meanwhile, so the other robot's turn comes before.
        assert self.run_one()[0] == b"other"

    def test_no_more_than_there_are_workers(self) -> None:
        for key in range(3):
            self.work(self.session(key), b"%d" % key, 0.0, prefetched=False)
        _, job = self.run_one()
        assert self.lines.take(self.now) is None
        assert self.lines.num_waiting == 2
        self.finish(job)
        assert self.run_one()[0] == b"1"
        assert self.lines.num_waiting == 1


class TestUsualTimes:
    def test_one_that_others_made_longer_counts_little_and_a_shorter_one_at_once(self) -> None:
        usual = UsualTime()
        assert usual.seconds == float("inf")
        for computed_s in (0.004, 0.0003, 0.005):
            usual.learn(computed_s)
        assert 0.0003 < usual.seconds < 0.001
        usual.learn(0.0002)
        assert usual.seconds == 0.0002

    def test_what_has_become_longer_is_known_to_be_after_a_while(self) -> None:
        usual = UsualTime()
        usual.learn(0.0003)
        for _ in range(20):
            usual.learn(0.004)
        assert usual.seconds > 0.002

    @pytest.mark.parametrize("task", [True, False])
    def test_the_two_parts_of_an_answer_are_apart(self, *, task: bool) -> None:
        times = ExpectedTimes(4.0, 1e-3, 1e-3)
        times.learn(0.0003, task=task)
        usual = (times.usual_task, times.usual_sensing)
        assert {each.seconds for each in usual} == {0.0003, float("inf")}
        assert (times.usual_task.seconds == 0.0003) is task
