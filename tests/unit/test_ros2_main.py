"""The node's command line, as far as it goes without ROS."""

from __future__ import annotations

import importlib.util

import pytest

from holdfast_ros.ros2.main import main, usage
from holdfast_ros.ros2.parameters import OWN


def test_help_names_every_parameter(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    assert printed == usage()
    for name in OWN:
        assert f"  {name}" in printed
    assert max(map(len, printed.splitlines())) <= 100


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="ROS 2 is here")
def test_without_ros_it_names_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "there is no rclpy: source your ROS 2" in capsys.readouterr().err
