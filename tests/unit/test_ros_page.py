"""The page about ROS names every key of a robot's interface, with its default and meaning."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from holdfast.ros.robot_interface import ROBOT_PARAMETERS, ROLES

PAGE = (Path(__file__).parents[2] / "docs" / "ros.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("key", ROBOT_PARAMETERS)
def test_each_key_of_a_robot_stands_there(key: str) -> None:
    default, meaning = ROBOT_PARAMETERS[key]
    name = key.removeprefix("environment.")
    role, _, last = name.partition(".")
    rows = [
        f"| `{each}` | `{json.dumps(default)}` | {meaning} |" for each in (name, f"ROLE.{last}")
    ]
    assert rows[0] in PAGE or (role in ROLES and rows[1] in PAGE)
