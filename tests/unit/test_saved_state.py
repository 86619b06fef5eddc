"""The file from which a guard goes on after it was killed with its master."""

import os
from pathlib import Path

import pytest
from tests.master_state import known

from ros1_master_guard.saved_state import read_journal, write_journal


def test_it_is_written_and_read(tmp_path: Path) -> None:
    path = tmp_path / "guard" / "journal"
    assert read_journal(path) is None
    write_journal(path, known())
    assert read_journal(path) == known()
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    assert [each.name for each in path.parent.iterdir()] == ["journal"]


def test_it_is_not_written_through_a_link(tmp_path: Path) -> None:
    (tmp_path / "precious").write_text("mine")
    (tmp_path / "journal.new").symlink_to(tmp_path / "precious")
    write_journal(tmp_path / "journal", known())
    assert (tmp_path / "precious").read_text() == "mine"
    assert read_journal(tmp_path / "journal") == known()


def test_what_is_there_and_cannot_be_read_is_said(tmp_path: Path) -> None:
    path = tmp_path / "journal"
    path.write_bytes(b"something else")
    with pytest.raises(ValueError, match="is no journal"):
        read_journal(path)
    write_journal(path, known())
    os.truncate(path, path.stat().st_size - 1)
    with pytest.raises(ValueError, match="is no whole journal"):
        read_journal(path)
    with pytest.raises(IsADirectoryError):
        read_journal(tmp_path)
