"""The robot's loop: its journal, its environment and its trials."""

import copy
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.robot_world import LOCAL, PLANNING, PROBLEM, FailingWorld, Misleading, World
from tests.trial_inputs import begin_anew, sense

from holdfast.errors import HeldError, UnknownPerformanceError
from holdfast.planning.inputs import ActingRecord, Late, Moved, Record, Sensed, encode_floats
from holdfast.planning.outcome import ending_of
from holdfast.planning.planner import Planner
from holdfast.planning.settings import LostSettings, OnLost, SimulatorSettings
from holdfast.planning.tracking import Trial, replay
from holdfast.protocol.effects import LogEvent
from holdfast.protocol.messages import Reply, SensingAnswer, TaskAnswer
from holdfast.protocol.question import OWN_PLANNER, InProcessSource
from holdfast.protocol.robot import Robot
from holdfast.protocol.robot_events import (
    Act,
    Acted,
    EndTrial,
    EnvironmentFailed,
    EnvironmentReady,
    Halt,
    NoReading,
    RobotEffect,
    Timing,
    WriteRecords,
)
from holdfast.reports.recorder import Recorder
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import run_trial

# -- the robot's own death ------------------------------------------------------------------------


def recorded() -> list[tuple[Record, ...]]:
    """Return what the journal held at each moment of a run without faults."""
    world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))
    stages: list[tuple[Record, ...]] = [()]
    world.start()
    carry_out = world.carry_out

    def watching(effects: list[RobotEffect]) -> None:
        for effect in effects:
            carry_out([effect])
            if isinstance(effect, WriteRecords):
                stages.append(tuple(world.journal))

    world.carry_out = watching  # type: ignore[method-assign]
    world.run()
    return stages


def test_what_earlier_processes_did_counts_in_the_result() -> None:
    """Each sensing decision with its time, and each time that another service took over."""

    def resumed(records: list[Record], lost_at: int | None, dies_at: int | None) -> World:
        world = World(simulator=SimulatorSettings(num_trials=1, max_steps=30, seed=11))
        cloud = world.services["cloud"]
        answer = cloud.answer

        def timed(payload: bytes) -> list[Reply]:
            return [
                msgspec.structs.replace(reply, computed_us=1000 * reply.step)
                if isinstance(reply, SensingAnswer)
                else reply
                for reply in answer(payload)
            ]

        cloud.answer = timed  # type: ignore[method-assign]
        world.services[LOCAL].answer = timed  # type: ignore[method-assign]

        def fault(step: int) -> None:
            if step == lost_at:
                world.kill("cloud")
                world.bring_up("cloud", 0.012)
            if step == dies_at:
                world.heap.clear()
                world.ended = True

        world.on_act = fault
        world.start(records=tuple(records))
        world.run()
        return world

    first = resumed([], 5, 12)
    second = resumed(first.journal, 16, 20)
    third = resumed(second.journal, None, None)
    (result,) = third.results
    assert result.recoveries == 2
    assert result.sensing_decisions == 8
    assert result.sensing_ms == pytest.approx([4.0 * number for number in range(8)])
    assert result.mean_sensing_ms == pytest.approx(14.0)
    assert (
        result.digest
        == run_trial(
            Planner(PROBLEM, PLANNING), third.simulator.seed, 0, max_steps=third.simulator.max_steps
        ).digest
    )


def begin_after(
    records: tuple[Record, ...], steps_performed: int | None, *, tail_is_certain: bool = True
) -> World:
    world = World()
    history = replay(Planner(PROBLEM, PLANNING), 11, 0, records)
    world.journal = list(records)
    world.environment = SimulatedEnvironment(PROBLEM, 11, 0)
    for action in history.actions:
        world.environment.perform(action)
    world.carry_out(
        world.robot.begin_trial(
            history, EnvironmentReady(None, steps_performed), 0.0, tail_is_certain=tail_is_certain
        )
    )
    return world


