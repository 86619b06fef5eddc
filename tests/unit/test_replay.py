"""A recorded run, planned again: its facts are those of the run, and its decisions the recorded."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.recordings import configuration_of, record_trial

from holdfast.errors import HoldfastError, OutputError
from holdfast.journal.run_directory import RunDirectory
from holdfast.planning.outcome import TrialResult
from holdfast.reports.csv_export import CsvSink
from holdfast.reports.facts import SensingFact, TaskFact, TrialBeginFact, TrialEndFact
from holdfast.reports.recorder import TrialRecord
from holdfast.reports.replay import RecordedRun


class Collected:
    """A sink that keeps all facts."""

    def __init__(self) -> None:
        self.facts: list[Any] = []
        self.trial_begins = self.sensed = self.acted = self.observed_late = self.facts.append
        self.trial_ends = self.happened = self.facts.append


def make_run(tmp_path: Path, change: Any = None) -> tuple[Path, list[TrialRecord]]:
    configuration = configuration_of(tmp_path)
    records = [record_trial(configuration, trial).record for trial in range(2)]
    with RunDirectory.create(tmp_path / "run", configuration) as directory:
        for record in records:
            assert record.result is not None
            directory.add(record.result if change is None else change(record.result))
    return tmp_path / "run", records


def test_facts_are_those_of_the_run(tmp_path: Path) -> None:
    path, records = make_run(tmp_path)
    sink, also = Collected(), Collected()
    with RecordedRun(path) as run:
        assert (run.trials, run.unfinished, run.has_times) == ((0, 1), None, False)
        assert list(run.replay([1], [sink, also])) == [1]
    assert sink.facts == also.facts
    begin, *between, end = sink.facts
    assert isinstance(begin, TrialBeginFact)
    assert isinstance(end, TrialEndFact)
    record = records[1]
    assert record.result is not None
    assert end.result == record.result
    sensed = [fact for fact in between if isinstance(fact, SensingFact)]
    acted = [fact for fact in between if isinstance(fact, TaskFact)]
    assert [fact.step.sensing_action for fact in sensed] == [
        sensing.sensing_action for sensing in record.sensing
    ]
    for fact, sensing in zip(sensed, record.sensing, strict=True):
        assert np.array_equal(fact.step.before.belief.states, sensing.before.belief.states)
    assert np.array_equal([fact.step.executed for fact in acted], record.actions)
    for task, true_state in zip(acted, record.true_states, strict=False):
        assert task.true_state is not None
        assert np.array_equal(task.true_state, true_state)


def test_another_decision_than_the_recorded_one_is_refused(tmp_path: Path) -> None:
    def otherwise(result: TrialResult) -> TrialResult:
        assert result.decisions is not None
        log = bytearray(result.decisions.log)
        log[9] ^= 1  # the first sensing action
        decisions = msgspec.structs.replace(result.decisions, log=bytes(log))
        return msgspec.structs.replace(result, decisions=decisions, digest=decisions.digest())

    path, _ = make_run(tmp_path, otherwise)
    with (
        RecordedRun(path) as run,
        pytest.raises(HoldfastError, match=r"trial 0: the decision of step 0 differs .*--trials"),
    ):
        list(run.replay([0, 1], [Collected()]))


def test_what_is_no_run_is_refused_with_its_purpose(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"holds no journal.bin, so no run to open"):
        RecordedRun(tmp_path, "open")


def test_tables_have_one_clock(tmp_path: Path) -> None:
    """Written by the sink of tables, to which no trial is too short."""
    path, _ = make_run(tmp_path)
    (tmp_path / "tables").mkdir()
    with (
        RecordedRun(path) as run,
        CsvSink(tmp_path / "tables", run.configuration.problem) as tables,
    ):
        list(run.replay(run.trials, [tables]))
    head, *rows = (tmp_path / "tables" / "trials.csv").read_text().splitlines()
    assert head.startswith("trial,began,ended,")
    times = [float(cell) for row in rows for cell in row.split(",")[1:3]]
    assert times == sorted(times)
