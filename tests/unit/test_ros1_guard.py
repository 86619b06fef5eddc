"""``holdfast ros1-guard`` before it starts a master; tests/ros has the rest."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.command_line import run_here


@pytest.mark.parametrize("log", ["text", "json"])
def test_a_master_at_no_address_is_refused(
    log: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", "nowhere")
    said = run_here(capsys, tmp_path, "ros1-guard", "--log", log)
    assert said.code == 2
    assert "ROS_MASTER_URI is 'nowhere'; expected http://HOST:PORT" in said.stderr
