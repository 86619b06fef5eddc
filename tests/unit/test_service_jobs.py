"""Jobs are pure functions of what they were made with; problems are lent to one at a time."""

from typing import Literal

import pytest
from tests.unit.test_protocol_service import Robot, make_problem

from holdfast.errors import InterruptedComputationError, InvalidValueError
from holdfast.planning.interruption import check
from holdfast.problems.problem import Problem
from holdfast.protocol.decision_cost import TYPICAL_PROBLEM, Pricing, ProblemCost
from holdfast.protocol.messages import Request, SessionConfiguration, pack_configuration
from holdfast.protocol.service_jobs import Job, ProblemPool
from holdfast.protocol.service_limits import ServiceLimits


def job(
    robot: Robot,
    request: Request | None,
    kind: Literal["task", "sensing"] = "sensing",
    limits: ServiceLimits | None = None,
) -> Job:
    configuration = robot.session_configuration
    return Job(
        kind,
        None,
        make_problem,
        str,
        pack_configuration(configuration),
        configuration.planning,
        configuration.seed,
        limits or ServiceLimits(),
        request,
        None,
    )


def test_the_same_job_has_the_same_result() -> None:
    robot = Robot()
    first, second = (job(robot, robot.request()) for _ in range(2))
    assert first.identity == second.identity
    results = [each.run() for each in (first, second)]
    assert results[0].failure is None
    assert results[0].sensing_action == results[1].sensing_action >= 0


def test_a_state_that_does_not_follow_is_asked_for() -> None:
    robot = Robot()
    result = job(robot, robot.request(digest=b"\1" * 16)).run()
    assert (result.lacks_state, result.differs, result.diverged) == (True, True, True)
    assert result.problem is not None, "it is worth keeping"


@pytest.mark.parametrize(
    ("limits", "says"),
    [
        (ServiceLimits(max_decision_s=1e-6), "--max-decision-s"),
        (ServiceLimits(max_decision_bytes=1000), "--max-decision-mb"),
        (ServiceLimits(), None),
    ],
)
def test_a_decision_has_a_bounded_size(limits: ServiceLimits, says: str | None) -> None:
    robot = Robot()
    failure = job(robot, robot.request(), limits=limits).run().failure
    if says is None:
        assert failure is None
    else:
        assert failure is not None
        assert failure[0] == "invalid"
        assert says in failure[1]


@pytest.mark.parametrize("during", ["building", "measuring"])
def test_building_and_measuring_can_be_ended(during: str) -> None:
    robot = Robot()

    def build(session_configuration: SessionConfiguration) -> Problem:
        if during == "building":
            made.cancel()
            check()
            pytest.fail("it goes on")
        return make_problem(session_configuration)

    def measure(_: Problem) -> ProblemCost:
        made.cancel()
        # Whatever a problem raises while it is measured is suppressed.
        with pytest.raises(InterruptedComputationError):
            check()
        return TYPICAL_PROBLEM

    made = job(robot, robot.request())
    made._make_problem, made._pricing = build, Pricing(measure=measure)
    assert made.run().cancelled


def test_a_problem_that_cannot_be_measured_is_refused() -> None:
    def measure(_: Problem) -> ProblemCost:
        raise InvalidValueError("model.init_mean: no place")

    robot = Robot()
    made = job(robot, robot.request())
    made._pricing = Pricing(measure=measure)
    assert made.run().failure == ("invalid", "model.init_mean: no place")


def test_a_problem_is_lent_to_one_job_and_the_oldest_are_dropped() -> None:
    pool = ProblemPool(2)
    problem = make_problem(Robot().session_configuration)
    assert pool.acquire(b"a") is None
    for key in (b"a", b"b", b"c"):
        pool.release(key, problem)
    assert pool.acquire(b"a") is None
    assert pool.acquire(b"c") is problem
    assert pool.acquire(b"c") is None


def test_what_a_problem_costs_is_known_for_longer_than_it_is_kept() -> None:
    pool = ProblemPool(1)
    pool.note_cost("anna", b"failed", None)
    assert pool.cost_of("anna", b"failed") is None
    for number in range(200):
        pool.note_cost("anna", b"%d" % number, TYPICAL_PROBLEM)
        pool.note_cost("anna", b"used", TYPICAL_PROBLEM)
    assert pool.cost_of("anna", b"used") == pool.cost_of("anna", b"199") == TYPICAL_PROBLEM
    assert pool.cost_of("anna", b"0") is None
    assert pool.cost_of(None, b"used") is None


def test_a_known_problem_is_not_measured_again() -> None:
    def measure(_: Problem) -> ProblemCost:
        raise AssertionError("measured again")

    robot = Robot()
    made = job(robot, robot.request())
    made._pricing, made._known = Pricing(measure=measure), TYPICAL_PROBLEM
    assert made.run().sensing_action >= 0
