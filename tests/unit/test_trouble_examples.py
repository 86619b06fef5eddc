"""The examples of robots in trouble: each is found, told, and mended as its page says."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tests.command_line import Workplace
from tests.recordings import decided

from holdfast.config.loader import Configuration, load
from holdfast.planning.outcome import TrialResult
from holdfast.planning.settings import LostSettings, OnLost
from holdfast.robot.environment_maker import load_environment

EXAMPLES = Path(__file__).parents[2] / "examples"
TRIALS = 10


def example(name: str, **overrides: Any) -> Configuration:
    return load(EXAMPLES / f"{name}.yaml", overrides={"simulator.seed": 1, **overrides})


def results_of(configuration: Configuration, on_lost: OnLost) -> list[TrialResult]:
    make = load_environment(configuration)
    lost = LostSettings(on_lost=on_lost)
    return [
        decided(configuration, trial, environment=make(trial), lost=lost) for trial in range(TRIALS)
    ]


def successes(configuration: Configuration, on_lost: OnLost = "continue") -> int:
    return sum(result.success for result in results_of(configuration, on_lost))


def run(workplace: Workplace, name: str, *, export: bool = False) -> list[dict[str, Any]]:
    """Run the example as its page says, and return its events."""
    words = ("--trials", "1", "--seed", "1", "--quiet", "--out", "run")
    workplace.runs("run", str(EXAMPLES / f"{name}.yaml"), *words)
    if export:
        workplace.runs("export", "run", "--csv", "csv", "--problem-directory", str(EXAMPLES))
    events = (workplace.directory / "run" / "events.jsonl").read_text()
    return [json.loads(line) for line in events.splitlines()]


def test_a_kidnapped_robot_is_told_and_finds_its_dock(workplace: Workplace) -> None:
    """Of 40 trials all reach the dock with a new belief, and none without it."""
    configuration = example("kidnapped_robot")
    anew = results_of(configuration, "reinitialise")
    assert sum(result.success for result in anew) == TRIALS
    assert [result.lost for result in anew] == [1] * TRIALS
    assert successes(configuration) == 0
    # What was recorded can be believed again, the new belief included.
    events = run(workplace, "kidnapped_robot", export=True)
    (lost,) = [event for event in events if event["event"] == "lost"]
    assert 20 < lost["step"] < 60
    (anew_at,) = [event["step"] for event in events if event["event"] == "reinitialised"]
    assert anew_at == lost["step"]


def test_a_robot_that_nobody_carries_is_not_lost() -> None:
    """Each trial has some 20 observations, so with this rate an alarm comes once in 50 tests."""
    configuration = example("kidnapped_robot", **{"environment.arguments": {"at_step": -1}})
    assert [result.lost for result in results_of(configuration, "reinitialise")] == [0] * TRIALS


def test_a_dead_sensor_is_named_and_can_be_left_out(workplace: Workplace) -> None:
    """Of 40 trials 35 name it at first, and 5 say lost; all reach the bay without that sensor."""
    dead = results_of(example("dead_sensor"), "continue")
    assert sum(result.suspect_sensors > 0 for result in dead) >= 6
    assert sum(result.success for result in dead) <= 2
    assert successes(example("dead_sensor", **{"model.left_out": 0})) == TRIALS
    events = run(workplace, "dead_sensor")
    suspect = next(event for event in events if event["event"] == "sensor_suspect")
    assert suspect["sensing_action"] == "0 (receiver x)"
    assert suspect["step"] > 30


def test_backlash_is_seen_in_the_measured_motion(workplace: Workplace) -> None:
    """Of 40 trials all reach the mark with the encoder, and 12 without."""
    blind = example("backlash", **{"environment.arguments": {"encoder": False}})
    assert successes(example("backlash")) == TRIALS
    assert successes(blind) <= 7
    run(workplace, "backlash", export=True)
    with (workplace.directory / "csv" / "steps.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["action_0"]]
    back = [row for row in rows if row["stage"] == "1"]
    motion = np.array([float(row["motion"]) for row in back[:8]])
    assert [float(row["action_0"]) for row in back[:8]] == pytest.approx([-0.1] * 8)
    # 0.4 m of play are four steps; then it moves as it is told.
    assert np.abs(motion[:3]).max() < 0.05
    assert motion[5:].max() < -0.05
