"""The same bits on another architecture: a wheel for aarch64 decides as one for x86_64 does.

``deploy/aarch64`` makes it, and a Debian for arm64, whose Python an emulated processor runs.
"""

import contextlib
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.deploy.docker import ROOT, missing
from tests.golden.table import pinned
from tests.ports import free_port
from tests.programs import completed

pytestmark = pytest.mark.slow

_PACKAGES = {
    "debootstrap": "debootstrap",
    "qemu-aarch64-static": "qemu-user-static",
    "aarch64-linux-gnu-g++": "g++-aarch64-linux-gnu",
}
_BOUND_S = 1200.0


def _run(*words: object, **options: Any) -> str:
    done = completed([str(word) for word in words], _BOUND_S, **options)
    assert done.returncode == 0, f"{words}: {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the files of a Debian for arm64 with Python, and holdfast's wheel installed."""
    if lacking := [package for name, package in _PACKAGES.items() if shutil.which(name) is None]:
        missing(f"Debian's packages are missing: {', '.join(lacking)}")
    if os.geteuid() != 0 or sys.version_info[:2] != (3, 11) or platform.machine() != "x86_64":
        missing("it takes root and, as Debian's for arm64, Python 3.11, on x86_64")
    directory = tmp_path_factory.mktemp("aarch64")
    root = directory / "root"
    made = {**os.environ, "PYTHON": sys.executable}
    _run(ROOT / "deploy/aarch64", root, directory / "dist", env=made)
    for name in ("tests", "examples", "studies"):
        shutil.copytree(ROOT / name, root / "tree" / name)
    (wheel,) = (directory / "dist").glob("*.whl")
    pip = (sys.executable, "-m", "pip")
    kinds = ("manylinux_2_17", "manylinux2014", "manylinux_2_28", "manylinux_2_35")
    _run(
        *(*pip, "install", "-q", "--target", root / "site", "--only-binary", ":all:"),
        *("--python-version", "3.11", *(f"--platform={kind}_aarch64" for kind in kinds), wheel),
    )
    return root


def _emulated(root: Path, *words: object) -> list[str]:
    command = ["chroot", str(root), "/emulator", "-E", "PYTHONPATH=/site:/tree"]
    return [*command, "/usr/bin/python3.11", "-m", *map(str, words)]


def test_every_pinned_decision_is_the_same(machine: Path) -> None:
    last = _run(*_emulated(machine, "tests.golden.table", "--check")).splitlines()[-1]
    assert last == f"{len(pinned())} runs on aarch64, 0 of them differ from digests.csv"


@contextlib.contextmanager
def _service(root: Path, port: int) -> Iterator[str]:
    endpoint = f"tcp/127.0.0.1:{port}"
    command = _emulated(root, "holdfast", "serve", "--listen", endpoint, "--log", "json")
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["event"] == "ready"
        yield endpoint
    finally:
        process.terminate()
        process.communicate(timeout=_BOUND_S)


def test_a_robot_of_one_kind_is_served_by_one_of_the_other(machine: Path, tmp_path: Path) -> None:
    """The service is believed to have the robot's code, and each of its answers is followed."""
    name = "examples/peg_in_hole_2d.yaml"
    words = pinned()[name][0].split()[1:]
    with _service(machine, free_port()) as endpoint:
        options = ("--service", endpoint, "--recovery", "never", "--quiet")
        command = (sys.executable, "-m", "holdfast", *words, *options)
        _run(*command, "--out", tmp_path / "run", cwd=ROOT)
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert summary["digest"] == pinned()[name][1]
    assert set(summary["sensing_decisions_by_service"]) == {endpoint}
    assert summary["verified_answers"] > 0
    assert summary["wrong_answers"] == {}
