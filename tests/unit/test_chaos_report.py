"""What is made of the outcomes of a series: rows, tables; and its table on the disk."""

from __future__ import annotations

import csv
import threading
from pathlib import Path

import msgspec
import pytest

from holdfast.errors import OutputError
from holdfast.lab.chaos.command import _write_table
from holdfast.lab.chaos.report import ChaosSummary, kind_rows, summarise, write_tables
from holdfast.lab.chaos.series import TRIALS_NAME, Series, SeriesPlan
from holdfast.lab.chaos.trial import Pace, TrialOutcome, Verdict
from holdfast.lab.errors import CancelledTrialError
from holdfast.lab.testbed.fault_times import FaultTimes
from holdfast.lab.testbed.faults import FaultKind

PLAN = SeriesPlan(
    seed=4,
    first=0,
    wires=("tcp", "udp"),
    kinds=(FaultKind.CLOUD_KILLED, FaultKind.COMBINATION),
    possible=tuple(FaultKind),
    commit="abc1234",
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
        faults_planned=len(faults),
        faults=faults,
        steps=160,
        sensing_actions=40,
        robots=1,
        statuses=2,
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
    return summarise(PLAN, outcomes(), trials=5, jobs=2, left_out=left_out)


def test_a_row_for_each_kind() -> None:
    killed, combined = kind_rows(outcomes())
    assert (killed.kind, killed.trials, killed.faults, killed.wrong) == ("cloud_killed", 2, 3, 0)
    assert killed.unnoticed == 1
    assert killed.detection is not None
    assert (killed.detection.count, killed.detection.median_ms) == (2, 6.0)
    assert (combined.trials, combined.wrong) == (1, 1)
    # Its faults overlap, so no time is due to one of them.
    assert combined.detection is combined.failback is None
    assert combined.longest_wait_ms == 250.0


def test_tables(tmp_path: Path) -> None:
    write_tables(tmp_path, summary(), outcomes())
    read = msgspec.json.decode((tmp_path / "summary.json").read_bytes(), type=ChaosSummary)
    assert read == summary()
    assert (read.trials, read.finished, read.identical, read.diverged) == (5, 3, 2, 1)
    assert (read.faults, read.steps, read.trials_took_s) == (4, 480, 12.0)
    assert read.left_out == {"packets_lost": "nft is not installed"}
    with (tmp_path / "chaos.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["trial"], row["fault"]) for row in rows] == [
        ("0", "0"),
        ("1", "0"),
        ("2", "0"),
        ("2", "1"),
    ]
    assert rows[0]["detection_ms"] == ""
    assert rows[1]["kind"] == "link_cut"
    assert rows[1]["trial_kind"] == "combination"
    assert rows[3]["detection_ms"] == "7.0"


def test_the_table_tells_behind_how_many_times_it_stands(tmp_path: Path) -> None:
    _write_table(summary(), tmp_path / "table.txt")
    text = (tmp_path / "table.txt").read_text()
    head, killed, combined = text.splitlines()[1:4]
    assert head.split()[6:] == ["n", "median", "p95", "max"] * 4
    # Three faults, of which two were found and two times the cloud came back.
    assert killed.split()[:8] == ["cloud_killed", "2", "3", "0", "2", "6", "7", "7"]
    assert killed.split()[12:16] == ["3", "200", "200", "200"]
    assert combined.split() == ["combination", "1", "1", "1", *"----"]
    assert "\nn: faults after which this was measured" in text
    assert "\n-: never measured" in text
    assert all(len(line) <= 142 for line in text.splitlines())


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

        monkeypatch.setattr("holdfast.lab.chaos.series.run_chaos_trial", run)

    @staticmethod
    def run(series: Series, trials: int, jobs: int = 1) -> list[int]:
        ended: list[int] = []
        series.run(trials, jobs, lambda *_: None, lambda outcome: ended.append(outcome.trial))
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

    def test_it_goes_on(self, tmp_path: Path) -> None:
        self.run(Series(tmp_path, PLAN), 2)
        with (tmp_path / TRIALS_NAME).open("a") as file:
            file.write('{"trial": 2, "ki')  # as it was cut off
        series = Series(tmp_path, PLAN, resume=True)
        assert self.run(series, 5) == [2, 3, 4]
        assert [each.trial for each in series.outcomes] == [0, 1, 2, 3, 4]
        again = Series(tmp_path, PLAN, resume=True)
        assert self.run(again, 5) == []
        assert again.outcomes == series.outcomes

    def test_only_as_what_it_was(self, tmp_path: Path) -> None:
        Series(tmp_path, PLAN)
        other = msgspec.structs.replace(PLAN, seed=5)
        with pytest.raises(OutputError, match=r"is a series with seed 4, not 5; .*--out"):
            Series(tmp_path, other, resume=True)
        other = msgspec.structs.replace(PLAN, commit="def5678")
        with pytest.raises(OutputError, match=r"with commit abc1234, not def5678"):
            Series(tmp_path, other, resume=True)
        other = msgspec.structs.replace(PLAN, kinds=(FaultKind.LINK_CUT,))
        with pytest.raises(OutputError, match=r"kinds cloud_killed combination, not link_cut"):
            Series(tmp_path, other, resume=True)

    def test_there_is_none_to_go_on_with(self, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match=r"holds no series\.json"):
            Series(tmp_path, PLAN, resume=True)

    def test_an_interruption_gives_up_what_goes_on(self, tmp_path: Path) -> None:
        series = Series(tmp_path, PLAN)

        def interrupt(trial: int, kind: FaultKind) -> None:
            if trial == 7:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            series.run(9, 1, interrupt, lambda _: None)
        # No thread is left, and of the trial nothing but that it is missing.
        assert not [each for each in threading.enumerate() if each.name.startswith("chaos-")]
        assert not (tmp_path / "trial-00007").exists()
        assert len(series.outcomes) == 7

    def test_an_error_ends_it(self, tmp_path: Path) -> None:
        series = Series(tmp_path, PLAN)
        (tmp_path / "trial-00001").touch()  # is no directory, and cannot be one
        with pytest.raises(OutputError, match="trial-00001: cannot be written"):
            self.run(series, 3)
