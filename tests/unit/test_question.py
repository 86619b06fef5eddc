"""A question's size, which replies can answer it, and what both sources of decisions offer."""

import inspect

import numpy as np
import pytest

from holdfast.errors import HoldfastError, MessageError
from holdfast.planning.inputs import Moved, encode_floats
from holdfast.planning.planner import Planner, decode_checkpoint
from holdfast.planning.settings import PlanningSettings
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.protocol.dispatcher import Dispatcher
from holdfast.protocol.messages import MAX_TASK_ACTIONS, SensingAnswer, TaskAnswer
from holdfast.protocol.question import (
    DecisionSource,
    InProcessSource,
    Provenance,
    Question,
    same_actions,
)


def question(step: int = 0, *, sensed: bool = False, interval: int = 2) -> Question:
    planning = PlanningSettings(sensing_interval=interval)
    planner = Planner(PegInHole2D(), planning)
    state = planner.init(1)._replace(step=step, sensed=sensed)
    return Question(planner, state, planner.digest(state), (), 0)


@pytest.mark.parametrize(
    ("asked", "task_count", "sensing_step"),
    [
        (question(), 0, 0),
        (question(sensed=True), 3, 3),
        (question(4), 2, 6),
        (question(sensed=True, interval=200), MAX_TASK_ACTIONS, None),
    ],
)
def test_the_answer_ends_with_the_next_sensing_action(
    asked: Question, task_count: int, sensing_step: int | None
) -> None:
    assert (asked.task_count, asked.sensing_step) == (task_count, sensing_step)
    assert not asked.complete


def test_it_is_complete_with_both_parts() -> None:
    asked = question(sensed=True)
    provenance = Provenance("cloud", 0.0, 0.0)
    asked.follow_tasks([np.zeros(3)] * 3, provenance)
    assert not asked.complete
    asked.follow_sensing(SensingAnswer(1, 3, 0, asked.digest, 0), provenance)
    assert asked.complete


def test_replies_that_cannot_answer_it_are_refused() -> None:
    asked = question(sensed=True)
    actions = encode_floats(np.ones((3, 3)))
    assert same_actions(asked.read_tasks(TaskAnswer(1, 3, actions, 0), 3), [np.ones(3)] * 3)
    with pytest.raises(MessageError, match="2 task actions where 3 were asked"):
        asked.read_tasks(TaskAnswer(1, 2, actions, 0), 3)
    with pytest.raises(MessageError, match="72 bytes are not"):
        asked.read_tasks(TaskAnswer(1, 3, actions, 0), 2)
    for step, action, digest, says in (
        (6, 0, asked.digest, "for step 6 where 3 was asked"),
        (3, 9, asked.digest, "there is no sensing action 9"),
    ):
        with pytest.raises(MessageError, match=says):
            asked.check_sensing(SensingAnswer(1, step, action, digest, 0), 3)
    now = question()
    with pytest.raises(MessageError, match="for another state"):
        now.check_sensing(SensingAnswer(1, 0, 0, b"\0" * 16, 0), 3)


def test_actions_are_the_same_bit_for_bit() -> None:
    assert same_actions([np.zeros(1)], [np.zeros(1)])
    assert not same_actions([np.zeros(1)], [-np.zeros(1)])
    assert not same_actions([np.zeros(1)], [])


def test_its_checkpoint_is_the_state() -> None:
    asked = question()
    whole = asked.request(bytes(16), 1, 2, None, None)
    assert whole.checkpoint is asked.checkpoint()
    state = decode_checkpoint(asked.checkpoint())
    assert (state.seed, state.trial, state.step) == (1, 0, 0)
    asked.inputs = (Moved(0, None, b"", b"1" * 8), Moved(1, None, b"", b"2" * 8))
    for count in (0, 1, 2):
        part = asked.request(bytes(16), 1, 2, count, None)
        assert (part.inputs, part.checkpoint) == (asked.inputs[2 - count :], None)


METHODS = [
    name
    for name, member in vars(DecisionSource).items()
    if inspect.isfunction(member) and not name.startswith("_")
]


def test_a_source_stops_once() -> None:
    source = InProcessSource()
    source.stop(first := HoldfastError("why"))
    source.stop(HoldfastError("what follows from it"))
    assert source.stopped_by is first


@pytest.mark.parametrize("source", [Dispatcher, InProcessSource])
@pytest.mark.parametrize("name", METHODS)
def test_methods_take_the_same_parameters(source: type, name: str) -> None:
    asked = inspect.signature(getattr(DecisionSource, name)).parameters
    assert list(inspect.signature(getattr(source, name)).parameters) == list(asked)
