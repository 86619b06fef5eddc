"""The file of a journal: found, counted, and its rows checked."""

from __future__ import annotations

from pathlib import Path

import pytest

from holdfast.errors import OutputError
from holdfast.recording.journal import Journal
from holdfast.recording.journal_file import (
    JournalFile,
    StepCount,
    find_journal,
    meta_checksum,
    of_steps,
    of_trials,
)


class TestFinding:
    def test_a_directory_or_the_journal_itself(self, tmp_path: Path) -> None:
        journal = tmp_path / "journal.sqlite"
        Journal.create(journal, {}).close()
        assert find_journal(tmp_path, "compare") == find_journal(journal, "compare") == journal

    def test_what_is_no_run(self, tmp_path: Path) -> None:
        table = tmp_path / "trials.csv"
        table.write_text("trial,seed\n")
        for run, message in (
            (tmp_path, "holds no journal.sqlite, so no run to compare"),
            (tmp_path / "missing", "no such directory or journal, so no run to compare"),
            (table, "is not a journal; name the directory of a run"),
            (Path("/dev/null"), "is a pipe or device"),
        ):
            with pytest.raises(OutputError, match=message):
                find_journal(run, "compare")


class TestCount:
    def test_it_comes_back(self, tmp_path: Path) -> None:
        path = JournalFile(tmp_path / "journal.sqlite").count
        assert StepCount.read(path) is None
        count = StepCount(path, synchronous=True)
        count.begin(3, 5)
        count.write(3, 6)
        count.close()
        assert StepCount.read(path) == (3, 6)
        path.write_bytes(path.read_bytes()[:-1])
        assert StepCount.read(path) is None

    def test_it_cannot_be_written(self, tmp_path: Path) -> None:
        with pytest.raises(OutputError, match="count: cannot be written"):
            StepCount(tmp_path / "missing" / "count", synchronous=False)


class TestChecksums:
    def test_content_key_and_table_count(self) -> None:
        checksums = [
            of_steps(0, 1, b"data"),
            of_steps(1, 1, b"data"),
            of_steps(0, 2, b"data"),
            of_steps(0, 1, b"Data"),
            of_trials(0, 1, b"data"),
            meta_checksum("a", "b"),
            meta_checksum("b", "a"),
        ]
        assert len(set(checksums)) == len(checksums)

    @pytest.mark.parametrize("row", [("text", 0), (None, 0), (b"data", "0"), (b"other", 0)])
    def test_a_value_of_another_type_is_not_intact(self, row: tuple[object, object]) -> None:
        checksum = of_steps(0, 1, b"data")
        assert of_steps.is_intact(b"data", checksum, 0, 1)
        assert not of_steps.is_intact(row[0], checksum, row[1], 1)


def test_a_journal_that_is_open_here_is_writable(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    with Journal.create(path, {}):
        assert JournalFile(path).log.exists()
        JournalFile(path).require_writable()
        with pytest.raises(OutputError, match="another process"):
            Journal.open(path)
    with pytest.raises(OutputError, match="cannot be written: No such file"):
        JournalFile(tmp_path / "missing").require_writable()


def test_a_file_that_is_replaced_is_another(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for path in (first, second):
        path.write_text("same")
    version = JournalFile(first).version()
    second.replace(first)
    assert JournalFile(first).version()[:2] != version[:2]
