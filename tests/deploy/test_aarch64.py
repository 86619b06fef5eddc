"""The same bits on another architecture: a wheel for aarch64 decides as one for x86_64 does.

Debian's cross compiler builds it, Debian's Python for arm64 runs it, and QEMU is the processor: not
as fast as one, but as exact, since its floating point is IEEE's. Single programs are emulated, no
machine is, so nothing of this machine is changed.
"""

from __future__ import annotations

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

pytestmark = pytest.mark.slow

_TRIPLET = "aarch64-linux-gnu"
_EMULATOR = "qemu-aarch64-static"
_PACKAGES = {
    "debootstrap": "debootstrap",
    _EMULATOR: "qemu-user-static",
    f"{_TRIPLET}-g++": f"g++-{_TRIPLET}",
}
_BOUND_S = 1200.0


def _run(*words: object, **options: Any) -> str:
    done: subprocess.CompletedProcess[str] = subprocess.run(
        [str(word) for word in words],
        text=True,
        capture_output=True,
        timeout=_BOUND_S,
        check=False,
        **options,
    )
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
    _run(
        *("debootstrap", "--foreign", "--arch=arm64", "--variant=minbase"),
        *("--include=python3,libpython3-dev", "bookworm", root, "http://deb.debian.org/debian"),
    )
    for package in root.glob("var/cache/apt/archives/*.deb"):
        _run("dpkg-deb", "-x", package, root)
    shutil.copy(str(shutil.which(_EMULATOR)), root / "emulator")
    for name in ("tests", "examples"):
        shutil.copytree(ROOT / name, root / "tree" / name)
    settings = (
        "-DCMAKE_SYSTEM_NAME=Linux",
        "-DCMAKE_SYSTEM_PROCESSOR=aarch64",
        f"-DCMAKE_CXX_COMPILER={_TRIPLET}-g++",
        f"-DCMAKE_CXX_FLAGS='-idirafter {root}/usr/include'",
        f"-DPython_INCLUDE_DIR={root}/usr/include/python3.11",
    )
    variables = {
        "CMAKE_ARGS": " ".join(settings),
        "SETUPTOOLS_EXT_SUFFIX": f".cpython-311-{_TRIPLET}.so",
        "_PYTHON_HOST_PLATFORM": "linux-aarch64",
    }
    pip = (sys.executable, "-m", "pip")
    build = (*pip, "wheel", "-q", "--no-deps", "--wheel-dir", directory, ROOT)
    _run(*build, env={**os.environ, **variables})
    (wheel,) = directory.glob("*.whl")
    kinds = ("linux", "manylinux_2_17", "manylinux2014", "manylinux_2_28")
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
        options = (
            "--service",
            endpoint,
            "--recovery",
            "never",
            "--quiet",
            "--out",
            tmp_path / "run",
        )
        _run(sys.executable, "-m", "holdfast", *words, *options, cwd=ROOT)
    summary = json.loads((tmp_path / "run/summary.json").read_text())
    assert summary["digest"] == pinned()[name][1]
    assert set(summary["sensing_decisions_by_service"]) == {endpoint}
    assert summary["verified_answers"] > 0
    assert summary["wrong_answers"] == {}
