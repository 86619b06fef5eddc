"""``holdfast ros1-guard`` before it starts a master; tests/ros has the rest."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.command_line import run_here


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--log", "xml"], "--log is 'xml'; allowed are text and json"),
        (["--silent-s", "0.1"], "--silent-s is '0.1'; allowed are numbers from 0.5 to 3600 (s)"),
        (["--rossout"], "did you mean --rosout?"),
    ],
)
def test_bad_options(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    said = run_here(capsys, tmp_path, "ros1-guard", *arguments)
    assert said.code == 2
    assert message in said.stderr


def test_a_master_at_no_address_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_MASTER_URI", "nowhere")
    said = run_here(capsys, tmp_path, "ros1-guard")
    assert said.code == 2
    assert "ROS_MASTER_URI" in said.stderr
