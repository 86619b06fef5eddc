"""Long decisions leave threads to the others, and end once nobody awaits them."""

import time

import pytest
from tests.fuzz.hostile_settings import with_key
from tests.unit.test_protocol_service import (
    Bench,
    Robot,
    content,
    make_problem,
    planning_of,
    refused,
)

from holdfast.planning.interruption import check
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.problem import Problem
from holdfast.protocol.decision_cost import ANY_MACHINE
from holdfast.protocol.messages import Busy, Refused, SessionConfiguration
from holdfast.protocol.service_limits import ServiceLimits


def long_planning() -> PlanningSettings:
    """Return settings whose decisions take seconds."""
    planning = with_key(planning_of(), "selector.method", "expected_return")
    planning = with_key(planning, "selector.max_observation_samples", 7000)
    return with_key(planning, "selector.rollout_steps", 2000)


def medium_planning() -> PlanningSettings:
    planning = with_key(planning_of(), "selector.method", "expected_return")
    return with_key(planning, "selector.max_observation_samples", 500)


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
        bench.apply(bench.service.gone(second))
        assert (bench.service.statistics.running, bench.service.statistics.waiting) == (1, 0)
        assert bench.service.statistics.calls == 1
        assert not bench.replies[first]

    def test_a_running_long_one_is_cancelled_and_the_next_begins(self) -> None:
        bench = Bench(workers=1)
        first, _ = ask_for_long_ones(bench, 2)
        (job,) = bench.jobs
        bench.apply(bench.service.gone(first))
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
        bench.apply(bench.service.gone(call))
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
        bench.apply(bench.service.gone(call))
        bench.run_all()
        assert content(bench.ask(robot.request())) == robot.right_answer()
        assert bench.service.statistics.cache_hits == 1

    def test_a_call_that_has_ended_can_go(self) -> None:
        bench, robot = Bench(), Robot()
        bench.ask(robot.request())
        bench.apply(bench.service.gone(0))
        assert content(bench.ask(robot.request())) == robot.right_answer()


def overrun(bench: Bench, index: int = -1) -> None:
    """Have a job use up its time."""
    bench.jobs[index].interruption.use_up()
    bench.run(index)


def test_a_robot_with_a_known_problem_does_not_wait_for_new_ones() -> None:
    bench, known, other = Bench(), Robot(key=1), Robot(key=2)
    bench.ask(known.request())
    bench.send(Robot("peg_in_hole_2d", key=3).request())
    assert len(bench.jobs) == 1, "of a problem that nobody has brought before"
    call = bench.send(other.request())
    bench.run(-1)
    assert content(bench.replies[call]) == other.right_answer()
    assert len(bench.jobs) == 1


class TestTheEstimateIsFarTooLow:
    def test_a_job_ends_once_it_has_used_up_its_time(self) -> None:
        bench = Bench()
        (slow,) = bench.known(1)
        call = bench.send(slow.request())
        bench.jobs[0].interruption.most_s = 0.0
        bench.run()
        assert bench.jobs[0]._most is None
        bench.run_all()
        assert content(bench.replies[call]) == slow.right_answer()

    def test_a_problem_that_takes_long_to_build_leaves_the_lane_of_new_ones(self) -> None:
        """A long one may take its time to build, or it would be built for ever."""

        def slowly_made(configuration: SessionConfiguration) -> Problem:
            began = time.thread_time()
            while time.thread_time() < began + 6 * ServiceLimits().max_brief_s:
                check()
            return make_problem(configuration)

        bench, robot = Bench(slowly_made), Robot()
        call = bench.send(robot.request())
        bench.run()
        assert not bench.replies[call]
        assert bench.jobs[0]._most is None
        bench.run()
        assert content(bench.replies[call]) == robot.right_answer()

    def test_the_decision_is_computed_as_a_long_one(self) -> None:
        bench = Bench()
        slow, other = bench.known(1, 2)
        call = bench.send(slow.request())
        waits = bench.send(other.request())
        assert len(bench.jobs) == 1, "there is one worker"
        overrun(bench)
        assert [each._most is None for each in bench.jobs] == [False, True]
        bench.run_all()
        assert content(bench.replies[call]) == slow.right_answer()
        assert content(bench.replies[waits]) == other.right_answer()

    def test_the_next_ones_are_too_until_one_takes_less(self) -> None:
        bench = Bench()
        (slow,) = bench.known(1)
        bench.send(slow.request())
        overrun(bench)
        bench.now += 1.0
        bench.run()  # as a long one
        assert bench.jobs[0]._most is None, "the sensing part, which nothing has shown to be slow"
        bench.run()
        slow.act_until_sensing()
        slow.sense()
        bench.send(slow.request())
        assert bench.jobs[0]._most is not None

    def test_a_newer_request_takes_its_place(self) -> None:
        bench = Bench()
        (slow,) = bench.known(1)
        call = bench.send(slow.request())
        overrun(bench)
        slow.act()
        newer = bench.send(slow.request())
        bench.run_all()
        assert call in bench.ended
        assert content(bench.replies[newer]) == slow.right_answer()

    def test_each_lane_has_its_time(self) -> None:
        """So many times its limit; new ones have that of brief ones."""
        bench, limits, most = Bench(), ServiceLimits(), []
        (known,) = bench.known(3)
        for robot in (known, robot_of(medium_planning(), 1), robot_of(long_planning(), 2)):
            bench.send(robot.request())
            most.append(bench.jobs[-1].interruption.most_s)
            bench.run()
            if bench.jobs:
                most.append(bench.jobs[-1].interruption.most_s)
            bench.jobs.clear()
            bench.service.forget_everything()
        brief_s = 5 * limits.max_brief_s
        medium_s, long_s = 5 * limits.max_medium_s, 4 * limits.max_decision_s
        assert most == [brief_s, brief_s, brief_s, medium_s, brief_s, long_s]


def test_what_takes_much_longer_than_estimated_is_refused() -> None:
    bench = Bench(workers=1)
    (call,) = ask_for_long_ones(bench, 1)
    overrun(bench)
    reply = bench.replies[call][-1]
    assert isinstance(reply, Refused)
    assert reply.code == "invalid"
    assert "has taken 40 s" in reply.text
    assert "at most 10 s (--max-decision-s)" in reply.text
    assert "rollout_steps 2000" in reply.text
    assert call in bench.ended
    assert bench.service.statistics.running == 0


def test_long_decisions_share_a_bound_on_memory() -> None:
    one = ANY_MACHINE.price_of(Robot().problem, long_planning()).sensing.num_bytes
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
