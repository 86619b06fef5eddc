"""What the tests with a real ROS begin with."""

import os
import shutil
import subprocess
import threading
from pathlib import Path
from typing import NoReturn

import pytest

ROOT = Path(__file__).parents[2]


PATIENCE_S = 60.0


def left_out(what: str) -> NoReturn:
    """Leave a test out because something is not here; where nothing may be left out, fail."""
    if os.environ.get("CI"):
        pytest.fail(what)
    pytest.skip(what)


def line_of(process: subprocess.Popen[str]) -> str:
    """Return the next line that a process writes; one that writes none in time is ended."""
    assert process.stdout is not None
    timer = threading.Timer(PATIENCE_S, process.kill)
    timer.start()
    try:
        return process.stdout.readline()
    finally:
        timer.cancel()


class Ros2:
    """A real ROS 2, as tests/ros/set_up_ros2 makes it."""

    def __init__(self, directory: Path) -> None:
        prefix = next(path for name in ("kilted", "jazzy") if (path := directory / name).is_dir())
        installed = sorted(path for path in (directory / "install").iterdir() if path.is_dir())
        self.distribution = prefix.name
        self.python = prefix / "bin" / "python"
        site = [
            str(place) for path in installed for place in path.glob("lib/python3*/site-packages")
        ]
        libraries = [str(path / "lib") for path in installed]
        self.environment = {
            **os.environ,
            "PATH": f"{prefix / 'bin'}:{os.environ['PATH']}",
            "AMENT_PREFIX_PATH": ":".join([*map(str, installed), str(prefix)]),
            "PYTHONPATH": ":".join(site),
            "LD_LIBRARY_PATH": ":".join(libraries),
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        }


@pytest.fixture(scope="session")
def ros2() -> Ros2:
    """Return a real ROS 2 with our interfaces."""
    directory = Path(os.environ.get("ROS2", ROOT / ".ros2"))
    if not (directory / ".built").exists():
        left_out(f"no ROS 2 in {directory}: make test-ros installs it")
    return Ros2(directory)


@pytest.fixture(scope="session")
def ros1() -> dict[str, str]:
    """Return the environment for processes of Debian's ROS 1."""
    if shutil.which("rosmaster") is None:
        left_out("no ROS 1: apt-get install ros-core")
    if not Path("/usr/lib/rosout/rosout").exists():
        left_out("no /rosout for the guard: apt-get install rosout")
    return {
        **os.environ,
        "ROS_VERSION": "1",
        "ROS_PACKAGE_PATH": f"{ROOT / 'ros'}:/usr/share",
        "ROS_HOSTNAME": "127.0.0.1",
    }