@pytest.mark.parametrize("on_lost", ["continue", "hold", "reinitialise"])
def test_what_came_late_is_written_before_a_pending_action_is_ordered(on_lost: OnLost) -> None:
    """And a robot that is lost by it and holds still does not order it."""
    planner = Planner(PROBLEM, PLANNING)
    history = Trial(planner, 11, 0, 1.0)
    sense(history, 0, None, 1.0)
    history.pending, _ = planner.choose_task_action(history.state)
    lost = LostSettings(false_alarm_rate=1.0, on_lost=on_lost)
    robot = Robot(planner, SimulatorSettings(), InProcessSource(), lost=lost)
    late = (Late(0, 0, encode_floats([1e3])),)
    begun = EnvironmentReady(None, 0, None, late)
    effects = robot.begin_trial(history, begun, 0.0, tail_is_certain=True)
    kinds = [type(effect) for effect in effects if not isinstance(effect, LogEvent)]
    times = 2 if on_lost == "reinitialise" else 1
    assert kinds == [*[WriteRecords] * times, Halt if on_lost == "hold" else Act]
    written = effects[[type(effect) for effect in effects].index(WriteRecords)]
    assert isinstance(written, WriteRecords)
    assert isinstance(written.records[0], Late)


def test_the_lines_about_what_nobody_awaits_are_bounded() -> None:
    planner = Planner(PROBLEM, PLANNING)
    robot = Robot(planner, SimulatorSettings(), InProcessSource())
    late = (Late(0, 7, bytes(8)),) * 1000
    begun = EnvironmentReady(None, 0, None, late)
    effects = robot.begin_trial(Trial(planner, 11, 0), begun, 0.0, tail_is_certain=True)
    told = [e.fields for e in effects if isinstance(e, LogEvent) and e.name == "late_unused"]
    assert len(told) == 10
    assert str(told[-1]["reason"]).endswith("further ones of this trial are counted only")
    assert robot.reports.counts["late_unused"] == 1000


def test_what_cannot_be_folded_in_is_not_written_down() -> None:
    """So the robot can go on once its environment is mended, which says again what it has shown."""
    planner = Planner(PROBLEM, PLANNING)
    history = Trial(planner, 11, 0)
    sense(history, 0, np.array([0.0]), 1.0)
    history.pending, _ = planner.choose_task_action(history.state)

    def begin(last: Moved) -> list[RobotEffect]:
        robot = Robot(planner, SimulatorSettings(), InProcessSource())
        begun = EnvironmentReady(None, 1, last)
        return robot.begin_trial(history, begun, 0.0, tail_is_certain=True)

    effects = begin(Moved(0, None, encode_floats([0.5])))
    assert isinstance(effects[-1], Halt)
    assert "has no move_by_measurement" in str(effects[-1].error)
    assert not any(isinstance(effect, WriteRecords) for effect in effects)
    effects = begin(Moved(0, None))
    written = [effect.records for effect in effects if isinstance(effect, WriteRecords)]
    assert written == [(Moved(0, None),)]


@pytest.mark.parametrize("lost_by", ["move", "late"])
def test_what_comes_with_a_move_is_written_before_a_lost_robot_holds_still(lost_by: str) -> None:
    """And it is still lost then for a robot that goes on and begins its belief anew."""
    settings = msgspec.structs.replace(PLANNING, sensing_interval=0)
    problem = copy.copy(PROBLEM)
    problem.move_log_likelihood = lambda states, *_: np.full(  # type: ignore[attr-defined]
        states.shape[0], -np.inf
    )
    planner = Planner(problem, settings)
    lost = LostSettings(false_alarm_rate=0.1, on_lost="hold")
    history = Trial(planner, 11, 0, lost.false_alarm_rate)
    for step in range(3):
        sense(history, 0, np.array([1e3]) if step == 1 else None, 1.0)
        history.pending, _ = planner.choose_task_action(history.state)
        history.take(Moved(step, None))
    sense(history, 0, np.array([0.0]), 1.0)
    history.pending, _ = planner.choose_task_action(history.state)
    robot = Robot(planner, SimulatorSettings(), InProcessSource(), lost=lost)
    robot.begin_trial(history, EnvironmentReady(None, 3), 0.0, tail_is_certain=True)
    late = (Late(4, 2, encode_floats([1e3])), Late(4, 0, bytes(8)))
    moved = Moved(3, None, b"", bytes(8) if lost_by == "move" else b"")
    effects = robot.handle(Acted(moved, None, late), 0.0)
    assert isinstance(effects[-1], Halt)
    written = [r for effect in effects if isinstance(effect, WriteRecords) for r in effect.records]
    assert [type(record) for record in written] == [Moved, Late, Late]
    assert history.awaited == ()
    assert history.is_lost
    begin_anew(history)
    assert not history.is_lost


