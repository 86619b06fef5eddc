"""Processes that outlive the guard, and one that waits to be a master."""

import signal
import socket
import sys
from pathlib import Path

import pytest
from tests.master_state import known

from ros1_master_guard import process as master_process
from ros1_master_guard.errors import GuardError
from ros1_master_guard.settings import GuardSettings, MasterAddress
from ros1_master_guard.standby import MasterProcess


def settings(directory: Path, program: str) -> GuardSettings:
    """Return settings with a Python that runs a program of ours instead of a master."""
    python = directory / "python"
    python.write_text(f'#!/bin/sh\nshift\nexec {sys.executable} -c "{program}" "$@"\n')
    python.chmod(0o755)
    return GuardSettings(MasterAddress("localhost", 11311, "127.0.0.1"), str(python))


async def test_what_a_master_told_is_known_when_it_has_ended(tmp_path: Path) -> None:
    program = f"""
import os, socket, sys
sys.path.insert(0, {str(Path(master_process.__file__).parent)!r})
from process import *
guard = socket.socket(fileno=int(sys.argv[2]))
guard.sendall(encoded('warm'))
read = lambda size: guard.recv(size, socket.MSG_WAITALL)
state = decoded(read(*HEAD.unpack(read(HEAD.size))))
guard.sendall(encoded(state))
for number in range(2000): guard.sendall(encoded(('parameters', '/a', [number] * 100)))
os.kill(os.getpid(), 9)
"""
    expected = known()
    expected.parameters["a"] = [1999] * 100
    with socket.socket() as listening:
        process = MasterProcess(settings(tmp_path, program), listening)
        await process.serve(known())
        assert await process.ended == -signal.SIGKILL
        assert process.link.following is not None
        await process.link.following
        await process.end()
    assert process.link.state == expected


async def test_a_process_that_ignores_the_signal_is_killed(tmp_path: Path) -> None:
    program = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); signal.pause()"
    with socket.socket() as listening:
        process = MasterProcess(settings(tmp_path, program), listening)
        await process.end(signal.SIGSTOP)
        assert await process.ended == -signal.SIGKILL


async def test_a_python_without_ros_is_named(tmp_path: Path) -> None:
    # Isolated and without site-packages, no Python has rosmaster.
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')
    python.chmod(0o755)
    settings = GuardSettings(MasterAddress("localhost", 11311, "127.0.0.1"), str(python))
    with socket.socket() as listening:
        process = MasterProcess(settings, listening)
        with pytest.raises(GuardError, match=r"cannot run a ROS 1 master .*rosmaster"):
            await process.warm()
        await process.end()


async def test_a_python_that_is_not_there_is_named(tmp_path: Path) -> None:
    address = MasterAddress("localhost", 11311, "127.0.0.1")
    settings = GuardSettings(address, str(tmp_path / "python"))
    with (
        socket.socket() as listening,
        pytest.raises(GuardError, match="cannot be run: No such file"),
    ):
        MasterProcess(settings, listening)
