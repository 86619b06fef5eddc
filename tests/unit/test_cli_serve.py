"""``holdfast serve`` brings ROS to the service, which starts only if all of it can.

processes/test_service_process.py has the rest.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.command_line import run_here

from holdfast.cli.serve import make_ros_service
from holdfast.errors import ConfigurationError, InvalidValueError
from holdfast.service.options import parse_options


def test_a_bad_option_ends_before_anything_starts(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    said = run_here(capsys, tmp_path, "serve", "--wokers", "2")
    assert (said.code, said.stdout) == (2, "")
    assert "'--wokers' is no option of holdfast serve; did you mean --workers?" in said.stderr


def test_an_address_of_ros1_that_others_reach_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run.yaml").write_text("problem: peg_in_hole_2d")
    monkeypatch.setenv("ROS_IP", "192.0.2.1")
    monkeypatch.delenv("ROS_HOSTNAME", raising=False)
    options = parse_options(["--ros1", "--configuration", str(tmp_path / "run.yaml")])
    with pytest.raises(InvalidValueError, match="no peer proves its identity"):
        make_ros_service(options)


def test_its_configuration_must_be_there(tmp_path: Path) -> None:
    options = parse_options(["--ros1", "--configuration", str(tmp_path / "none.yaml")])
    with pytest.raises(ConfigurationError, match="there is no such file"):
        make_ros_service(options)