def test_an_unknown_performance_stops_unless_the_environment_can_tell() -> None:
    stages = recorded()
    pending = next(s for s in stages if s and isinstance(s[-1], ActingRecord) and len(s) > 6)
    known = len([r for r in pending if isinstance(r, Moved)])
    stopped = begin_after(pending, None).stopped
    assert stopped is not None
    assert isinstance(stopped.error, UnknownPerformanceError)
    assert f"step {known}" in str(stopped.error)
    for count in (known - 1, known + 2):
        stopped = begin_after(pending, count).stopped
        assert stopped is not None
        assert isinstance(stopped.error, UnknownPerformanceError)
    for count in (known, known + 1):
        assert begin_after(pending, count).stopped is None


def test_a_tail_that_may_be_lost_stops_unless_the_environment_can_tell() -> None:
    stages = recorded()
    settled = next(s for s in stages if s and isinstance(s[-1], Sensed) and len(s) > 6)
    known = len([r for r in settled if isinstance(r, Moved)])
    assert begin_after(settled, None, tail_is_certain=True).stopped is None
    assert begin_after(settled, None, tail_is_certain=False).stopped is not None
    assert begin_after(settled, known, tail_is_certain=False).stopped is None
    assert begin_after(settled, known + 1, tail_is_certain=False).stopped is not None


def stopped_by(failure: EnvironmentFailed) -> tuple[World, Halt]:
    """Return the machine of a robot whose environment fails in the task action of step 5."""
    world = World()
    world.start()
    act = world.act

    def act_and_fail(effect: Act) -> None:
        act(effect)
        if effect.step == 5:
            world.heap = []  # What the environment would have delivered never comes.
            world.after(0.1, lambda: world.robot.handle(failure, world.now))

    world.act = act_and_fail  # type: ignore[method-assign]
    world.run()
    assert world.stopped is not None
    return world, world.stopped


@pytest.mark.parametrize(
    ("counts", "expected"), [(True, HeldError), (False, UnknownPerformanceError)]
)
def test_an_environment_that_fails_holds_the_robot(counts: bool, expected: type) -> None:
    # One that counts can say later whether the action was performed; else nobody ever can.
    failure = EnvironmentFailed(5, "perform", "the arm is stuck", True, counts_steps=counts)
    world, stopped = stopped_by(failure)
    assert type(stopped.error) is expected
    assert str(stopped.error).endswith(": the arm is stuck")
    assert ("steps_performed" in str(stopped.error)) is not counts
    assert isinstance(world.journal[-1], ActingRecord)


def test_what_fails_after_an_action_was_performed_leaves_it_in_the_journal() -> None:
    failure = EnvironmentFailed(5, "is_done", "returned None", False, Acted(Moved(5, -2.5)))
    world, stopped = stopped_by(failure)
    assert type(stopped.error) is HeldError
    assert "step 5, whose task action was performed: returned None" in str(stopped.error)
    assert world.journal[-1] == Moved(5, -2.5)
    # The effects come in this order: what is to be written down is, before the robot stops.
    resumed = begin_after(tuple(world.journal), None)
    assert resumed.stopped is None
    state = resumed.robot.state
    assert state is not None and state.step == 6


