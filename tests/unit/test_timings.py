"""The table of a run's decisions: what a row says, and what becomes of a row that was cut off."""

import csv
import os
from pathlib import Path

import pytest

from holdfast.errors import OutputError
from holdfast.journal.timings import (
    AnswerCounts,
    EventTable,
    VerificationCounts,
    count_answers,
    count_verified,
)
from holdfast.protocol.robot_events import Timing, VerificationNoted
from holdfast_lab.testbed.records import DecisionTable, time_of

MOMENT_NS = 1_700_000_000_123_456_789


def timing(step: int = 9, service: str = "tcp/127.0.0.1:7447") -> Timing:
    return Timing(2, step, "task", service, "keep_alive", 1.5, 2.25, 0.75)


def written(path: Path, *rows: Timing | VerificationNoted) -> Path:
    table = EventTable(path, type(rows[0]), clock=lambda: MOMENT_NS)
    for row in rows:
        table.add(row)
    table.close()
    return path


def test_a_row(tmp_path: Path) -> None:
    path = written(tmp_path / "timings.csv", timing(), timing(service='a,"b"'))
    with path.open(newline="") as file:
        header, first, second = csv.reader(file)
    assert ",".join(header) == (
        "trial,step,kind,service,status,waited_ms,round_trip_ms,computed_ms,time,boot,uptime_s"
    )
    assert first[:5] == ["2", "9", "task", "tcp/127.0.0.1:7447", "keep_alive"]
    assert first[5:9] == ["1.500", "2.250", "0.750", "2023-11-14T22:13:20.123456Z"]
    assert second[3] == 'a,"b"'


def test_it_goes_on_after_a_row_that_was_cut_off(tmp_path: Path) -> None:
    path = written(tmp_path / "timings.csv", timing(step=0), timing(step=9))
    path.write_bytes(path.read_bytes()[:-5])
    written(path, timing(step=18))
    with path.open(newline="") as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["0", "18"]


def test_it_is_read_while_it_grows(tmp_path: Path) -> None:
    """Whatever part of the file is there at the moment."""
    path = written(tmp_path / "timings.csv", timing(step=0), timing(step=9))
    content = path.read_bytes()
    path.unlink()

    reader = DecisionTable(path)
    reader.read()
    assert reader.rows == []
    with path.open("wb", buffering=0) as file:
        for position in range(len(content)):
            file.write(content[position : position + 1])
            reader.read()
            assert len(reader.rows) == max(0, content[: position + 1].count(b"\n") - 1)
    reader.close()
    assert [row.step for row in reader.rows] == [0, 9]
    row = reader.rows[1]
    assert row[1:] == (2, 9, "task", "tcp/127.0.0.1:7447", "keep_alive", 1.5, 2.25, 0.75)
    assert row.at == time_of("2023-11-14T22:13:20.123456Z") == pytest.approx(1e-9 * MOMENT_NS)


def test_it_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        EventTable(tmp_path / "missing" / "timings.csv", Timing)


def test_a_full_disk(tmp_path: Path) -> None:
    table = EventTable(tmp_path / "timings.csv", Timing)
    with Path("/dev/full").open("wb") as full:
        os.dup2(full.fileno(), table._file.fileno())
    with pytest.raises(OutputError, match="cannot be written: No space left"):
        table.add(timing())
    with pytest.raises(OutputError, match="cannot be written: No space left"):
        table.close()


class TestCountVerified:
    def test_each_verdict_counts(self, tmp_path: Path) -> None:
        cloud = "tcp/127.0.0.1:7447"
        rows = (
            (0, "question", "asked"),
            (0, "task", "same"),
            (0, "sensing", "different"),
            (9, "question", "asked"),
            (9, "task", "not_deterministic"),
            (18, "question", "left_out"),
        )
        noted = (VerificationNoted(1, step, cloud, *told) for step, *told in rows)
        path = written(tmp_path / "verification.csv", *noted)
        head, first = path.read_text().splitlines()[:2]
        assert head == "trial,step,service,kind,verdict,time,boot,uptime_s"
        assert first.startswith(f"1,0,{cloud},question,asked,2023-11-14T22:13:20.123456Z,")
        assert count_verified(path) == VerificationCounts(2, {cloud: 1}, 1, 1)

    def test_there_is_no_table(self, tmp_path: Path) -> None:
        assert count_verified(tmp_path / "verification.csv") is None


class TestCountAnswers:
    def test_each_decision_of_a_finished_trial_counts_once(self, tmp_path: Path) -> None:
        cloud, local = 'tcp/"a",b:7447', "local"
        rows = [
            (0, 0, "sensing", cloud, 4.0),
            (0, 0, "task", cloud, 0.0),
            # The robot was killed before it could use this one, and asked again.
            (0, 9, "sensing", cloud, 900.0),
            (0, 9, "sensing", local, 7.5),
            (0, 9, "task", local, 0.0),
            (1, 0, "sensing", cloud, 0.25),
            (1, 0, "task", cloud, 0.0),
            # Not finished.
            (2, 0, "sensing", "another", 5000.0),
        ]
        timings = (Timing(*row[:4], "standard", row[4], 1.0, 1.0) for row in rows)
        path = written(tmp_path / "timings.csv", *timings)
        counts = count_answers(path, {0, 1})
        assert counts == AnswerCounts({cloud: 2, local: 1}, {cloud: 2, local: 1}, 900.0)
        assert list(counts.sensing_decisions_by_service) == [cloud, local]

    def test_damaged_rows_do_not_count(self, tmp_path: Path) -> None:
        path = written(tmp_path / "timings.csv", timing())
        with path.open("ab") as file:
            file.write(b"2,18,task\n\0\0\0\0\n2,x,task,a,b,1.0,1.0,1.0,now\n\xff\xfe\n")
        assert count_answers(path, {2}) == AnswerCounts({}, {"tcp/127.0.0.1:7447": 1}, 1.5)

    def test_there_is_no_table(self, tmp_path: Path) -> None:
        assert count_answers(tmp_path / "timings.csv", {0}) is None
