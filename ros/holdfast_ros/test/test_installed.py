"""For ``colcon test``: the package is installed beside its interfaces, and has what it needs."""

import importlib

import pytest


def test_the_nodes_interfaces_are_built() -> None:
    """The interfaces of this ROS have the fields that the node uses."""
    interfaces = pytest.importorskip("holdfast_interfaces.action")
    assert {"trial", "step"} <= interfaces.Act.Goal.get_fields_and_field_types().keys()


@pytest.mark.parametrize("module", ["ros2.main", "ros2.parameters", "executive", "ros1_serve"])
def test_holdfast_is_in_the_python_of_this_ros(module: str) -> None:
    """What the node imports is found, holdfast included."""
    importlib.import_module(f"holdfast_ros.{module}")