class TestFailedTask:
    """An environment says that the task has failed: the trial ends, and not with success."""

    def world(self) -> World:
        world = World(simulator=SimulatorSettings(num_trials=1, max_steps=14, seed=11))
        world.environment_class = FailingWorld
        return world

    def assert_failed(self, world: World) -> None:
        (result,) = world.results
        assert (result.outcome, result.success, result.failed) == ("failed", False, True)
        assert result.steps == FailingWorld.fails_at
        expected = run_trial(
            Planner(PROBLEM, PLANNING),
            world.simulator.seed,
            0,
            max_steps=world.simulator.max_steps,
            environment=FailingWorld(PROBLEM, world.simulator.seed, 0),
        )
        assert (result.digest, result.outcome) == (expected.digest, expected.outcome)

    def test_is_still_so_for_a_robot_that_was_killed_right_after(self) -> None:
        killed = self.world()
        killed.on_act = lambda step: setattr(killed, "ended", step == FailingWorld.fails_at - 1)
        killed.start_and_run()
        assert not killed.results
        assert isinstance(killed.journal[-1], ActingRecord)
        resumed = self.world()
        resumed.carry_out(resumed.robot.start(0.0))
        history = replay(resumed.planner, 11, 0, killed.journal)
        begun = EnvironmentReady(ending_of(killed.environment.is_done()), killed.environment.step)
        resumed.carry_out(resumed.robot.begin_trial(history, begun, 0.0, tail_is_certain=True))
        self.assert_failed(resumed)

    @pytest.mark.parametrize("environment_class", [FailingWorld, SimulatedEnvironment])
    def test_is_kept_when_the_robot_is_asked_to_end_in_the_last_action(
        self, environment_class: type[SimulatedEnvironment]
    ) -> None:
        """Nobody may be there to say it again."""
        world = self.world()
        world.environment_class = environment_class
        last = (FailingWorld.fails_at if environment_class is FailingWorld else 14) - 1
        world.on_act = lambda step: (
            world.after(0.0001, lambda: world.robot.pause(world.now)) if step == last else None
        )
        world.start_and_run()
        (result,) = world.results
        assert result.outcome == ("failed" if environment_class is FailingWorld else "truncated")
        assert result.steps == last + 1


class TestUnexplainedObservations:
    def world(self, lies: set[int], num_sensing: int, records: tuple[Record, ...] = ()) -> World:
        class Lying(Misleading):
            pass

        Lying.lies = frozenset(lies)
        world = World(simulator=SimulatorSettings(num_trials=1, max_steps=4 * num_sensing, seed=11))
        world.environment_class = Lying
        world.start(records=records)
        world.run()
        return world

    def test_each_is_told(self) -> None:
        world = self.world({2, 4}, 6)
        recorder = Recorder(trial=0)
        alike = world.environment_class(PROBLEM, world.simulator.seed, 0)
        run_trial(
            Planner(PROBLEM, PLANNING),
            world.simulator.seed,
            0,
            max_steps=world.simulator.max_steps,
            environment=alike,
            observer=recorder,
        )
        unexplained = [
            each for each in recorder.record.sensing if not each.observation_info.explained
        ]
        told = world.reports("unexplained")
        assert [(fields["step"], fields["sensing_action"]) for fields in told] == [
            (each.before.step, each.sensing_action) for each in unexplained
        ]
        assert {2 * 4, 4 * 4} <= {each.before.step for each in unexplained}
        assert len(unexplained) == world.results[0].unexplained_observations < 5
        for fields in told:
            assert fields["trial"] == 0
            assert isinstance(fields["deviations"], float)
            assert fields["deviations"] > 8.0

    def test_the_lines_are_bounded(self) -> None:
        world = self.world(set(range(1, 40)), 40)
        assert len(world.reports("unexplained")) == 10
        assert world.results[0].unexplained_observations == 39
        assert "counted only" in str(world.reports("unexplained")[-1]["reason"])

    def test_a_robot_that_was_restarted_counts_on(self) -> None:
        first = World(simulator=SimulatorSettings(num_trials=1, max_steps=32, seed=11))

        class Lying(Misleading):
            lies = frozenset(range(20))

        first.environment_class = Lying
        first.on_act = lambda step: setattr(first, "ended", step == 10)
        first.start_and_run()
        assert len(first.reports("unexplained")) == first.robot.unexplained_observations == 3
        assert not first.reports("lost")
        second = self.world(set(range(20)), 8, tuple(first.journal[:-1]))
        assert [lost["step"] for lost in second.reports("lost")] == [4 * 4]
        assert len(second.reports("unexplained")) == 5
        assert second.results[0].unexplained_observations == 8


