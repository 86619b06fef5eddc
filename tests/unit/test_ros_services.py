"""The services in ROS that ``holdfast serve`` is asked for, before any of them starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from holdfast.cli.ros_services import make_ros_services
from holdfast.errors import ConfigurationError, InvalidValueError
from holdfast.service.options import parse_options


def test_an_address_of_ros1_that_others_reach_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "run.yaml").write_text("problem: peg_in_hole_2d")
    monkeypatch.setenv("ROS_IP", "192.0.2.1")
    monkeypatch.delenv("ROS_HOSTNAME", raising=False)
    options = parse_options(["--ros1", "--configuration", str(tmp_path / "run.yaml")])
    with pytest.raises(InvalidValueError, match="no peer proves its identity"):
        make_ros_services(options)


def test_its_configuration_must_be_there(tmp_path: Path) -> None:
    options = parse_options(["--ros1", "--configuration", str(tmp_path / "none.yaml")])
    with pytest.raises(ConfigurationError, match="there is no such file"):
        make_ros_services(options)
