"""What a trial of ``holdfast chaos`` makes of two runs: the same, or not, or not to be read."""

from __future__ import annotations

import contextlib
import shutil
import sqlite3
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from holdfast.chaos.schedule import FaultKind, Schedule
from holdfast.chaos.trial import Pace, _Trial, _TrialError

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
    faults=(),
)


@pytest.fixture
def trial(tmp_path: Path) -> Iterator[_Trial]:
    """Return a trial whose run with faults was the run without faults."""
    with _Trial(SCHEDULE, tmp_path, Pace(60, 60.0), threading.Event()) as trial:
        trial._run_twin()
        shutil.copytree(tmp_path / "undisturbed", tmp_path / "disturbed", dirs_exist_ok=True)
        shutil.copy(performed(tmp_path, "undisturbed"), performed(tmp_path, "disturbed"))
        yield trial


def performed(directory: Path, run: str) -> Path:
    return directory / f"performed-{run}.txt"


def test_the_same(trial: _Trial) -> None:
    trial._compare()
    assert trial.steps >= 60


def test_what_the_world_tells_is_believed(trial: _Trial, tmp_path: Path) -> None:
    """The run without faults did one step less: so the robot has done one too many."""
    lines = performed(tmp_path, "undisturbed").read_text().splitlines(keepends=True)
    performed(tmp_path, "undisturbed").write_text("".join(lines[:-1]))
    with pytest.raises(
        _TrialError, match=r"the world was acted on otherwise: .*expected nothing, "
    ):
        trial._compare()


def test_what_the_journals_tell_is_believed(trial: _Trial, tmp_path: Path) -> None:
    other = tmp_path / "other"
    other.mkdir()
    schedule = msgspec.structs.replace(SCHEDULE, world_seed=12)
    with _Trial(schedule, other, Pace(60, 60.0), threading.Event()) as another:
        another._run_twin()
    shutil.rmtree(tmp_path / "undisturbed")
    shutil.copytree(other / "undisturbed", tmp_path / "undisturbed")
    with pytest.raises(_TrialError, match=r"^different: seed") as raised:
        trial._compare()
    assert raised.value.verdict == "diverged"


def test_a_journal_that_is_damaged_has_failed(trial: _Trial, tmp_path: Path) -> None:
    path = tmp_path / "undisturbed" / "journal.sqlite"
    with contextlib.closing(sqlite3.connect(path)) as journal, journal:
        journal.execute("UPDATE meta SET value = value || ' ' WHERE key = 'configuration'")
    with pytest.raises(_TrialError, match=r"journal\.sqlite: the journal is damaged") as raised:
        trial._compare()
    assert raised.value.verdict == "failed"
