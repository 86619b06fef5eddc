"""An executive that asks for decisions: numbers, repeated calls, bad answers, waiting."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from holdfast.config.registry import problem_class
from holdfast.errors import EnvironmentFailedError
from holdfast.robot.environment import is_no_reading
from holdfast_ros.executive import DecideCode, DecideRequest, DecisionHandover, ExecutiveEnvironment

FOREVER_S = 60.0


@pytest.fixture
def robot() -> Iterator[ThreadPoolExecutor]:
    """Return what asks the environment, on a thread of its own."""
    with ThreadPoolExecutor(1) as pool:
        yield pool


def executive() -> DecisionHandover:
    return DecisionHandover(problem_class("peg_in_hole_2d")())


def observation() -> np.ndarray:
    return np.zeros(1)


def test_a_trial_goes_from_call_to_call(robot: ThreadPoolExecutor) -> None:
    meeting = executive()
    world = ExecutiveEnvironment(meeting, trial=3)
    sensed = robot.submit(world.perform_sensing, 2)
    first = meeting.call(DecideRequest(), FOREVER_S)
    assert first.code == DecideCode.OK
    assert first.due is not None
    assert (first.due.trial, first.due.number, first.due.sensing_action) == (3, 1, 2)

    acted = robot.submit(world.perform, np.array([1.0, 2.0]))
    second = meeting.call(DecideRequest(3, 1, np.array([0.5])), FOREVER_S)
    assert np.asarray(sensed.result()).tolist() == [0.5]
    assert second.due is not None
    assert (second.due.number, second.due.sensing_action) == (2, None)
    assert second.due.task_action.tolist() == [1.0, 2.0]

    again = robot.submit(world.perform, np.array([3.0, 4.0]))
    third = meeting.call(DecideRequest(3, 2, reward=-1.5), FOREVER_S)
    assert acted.result() == -1.5
    assert world.is_done() is False
    assert third.due is not None
    assert (third.due.number, third.due.step) == (4, 1)

    robot.submit(meeting.end, DecideCode.FINISHED, "all")
    assert meeting.call(DecideRequest(3, 4, done="failed"), FOREVER_S).code == DecideCode.FINISHED
    assert again.result() is None
    assert world.is_done() == "failed"


def test_a_repeated_call_gets_the_same_decision(robot: ThreadPoolExecutor) -> None:
    meeting = executive()
    world = ExecutiveEnvironment(meeting)
    robot.submit(world.perform_sensing, 0)
    first = meeting.call(DecideRequest(), FOREVER_S).due
    assert first is not None
    assert meeting.call(DecideRequest(), FOREVER_S).due is first
    robot.submit(world.perform, np.zeros(2))
    answer = DecideRequest(0, 1, observation())
    second = meeting.call(answer, FOREVER_S).due
    assert second is meeting.call(answer, FOREVER_S).due is not None
    meeting.end(DecideCode.ENDED, "over")


@pytest.mark.parametrize(
    ("step", "sensing", "before"),
    [
        (0, True, (4, 17)),
        (0, False, (5, 1)),
        (1, False, (5, 2)),
        (2, True, (5, 4)),
        (2, False, (5, 1)),
    ],
)
def test_after_a_crash_the_call_before_is_known_as_such(
    robot: ThreadPoolExecutor, step: int, sensing: bool, before: tuple[int, int]
) -> None:
    meeting = executive()
    world = ExecutiveEnvironment(meeting, 5, [np.zeros(2)] * step)
    if sensing:
        robot.submit(world.perform_sensing, 0)
    else:
        robot.submit(world.perform, np.zeros(2))
    reply = meeting.call(DecideRequest(*before, observation()), FOREVER_S)
    assert reply.code == DecideCode.OK
    assert reply.due is not None
    assert (reply.due.trial, reply.due.step) == (5, step)
    meeting.end(DecideCode.ENDED, "over")


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            DecideRequest(0, 3, observation()),
            "trial 0, number 3: trial 0, number 1 is to be answered",
        ),
        (
            DecideRequest(2, 1, observation()),
            "trial 2, number 1: trial 0, number 1 is to be answered",
        ),
        (DecideRequest(0, 1), "observation of 0 values: sensing action 0 of peg_in_hole_2d has 1"),
        (
            DecideRequest(0, 1, np.zeros(4)),
            "observation of 4 values: sensing action 0 of peg_in_hole_2d",
        ),
        (DecideRequest(0, 1, np.array([np.inf])), "observation[0] is inf: must be a finite number"),
        (DecideRequest(0, 1, observation(), done=3), "done 3: allowed are 0 to 2"),  # type: ignore[arg-type]
        (DecideRequest(0, 1, observation(), np.inf), "reward inf: must be a finite number"),
        (
            DecideRequest(0, 1, observation(), done=True),
            "done says that it has succeeded: number 1 is a se",
        ),
        (
            DecideRequest(0, 1, observation(), done="failed"),
            "done says that the task has failed: number 1",
        ),
    ],
)
def test_a_bad_answer_changes_nothing(
    robot: ThreadPoolExecutor, call: DecideRequest, message: str
) -> None:
    meeting = executive()
    sensed = robot.submit(ExecutiveEnvironment(meeting).perform_sensing, 0)
    assert meeting.call(DecideRequest(), FOREVER_S).code == DecideCode.OK
    reply = meeting.call(call, FOREVER_S)
    assert reply.code == DecideCode.BAD_REQUEST
    assert message in reply.message
    assert not sensed.done()
    meeting.end(DecideCode.ENDED, "over")


def test_nan_is_no_reading(robot: ThreadPoolExecutor) -> None:
    meeting = executive()
    sensed = robot.submit(ExecutiveEnvironment(meeting).perform_sensing, 0)
    assert meeting.call(DecideRequest(), FOREVER_S).code == DecideCode.OK
    meeting.call(DecideRequest(0, 1, np.array([np.nan])), 0.0)
    assert is_no_reading(np.asarray(sensed.result()))
    meeting.end(DecideCode.ENDED, "over")


def test_a_task_action_shows_nothing(robot: ThreadPoolExecutor) -> None:
    meeting = executive()
    robot.submit(ExecutiveEnvironment(meeting, 0, [np.zeros(2)]).perform, np.zeros(2))
    assert meeting.call(DecideRequest(), FOREVER_S).code == DecideCode.OK
    reply = meeting.call(DecideRequest(0, 4, observation()), FOREVER_S)
    assert "observation of 1 values: number 4 is a task action" in reply.message
    meeting.end(DecideCode.ENDED, "over")


def test_who_waits_too_long_is_told_to_ask_again() -> None:
    assert executive().call(DecideRequest(), 0.0).code == DecideCode.HOLDING


def test_an_answer_is_not_taken_twice_while_the_robot_thinks(robot: ThreadPoolExecutor) -> None:
    meeting = executive()
    sensed = robot.submit(ExecutiveEnvironment(meeting).perform_sensing, 0)
    meeting.call(DecideRequest(), FOREVER_S)
    assert meeting.call(DecideRequest(0, 1, np.array([1.0])), 0.0).code == DecideCode.HOLDING
    assert np.asarray(sensed.result()).tolist() == [1.0]
    assert meeting.call(DecideRequest(0, 1, np.array([9.0])), 0.0).code == DecideCode.HOLDING
    assert meeting.call(DecideRequest(0, 7), 0.0).code == DecideCode.BAD_REQUEST


def test_a_run_that_ends_lets_all_go(robot: ThreadPoolExecutor) -> None:
    meeting = executive()
    sensed = robot.submit(ExecutiveEnvironment(meeting).perform_sensing, 0)
    assert meeting.call(DecideRequest(), FOREVER_S).code == DecideCode.OK
    meeting.end(DecideCode.ENDED, "the node was deactivated")
    with pytest.raises(EnvironmentFailedError, match="deactivated"):
        sensed.result()
    assert meeting.call(DecideRequest(0, 1, observation()), FOREVER_S).code == DecideCode.ENDED
    assert meeting.call(DecideRequest(), FOREVER_S).code == DecideCode.ENDED
