"""Long decisions leave threads to the others, and end once nobody awaits them."""

from __future__ import annotations

import pytest
from tests.fuzz.hostile_settings import with_key
from tests.unit.test_protocol_service import Bench, Robot, content, planning_of, refused

from holdfast.config.settings import PlanningSettings
from holdfast.protocol.decision_cost import cost_of_sensing
from holdfast.protocol.messages import Busy, Progress, Refused
from holdfast.protocol.service_jobs import Job
from holdfast.protocol.service_limits import ServiceLimits


def long_planning() -> PlanningSettings:
    """Return settings whose decisions take seconds."""
    planning = with_key(planning_of(), "selector.method", "expected_return")
    planning = with_key(planning, "selector.max_observation_samples", 100)
    return with_key(planning, "selector.rollout_steps", 2000)


def medium_planning() -> PlanningSettings:
    planning = with_key(planning_of(), "selector.method", "expected_return")
    return with_key(planning, "selector.rollout_steps", 50)


def robot_of(planning: PlanningSettings, key: int) -> Robot:
    return Robot(planning=planning, key=key)


def estimate(bench: Bench) -> None:
    """Run the jobs that are there until each has gone on or has its lane."""
    for _ in range(len(bench.jobs)):
        bench.run()


def ask_for_long_ones(bench: Bench, count: int, owner: str | None = None) -> list[int]:
    """Ask for long decisions; return their calls. Their jobs are not run."""
    calls = []
    for key in range(count):
        calls.append(bench.send(robot_of(long_planning(), 100 + key).request(), owner))
        while any(job._most is not None for job in bench.jobs):
            bench.run(next(i for i, job in enumerate(bench.jobs) if job._most is not None))
    return calls


def test_the_settings_of_these_tests_are_what_they_are_called() -> None:
    limits = ServiceLimits()
    problem = Robot().problem
    brief, medium, long = (
        cost_of_sensing(problem, each).seconds
        for each in (planning_of(), medium_planning(), long_planning())
    )
    assert brief < limits.max_brief_s < medium < limits.max_medium_s < long < limits.max_decision_s


@pytest.mark.parametrize("workers", [1, 2, 4])
@pytest.mark.parametrize("owner", [None, "hostile"])
def test_long_decisions_of_one_owner_leave_all_workers_to_the_others(
    workers: int, owner: str | None
) -> None:
    bench = Bench(workers=workers)
    calls = ask_for_long_ones(bench, 2 * workers + 2, owner)
    assert len(bench.jobs) == max(1, workers - 1)
    assert all(not bench.replies[call] for call in calls)
    honest = Robot(key=1)
    for _ in range(3):
        call = bench.send(honest.request())
        while len(bench.jobs) > max(1, workers - 1):
            bench.run(-1)
        assert content(bench.replies[call]) == honest.right_answer()
        honest.act_until_sensing()
        honest.sense()
    assert len(bench.jobs) == max(1, workers - 1)


def test_a_medium_decision_is_computed_and_the_same() -> None:
    bench, robot = Bench(), robot_of(medium_planning(), 1)
    call = bench.send(robot.request())
    bench.run()
    assert not bench.replies[call], "the first job only estimated"
    assert len(bench.jobs) == 1
    bench.run_all()
    assert content(bench.replies[call]) == robot.right_answer()


def test_medium_decisions_leave_a_worker_to_brief_ones() -> None:
    bench = Bench(workers=3)
    for key in range(6):
        bench.send(robot_of(medium_planning(), 100 + key).request())
    for _ in range(20):
        waiting = [index for index, job in enumerate(bench.jobs) if job._most.seconds < 0.05]  # type: ignore[union-attr]
        if not waiting:
            break
        bench.run(waiting[0])
    assert len(bench.jobs) == 2
    honest = Robot(key=1)
    call = bench.send(honest.request())
    bench.run(-1)
    assert content(bench.replies[call]) == honest.right_answer()