def test_rate_paces_the_steps_and_counts_missed_ticks() -> None:
    world = World(rate_hz=20.0, launch="never")
    world.lose_the_cloud_for_a_while()
    world.complete()
    times = [at for at, e in world.trace if isinstance(e, Act)][:20]
    gaps = np.diff(times)
    assert np.count_nonzero(np.abs(gaps - 0.05) < 1e-9) >= 17
    assert 3 <= world.robot.missed_ticks <= 6
    reported = sum(int(str(f["missed"])) for f in world.reports("missed_ticks"))
    assert reported == world.robot.missed_ticks
    told = next(at for at, e in world.trace if isinstance(e, LogEvent) and e.name == "missed_ticks")
    ended = next(at for at, e in world.trace if isinstance(e, EndTrial))
    assert told < ended  # as soon as they are missed


def test_a_robot_that_takes_its_task_actions_itself_waits_at_sensing_steps_alone() -> None:
    world = World(what="sensing", rate_hz=20.0, launch="never", verify_share=1.0)
    cloud = world.services["cloud"]
    cloud.latency_s = 0.03
    answer = cloud.answer

    def lies(payload: bytes) -> Iterator[Reply]:
        for each in answer(payload):
            if isinstance(each, TaskAnswer):
                each = msgspec.structs.replace(each, actions=bytes(len(each.actions)))
            yield each

    cloud.answer = lies  # type: ignore[method-assign,assignment]
    world.lose_the_cloud_for_a_while()
    world.complete()
    timings = [e for _, e in world.trace if isinstance(e, Timing)]
    assert {(e.service, e.waited_ms) for e in timings if e.kind == "task"} == {(OWN_PLANNER, 0.0)}
    waited = [e.step for e in timings if e.kind == "sensing" and e.waited_ms and e.trial == 0]
    assert waited == [0, 12]  # the trial's first, and the one asked for while nobody was there
    assert [e["step"] for e in world.reports("holding")] == [8]
    assert 3 <= world.robot.missed_ticks <= 6
    # What the service says of task actions is not true, and not used.
    verdicts = {(each.kind, each.verdict) for each in world.verified}
    assert verdicts == {("question", "asked"), ("sensing", "same")}
    assert not world.reports("disagreement")


# -- found in review -------------------------------------------------------------------------------


def why_stopped(world: World, spoilt: Callable[[Any], Sensed | NoReading | Acted]) -> str:
    """Return why a robot stops whose environment's answers are spoilt."""
    later = world.later
    world.later = lambda event: later(spoilt(event))  # type: ignore[method-assign]
    world.start_and_run()
    assert world.stopped is not None
    return str(world.stopped.error)


def test_an_answer_for_another_step_than_was_asked_of_the_environment_stops_the_robot() -> None:
    def spoilt(event: Any) -> Any:
        wrong = isinstance(event, Acted) and event.step == 6
        return event._replace(moved=Moved(5, None)) if wrong else event

    assert "step 5 where step 6" in why_stopped(World(), spoilt)


def test_a_performance_is_written_down_before_the_robot_waits_for_anything() -> None:
    world = World(rate_hz=10.0)
    waits = 0

    def watch(step: int) -> None:
        def look() -> list[RobotEffect]:
            nonlocal waits
            waits += 1
            last = world.journal[-1] if world.journal else None
            assert not isinstance(last, ActingRecord), "killed now, nobody would know"
            return []

        world.after(0.05, look)  # between the performance and the next tick

    world.on_act = watch
    world.complete()
    assert waits >= 75


def test_an_observation_of_the_wrong_size_stops_the_robot_resumably() -> None:
    def spoilt(event: Any) -> Any:
        wrong = isinstance(event, Sensed) and event.step >= 4
        return msgspec.structs.replace(event, observation=bytes(56)) if wrong else event

    why_stopped(world := World(launch="never"), spoilt)
    history = replay(Planner(PROBLEM, PLANNING), 11, 0, world.journal)
    assert history.pending is None
    assert history.state.step == 4
