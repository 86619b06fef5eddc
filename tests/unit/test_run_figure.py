"""The figure of trial 0, which is run again where this process did not run it.

Where the trial is first decided otherwise then, and which service was wrong.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest
from tests.command_line import run_here
from tests.recordings import configuration_of, record_trial

from holdfast.cli.run_figure import Deviation, Repetition, repeat, wrong_service
from holdfast.planning.outcome import Decisions
from holdfast.protocol.events import Timing
from holdfast.protocol.question import OWN_PLANNER
from holdfast.recording.timings import EventTable

PEG = """
problem: peg_in_hole_2d
particle_filter: {num_particles: 40}
active_sensing: {num_observation_samples: 3, num_cores: 1}
simulator: {num_trials: 1, max_steps: 60, seed: 3}
"""


def test_a_figure_of_this_run_and_of_an_earlier_one(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "peg.yaml").write_text(PEG)
    command = ["run", "peg.yaml", "--jobs", "1", "--out", "out"]
    assert run_here(capsys, tmp_path, *command, figures=True).code == 0
    figure = tmp_path / "out" / "trial.png"
    assert figure.read_bytes().startswith(b"\x89PNG\r\n")
    figure.unlink()
    again = run_here(capsys, tmp_path, *command, "--trials", "2", "--resume", figures=True)
    assert (again.code, "figure" in again.stderr) == (0, False)
    assert figure.read_bytes().startswith(b"\x89PNG\r\n")


def test_without_matplotlib_a_note_says_so(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "peg.yaml").write_text(PEG)
    said = run_here(capsys, tmp_path, "run", "peg.yaml", "--out", "out")
    assert said.code == 0
    assert "note: no figure, because matplotlib is not installed" in said.stderr


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
        pytest.param(-1, Deviation(30, None), id="the last state"),
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
        table = EventTable(path, Timing)
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
