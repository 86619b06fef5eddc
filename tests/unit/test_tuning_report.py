"""What a tuning leaves behind."""

from pathlib import Path

import msgspec
import pytest

from holdfast.config.loader import load
from holdfast.tuning.candidates import changed
from holdfast.tuning.tuning_report import (
    CandidateRow,
    Tuning,
    tuned_yaml,
    tuning_figure,
    tuning_tables,
    write_report,
)
from holdfast.tuning.verdict import Comparison

CHANGES = {"selector.method": "state_entropy", "selector.resolution": [0.3, 0.3, 0.1]}
SUCCESS = Comparison(
    candidate="state_entropy",
    against="random",
    measure="success",
    value=0.9,
    other=0.5,
    difference=0.4,
    interval=(0.3, 0.5),
)
STEPS = msgspec.structs.replace(
    SUCCESS, measure="steps", value=41.0, other=40.0, difference=1.0, interval=(-1.0, 3.0)
)
FOUND = Tuning(
    sentence="Sense by state_entropy: 41 steps.",
    choice="state_entropy",
    changes=CHANGES,
    matters=True,
    objective="steps",
    fresh_trials=80,
    comparisons=(SUCCESS, STEPS),
    candidates=(
        CandidateRow(
            candidate="state_entropy",
            changes=CHANGES,
            trials=200,
            cost=40.0,
            difference=-3.0,
            interval=(-4.0, -2.0),
            success=0.9,
            decision_ms=1.5,
            trial_s=0.2,
            state="in the race",
        ),
        CandidateRow(candidate="slow|er", changes={}, trials=0, state="refused: it fails"),
    ),
)


def test_the_configuration_with_the_keys_that_changed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    path = tmp_path / "mine" / "run.yaml"
    (path.parent / "room.py").write_text("from tests.line_problem import Line\n")
    path.write_text("problem: room:Line\nselector: {sensing_action: 1}\noffload: {tls: keys}\n")
    given = {"particle_filter.num_particles": 40, "simulator.seed": 5, "selector.resolution": 0.2}
    base = load(path, overrides=given)
    found = tuned_yaml(base, FOUND)
    # From another directory, the module and the credentials are found.
    expected = changed(base, {"selector.method": "state_entropy", "selector.resolution": 0.1})
    one = found.replace("resolution: [0.3, 0.3, 0.1]", "resolution: 0.1")
    (tmp_path / "tuned.yaml").write_text(one)
    assert load(tmp_path / "tuned.yaml") == expected
    assert "# Sense by state_entropy: 41 steps.\n" in found
    assert '# selector.method was "path_entropy".\n# selector.resolution was 0.2.\n' in found
    assert "active_sensing" not in found


def test_tables(tmp_path: Path) -> None:
    text = tuning_tables(FOUND)
    assert "| success (%) | 90 " in text
    assert "| +40        | [+30, +50] | better " in text
    assert "| [-1, +3]   | within noise |" in text
    assert "| slow\\|er " in text
    run = tmp_path / "run.yaml"
    run.write_text("problem: peg_in_hole_2d\n")
    write_report(tmp_path, load(run), FOUND)
    assert (tmp_path / "tune.md").read_text() == text
    first, second = FOUND.to_pandas().to_dict("records")
    assert (first["low"], first["high"], first["trials"]) == (-4.0, -2.0, 200)
    assert second["state"] == "refused: it fails"
    assert (tmp_path / "candidates.csv").read_text().count("\n") == 3


def test_the_figure() -> None:
    pytest.importorskip("matplotlib")
    assert tuning_figure(FOUND).startswith(b"\x89PNG")
