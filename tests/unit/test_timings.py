"""The table of a run's decisions: what a row says, and what becomes of a row that was cut off."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from holdfast.cli.witness import DecisionTable, time_of
from holdfast.files import OutputError
from holdfast.recording.timings import TIMING_COLUMNS, TimingTable
from holdfast.session.effects import Timing

MOMENT_NS = 1_700_000_000_123_456_789


def timing(step: int = 9, service: str = "tcp/127.0.0.1:7447") -> Timing:
    return Timing(2, step, "task", service, "keep_alive", 1.5, 2.25, 0.75)


def test_a_row(tmp_path: Path) -> None:
    path = tmp_path / "timings.csv"
    table = TimingTable(path, clock=lambda: MOMENT_NS)
    table.add(timing())
    table.add(timing(service='a,"b"'))
    table.close()
    with path.open(newline="") as file:
        header, first, second = csv.reader(file)
    assert tuple(header) == TIMING_COLUMNS
    assert first[:5] == ["2", "9", "task", "tcp/127.0.0.1:7447", "keep_alive"]
    assert first[5:] == ["1.500", "2.250", "0.750", "2023-11-14T22:13:20.123456Z"]
    assert second[3] == 'a,"b"'


def test_it_goes_on_after_a_row_that_was_cut_off(tmp_path: Path) -> None:
    path = tmp_path / "timings.csv"
    table = TimingTable(path)
    table.add(timing(step=0))
    table.add(timing(step=9))
    table.close()
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    table = TimingTable(path)
    table.add(timing(step=18))
    table.close()
    with path.open(newline="") as file:
        assert [row["step"] for row in csv.DictReader(file)] == ["0", "18"]


def test_it_is_read_while_it_grows(tmp_path: Path) -> None:
    """Whatever part of the file is there at the moment."""
    path = tmp_path / "timings.csv"
    table = TimingTable(path, clock=lambda: MOMENT_NS)
    for step in (0, 9):
        table.add(timing(step=step))
    table.close()
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
    assert row[1:] == (2, 9, "task", "tcp/127.0.0.1:7447", "keep_alive", 1.5)
    assert row.at == time_of("2023-11-14T22:13:20.123456Z") == pytest.approx(1e-9 * MOMENT_NS)


def test_it_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="cannot be written"):
        TimingTable(tmp_path / "missing" / "timings.csv")
