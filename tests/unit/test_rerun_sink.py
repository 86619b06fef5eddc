"""Facts as Rerun shows them: written to a file, and read back by Rerun's own reader."""

from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rerun.chunk import RrdReader
from tests.recordings import a_sensing_step, a_task_step, result_of

from holdfast.config.loader import Configuration, load
from holdfast.planning.belief import Belief
from holdfast.planning.inputs import Late, encode_floats
from holdfast.planning.outcome import TrialResult
from holdfast.protocol.robot_events import Timing
from holdfast.reports.facts import (
    EventFact,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
)
from holdfast.reports.rerun_sink import MAX_PARTICLES, RerunSink
from holdfast.reports.view_target import ViewTarget
from holdfast.robot.trial import LateStep

EXAMPLES = Path(__file__).parents[2] / "examples"


DECIDER = Timing(0, 0, "task", "tcp/10.0.0.7:7447", "local_recovery", 1.0, 2.0, 3.0)
MS = 1_000_000


def belief_of(count: int, *, size: int = 3) -> Belief:
    states = np.arange(count * size, dtype=np.float64).reshape(count, size) / count
    weights = np.arange(1.0, count + 1.0)
    return Belief(states, weights / weights.sum())


def shown(
    tmp_path: Path,
    write: Callable[[RerunSink], object],
    problem: str = "peg_in_hole_2d",
    *,
    has_times: bool = True,
    configuration: Configuration | None = None,
) -> tuple[dict[str, list[dict[str, Any]]], dict[str, list[dict[str, Any]]]]:
    """Return the rows under each path of the recording, and those of its blueprint."""
    file = tmp_path / "shown.rrd"
    if configuration is None:
        configuration = load(EXAMPLES / f"{problem}.yaml")
    with RerunSink(
        configuration, ViewTarget(None, str(file)), has_times=has_times, live=False
    ) as sink:
        write(sink)
    reader = RrdReader(file)
    (blueprint,) = reader.blueprints()
    return _rows(reader.stream()), _rows(reader.stream(store=blueprint))


def _rows(stream: Any) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for chunk in stream.to_chunks():
        found[chunk.entity_path.replace("\\", "")] += chunk.to_record_batch().to_pylist()
    return found


def values(rows: list[dict[str, Any]], name: str) -> list[Any]:
    return [row[name] for row in rows if row.get(name) is not None]


def a_trial(sink: RerunSink, trial: int = 0, at: int = 10 * MS, particles: int = 2) -> None:
    belief = belief_of(particles)
    estimate = np.array([2.5, 2.0, 0.1])
    sink.trial_begins(TrialBeginFact(trial, at))
    sink.sensed(
        SensingFact(
            a_sensing_step(
                belief, 2, trial=trial, entropies=np.array([-1.0, np.inf, -2.0]),
                observation=np.array([0.2]), explained=False, mahalanobis_distance=9.0,
            ),
            at, at + MS, DECIDER,
        )
    )  # fmt: skip
    acted = a_task_step(belief, np.array([-0.1, 0.0, 0.0]), estimate, trial=trial)
    sink.acted(TaskFact(acted, at + 2 * MS, DECIDER, np.array([2.4, 2.1, 0.0])))
    sink.trial_ends(TrialEndFact(trial, at + 3 * MS, 1, result_of(trial), belief, estimate))