class TestNobodyAwaitsIt:
    def test_a_waiting_decision_is_dropped(self) -> None:
        bench = Bench(workers=1)
        first, second = ask_for_long_ones(bench, 2)
        assert (bench.service.statistics.running, bench.service.statistics.waiting) == (1, 1)
        bench.apply(bench.service.gone(second, bench.now))
        assert (bench.service.statistics.running, bench.service.statistics.waiting) == (1, 0)
        assert bench.service.statistics.calls == 1
        assert not bench.replies[first]

    def test_a_running_long_one_is_cancelled_and_the_next_begins(self) -> None:
        bench = Bench(workers=1)
        first, _ = ask_for_long_ones(bench, 2)
        (job,) = bench.jobs
        bench.apply(bench.service.gone(first, bench.now))
        outcome = job.run()
        assert outcome.cancelled
        assert outcome.problem is None, "left in the middle of something"
        bench.jobs.clear()
        bench.apply(bench.service.finished(job, outcome, bench.now))
        assert not bench.replies[first]
        (following,) = bench.jobs
        assert following is not job
        assert bench.service.statistics.waiting == 0

    def test_whoever_asks_again_does_not_wait_for_what_was_cancelled(self) -> None:
        bench, robot = Bench(workers=1), robot_of(long_planning(), 100)
        (call,) = ask_for_long_ones(bench, 1)
        (job,) = bench.jobs
        bench.apply(bench.service.gone(call, bench.now))
        again = bench.send(robot.request())
        estimate_index = next(i for i, each in enumerate(bench.jobs) if each is not job)
        bench.run(estimate_index)
        assert bench.service.statistics.waiting == 1, "held back until the first has ended"
        bench.jobs.remove(job)
        bench.apply(bench.service.finished(job, job.run(), bench.now))
        assert len(bench.jobs) == 1
        assert again not in bench.ended

    def test_a_newer_request_cancels_it(self) -> None:
        bench, robot = Bench(workers=1), robot_of(long_planning(), 100)
        (call,) = ask_for_long_ones(bench, 1)
        (job,) = bench.jobs
        robot.number = 5
        robot.sense()
        bench.send(robot.request())
        assert call in bench.ended
        assert job.run().cancelled

    def test_a_brief_one_goes_on_for_the_robots_next_link(self) -> None:
        bench, robot = Bench(), Robot()
        call = bench.send(robot.request())
        bench.apply(bench.service.gone(call, bench.now))
        bench.run_all()
        assert content(bench.ask(robot.request())) == robot.right_answer()
        assert bench.service.statistics.cache_hits == 1

    def test_a_call_that_has_ended_can_go(self) -> None:
        bench, robot = Bench(), Robot()
        bench.ask(robot.request())
        bench.apply(bench.service.gone(0, bench.now))
        assert content(bench.ask(robot.request())) == robot.right_answer()


def held_up(bench: Bench) -> tuple[Robot, int, Robot, int, Job]:
    """Have a brief decision run for far too long, while another robot waits for the worker."""
    slow, other = Robot(key=1), Robot(key=2)
    call = bench.send(slow.request())
    (job,) = bench.jobs
    waits = bench.send(other.request())
    assert len(bench.jobs) == 1, "there is one worker"
    limit_s = ServiceLimits().max_brief_s
    bench.now += 4.0 * limit_s
    bench.apply(bench.service.tick(bench.now))
    assert not job.is_cancelled
    bench.now += 2.0 * limit_s
    due = bench.service.next_wakeup()
    assert due is not None
    assert due <= bench.now
    bench.apply(bench.service.tick(bench.now))
    return slow, call, other, waits, job


