"""The tables of an exported run: what is not known is an empty cell."""

import csv
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from tests.recordings import a_sensing_step, a_task_step, configuration_of, result_of

from holdfast.planning.belief import Belief
from holdfast.planning.inputs import Late, encode_floats
from holdfast.protocol.robot_events import Timing
from holdfast.reports.csv_export import TABLES, CsvSink, state_labels
from holdfast.reports.facts import (
    EventFact,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
)
from holdfast.robot.trial import LateStep


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_rows(tmp_path: Path) -> None:
    problem = configuration_of(tmp_path).problem
    tables = tmp_path / "tables"
    tables.mkdir()
    belief = Belief(np.array([[0.1 + 0.2, 0.0, 1.0]]), np.array([1.0]))
    decider = Timing(0, 0, "sensing", "local", "standard", 1.5, math.nan, math.nan)
    with CsvSink(tables, problem) as sink:
        sink.trial_begins(TrialBeginFact(0, 1_000_000_000))
        sensed = a_sensing_step(belief, 2)
        sink.sensed(SensingFact(sensed, 1_500_000_000, 1_600_000_000, decider))
        action, estimate = np.array([0.5, -0.0, 1e-300]), belief.states[0]
        sink.acted(TaskFact(a_task_step(belief, action, estimate), 1_700_000_000, None))
        again = a_sensing_step(belief, 1, step=1)
        sink.sensed(SensingFact(again, 2_500_000_000, 2_600_000_000, None))
        sink.happened(EventFact(2_700_000_000, "status", {"status": "für"}))
        late = Late(1, 0, encode_floats([0.25]))
        step = LateStep(late, again.after, again.observation_info)
        sink.observed_late(LateFact(step, 2_800_000_000))
        sink.trial_ends(TrialEndFact(0, 3_000_000_000, 1, None))
        sink.trial_begins(TrialBeginFact(1, 3_500_000_000))
        sink.trial_ends(TrialEndFact(1, 4_000_000_000, 10, result_of(1)))
    assert sorted(path.name for path in tables.iterdir()) == sorted(TABLES)
    first, second = rows_of(tables / "steps.csv")
    assert (first["sensing_time"], first["action_time"]) == ("1.500000000", "1.700000000")
    assert (first["sensing_service"], first["sensing_waited_ms"]) == ("local", "1.5")
    assert (first["sensing_round_trip_ms"], first["action_service"]) == ("", "")
    actions = [first[f"action_{index}"] for index in range(problem.action_size)]
    assert actions == ["0.5", "-0.0", "1e-300"]
    # It ends in mid-step.
    assert (second["step"], second["sensing_action"], second["action_time"]) == ("1", "1", "")
    assert [row["outcome"] for row in rows_of(tables / "trials.csv")] == ["unfinished", "succeeded"]
    particles = rows_of(tables / "beliefs.csv")
    assert [row["when"] for row in particles] == ["sensing", "acting", "sensing"]
    assert float(particles[0][state_labels(problem)[0]]) == 0.1 + 0.2
    status, came = rows_of(tables / "events.csv")
    assert (status["event"], status["fields"]) == ("status", '{"status": "für"}')
    assert (came["event"], came["trial"]) == ("late_observation", "0")
    assert '"taken": 0, "observation": [0.25]' in came["fields"]


def test_labels_are_those_of_the_problem_if_it_has_one_for_each(tmp_path: Path) -> None:
    assert state_labels(configuration_of(tmp_path).problem) == ["x (m)", "y (m)", "θ (rad)"]
    some: Any = SimpleNamespace(state_size=3, state_labels=("x", "x", "y"))
    assert state_labels(some) == ["state_0", "state_1", "state_2"]