def test_a_step_in_all_its_parts(tmp_path: Path) -> None:
    rows, _ = shown(tmp_path, a_trial)
    # The viewer has no scale for what is infinite.
    (scores,) = values(rows["/scores"], "Scalars:scalars")
    assert scores[0] == -1.0
    assert np.isnan(scores[1])
    assert values(rows["/scores"], "SeriesLines:names") == [["x", "y", "θ", "no sensing"]]
    assert values(rows["/scores/chosen"], "Scalars:scalars") == [[-2.0]]
    assert values(rows["/filter/effective_sample_size"], "Scalars:scalars") == [[1.5]]
    assert values(rows["/filter/mahalanobis_distance/unexplained"], "Scalars:scalars") == [[9.0]]
    estimate, lower, upper = values(rows["/state/x (m)"], "Scalars:scalars")[0]
    assert (estimate, upper - estimate) == (2.5, pytest.approx(estimate - lower))
    assert values(rows["/state/x (m)/true"], "Scalars:scalars") == [[2.4]]
    assert values(rows["/world/truth"], "Transform3D:translation") == [[[2.4, 2.1, 0.0]]] or (
        np.allclose(values(rows["/world/truth"], "Transform3D:translation")[0], [[2.4, 2.1, 0.0]])
    )
    (arrow,) = values(rows["/world/action"], "Arrows3D:vectors")
    assert np.allclose(arrow, [[-0.1, 0.0, 0.0]])
    for path in ("/world/obstacles", "/world/estimate/body", "/world/truth/body"):
        assert rows[path], path
    states = {
        name: [state for (state,) in values(rows[f"/decisions/{name}"], "StateChange:state")]
        for name in ("decider", "sensing_action", "status", "trial")
    }
    assert states == {
        "decider": ["tcp/10.0.0.7:7447"],
        "sensing_action": ["θ"],
        "status": ["local_recovery"],
        "trial": ["trial 0", "succeeded"],
    }
    log = [text for (text,) in values(rows["/log"], "TextLog:text")]
    assert log == [
        "trial 0 begins",
        "trial 0, step 0: no particle explains the observation of θ",
        "trial 0 succeeded after 10 steps, 0 sensing actions; reward -1",
    ]


