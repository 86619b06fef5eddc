"""The node's command line, as far as it goes without ROS."""

import importlib.util

import pytest

from holdfast_ros.ros2.main import main


@pytest.mark.skipif(importlib.util.find_spec("rclpy") is not None, reason="ROS 2 is here")
def test_without_ros_it_names_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "there is no rclpy: source your ROS 2" in capsys.readouterr().err
