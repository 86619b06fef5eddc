"""A recorded trial, run again from its records."""

from pathlib import Path

import msgspec
import numpy as np
import pytest
from tests.recordings import Journalling, configuration_of, decided, record_trial
from tests.trial_inputs import come_late, sense

from holdfast.config.loader import Configuration
from holdfast.errors import RecordError
from holdfast.planning.inputs import ActingRecord, Moved, Record, Sensed, encode_floats
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner
from holdfast.planning.settings import ParticleFilterSettings, PlanningSettings
from holdfast.planning.tracking import Trial
from holdfast.problems.peg_in_hole_2d import PegInHole2D
from holdfast.reports.figure import trial_figure
from holdfast.reports.recorder import Recorder
from holdfast.robot.recomputing import run_recorded_trial
from holdfast.robot.trial import NULL_OBSERVER


class TestRunRecordedTrial:
    """What was observed, given to the same planner, leads to the same beliefs."""

    @staticmethod
    def again(
        configuration: Configuration, records: list[Record], result: TrialResult
    ) -> tuple[Recorder, TrialResult]:
        recorder = Recorder(result.trial)
        found = run_recorded_trial(
            Planner(configuration.problem, configuration.planning),
            configuration.simulator.seed,
            result.trial,
            records,
            recorder,
            result,
        )
        assert found is not None
        return recorder, found

    @staticmethod
    def first(configuration: Configuration) -> tuple[list[Record], TrialResult]:
        journalling = Journalling()
        result = decided(configuration, observer=journalling)
        return journalling.records, result

    @pytest.mark.parametrize("max_steps", [20, 500])
    def test_the_beliefs_are_those_of_the_trial(self, tmp_path: Path, max_steps: int) -> None:
        configuration = configuration_of(tmp_path, max_steps=max_steps)
        records, result = self.first(configuration)
        assert result.success == (max_steps == 500)
        # The last performance is not written down on its own: the result says all of it.
        recorder, again = self.again(configuration, records[:-1], result)
        assert again.digest == result.digest
        assert (again.success, again.steps) == (result.success, result.steps)
        expected = record_trial(configuration).record
        record = recorder.record
        assert np.array_equal(record.estimates, expected.estimates)
        assert np.array_equal(record.standard_deviations, expected.standard_deviations)
        for seen, known in zip(record.sensing, expected.sensing, strict=True):
            assert np.array_equal(seen.after.belief.states, known.after.belief.states)
        assert record.true_states == []
        assert record.rewards[:-1] == expected.rewards[:-1]
        assert trial_figure(configuration, record).startswith(b"\x89PNG\r\n")

    def test_a_failure_is_one_again(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        records, result = self.first(configuration)
        failed = msgspec.structs.replace(result, success=False, failed=True, steps=4)
        upto = next(at for at, each in enumerate(records) if getattr(each, "step", None) == 4)
        _, again = self.again(configuration, records[:upto], failed)
        assert (again.failed, again.steps) == (True, 4)

    def test_what_was_decided_otherwise_is_refused(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        records, result = self.first(configuration)
        observed = records[0]
        assert isinstance(observed, Sensed)
        other = msgspec.structs.replace(observed, sensing_action=observed.sensing_action ^ 1)
        for spoilt in ([other, *records[1:]], records[:20], records[1:]):
            with pytest.raises(RecordError, match="trial 1: the decision of step"):
                self.again(configuration, spoilt, result)


@pytest.mark.parametrize("again", [(), ("chosen",), ("moving",), ("chosen", "moving")])
def test_what_came_when_a_killed_robot_went_on_comes_there_again(again: tuple[str, ...]) -> None:
    """Before a task action was chosen, or between that and its performance."""
    settings = PlanningSettings(
        particle_filter=ParticleFilterSettings(num_particles=30), sensing_interval=0
    )
    planner = Planner(PegInHole2D(), settings)
    history, records = Trial(planner, 3, 0), list[Record]()

    def late(taken: int) -> None:
        records.append(come_late(history, taken, np.array([0.1 * taken])))

    for step in range(4):
        sensing_action, _ = planner.choose_sensing_action(history.state)
        records.append(sense(history, sensing_action, None, 0.0))
        if step == 2 and "chosen" in again:
            late(0)
        history.pending, _ = planner.choose_task_action(history.state)
        records.append(ActingRecord(step, encode_floats(history.pending)))
        if step == 2 and "moving" in again:
            late(1)
        performed = Moved(step, None)
        records.append(performed)
        history.take(performed)
        if step == 2:
            late(2)
    result = history.result(None)

    def run(upto: list[Record], result: TrialResult | None) -> TrialResult | None:
        return run_recorded_trial(planner, 3, 0, upto, NULL_OBSERVER, result)

    found = run(records, result)
    assert found is not None
    assert found.decisions == result.decisions
    for count in range(1, len(records) - 1):
        assert run(records[:count], None) is None
