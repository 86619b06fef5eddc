"""What a robot tells of what it observes, and does where it is lost, through its state machine."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from tests.robot_world import PLANNING, PROBLEM, World

from holdfast.errors import HeldError
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.belief import ObservationInfo
from holdfast.planning.inputs import Record, Reinitialised, Sensed
from holdfast.planning.lost import MOVE, Verdict
from holdfast.planning.outcome import MoveResult, TrialResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import LostSettings, OnLost, SimulatorSettings
from holdfast.planning.tracking import Trial, replay
from holdfast.protocol.effects import Effects, LogEvent
from holdfast.protocol.observation_warnings import ObservationWarnings
from holdfast.protocol.robot_events import Halt, RobotEffect, WriteRecords
from holdfast.robot.environment import SimulatedEnvironment
from holdfast.robot.trial import run_trial

SIMULATOR = SimulatorSettings(num_trials=1, max_steps=120, seed=11)


class Kidnapped(SimulatedEnvironment):
    """Somebody moves the peg every 40 steps, far away."""

    def perform(self, task_action: FloatArray) -> float | MoveResult | None:
        reward = super().perform(task_action)
        if self.step % 40 == 0:
            self.state = self.state + np.array([9.0, 9.0, 1.0])
        return reward


def world_of(
    on_lost: OnLost,
    records: tuple[Record, ...] = (),
    prepare: Callable[[World], None] = lambda _: None,
) -> World:
    world = World(simulator=SIMULATOR, on_lost=on_lost)
    world.environment_class = Kidnapped
    prepare(world)
    world.start(records=records)
    world.run()
    return world


def in_process(on_lost: OnLost) -> TrialResult:
    return run_trial(
        Planner(PROBLEM, PLANNING),
        SIMULATOR.seed,
        max_steps=SIMULATOR.max_steps,
        environment=Kidnapped(PROBLEM, SIMULATOR.seed, 0),
        lost=LostSettings(on_lost=on_lost),
    )


class Blinking(SimulatedEnvironment):
    """Every second look has no reading."""

    def perform_sensing(self, sensing_action: int) -> Any:
        return None if self.step % 8 else super().perform_sensing(sensing_action)


def test_what_gave_no_reading_is_told_and_counted() -> None:
    """And services decide as the loop in process does."""
    world = World(simulator=SimulatorSettings(num_trials=1, max_steps=200, seed=12))
    world.environment_class = Blinking
    world.start_and_run()
    (result,) = world.results
    told = [e.fields for _, e in world.trace if isinstance(e, LogEvent) and e.name == "no_reading"]
    assert result.missing_observations > 10
    assert len(told) == 10
    assert [each["step"] for each in told] == list(range(4, 84, 8))
    assert told[0]["sensing_action"] in range(3)
    assert str(told[-1]["reason"]).endswith("further ones of this trial are counted only")
    assert world.robot.reports.counts["no_reading"] == result.missing_observations
    expected = run_trial(
        Planner(PROBLEM, PLANNING), 12, max_steps=200, environment=Blinking(PROBLEM, 12, 0)
    )
    assert result.digest == expected.digest
    assert result.missing_observations == expected.missing_observations


def test_a_lost_robot_is_told_and_goes_on() -> None:
    world = world_of("continue")
    told = world.reports("lost")
    assert len(told) == world.results[0].lost > 0
    assert told[0]["step"] in range(41, 80)
    assert told[0]["false_alarm_rate"] == 1e-4
    assert 5 <= told[0]["outside"] <= told[0]["observations"]  # type: ignore[operator]
    assert not world.reports("reinitialised")
    assert not any(isinstance(record, Reinitialised) for record in world.journal)


def test_a_lost_robot_begins_its_belief_anew() -> None:
    """As the planner in process does, through services, at the same steps, bit for bit."""
    world, alone = world_of("reinitialise"), in_process("reinitialise")
    (result,) = world.results
    assert result.digest == alone.digest != in_process("continue").digest
    assert result.lost == alone.lost == len(world.reports("lost")) > 0
    again = world.reports("reinitialised")
    assert [each["step"] for each in again] == [each["step"] for each in world.reports("lost")]
    assert result.decisions is not None
    assert len(result.decisions.reinitialised_after()) == result.lost


def written(world: World) -> tuple[Record, ...]:
    records: list[Record] = []
    for _, effect in world.trace:
        if isinstance(effect, WriteRecords):
            records += effect.records
    return tuple(records)


def test_a_robot_killed_anywhere_near_begins_it_anew_once() -> None:
    """Also between the observation and the record of the new belief."""
    whole = world_of("reinitialise")
    records = written(whole)
    at = next(i for i, record in enumerate(records) if isinstance(record, Reinitialised))
    assert isinstance(records[at - 1], Sensed)
    for length in range(at - 2, at + 4):
        again = world_of("reinitialise", records[:length])
        assert again.results[0].digest == whole.results[0].digest
        assert again.results[0].lost == whole.results[0].lost


def test_a_lost_robot_holds_still_and_can_be_resumed() -> None:
    held = world_of("hold")
    assert held.stopped is not None
    assert isinstance(held.stopped.error, HeldError)
    assert "lost.on_lost=reinitialise" in str(held.stopped.error)
    (lost,) = held.reports("lost")
    step = lost["step"]
    assert f"trial 0, step {step}," in str(held.stopped.error)
    records = tuple(held.journal)
    assert replay(held.planner, SIMULATOR.seed, 0, records).state.step == step
    # Whoever resumes it has seen to it: it goes on as if it had not held still.
    assert world_of("continue", records).results[0].digest == in_process("continue").digest
    anew = world_of("reinitialise", records)
    assert anew.results[0].digest == in_process("reinitialise").digest
    assert anew.reports("reinitialised")[0]["step"] == step


def test_hold_in_process() -> None:
    with pytest.raises(HeldError, match=r"the robot is lost in trial 0, step \d+"):
        in_process("hold")


@pytest.mark.parametrize(("action", "named"), [(2, "2 (θ)"), (MOVE, "move")])
def test_a_suspect_sensor_is_named_and_the_robot_is_not_lost(action: int, named: str) -> None:
    effects: Effects[RobotEffect] = Effects()
    reports = ObservationWarnings(effects, LostSettings(on_lost="hold"))
    trial = Trial(Planner(PROBLEM, PLANNING), 11, 0)
    trial.alarm = Verdict("sensor_suspect", action, 5, 6)
    trial.found = ObservationInfo(1.0, True, True)
    assert reports.observed(trial, 3) is None
    (told,) = effects.take()
    assert isinstance(told, LogEvent)
    assert told.name == "sensor_suspect"
    assert (told.fields["step"], told.fields["sensing_action"]) == (3, named)
    assert (told.fields["outside"], told.fields["observations"]) == (5, 6)


def test_what_else_comes_at_once_does_not_find_a_lost_robot_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of several late observations the first finds it lost, and the last is explained."""
    world = World(simulator=SIMULATOR, on_lost="hold")
    world.start()
    robot = world.robot
    found = iter(["hold", None])
    monkeypatch.setattr(robot.reports, "observed", lambda *_, **__: next(found))
    for step in (3, 2):
        robot._judge(step)
    robot._hold_if_lost()
    (halt,) = [each for each in robot._take() if isinstance(each, Halt)]
    assert "step 3" in str(halt.error)
