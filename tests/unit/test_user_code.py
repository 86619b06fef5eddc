"""Whose code a frame of a traceback belongs to."""

from __future__ import annotations

from pathlib import Path

import pytest

from holdfast import planning
from holdfast.user_code import is_users_file


@pytest.mark.parametrize("name", [planning.__file__, "holdfast/session/robot.py", "<string>"])
def test_ours(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Also as compiled modules name themselves, wherever the process is."""
    monkeypatch.chdir(tmp_path)
    assert not is_users_file(name)


@pytest.mark.parametrize("name", ["holdfast/mine.py", "mine.py", "../holdfast/mine.py"])
def test_theirs(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert is_users_file(name)
    assert is_users_file(str(tmp_path / name))
