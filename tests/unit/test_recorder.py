"""The observer that records a trial for its figure."""

from pathlib import Path

import numpy as np
import pytest
from tests.recordings import configuration_of, decided, record_trial

from holdfast.reports.recorder import MAX_PARTICLES_KEPT, Recorder


class TestRecorder:
    def test_it_keeps_every_step(self, tmp_path: Path) -> None:
        record = record_trial(configuration_of(tmp_path)).record
        assert record.result is not None
        steps = record.result.steps
        assert len(record.actions) == len(record.rewards) == steps
        # One more than steps: the states before the first and after each.
        assert len(record.true_states) == len(record.estimates) == steps + 1
        assert len(np.unique(record.true_states, axis=0)) == steps + 1  # they are copies
        assert len(record.standard_deviations) == steps + 1
        assert sum(record.rewards) == pytest.approx(record.result.reward)
        assert [sensing.before.step for sensing in record.sensing] == list(range(0, steps, 9))

    def test_it_looks_away_from_other_trials(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path)
        recorder = Recorder(trial=0)
        decided(configuration, observer=recorder)
        assert recorder.record.result is None
        assert not recorder.record.actions

    def test_particles_are_thinned_out(self, tmp_path: Path) -> None:
        configuration = configuration_of(tmp_path, num_particles=2 * MAX_PARTICLES_KEPT + 1)
        before = record_trial(configuration).record.sensing[0].before.belief.states
        assert MAX_PARTICLES_KEPT // 2 < len(before) <= MAX_PARTICLES_KEPT
