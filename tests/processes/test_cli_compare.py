"""``holdfast compare``, as a person types it, on real runs."""

import json
from pathlib import Path

import pytest
from tests.command_line import run_here
from tests.processes.faults import holdfast

CONFIGURATION = """\
problem: peg_in_hole_2d
particle_filter: {num_particles: 30}
simulator: {num_trials: 6, max_steps: 40, seed: 3}
"""


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory with two runs of the same worlds and one of others."""
    directory = tmp_path_factory.mktemp("runs")
    (directory / "peg.yaml").write_text(CONFIGURATION)
    for out, *words in (
        ("first",),
        ("random", "--set", "selector.method=random"),
        ("elsewhere", "--seed", "4"),
    ):
        done = holdfast(directory, "run", "peg.yaml", "-q", "--out", out, *words)
        assert done.returncode == 0, done.stderr
    return directory


def test_outcomes(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = run_here(capsys, runs, "compare", "--outcomes", "first", "random")
    assert done.code == 0, done.stderr
    head, columns, *rows = done.stdout.splitlines()
    assert head == "random against first, 6 trials paired by number:"
    assert columns.split() == ["baseline", "run", "effect", "95%", "interval"]
    assert [row.split("  ")[1] for row in rows[:4]] == [
        "success (%)",
        "steps",
        "reward",
        "decision (ms)",
    ]
    assert rows[-3].endswith("counts as its limit, 40 steps.")


def test_json(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    done = run_here(capsys, runs, "compare", "--outcomes", "--json", "first", "random", "first")
    found = json.loads(done.stdout)
    assert (found["baseline"], found["paired"], found["step_limit"]) == ("first", True, 40)
    itself = found["runs"][1]
    assert all(effect["interval"] is None for effect in itself["effects"])


def test_other_worlds(runs: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused = run_here(capsys, runs, "compare", "--outcomes", "first", "elsewhere")
    assert refused.code == 2
    assert "the seed is 4 here and 3 there" in refused.stderr
    done = run_here(capsys, runs, "compare", "--outcomes", "--unpaired", "first", "elsewhere")
    assert done.code == 0
    assert "6 trials not paired:" in done.stdout


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["first"], "compare takes two runs (more with --outcomes), not 1"),
        (["first", "random", "first"], "compare takes two runs (more with --outcomes), not 3"),
        (["--outcomes", "first"], "compare takes two or more runs, not 1"),
        (["--unpaired", "first", "random"], "give --outcomes as well"),
        (["--outcomes", "first", "nothing"], "so no run to compare"),
    ],
)
def test_refusals(
    runs: Path, words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    done = run_here(capsys, runs, "compare", *words)
    assert done.code == 2
    assert message in done.stderr