class TestTheEstimateIsFarTooLow:
    def test_what_holds_up_others_is_computed_as_a_long_one(self) -> None:
        bench = Bench()
        slow, call, other, waits, job = held_up(bench)
        assert job.is_cancelled
        due = bench.service.next_wakeup()
        assert due is None or due > bench.now
        again = bench.send(slow.request())
        bench.run()
        assert [each._most is None for each in bench.jobs] == [False, True]
        bench.run_all()
        assert content(bench.replies[waits]) == other.right_answer()
        assert call in bench.ended, "superseded by the same robot's next request"
        assert content(bench.replies[again]) == slow.right_answer()

    def test_whoever_waits_for_it_gets_the_answer(self) -> None:
        bench = Bench()
        slow, call, other, waits, _ = held_up(bench)
        bench.run_all()
        assert content(bench.replies[call]) == slow.right_answer()
        assert content(bench.replies[waits]) == other.right_answer()

    def test_one_that_has_just_ended_is_answered_at_once(self) -> None:
        bench, robot = Bench(), Robot()
        call = bench.send(robot.request())
        outcome = bench.jobs[0].run()
        bench.send(Robot(key=2).request())
        # The machine stood still meanwhile.
        bench.now += 1.0
        bench.apply(bench.service.tick(bench.now))
        bench.apply(bench.service.finished(bench.jobs.popleft(), outcome, bench.now))
        bench.run_all()
        assert content(bench.replies[call]) == robot.right_answer()

    def test_one_that_holds_up_nobody_goes_on(self) -> None:
        bench, robot = Bench(), Robot()
        call = bench.send(robot.request())
        bench.now += 1.0
        bench.apply(bench.service.tick(bench.now))
        (job,) = bench.jobs
        assert not job.is_cancelled
        bench.send(Robot(key=2).request())
        due = bench.service.next_wakeup()
        assert due is not None
        assert due <= bench.now, "now it does"
        bench.run_all()
        assert content(bench.replies[call]) == robot.right_answer()

    def test_one_that_nobody_awaits_ends_at_its_lanes_limit(self) -> None:
        for before in (0.0, 1.1):
            bench, robot = Bench(), Robot()
            call = bench.send(robot.request())
            (job,) = bench.jobs
            limit_s = ServiceLimits().max_brief_s
            bench.now += before * limit_s
            bench.apply(bench.service.gone(call, bench.now))
            assert job.is_cancelled == (before > 1.0)
            bench.now += 1.1 * limit_s
            due = bench.service.next_wakeup()
            assert job.is_cancelled or (due is not None and due <= bench.now)
            bench.apply(bench.service.tick(bench.now))
            assert job.is_cancelled
            bench.run_all()
            assert content(bench.ask(robot.request())) == robot.right_answer()

    def test_a_medium_one_has_more_time(self) -> None:
        bench, robot = Bench(), robot_of(medium_planning(), 1)
        call = bench.send(robot.request())
        bench.run()
        bench.send(Robot(key=2).request())
        bench.now += 0.4
        bench.apply(bench.service.tick(bench.now))
        assert [each.is_cancelled for each in bench.jobs] == [False]
        bench.now += 0.2
        bench.apply(bench.service.tick(bench.now))
        assert [each.is_cancelled for each in bench.jobs] == [True]
        bench.run_all()
        assert content(bench.replies[call]) == robot.right_answer()


def test_what_takes_much_longer_than_estimated_is_refused_and_cancelled() -> None:
    bench = Bench(workers=1)
    (call,) = ask_for_long_ones(bench, 1)
    (job,) = bench.jobs
    limit_s = ServiceLimits().max_decision_s
    bench.now += 2.0 * limit_s
    bench.apply(bench.service.tick(bench.now))
    assert all(isinstance(reply, Progress) for reply in bench.replies[call])
    due = bench.service.next_wakeup()
    bench.now += 2.0 * limit_s
    assert due is not None
    assert due <= bench.now
    bench.apply(bench.service.tick(bench.now))
    reply = bench.replies[call][-1]
    assert isinstance(reply, Refused)
    assert reply.code == "invalid"
    assert "at most 10 s (--max-decision-s)" in reply.text
    assert "rollout_steps 2000" in reply.text
    assert job.run().cancelled
    bench.apply(bench.service.tick(bench.now + 1.0))
    wakeup = bench.service.next_wakeup()
    assert wakeup is None or wakeup > bench.now


def test_long_decisions_share_a_bound_on_memory() -> None:
    one = cost_of_sensing(Robot().problem, long_planning()).num_bytes
    bench = Bench(workers=4, max_decision_bytes=int(2.5 * one))
    ask_for_long_ones(bench, 4)
    assert len(bench.jobs) == 2, "of three threads"
    bench = Bench(workers=4, max_decision_bytes=int(0.5 * one))
    reply = refused(bench.ask(robot_of(long_planning(), 100).request()))
    assert "(--max-decision-mb)" in reply.text


def test_too_many_long_ones_are_turned_away_and_brief_ones_are_not() -> None:
    bench = Bench(workers=1, max_waiting=4)
    calls = ask_for_long_ones(bench, 8)
    turned_away = [call for call in calls if any(isinstance(r, Busy) for r in bench.replies[call])]
    assert turned_away
    honest = Robot(key=1)
    call = bench.send(honest.request())
    bench.run(-1)
    assert content(bench.replies[call]) == honest.right_answer()
