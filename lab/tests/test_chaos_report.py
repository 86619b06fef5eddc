"""What is made of the outcomes of a series: rows, a summary and a table; and how a series runs."""

import threading
from pathlib import Path

import msgspec
import pytest

from holdfast.errors import OutputError
from holdfast_lab.chaos.report import ChaosSummary, kind_rows, summarise, text_of, write_report
from holdfast_lab.chaos.series import TRIALS_NAME, Series, SeriesPlan
from holdfast_lab.chaos.trial import Pace, TrialOutcome, Verdict
from holdfast_lab.errors import CancelledTrialError
from holdfast_lab.testbed.fault_times import FaultTimes
from holdfast_lab.testbed.faults import FaultKind

PLAN = SeriesPlan(
    seed=4,
    wires=("tcp", "udp"),
    kinds=(FaultKind.CLOUD_KILLED, FaultKind.COMBINATION),
    possible=tuple(FaultKind),
)


def fault(
    kind: FaultKind, *, detection_ms: float | None = 5.0, failback_ms: float | None = 80.0
) -> FaultTimes:
    return FaultTimes(
        kind=kind.value,
        target="tcp/127.0.0.1:1",
        away_ms=400.0,
        in_use=True,
        detection_ms=detection_ms,
        recovery_ms=detection_ms,
        launch_ms=200.0,
        failback_ms=failback_ms,
        longest_wait_ms=250.0,
    )


def outcome(
    trial: int,
    kind: FaultKind = FaultKind.CLOUD_KILLED,
    *faults: FaultTimes,
    verdict: Verdict = "identical",
) -> TrialOutcome:
    return TrialOutcome(
        trial=trial,
        kind=kind,
        wire="tcp",
        verdict=verdict,
        reason="" if verdict == "identical" else "for a reason",
        launch="on_failure",
        faults=faults,
        steps=160,
        sensing_actions=40,
        robots=1,
        took_s=4.0,
    )


def outcomes() -> list[TrialOutcome]:
    killed, combined = FaultKind.CLOUD_KILLED, FaultKind.COMBINATION
    return [
        outcome(2, killed, fault(killed), fault(killed, detection_ms=7.0)),
        outcome(0, killed, fault(killed, detection_ms=None, failback_ms=None)),
        outcome(1, combined, fault(FaultKind.LINK_CUT), verdict="diverged"),
    ]


def summary() -> ChaosSummary:
    left_out = {FaultKind.PACKETS_LOST: "nft is not installed"}
    return summarise(outcomes(), range(5), 4, 2, left_out)


def test_a_row_for_each_kind() -> None:
    killed, combined = kind_rows(outcomes())
    assert (killed.kind, killed.trials, killed.faults, killed.wrong) == ("cloud_killed", 2, 3, 0)
    assert (killed.times["detection"].count, killed.times["detection"].median_ms) == (2, 6.0)
    assert (combined.trials, combined.wrong) == (1, 1)
    # Its faults overlap, so no time is due to one of them.
    assert combined.times == {}


def test_files(tmp_path: Path) -> None:
    write_report(tmp_path, summary())
    read = msgspec.json.decode((tmp_path / "summary.json").read_bytes(), type=ChaosSummary)
    assert read == summary()
    assert (read.trials, read.finished, read.identical, read.diverged) == (5, 3, 2, 1)
    assert (read.faults, read.steps) == (4, 480)
    assert read.left_out == {"packets_lost": "nft is not installed"}
    assert (tmp_path / "table.txt").read_text() == text_of(read, 142)


def test_the_table_tells_behind_how_many_times_it_stands() -> None:
    text = text_of(summary(), 142)
    head, killed, combined = text.splitlines()[1:4]
    assert head.split()[6:] == ["n", "median", "p95", "max"] * 4
    # Three faults, of which two were found and two times the cloud came back.
    assert killed.split()[:8] == ["cloud_killed", "2", "3", "0", "2", "6", "7", "7"]
    assert killed.split()[12:16] == ["3", "200", "200", "200"]
    assert combined.split() == ["combination", "1", "1", "1", *"----"]
    assert "\nn: faults after which this was measured" in text
    assert "\n-: never measured" in text
    assert "\n1 of 3 trials went wrong (1 diverged, 0 failed, 0 timed out), over tcp (3); " in text
    assert all(len(line) <= 142 for line in text.splitlines())


def test_a_narrow_terminal_gets_a_part_of_it() -> None:
    lines = text_of(summary(), 80).splitlines()
    assert lines[1].split()[3:] == ["trials", "wrong", *["median", "max"] * 4]
    times = ["6", "7", "6", "7", "200", "200", "80", "80"]
    assert lines[2].split() == ["cloud_killed", "2", "0", *times]
    assert all(len(line) <= 80 for line in lines)


class TestSeries:
    @pytest.fixture(autouse=True)
    def _trials_are_quick(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The trials here have no processes; one in three diverges, number 7 never ends."""

        def run(
            schedule: object, directory: Path, pace: Pace, cancelled: threading.Event
        ) -> TrialOutcome:
            (directory / "file").touch()
            number = int(directory.name.removeprefix("trial-"))
            if number == 7:
                assert cancelled.wait(20.0)
                raise CancelledTrialError("given up")
            return outcome(number, verdict="identical" if number % 3 else "diverged")

        monkeypatch.setattr("holdfast_lab.chaos.series.run_chaos_trial", run)

    @staticmethod
    def run(series: Series, trials: int, jobs: int = 1) -> list[int]:
        ended: list[int] = []
        series.run(range(trials), jobs, lambda outcome: ended.append(outcome.trial))
        return ended

    @pytest.mark.parametrize("jobs", [1, 3])
    def test_good_trials_leave_nothing_but_a_line(self, tmp_path: Path, jobs: int) -> None:
        series = Series(tmp_path, PLAN)
        assert sorted(self.run(series, 5, jobs)) == [0, 1, 2, 3, 4]
        assert len((tmp_path / TRIALS_NAME).read_text().splitlines()) == 5
        kept = sorted(path.name for path in tmp_path.iterdir() if path.is_dir())
        assert kept == ["trial-00000", "trial-00003"]

    def test_all_can_be_kept(self, tmp_path: Path) -> None:
        self.run(Series(tmp_path, PLAN, keep=True), 3)
        assert sum(path.is_dir() for path in tmp_path.iterdir()) == 3

    def test_an_interruption_gives_up_what_goes_on(self, tmp_path: Path) -> None:
        series = Series(tmp_path, PLAN)

        def interrupt(outcome: TrialOutcome) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            series.run([7, 1, 2], 2, interrupt)
        # No thread is left, and of the trial nothing but that it is missing.
        assert not [each for each in threading.enumerate() if each.name.startswith("chaos-")]
        assert not (tmp_path / "trial-00007").exists()
        assert [outcome.trial for outcome in series.outcomes] == [1]

    def test_an_error_ends_it(self, tmp_path: Path) -> None:
        series = Series(tmp_path, PLAN)
        (tmp_path / "trial-00001").touch()  # is no directory, and cannot be one
        with pytest.raises(OutputError, match="trial-00001: cannot be written"):
            self.run(series, 3)
