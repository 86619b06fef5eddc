"""The directory of a robot's local socket: private, and not left behind."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from holdfast.errors import TransportError
from holdfast.transport.endpoints import PrivateSocket

MAKES_ONE_AND_WAITS = """
import sys
from holdfast.transport.endpoints import PrivateSocket
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
