"""A grid of settings on the same worlds."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from tests.unit.test_trial import configuration_of, one

from holdfast.config.loader import Configuration, load
from holdfast.errors import InvalidValueError, OutputError
from holdfast.planning.outcome import TrialResult
from holdfast.reports.outcome_comparison import compare_outcomes
from holdfast.tuning.sweep import Sweep, SweptArm, arms_of


def arms(tmp_path: Path, axes: Mapping[str, list[Any]]) -> list[SweptArm]:
    path = configuration_of(tmp_path, num_trials=3).path

    def loaded(values: Mapping[str, Any]) -> Configuration:
        return load(path, overrides=values)

    return arms_of(axes, loaded)


AXES: dict[str, list[Any]] = {
    "selector.method": ["random", "path_entropy"],
    "particle_filter.num_particles": [30],
}


def test_the_last_key_varies_fastest_and_names_are_short(tmp_path: Path) -> None:
    found = arms(
        tmp_path,
        {
            "selector.method": ["random", "path_entropy"],
            "active_sensing.num_observation_samples": [2],
            "selector.path_offsets": [[0, 1], [0, 2]],
        },
    )
    assert [arm.label for arm in found] == [
        "method=random, path_offsets=[0, 1]",
        "method=random, path_offsets=[0, 2]",
        "method=path_entropy, path_offsets=[0, 1]",
        "method=path_entropy, path_offsets=[0, 2]",
    ]
    assert len({arm.directory for arm in found}) == 4
    assert found[1].directory == "method=random,path_offsets=_0,2"
    planning = found[3].configuration.planning
    assert planning.selector.path_offsets == (0, 2)
    assert planning.active_sensing.num_observation_samples == 2


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        ({"selector.method": ["random", "random"]}, "selector.method has the value random twice"),
        ({"simulator.seed": [1, 2]}, r"simulator\.seed is 1 and 2: it cannot be swept"),
        ({"simulator.max_steps": [10, 20]}, r"simulator\.max_steps is 10 and 20"),
        (
            {"particle_filter.num_particles": list(range(1, 202))},
            "201 combinations; a sweep has at most 200",
        ),
    ],
)
def test_refusals(tmp_path: Path, axes: Any, message: str) -> None:
    with pytest.raises(InvalidValueError, match=message):
        arms(tmp_path, axes)


def test_a_sweep_that_was_interrupted_goes_on(tmp_path: Path) -> None:
    """It has pairs by then, runs no trial twice, and compares as the runs do by themselves."""
    found = arms(tmp_path, AXES)
    out = tmp_path / "out"
    seen: list[tuple[int, str]] = []

    def interrupt(result: TrialResult) -> None:
        seen.append((result.trial, result.digest))
        if len(seen) == 3:
            raise KeyboardInterrupt

    with Sweep(out, found) as sweep, pytest.raises(KeyboardInterrupt):
        sweep.run(1, interrupt)
    assert [trial for trial, _ in seen] == [0, 0, 1]
    with Sweep(out, found) as sweep:
        assert (sweep.finished, sweep.total) == (3, 6)
        sweep.run(1, lambda result: seen.append((result.trial, result.digest)))
        assert len({digest for _, digest in seen}) == len(seen) == 6
        comparison = sweep.comparison(baseline=1)
        assert sweep.write_tables(comparison) == [
            "table.md",
            "table.tex",
            "table.csv",
            "trials.csv",
        ]
    assert comparison.baseline == "method=path_entropy"
    alone = compare_outcomes([out / found[1].directory, out / found[0].directory])
    assert comparison.runs[0].effects[:-1] == alone.runs[0].effects[:-1]
    with (out / "trials.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["selector.method"] for row in rows] == ["random"] * 3 + ["path_entropy"] * 3
    assert rows[0]["particle_filter.num_particles"] == "30"
    assert rows[4]["digest"] == one(found[1].configuration, 1).digest
    assert "| method=path_entropy (baseline) |" in (out / "table.md").read_text()
    judged = {each.measure: each.verdict for each in comparison.runs[0].effects}
    assert judged["decision_ms"] == "too few trials"
    # More values extend it, and their times are of another moment; other keys are another sweep.
    more = arms(tmp_path, {**AXES, "selector.method": [*AXES["selector.method"], "fixed"]})
    with Sweep(out, more) as sweep:
        assert (sweep.finished, sweep.new) == (6, ["method=fixed"])
        sweep.run(1, lambda _: None)
        judged = {each.measure: each.verdict for each in sweep.comparison().runs[0].effects}
    assert judged["decision_ms"] == "not judged"
    other = arms(tmp_path, {**AXES, "particle_filter.num_particles": [30, 40]})
    with pytest.raises(OutputError, match=r"out: has a sweep of selector.method, and this one is"):
        Sweep(out, other).__enter__()
