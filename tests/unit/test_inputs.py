"""Records of an unfinished trial: what is none is said to be none, whatever it is instead."""

import msgspec
import numpy as np
import pytest
from tests.trial_inputs import begin_anew, come_late, sense

from holdfast.errors import RecordError
from holdfast.journal.journal_file import encode
from holdfast.journal.journal_reader import decode_records
from holdfast.planning.inputs import (
    ActingRecord,
    Late,
    LocalTookOverRecord,
    Moved,
    PausedRecord,
    Record,
    Reinitialised,
    Sensed,
    encode_floats,
    has_shown,
)
from holdfast.planning.planner import Planner
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.planning.tracking import Trial, replay
from holdfast.problems.peg_in_hole_2d import PegInHole2D

PROBLEM = PegInHole2D()
PLANNING = PlanningSettings(
    particle_filter=ParticleFilterSettings(num_particles=12), sensing_interval=3
)
PLANNING_EACH_STEP = msgspec.structs.replace(PLANNING, sensing_interval=0)
RECORDS: list[Record] = [
    Sensed(8, 1, encode_floats([0.5]), bytes(32), 1.5),
    ActingRecord(8, encode_floats([0.25, -0.5, 0.0])),
    Moved(8, None),
    PausedRecord(),
    LocalTookOverRecord(2),
    Moved(8, -1.0, encode_floats([0.5]), encode_floats([1.0, 2.0])),
    Late(9, 8, encode_floats([0.5]), bytes(32)),
    Reinitialised(9, bytes(32)),
]


@pytest.mark.parametrize("record", RECORDS, ids=lambda record: type(record).__name__)
def test_a_record_comes_back(record: Record) -> None:
    assert decode_records(encode([record])) == [record]


def first_record(**changes: object) -> Sensed:
    """Return an observation that could be the first of a trial, but for its digest."""
    shown = encode_floats(np.zeros(1))
    return msgspec.structs.replace(Sensed(0, 0, shown, bytes(32), 1.0), **changes)


@pytest.mark.parametrize(
    ("record", "why"),
    [
        (first_record(sensing_action=99), "sensing action 99"),
        (first_record(sensing_action=-1), "sensing action -1"),
        (first_record(observation=encode_floats(np.zeros(7))), "observation"),
        (first_record(observation=b"short"), "5 bytes are not 0 numbers"),
        (first_record(), "another state"),
        (first_record(step=1), "of step 1"),
    ],
    ids=["too high", "too low", "too long", "half a number", "digest", "step"],
)
def test_a_record_that_does_not_follow_is_named(record: Record, why: str) -> None:
    with pytest.raises(RecordError, match=rf"trial 4: record 1 of its journal .*{why}"):
        replay(Planner(PROBLEM, PLANNING), 11, 4, [LocalTookOverRecord(1), record])


def test_what_came_late_may_stand_between_an_action_and_its_performance() -> None:
    """A resumed robot is told of it before it performs the action that its journal ends with."""
    planner = Planner(PROBLEM, PLANNING)
    history = Trial(planner, 11, 4)
    sensed = sense(history, 0, None, 1.0)
    action, _ = planner.choose_task_action(history.state)
    history.pending = action
    found = come_late(history, 0, np.array([3.5]))
    performed = Moved(0, -1.0)
    history.take(performed)
    records: list[Record] = [sensed, ActingRecord(0, encode_floats(action)), found, performed]
    again = replay(planner, 11, 4, records)
    assert planner.digest(again.state) == planner.digest(history.state)
    assert again.awaited == ()
    for record in records[:2]:
        with pytest.raises(RecordError, match="before the action of that step is known"):
            replay(planner, 11, 4, [*records[:2], record])


def test_a_lost_robot_stays_lost_when_an_explained_observation_comes_late() -> None:
    """It held still, or was killed, before the new belief was written down."""
    history = Trial(Planner(PROBLEM, PLANNING_EACH_STEP), 5, 0, 1.0)
    explained = history.planner.problem.observation_mean(history.state.belief.states[:1], 0)[0]
    sense(history, 0, None, 0.0)
    history.pending = np.zeros(3)
    history.take(Moved(0, None))
    sense(history, 0, np.full(1, 1e6), 0.0)
    assert history.is_lost
    come_late(history, 0, explained)
    assert history.found is not None
    assert history.found.within_gate
    assert history.is_lost
    begin_anew(history)
    assert not history.is_lost


def test_an_unexplained_observation_that_comes_late_can_find_it_lost() -> None:
    history = Trial(Planner(PROBLEM, PLANNING_EACH_STEP), 5, 0, 1.0)
    sense(history, 0, None, 0.0)
    assert not history.is_lost
    come_late(history, 0, np.full(1, 1e6))
    assert history.is_lost


def test_a_suspect_sensor_is_no_lost_robot() -> None:
    """Twice outside, and between them another sensor inside."""
    history = Trial(Planner(PROBLEM, PLANNING_EACH_STEP), 5, 0, 2 / 80)
    kinds = []
    for action in (0, 1, 0):
        inside = history.planner.problem.observation_mean(history.state.belief.states, action)
        sense(history, action, np.full(1, 1e6) if action == 0 else inside[0], 0.0)
        kinds.append(None if history.alarm is None else history.alarm.kind)
        assert not history.is_lost
        history.pending = np.zeros(3)
        history.take(Moved(history.state.step, None))
    assert kinds == [None, None, "sensor_suspect"]


def test_what_a_record_has_shown() -> None:
    shown = encode_floats(np.zeros(1))
    assert not has_shown(Moved(0, None))
    assert has_shown(Moved(0, None, shown))
    assert has_shown(Moved(0, None, b"", shown))
    assert has_shown(Late(2, 0, shown, bytes(32)))
    assert not has_shown(first_record())
