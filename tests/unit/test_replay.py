"""A recorded run, planned again: its facts are those of the run, and its decisions the recorded."""

from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
from tests.recordings import configuration_of, decided, flipped

from holdfast.errors import HoldfastError, OutputError
from holdfast.journal.run_directory import RunDirectory
from holdfast.planning.outcome import TrialResult
from holdfast.reports.csv_export import CsvSink
from holdfast.reports.replay import RecordedRun


def make_run(tmp_path: Path, change: Callable[[TrialResult], TrialResult]) -> Path:
    configuration = configuration_of(tmp_path)
    with RunDirectory.create(tmp_path / "run", configuration) as directory:
        for trial in range(2):
            directory.add(change(decided(configuration, trial)))
    return tmp_path / "run"


def test_another_decision_than_the_recorded_one_is_refused(tmp_path: Path) -> None:
    with (
        RecordedRun(make_run(tmp_path, flipped)) as run,
        pytest.raises(HoldfastError, match=r"trial 0: the decision of step 0 differs .*--trials"),
    ):
        list(run.replay([0, 1], [Mock()]))


def test_what_is_no_run_is_refused_with_its_purpose(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"holds no journal.bin, so no run to open"):
        RecordedRun(tmp_path, "open")


def test_tables_have_one_clock(tmp_path: Path) -> None:
    """Written by the sink of tables, to which no trial is too short."""
    path = make_run(tmp_path, lambda result: result)
    (tmp_path / "tables").mkdir()
    with (
        RecordedRun(path) as run,
        CsvSink(tmp_path / "tables", run.configuration.problem) as tables,
    ):
        assert (run.trials, run.unfinished, run.has_times) == ((0, 1), None, False)
        list(run.replay(run.trials, [tables]))
    head, *rows = (tmp_path / "tables" / "trials.csv").read_text().splitlines()
    assert head.startswith("trial,began,ended,")
    times = [float(cell) for row in rows for cell in row.split(",")[1:3]]
    assert times == sorted(times)
