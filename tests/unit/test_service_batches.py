"""Brief jobs that are computed at once: results, and what is left to each job alone."""

from collections.abc import Callable

import msgspec
import pytest
from tests.unit.test_protocol_service import Bench, Robot, content, planning_of

from holdfast.planning.planner import digest
from holdfast.protocol.decision_cost import Cost
from holdfast.protocol.messages import Refused
from holdfast.protocol.service_batches import run_together
from holdfast.protocol.service_jobs import Job, JobResult
from holdfast.protocol.service_sessions import SHORT_S


def jobs_of(number: int, *, interval: int = 3) -> tuple[Bench, list[Robot]]:
    """Return robots that were served before, whose next requests are handed out together."""
    bench = Bench()
    robots = [Robot(planning=planning_of(interval), key=key, seed=key) for key in range(number)]
    for _ in range(3):  # the first job of each kind predicts nothing
        for robot in robots:
            bench.ask(robot.request(since=max(0, len(robot.observed) - 1)))
            robot.act_until_sensing()
            robot.sense()
    for robot in robots:
        bench.send(robot.request(since=len(robot.observed) - 1))
    assert len(bench.jobs) == number, "short ones go out together"
    return bench, robots


def comparable(result: JobResult) -> tuple[object, ...]:
    states = [None if each is None else digest(each) for each in (result.state, result.ahead)]
    return (*states, *result._replace(state=None, ahead=None))


@pytest.mark.parametrize("interval", [0, 3])
def test_results_are_those_of_each_alone(interval: int) -> None:
    bench, robots = jobs_of(3, interval=interval)
    for kind in ("task", "sensing"):
        jobs = list(bench.jobs)
        assert {job.kind for job in jobs} == {kind}
        bench.jobs.clear()
        results = run_together(jobs)
        for job in jobs:
            result = results[job]
            assert comparable(result) == comparable(job.run())
            bench.apply(bench.service.finished(job, result, bench.now))
    for call, robot in zip(list(bench.replies)[-3:], robots, strict=True):
        assert content(bench.replies[call]) == robot.right_answer()


def has_other_digest(job: Job) -> None:
    assert job.request is not None
    job.request = msgspec.structs.replace(job.request, digest=bytes(16))


def costs_too_much(job: Job) -> None:
    job._most = Cost(1e-9, 1e-9)


@pytest.mark.parametrize("change", [has_other_digest, costs_too_much])
def test_what_is_unlike_is_left_to_itself(change: Callable[[Job], None]) -> None:
    bench, _ = jobs_of(3)
    jobs = list(bench.jobs)
    change(jobs[1])
    assert list(run_together(jobs)) == [jobs[0], jobs[2]]


def test_what_goes_wrong_is_left_to_each() -> None:
    bench, _ = jobs_of(3)
    jobs = list(bench.jobs)
    jobs[1].request = msgspec.structs.replace(jobs[1].request, inputs=(jobs[0].request,))  # type: ignore[type-var]
    assert not run_together(jobs)


def test_which_are_alike() -> None:
    bench, _ = jobs_of(2)
    one, other = bench.jobs
    assert one.is_like(other)
    assert list(run_together([one])) == []
    assert list(run_together([one, other])) == [one, other]
    bench.run()
    sensing = bench.jobs[-1]
    assert sensing.kind == "sensing"
    assert not other.is_like(sensing)
    other.company = b"another"
    assert not one.is_like(other)
    one.company = other.company = None
    assert not one.is_like(other)


def test_a_short_one_that_takes_long_is_computed_anew_on_a_thread() -> None:
    bench, (robot,) = jobs_of(1)
    call = list(bench.replies)[-1]
    assert is_short(bench.jobs[0])
    bench.jobs[0].interruption.use_up()
    bench.run()
    assert not is_short(bench.jobs[0])
    bench.run_all()
    assert content(bench.replies[call]) == robot.right_answer()


def test_what_is_known_of_newcomers() -> None:
    bench, _ = jobs_of(1)
    bench.run_all()
    bench.send(Robot(planning=planning_of(), key=8).request())
    assert is_short(bench.jobs[0]), "others had the same problem and settings"
    bench.run_all()
    came = Robot(planning=planning_of(), key=9)
    came.sense()
    bench.send(came.restore())
    assert not is_short(bench.jobs[0]), "nothing is known of a state from outside"
    bench.run()
    assert is_short(bench.jobs[0]), "that took no longer than others"


def is_short(job: Job) -> bool:
    return job.interruption.most_s <= 5.0 * SHORT_S


def test_who_is_refused_is_computed_on_a_thread_next() -> None:
    """Else each of its requests would have others computed twice."""
    bench, (robot,) = jobs_of(1)
    bench.run_all()
    robot.act_until_sensing()
    robot.sense()
    wrong = msgspec.structs.replace(robot.observed[-1], observation=bytes(8))
    (reply,) = bench.ask(robot.request(inputs=(wrong,)))
    assert isinstance(reply, Refused)
    call = bench.send(robot.request(since=len(robot.observed) - 1))
    assert not is_short(bench.jobs[0])
    bench.run_all()
    assert content(bench.replies[call]) == robot.right_answer()