def test_particles_are_coloured_by_weight_and_bounded(tmp_path: Path) -> None:
    rows, _ = shown(tmp_path, lambda sink: a_trial(sink, particles=2 * MAX_PARTICLES + 1))
    positions = values(rows["/world/belief"], "Points3D:positions")
    assert {len(each) for each in positions} <= set(range(MAX_PARTICLES // 2, MAX_PARTICLES + 1))
    colors = values(rows["/world/belief"], "Points3D:colors")[0]
    assert colors[0] < colors[-1]  # red, the highest byte, grows with the weight


def test_the_timelines(tmp_path: Path) -> None:
    def two_trials(sink: RerunSink) -> None:
        a_trial(sink, 4, 10 * MS)
        a_trial(sink, 7, 20 * MS)

    rows, _ = shown(tmp_path, two_trials)
    begun = [row for row in rows["/log"] if row["TextLog:text"][0].endswith("begins")]
    # No trial lies over another one.
    assert [(row["step"], row["trial"]) for row in begun] == [(0, 4), (2, 7)]
    assert [row["time"].timestamp() for row in begun] == [0.01, 0.02]
    rows, _ = shown(tmp_path, a_trial, has_times=False)
    assert rows["/log"][0]["time"].total_seconds() == 0.01


def test_events(tmp_path: Path) -> None:
    def happen(sink: RerunSink) -> None:
        fields = {"component": "robot", "from": "standard", "to": "local_recovery"}
        sink.happened(EventFact(MS, "status", fields))
        sink.happened(EventFact(MS, "trial", {"trial": 0}))
        sink.happened(EventFact(MS, "holding", {"reason": "no answer"}))

    rows, _ = shown(tmp_path, happen)
    assert values(rows["/decisions/status"], "StateChange:state") == [["local_recovery"]]
    assert values(rows["/log"], "TextLog:text") == [
        ["status: standard -> local_recovery"],
        ["holding: no answer"],
    ]
    assert values(rows["/log"], "TextLog:level") == [["WARN"], ["WARN"]]


def test_a_late_observation_and_the_choice_not_to_sense(tmp_path: Path) -> None:
    def happen(sink: RerunSink) -> None:
        belief = belief_of(2)
        sink.sensed(SensingFact(a_sensing_step(belief, 3, step=3), MS, 2 * MS, None))
        for explained in (False, True):
            after = a_sensing_step(belief, 3, step=5, explained=explained)
            late = Late(5, 2, encode_floats([0.1]))
            step = LateStep(late, after.after, after.observation_info)
            sink.observed_late(LateFact(step, 3 * MS))

    rows, _ = shown(tmp_path, happen)
    assert values(rows["/decisions/sensing_action"], "StateChange:state") == [["no sensing"]]
    assert not rows["/world/sensing/label"]
    assert [(row["TextLog:level"][0], row["TextLog:text"][0]) for row in rows["/log"]] == [
        ("WARN", "trial 0, step 5: the observation of step 2 came, which no particle explains"),
        ("INFO", "trial 0, step 5: the observation of step 2 came"),
    ]
    assert values(rows["/world/belief"], "step") == [3, 3, 5, 5]


@pytest.mark.parametrize(
    ("outcome", "words"),
    [
        ({"success": False, "failed": True, "reason": "dropped the peg"},
         "failed after 10 steps, 0 sensing actions: dropped the peg; reward -1"),
        (None, "1 steps so far; not finished"),
    ],
)  # fmt: skip
def test_endings(tmp_path: Path, outcome: dict[str, Any] | None, words: str) -> None:
    import msgspec

    result: TrialResult | None = None
    if outcome is not None:
        result = msgspec.structs.replace(result_of(0), **outcome)

    def end(sink: RerunSink) -> None:
        sink.trial_begins(TrialBeginFact(0, MS))
        sink.trial_ends(TrialEndFact(0, 2 * MS, 1, result))

    rows, _ = shown(tmp_path, end)
    assert words in values(rows["/log"], "TextLog:text")[-1][0]


def test_the_blueprint_shows_every_path_that_is_logged(tmp_path: Path) -> None:
    rows, layout = shown(tmp_path, a_trial)
    all_rows = [row for found in layout.values() for row in found]
    origins = [origin for (origin,) in values(all_rows, "ViewBlueprint:space_origin")]
    assert len(origins) == 1 + 1 + 3 + 2 + 1 + 1
    for path in rows:
        assert path.startswith("/__properties") or any(
            path.startswith(origin if origin.startswith("/") else f"/{origin}")
            for origin in (each.replace("\\", "") for each in origins)
        ), path
    assert values(all_rows, "TimePanelBlueprint:timeline") == [["step"]]


class TestWithoutAPose:
    def test_a_drawing_says_what_to_draw(self, tmp_path: Path) -> None:
        rows, _ = shown(
            tmp_path,
            lambda sink: sink.trial_ends(
                TrialEndFact(0, MS, 0, None, belief_of(4, size=2), np.array([1.0, 2.0]))
            ),
            "light_dark_room",
        )
        places = np.array(values(rows["/world/belief"], "Points3D:positions")[0])
        assert np.allclose(places[:, :2], belief_of(4, size=2).states)

    def test_without_a_drawing_there_are_histograms_and_plots(self, tmp_path: Path) -> None:
        def end(sink: RerunSink) -> None:
            sink.trial_ends(TrialEndFact(0, MS, 0, None, belief_of(4, size=1), np.array([1.0])))

        rows, layout = shown(tmp_path, end, "corridor_doors")
        assert not [path for path in rows if path.startswith("/world")]
        assert rows["/state/x (m)"]
        (shares,) = values(rows["/belief/x (m)"], "BarChart:values")
        assert sum(shares[0]["buffer"] if isinstance(shares[0], dict) else shares) > 0
        kinds = [row for found in layout.values() for row in found]
        assert ["3D"] not in values(kinds, "ViewBlueprint:class_identifier")


def test_space(tmp_path: Path) -> None:
    def end(sink: RerunSink) -> None:
        sink.trial_begins(TrialBeginFact(0, MS))
        state = np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
        sink.trial_ends(TrialEndFact(0, 2 * MS, 1, None, belief_of(4, size=6), state))

    rows, layout = shown(tmp_path, end, "peg_in_hole_3d")
    (place,) = values(rows["/world/estimate"], "Transform3D:translation")
    assert np.allclose(place, [[1.0, 2.0, 3.0]])
    (half,) = values(rows["/world/estimate/body"], "Boxes3D:half_sizes")
    assert np.allclose(half, [[0.5, 0.5, 1.0]])
    eye = [row for path, found in layout.items() if "EyeControls3D" in path for row in found]
    assert values(eye, "EyeControls3D:eye_up") == [[[0.0, 0.0, 1.0]]]
