"""The directory of a robot's local socket: private, and not left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from holdfast.errors import TransportError
from holdfast.transport.private_socket import PrivateSocket

MAKES_ONE_AND_WAITS = """
import sys
from holdfast.transport.private_socket import PrivateSocket
local = PrivateSocket()
print(local.endpoint, flush=True)
sys.stdin.read()
"""


@pytest.fixture
def temporary(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    # A short one: the path of a socket has a hundred characters at most.
    with tempfile.TemporaryDirectory(prefix="h") as directory:
        monkeypatch.setenv("TMPDIR", directory)
        monkeypatch.setattr(tempfile, "tempdir", None)
        yield Path(directory)


def directory_of(endpoint: str) -> Path:
    return Path(endpoint.partition("/")[2]).parent


def test_nobody_else_can_enter(temporary: Path) -> None:
    with PrivateSocket() as local:
        directory = directory_of(local.endpoint)
        assert directory.parent == temporary
        assert directory.stat().st_mode & 0o777 == 0o700
    assert list(temporary.iterdir()) == []
    local.remove()


def test_what_a_killed_process_left_goes_and_what_is_used_stays(temporary: Path) -> None:
    processes = [
        subprocess.Popen(
            [sys.executable, "-c", MAKES_ONE_AND_WAITS],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        for _ in range(2)
    ]
    try:
        directories = []
        for process in processes:
            assert process.stdout is not None
            directories.append(directory_of(process.stdout.readline().strip()))
        processes[0].send_signal(signal.SIGKILL)
        processes[0].wait(30)
        (directories[0] / "s").touch()
        with PrivateSocket() as local:
            left = set(temporary.iterdir())
            assert left == {directories[1], directory_of(local.endpoint)}
    finally:
        for process in processes:
            process.kill()
            process.communicate(timeout=30)


def test_too_long_a_path_is_said(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    long = temporary / ("d" * 100)
    long.mkdir()
    monkeypatch.setenv("TMPDIR", str(long))
    monkeypatch.setattr(tempfile, "tempdir", None)
    with pytest.raises(TransportError, match="TMPDIR"):
        PrivateSocket()
    assert list(long.iterdir()) == []


def test_a_link_to_a_directory_is_not_followed(temporary: Path) -> None:
    victim = temporary / "victim"
    victim.mkdir(mode=0o700)
    for name in ("s", "lock"):
        (victim / name).touch()
    before = sorted(victim.iterdir())
    (temporary / f"holdfast-{os.getuid()}-planted").symlink_to(victim)
    with PrivateSocket():
        pass
    assert sorted(victim.iterdir()) == before


def test_a_directory_that_others_can_enter_is_none_of_ours(temporary: Path) -> None:
    other = temporary / f"holdfast-{os.getuid()}-other"
    other.mkdir()
    other.chmod(0o755)
    for name in ("s", "lock"):
        (other / name).touch()
    with PrivateSocket():
        pass
    assert sorted(file.name for file in other.iterdir()) == ["lock", "s"]


def test_files_of_another_name_are_kept(temporary: Path) -> None:
    abandoned = temporary / f"holdfast-{os.getuid()}-abandoned"
    abandoned.mkdir(mode=0o700)
    for name in ("s", "lock", "notes"):
        (abandoned / name).touch()
    with PrivateSocket() as local:
        (directory_of(local.endpoint) / "notes").touch()
    assert [file.name for file in abandoned.iterdir()] == ["notes"]
    assert [file.name for file in directory_of(local.endpoint).iterdir()] == ["notes"]
