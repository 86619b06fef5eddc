"""What tests/unit compares our messages with is what a real ROS 2 makes of them today."""

from __future__ import annotations

import subprocess
from pathlib import Path

from tests.ros.conftest import ROOT, Ros2

GOLDEN = ROOT / "tests" / "unit" / "data" / "ros2"


def test_golden_files(ros2: Ros2, tmp_path: Path) -> None:
    subprocess.run(
        [ros2.python, ROOT / "tests" / "ros" / "golden_ros2.py", tmp_path],
        env=ros2.environment,
        check=True,
        timeout=120,
    )
    made = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert made == {path.name: path.read_bytes() for path in GOLDEN.iterdir()}
