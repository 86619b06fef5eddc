"""The verdict of a trial of ``holdfast chaos`` over its two runs."""

import shutil
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from holdfast_lab.chaos.schedule import Schedule
from holdfast_lab.chaos.trial import _make_reference_run, compare_with_reference
from holdfast_lab.testbed.driver import Testbed
from holdfast_lab.testbed.faults import FaultKind

SCHEDULE = Schedule(
    seed=0,
    trial=0,
    kind=FaultKind.COMBINATION,
    wire="tcp",
    world_seed=11,
    num_particles=30,
    num_clouds=1,
    launch="on_failure",
    decision_deadline_ms=None,
    what="all",
    faults=(),
)


def make_reference_run(directory: Path, schedule: Schedule) -> None:
    with Testbed(directory) as testbed:
        testbed.add_service("tcp/127.0.0.1:20000")
        _make_reference_run(testbed, schedule, 60, None)


@pytest.fixture
def directory(tmp_path: Path) -> Iterator[Path]:
    """Return the directory of a trial whose run with faults is its reference run."""
    make_reference_run(tmp_path, SCHEDULE)
    shutil.copytree(tmp_path / "undisturbed", tmp_path / "disturbed", dirs_exist_ok=True)
    shutil.copy(performed(tmp_path, "undisturbed"), performed(tmp_path, "disturbed"))
    yield tmp_path


def performed(directory: Path, run: str) -> Path:
    return directory / f"performed-{run}.txt"


def test_the_same(directory: Path) -> None:
    verdict, reason, comparison = compare_with_reference(directory)
    assert (verdict, reason) == ("identical", "")
    assert comparison is not None
    assert comparison.task_actions >= 60


def test_the_world_is_believed(directory: Path) -> None:
    """The reference run did one step less: so the robot has done one too many."""
    lines = performed(directory, "undisturbed").read_text().splitlines(keepends=True)
    performed(directory, "undisturbed").write_text("".join(lines[:-1]))
    verdict, reason, _ = compare_with_reference(directory)
    assert verdict == "diverged"
    assert reason.startswith("the world was acted on otherwise: ")
    assert "expected nothing, " in reason


def test_the_journals_are_believed(directory: Path) -> None:
    other = directory / "other"
    other.mkdir()
    make_reference_run(other, msgspec.structs.replace(SCHEDULE, world_seed=12))
    shutil.rmtree(directory / "undisturbed")
    shutil.copytree(other / "undisturbed", directory / "undisturbed")
    verdict, reason, _ = compare_with_reference(directory)
    assert verdict == "diverged"
    assert reason.startswith("different: seed")


def test_a_damaged_journal_has_failed(directory: Path) -> None:
    path = directory / "undisturbed" / "journal.bin"
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    verdict, reason, _ = compare_with_reference(directory)
    assert verdict == "failed"
    assert "journal.bin: the journal is damaged" in reason
