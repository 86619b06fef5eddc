"""``holdfast simulate``, as whoever types it sees it."""

import functools
from pathlib import Path
from typing import Protocol
from unittest import mock

import pytest
from tests.command_line import Said, run_here

from holdfast.protocol.messages import CHECKSUM_SIZE
from holdfast_lab.simulation.exploration import ExplorationTally

STORY = Path(__file__).parents[2] / "tests" / "scenarios" / "cloud_comes_back.story"


class Simulate(Protocol):
    """Runs the command."""

    def __call__(self, *arguments: str) -> Said: ...


@pytest.fixture
def simulate(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Simulate:
    return functools.partial(run_here, capsys, tmp_path, "simulate")


def test_a_few_seeds(simulate: Simulate) -> None:
    done = simulate("--seeds", "100:130", "--jobs", "1")
    assert done.code == 0, done.stdout
    assert "seeds         100:130\nruns          30 in " in done.stdout
    assert "violations    0\n\n30 runs decided as the runs without faults do" in done.stdout


def test_a_story_of_a_seed(simulate: Simulate) -> None:
    done = simulate("--story", "--seeds", "5:6")
    assert done.code == 0
    assert done.stdout.startswith("# seed 5\nrun trial=")
    assert "robot    performs task action" in done.stdout
    assert "the run decided as the one without faults" in done.stdout


def test_a_schedule_of_a_file(tmp_path: Path, simulate: Simulate) -> None:
    path = tmp_path / "a.schedule"
    path.write_text(STORY.read_text(encoding="utf-8").partition("----")[0], encoding="utf-8")
    done = simulate("--schedule", str(path))
    assert done.code == 0
    assert "status from=standard to=local_recovery" in done.stdout


@pytest.mark.parametrize(
    ("seeds", "says"),
    [
        ("5", "allowed are two whole numbers A:B"),
        ("a:b", "allowed are two whole numbers A:B"),
        ("1:2:3", "allowed are two whole numbers A:B"),
        ("7:7", "allowed are A:B with B above A"),
        ("9:3", "allowed are A:B with B above A"),
        ("-3:2", "allowed are seeds from 0 to 1,000,000,000,000"),
        ("3:-2", "allowed are seeds from 0 to 1,000,000,000,000"),
        ("0:1000000000001", "allowed are seeds from 0 to 1,000,000,000,000"),
        ("0:" + "9" * 5000, "allowed are seeds from 0 to 1,000,000,000,000"),
    ],
)
def test_seeds_that_are_none(seeds: str, says: str, simulate: Simulate) -> None:
    done = simulate("--seeds", seeds)
    assert done.code != 0
    assert done.stderr.startswith(f"holdfast: error: --seeds is '{seeds[:20]}")
    assert says in done.stderr


def test_files_that_are_no_schedule(tmp_path: Path, simulate: Simulate) -> None:
    missing = simulate("--schedule", str(tmp_path / "none"))
    assert "none: cannot be read: No such file" in missing.stderr
    path = tmp_path / "bad"
    path.write_text("run\ncrash service=cloud-1 at=x\n", encoding="utf-8")
    bad = simulate("--schedule", str(path))
    assert "bad: 'crash service=cloud-1 at=x': Expected `float`" in bad.stderr


def test_a_finding_is_told_and_made_small(simulate: Simulate) -> None:
    """With messages whose checksums nobody looks at."""

    def unsealed(payload: bytes) -> memoryview:
        return memoryview(payload)[:-CHECKSUM_SIZE]

    with mock.patch("holdfast.protocol.messages._checked_content", unsealed):
        done = simulate("--seeds", "0:400", "--jobs", "1")
    assert done.code == 1
    assert "\nVIOLATION under seed " in done.stdout
    assert "Again, with its story: holdfast simulate --story --seeds " in done.stdout
    drawn, _, smallest = done.stdout.partition("smallest")
    assert "what=corrupt" in smallest
    assert smallest.count("message ") < drawn.count("message ") / 3


def test_ctrl_c_says_how_to_go_on(simulate: Simulate) -> None:
    def interrupted(seeds: range, jobs: int, on_batch: object) -> None:
        del seeds, jobs
        assert callable(on_batch)
        on_batch(range(100), ExplorationTally(runs=100))
        raise KeyboardInterrupt

    with mock.patch("holdfast_lab.simulation.exploration.explore", interrupted):
        done = simulate("--seeds", "0:1000")
    assert done.code == 130
    assert "Go on with: holdfast simulate --seeds 100:1000\n" in done.stdout
    assert "bit for bit" not in done.stdout


def test_runs_that_stopped_are_told_apart(simulate: Simulate) -> None:
    def explored(seeds: range, jobs: int, on_batch: object) -> None:
        del jobs
        assert callable(on_batch)
        on_batch(seeds, ExplorationTally(runs=len(seeds), held=46))

    with mock.patch("holdfast_lab.simulation.exploration.explore", explored):
        done = simulate("--seeds", "0:500")
    assert done.stdout.endswith(
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
def test_options_that_do_not_fit(arguments: list[str], says: str, simulate: Simulate) -> None:
    assert says in simulate(*arguments).stderr
