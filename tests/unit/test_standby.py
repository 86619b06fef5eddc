"""Processes that outlive the guard, and one that waits to be a master."""

from __future__ import annotations

import asyncio
import signal
import socket
import sys
from pathlib import Path

import pytest

from ros1_master_guard.errors import GuardError
from ros1_master_guard.settings import GuardSettings, MasterAddress
from ros1_master_guard.standby import DetachedProcess, MasterProcess


def test_an_exit_code_is_known_and_an_end_may_be_repeated() -> None:
    async def run() -> int:
        process = DetachedProcess([sys.executable, "-c", "raise SystemExit(3)"], {})
        code = await process.wait()
        await process.end(signal.SIGTERM)
        return code

    assert asyncio.run(run()) == 3


def test_a_process_that_ignores_the_signal_is_killed() -> None:
    program = "import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN); signal.pause()"

    async def run() -> int:
        process = DetachedProcess([sys.executable, "-c", program], {})
        await process.end(signal.SIGSTOP)
        return await process.wait()

    assert asyncio.run(run()) == -signal.SIGKILL


def test_a_python_without_ros_is_named(tmp_path: Path) -> None:
    # Isolated and without site-packages, no Python has rosmaster.
    python = tmp_path / "python"
    python.write_text(f'#!/bin/sh\nexec {sys.executable} -I -S "$@"\n')
    python.chmod(0o755)
    settings = GuardSettings(MasterAddress("localhost", 11311, "127.0.0.1"), str(python))

    async def run() -> None:
        with socket.socket() as listening:
            process = MasterProcess(settings, listening, tmp_path / "journal")
            try:
                await process.warm()
            finally:
                await process.end(at_once=True)

    with pytest.raises(GuardError, match=r"cannot run a ROS 1 master .*rosmaster"):
        asyncio.run(run())


def test_a_python_that_is_not_there_is_named(tmp_path: Path) -> None:
    address = MasterAddress("localhost", 11311, "127.0.0.1")
    settings = GuardSettings(address, str(tmp_path / "python"))

    async def run() -> None:
        with socket.socket() as listening:
            MasterProcess(settings, listening, tmp_path / "journal")

    with pytest.raises(GuardError, match="cannot be run: No such file"):
        asyncio.run(run())
