"""A trial as a chart: what is kept of it, and where it has no truth, scene or scores."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.recordings import a_sensing_step, a_task_step, configuration_of, result_of

from holdfast.planning.belief import Belief
from holdfast.problems.problem import Scene
from holdfast.reports.facts import SensingFact, TaskFact, TrialBeginFact, TrialEndFact
from holdfast.reports.trial_chart import MAX_PARTICLES, TrialChart

STATES = np.linspace(0.0, 2.0, 3 * 200).reshape(200, 3)
BELIEF = Belief(STATES, np.full(200, 1 / 200))


def drawn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scene: Scene | None) -> Any:
    """Return the chart of 40 steps, ten of them with sensing, of which five each shall be kept."""
    configuration = configuration_of(tmp_path)
    monkeypatch.setattr(configuration.problem, "scene", lambda: scene, raising=False)
    result = result_of(0, sensing_ms=(1.0,) * 10)
    chart = TrialChart(configuration, msgspec.structs.replace(result, steps=40), 5)
    chart.trial_begins(TrialBeginFact(0, 0))
    for step in range(40):
        if step % 4 == 2:
            entropies = np.array([3.0, 1.0, 2.0])
            sensed = a_sensing_step(BELIEF, 1, step=step, entropies=entropies)
            chart.sensed(SensingFact(sensed, 0, 0, None))
        task = a_task_step(BELIEF, np.zeros(3), STATES[step])
        at = task.state._replace(step=step)
        chart.acted(TaskFact(task._replace(state=at), 0, None, STATES[step] if scene else None))
    chart.trial_ends(
        TrialEndFact(0, 0, 40, None, BELIEF, STATES[40], STATES[40] if scene else None)
    )
    assert chart.left_out
    return chart.chart()


def test_what_is_kept_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene((0, 1), (0, 0, 4, 4), targets=[(1, 2)], walls=[((2, None), (1, 0, 1.1, 4))])
    chart = drawn(tmp_path, monkeypatch, scene)
    steps, beliefs = chart["datasets"]["steps"], chart["datasets"]["beliefs"]
    assert [row["s"] for row in steps] == [0, 2, 8, 10, 16, 18, 24, 26, 32, 34, 40]
    assert [row["s"] for row in steps if row["sensed"]] == [2, 10, 18, 26, 34]
    assert all(len(row["x0"]) == len(row["y1"]) <= MAX_PARTICLES for row in beliefs)
    assert [row["of"] for row in beliefs[:3]] == ["belief", "before sensing", "belief"]
    first = steps[0]
    assert first["t0"] == first["m0"] == 0.0
    assert [first[f"w0{end}"] for end in "abcd"] == pytest.approx(
        [1.0 + STATES[0, 2], 0.0, 1.1 + STATES[0, 2], 4.0], rel=1e-4
    )
    scores = chart["datasets"]["entropies"][0]
    assert scores["c"] == ["not chosen", "chosen", "not chosen"]
    names = {layer.get("name") for layer in chart["concat"][0]["vconcat"][0]["layer"]}
    assert {"particles0", "particles1"} <= names


def test_without_a_scene_and_a_true_state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chart = drawn(tmp_path, monkeypatch, None)
    assert not any("t0" in row for row in chart["datasets"]["steps"])
    plane = chart["concat"][0]["vconcat"][0]["layer"]
    assert all(layer["encoding"]["x"]["scale"]["domain"][1] > 0.4 for layer in plane)
