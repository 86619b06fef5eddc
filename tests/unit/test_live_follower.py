"""The process that shows a run comes to the robot's own beliefs, and leaves out what is late."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.recordings import Journalling, Steps, configuration_of
from tests.trial_inputs import come_late, sense

from holdfast.config.loader import Configuration
from holdfast.journal.journal import Journal
from holdfast.journal.timings import EventTable
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import ActingRecord, Moved, Record, encode_floats
from holdfast.planning.outcome import Ending
from holdfast.planning.planner import Planner, digest
from holdfast.planning.tracking import Trial, replay
from holdfast.protocol.robot_events import Timing
from holdfast.reports.facts import (
    EventFact,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
)
from holdfast.reports.live_follower import Follower, RunFiles
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import run_trial

SECOND = 1_000_000_000


class Facts:
    """Keeps the facts that it gets."""

    def __init__(self) -> None:
        self.all: list[Any] = []
        self.trial_begins = self.sensed = self.acted = self.observed_late = self.all.append
        self.trial_ends = self.happened = self.all.append

    def of(self, kind: type) -> list[Any]:
        return [fact for fact in self.all if isinstance(fact, kind)]


def a_trial(configuration: Configuration, number: int) -> tuple[list[Record], Trial]:
    """Run a trial, and return its records as a robot journals them."""
    seed, max_steps = configuration.simulator.seed, configuration.simulator.max_steps
    planner, robot = Planner(configuration.problem, configuration.planning), Journalling()
    run_trial(planner, seed, number, max_steps=max_steps, observer=robot)
    return robot.records, replay(planner, seed, number, robot.records)


def _known(values: FloatArray | None) -> FloatArray:
    assert values is not None
    return values


@pytest.fixture
def configuration(tmp_path: Path) -> Configuration:
    return configuration_of(tmp_path, max_steps=20)


def test_the_same_facts_as_of_the_trial_itself(configuration: Configuration) -> None:
    records, history = a_trial(configuration, 1)
    facts = Facts()
    follower = Follower(configuration, facts, clock=lambda: 0)
    for record in records[:-1]:  # the last one is in the result
        follower.records(1, [record], 0)
    follower.finished(history.result(Ending("failed", "it fell")), 0)
    expected = Steps()
    run_trial(
        Planner(configuration.problem, configuration.planning),
        configuration.simulator.seed, 1, max_steps=20, observer=expected,
    )  # fmt: skip
    assert len(facts.of(SensingFact)) == len(expected.sensing) > 1
    for fact, step in zip(facts.of(SensingFact), expected.sensing, strict=True):
        shown = fact.step
        assert shown.sensing_action == step.sensing_action
        entropies = _known(step.sensing_info.entropies)
        assert np.array_equal(shown.sensing_info.entropies, entropies)
        assert np.array_equal(shown.observation, _known(step.observation))
        assert digest(shown.before) == digest(step.before)
        assert digest(shown.after) == digest(step.after)
        assert shown.observation_info == step.observation_info
    world = SimulatedEnvironment(configuration.problem, configuration.simulator.seed, 1)
    for fact, acted in zip(facts.of(TaskFact), expected.tasks, strict=True):
        assert fact.step.executed.tobytes() == acted.executed.tobytes()
        assert digest(fact.step.state) == digest(acted.state)
        assert fact.step.task_info.estimate.tolist() == acted.task_info.estimate.tolist()
        assert fact.true_state.tolist() == world.state.tolist()
        world.perform(fact.step.executed)
    (end,) = facts.of(TrialEndFact)
    assert end.steps == 20
    assert (end.result.outcome, end.result.reason) == ("failed", "it fell")
    assert end.belief.states.tobytes() == history.state.belief.states.tobytes()
    assert (follower.steps, follower.left_out) == (20, 0)


def test_what_is_late_is_folded_and_not_shown(configuration: Configuration) -> None:
    records, history = a_trial(configuration, 0)
    facts = Facts()
    now = 0
    follower = Follower(configuration, facts, clock=lambda: now)
    middle = len(records) // 2
    now = 4 * SECOND
    follower.records(0, records[:middle], SECOND // 2)
    assert facts.of(SensingFact) == facts.of(TaskFact) == []
    left_out = follower.left_out
    assert left_out > 0
    follower.records(0, records[middle:], now)
    follower.finished(history.result(None), now)
    assert follower.left_out == left_out
    assert len(facts.of(TaskFact)) == follower.steps - left_out
    assert facts.all[-1].belief.states.tobytes() == history.state.belief.states.tobytes()


def test_the_files_of_a_run_that_goes_on(configuration: Configuration, tmp_path: Path) -> None:
    records, history = a_trial(configuration, 1)
    events = tmp_path / "events.jsonl"
    events.write_text('{"time":"2026-11-26T13:00:00Z","event":"before"}\n{"time":"2026-1')
    facts = Facts()
    follower = Follower(configuration, facts)
    answer = ("tcp/a:1", "standard", 1.0, 2.0, 3.0)
    with Journal.create(tmp_path / "journal.bin", {}) as journal:
        journal.append(1, records[:2])
        files = RunFiles(tmp_path)
        # The robot's tables are opened later, and what a crash has cut short is removed.
        table = EventTable(tmp_path / "timings.csv", Timing)
        events.write_text('{"time":"2026-11-26T13:00:00Z","event":"before"}\n')
        for _ in range(2):
            files.tell(follower, facts, time.time_ns())
            assert [fact.step.state.step for fact in facts.of(TaskFact)] == [0]
        with events.open("a") as log:
            log.write('{"time":"2026-11-26T13:00:01Z","component":"robot","eve')
            log.flush()
            table.add(Timing(1, 1, "task", *answer))
            journal.append(1, records[2:4])
            files.tell(follower, facts, time.time_ns())
            assert facts.of(EventFact) == []
            log.write('nt":"holding","reason":"r"}\n')
        # The table is read after the journal, so what it says of the next trial may come early.
        table.add(Timing(2, 0, "sensing", *answer))
        journal.append(1, records[4:-1])
        result = history.result(None)
        journal.add(result)
        files.tell(follower, facts, time.time_ns())
        journal.append(2, a_trial(configuration, 2)[0])
        files.tell(follower, facts, time.time_ns())
        table.close()
    (event,) = facts.of(EventFact)
    assert (event.name, event.fields) == ("holding", {"component": "robot", "reason": "r"})
    (end,) = facts.of(TrialEndFact)
    assert end.result.digest == result.digest
    assert end.belief.states.tobytes() == history.state.belief.states.tobytes()
    first, second, third, *_ = facts.of(TaskFact)
    assert first.decider is None
    assert second.decider.service == "tcp/a:1"
    assert third.decider == second.decider  # of the same answer
    (sensed, *_) = (fact for fact in facts.of(SensingFact) if fact.step.before.trial == 2)
    assert sensed.decider.service == "tcp/a:1"
    assert sensed.decided_ns <= sensed.observed_ns
    assert [fact.trial for fact in facts.of(TrialBeginFact)] == [1, 2]


def test_an_observation_that_comes_late(configuration: Configuration) -> None:
    planner = Planner(configuration.problem, configuration.planning)
    seed = configuration.simulator.seed
    history = Trial(planner, seed, 0)
    world = SimulatedEnvironment(configuration.problem, seed, 0)
    shown = np.asarray(world.perform_sensing(1), dtype=np.float64)
    observed = sense(history, 1, None)
    action, _ = planner.choose_task_action(history.state)
    history.pending = action
    performed = Moved(0, None)
    history.take(performed)
    late, found = come_late(history, 0, shown), history.found
    facts = Facts()
    follower = Follower(configuration, facts, clock=lambda: 0)
    acting = ActingRecord(0, encode_floats(action))
    follower.records(0, [observed, acting, performed, late], 0)
    follower.end(0)
    (sensed,) = facts.of(SensingFact)
    assert (sensed.step.sensing_action, sensed.step.observation) == (1, None)
    assert sensed.step.observation_info.explained
    (came_late,) = facts.of(LateFact)
    taken, after, info = came_late.step
    assert (after.step, taken.taken, info) == (1, 0, found)
    assert taken.observation == shown.tobytes()
    assert digest(after) == digest(history.state)
    assert facts.all[-1].belief.states.tobytes() == history.state.belief.states.tobytes()
