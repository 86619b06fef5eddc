"""A trial run again: where it is first decided otherwise, and which service was wrong."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from tests.recordings import configuration_of, record_trial

from holdfast.outcome import Decisions
from holdfast.protocol.events import Timing
from holdfast.protocol.question import OWN_PLANNER
from holdfast.recording.repetition import Deviation, Repetition, repeat, wrong_service
from holdfast.recording.timings import TimingTable


def decisions_of(tmp_path: Path) -> Decisions:
    result = record_trial(configuration_of(tmp_path)).record.result
    assert result is not None
    assert result.decisions is not None
    return result.decisions


def test_the_same_trial_has_no_deviation(tmp_path: Path) -> None:
    kept = decisions_of(tmp_path)
    assert repeat(configuration_of(tmp_path), kept, 1, None) == Repetition(kept, None)


@pytest.mark.parametrize(
    ("byte", "deviation"),
    [
        pytest.param(9, Deviation(0, "sensing"), id="the first sensing action"),
        pytest.param(13, Deviation(0, None), id="the state after it"),
        pytest.param(45 + 9, Deviation(0, "task"), id="the first task action"),
        pytest.param(-1, Deviation(29, None), id="the last state"),
    ],
)
def test_the_first_deviation_is_found(byte: int, deviation: Deviation, tmp_path: Path) -> None:
    log = bytearray(decisions_of(tmp_path).log)
    log[byte] ^= 1
    kept = msgspec.structs.replace(decisions_of(tmp_path), log=bytes(log))
    assert repeat(configuration_of(tmp_path), kept, 1, None).deviation == deviation


class TestWrongService:
    @staticmethod
    def timings_of(tmp_path: Path, service: str) -> Path:
        path = tmp_path / "timings.csv"
        table = TimingTable(path)
        table.add(Timing(1, 0, "task", service, "standard", 1.0, 1.0, 1.0))
        table.close()
        return path

    @pytest.mark.parametrize(
        ("service", "again", "wrong"),
        [
            ("tcp/cloud:7447", Repetition(None, Deviation(3, "task")), "tcp/cloud:7447"),
            ("tcp/cloud:7447", Repetition(None, Deviation(4, "task")), None),
            (OWN_PLANNER, Repetition(None, Deviation(3, "task")), None),
        ],
    )
    def test_one_that_decided_what_the_planner_does_not(
        self, service: str, again: Repetition, wrong: str | None, tmp_path: Path
    ) -> None:
        """An answer has the task actions up to the next sensing step: that of step 0 has step 3."""
        first = Repetition(None, Deviation(3, "task"))
        timings = self.timings_of(tmp_path, service)
        assert wrong_service(first, lambda: again, timings, 1) == wrong
