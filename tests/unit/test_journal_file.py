"""The file of a journal: found, of this form, and its frames as they were written."""

import os
from pathlib import Path

import pytest

from holdfast.errors import OutputError
from holdfast.journal.journal import Journal
from holdfast.journal.journal_file import START, JournalFile, find_journal


class TestFinding:
    @pytest.mark.parametrize("name", ["journal.bin", "journal.sqlite"])
    def test_a_directory_or_the_journal_itself(self, tmp_path: Path, name: str) -> None:
        journal = tmp_path / name
        Journal.create(journal, {}).close()
        assert find_journal(tmp_path, "compare") == find_journal(journal, "compare") == journal

    def test_what_is_no_run(self, tmp_path: Path) -> None:
        os.mkfifo(tmp_path / "pipe")
        (tmp_path / "one").mkdir()
        (tmp_path / "one" / "journal.bin").touch()
        # An end that stays open, so that a reader that waits would hang, not fail.
        held = os.open(tmp_path / "pipe", os.O_RDWR)
        for run, message in (
            (tmp_path, "holds no journal.bin, so no run to compare; one of a sweep's is .*/one"),
            (tmp_path / "missing", "no such directory or journal, so no run to compare"),
            (Path("/dev/null"), "is a pipe or device"),
            (tmp_path / "pipe", "is a pipe or device"),
        ):
            with pytest.raises(OutputError, match=message):
                find_journal(run, "compare")
        os.close(held)


@pytest.mark.parametrize("sizes", [(0, 1, 12), (1 << 18, 5, (1 << 18) - 12, 3), (700_000,) * 2])
def test_frames_of_any_size_come_back(tmp_path: Path, sizes: tuple[int, ...]) -> None:
    file = JournalFile(tmp_path / "journal.bin", os.O_RDWR | os.O_CREAT)
    file.fill([])
    payloads = [bytes([number]) * size for number, size in enumerate(sizes)]
    end = file.append(START, payloads[:1])
    end = file.append(end, payloads[1:])
    for chunk_bytes in (12, 4096, 1 << 18):
        found = list(file.frames(START, chunk_bytes))
        assert [payload for payload, _ in found] == payloads
        assert found[-1][1] == end
    assert file.promised() == (START.offset, START.offset)
    file.mark(end.offset, 64)
    assert file.promised() == (end.offset, 64)
    file.close()


def test_another_form_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "journal.bin"
    with pytest.raises(OutputError, match="there is no journal"):
        Journal.open(path)
    Journal.create(path, {}).close()
    data = path.read_bytes()
    for header, message in (
        (b"", "is empty, so not a journal; name the directory"),
        (b"no journal at all", "is not a journal"),
        (data[:17] + b"55" + data[19:], "journal version '55'; this holdfast reads version 4"),
    ):
        path.write_bytes(header)
        for opens in (Journal.open, Journal.read):
            with pytest.raises(OutputError, match=message) as raised:
                opens(path)
            # Who only reads begins no run.
            assert ("start anew" in str(raised.value)) == (opens == Journal.open)
        assert path.read_bytes() == header
