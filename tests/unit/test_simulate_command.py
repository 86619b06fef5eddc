"""``holdfast simulate``, as whoever types it sees it."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import pytest
from typer.testing import CliRunner, Result

from holdfast.cli.application import app
from holdfast.session.messages import CHECKSUM_SIZE
from holdfast.simulation.exploration import Tally

STORY = Path(__file__).parents[1] / "scenarios" / "cloud_comes_back.story"


def simulate(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["simulate", *arguments])


def test_a_few_seeds() -> None:
    done = simulate("--seeds", "100:130", "--jobs", "1")
    assert done.exit_code == 0, done.output
    assert "seeds         100:130\nruns          30 in " in done.output
    assert "violations    0\n\n30 runs decided as the runs without faults do" in done.output


def test_a_story_of_a_seed() -> None:
    done = simulate("--story", "--seeds", "5:6")
    assert done.exit_code == 0
    assert done.output.startswith("# seed 5\nrun trial=")
    assert "robot    performs task action" in done.output
    assert "the run decided as the one without faults" in done.output


def test_a_schedule_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "a.schedule"
    path.write_text(STORY.read_text(encoding="utf-8").partition("----")[0], encoding="utf-8")
    done = simulate("--schedule", str(path))
    assert done.exit_code == 0
    assert "status from=standard to=local_recovery" in done.output


@pytest.mark.parametrize(
    ("seeds", "says"),
    [
        ("5", "must be two whole numbers A:B"),
        ("a:b", "must be two whole numbers A:B"),
        ("1:2:3", "must be two whole numbers A:B"),
        ("7:7", "holds no seed; the second number (7) must be above the first (7)"),
        ("9:3", "holds no seed; the second number (3) must be above the first (9)"),
        ("-3:2", "-3 is no seed; allowed are 0 to 1,000,000,000,000"),
        ("3:-2", "-2 is no seed; allowed are 0 to 1,000,000,000,000"),
        ("0:1000000000001", "1000000000001 is no seed; allowed are 0 to 1,000,000,000,000"),
        ("0:" + "9" * 5000, "9 is no seed; allowed are 0 to 1,000,000,000,000"),
    ],
)
def test_seeds_that_are_none(seeds: str, says: str) -> None:
    done = simulate("--seeds", seeds)
    assert done.exit_code != 0
    assert str(done.exception).startswith(f"--seeds {seeds}: ")
    assert says in str(done.exception)


def test_files_that_are_no_schedule(tmp_path: Path) -> None:
    missing = simulate("--schedule", str(tmp_path / "none"))
    assert "none: cannot be read: No such file" in str(missing.exception)
    path = tmp_path / "bad"
    path.write_text("run\ncrash service=cloud-1 at=x\n", encoding="utf-8")
    bad = simulate("--schedule", str(path))
    assert "bad: 'crash service=cloud-1 at=x': Expected `float`" in str(bad.exception)


def test_a_finding_is_told_and_made_small() -> None:
    """With messages whose checksums nobody looks at."""

    def unsealed(payload: bytes) -> memoryview:
        return memoryview(payload)[:-CHECKSUM_SIZE]

    with mock.patch("holdfast.session.messages._unsealed", unsealed):
        done = simulate("--seeds", "0:400", "--jobs", "1")
    assert done.exit_code == 1
    assert "\nVIOLATION under seed " in done.output
    assert "Again, with its story: holdfast simulate --story --seeds " in done.output
    drawn, _, smallest = done.output.partition("smallest")
    assert "what=corrupt" in smallest
    assert smallest.count("message ") < drawn.count("message ") / 3


def test_ctrl_c_says_how_to_go_on() -> None:
    def interrupted(seeds: range, jobs: int, on_batch: object) -> None:
        del seeds, jobs
        assert callable(on_batch)
        on_batch(range(100), Tally(runs=100))
        raise KeyboardInterrupt

    with mock.patch("holdfast.simulation.exploration.explore", interrupted):
        done = simulate("--seeds", "0:1000")
    assert done.exit_code == 130
    assert "Go on with: holdfast simulate --seeds 100:1000\n" in done.output
    assert "bit for bit" not in done.output


def test_runs_that_stopped_are_told_apart() -> None:
    def explored(seeds: range, jobs: int, on_batch: object) -> None:
        del jobs
        assert callable(on_batch)
        on_batch(seeds, Tally(runs=len(seeds), held=46))

    with mock.patch("holdfast.simulation.exploration.explore", explored):
        done = simulate("--seeds", "0:500")
    assert done.output.endswith(
        "500 runs decided as the runs without faults do, bit for bit; the 46 that stopped on "
        "purpose did so up to where they stopped.\n"
    )


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--jobs", "-1"], "--jobs is '-1'; allowed are whole numbers from 0 to 1024"),
        (["--schedule", str(STORY), "--seeds", "0:5"], "leave --seeds and --story out"),
    ],
)
def test_options_that_do_not_fit(arguments: list[str], says: str) -> None:
    assert says in str(simulate(*arguments).exception)
