"""The local service as a process of its own: started, replaced, ended, and missed."""

import asyncio
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from holdfast.protocol.robot_events import RecoveryExited
from holdfast.robot.recovery_launcher import RecoveryLauncher

PATIENCE_S = 60.0


@pytest.fixture
def launcher() -> Iterator[RecoveryLauncher]:
    connections: list[socket.socket] = []
    made = RecoveryLauncher([], connections.append)
    yield made
    made.close()
    for connection in connections:
        connection.close()


class Exits(asyncio.Queue[RecoveryExited]):
    """What a launcher has delivered."""

    async def next(self) -> RecoveryExited:
        return await asyncio.wait_for(self.get(), PATIENCE_S)


def pid_of(launcher: RecoveryLauncher) -> int:
    assert launcher._process is not None
    return launcher._process.pid


async def test_a_killed_service_is_reported_with_its_number(launcher: RecoveryLauncher) -> None:
    exits = Exits()
    launcher.launch(3, exits.put_nowait)
    os.kill(pid_of(launcher), signal.SIGKILL)
    assert await exits.next() == (3, "was ended by SIGKILL")


async def test_a_service_that_is_replaced_or_closed_is_not_reported(
    launcher: RecoveryLauncher,
) -> None:
    exits = Exits()
    launcher.launch(1, exits.put_nowait)
    first = pid_of(launcher)
    launcher.launch(2, exits.put_nowait)
    assert pid_of(launcher) != first
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
    launcher.close()
    launcher.close()
    await asyncio.sleep(0)
    assert exits.empty()


async def test_one_that_refuses_its_options_says_why_in_its_log(tmp_path: Path) -> None:
    exits = Exits()
    log = tmp_path / "recovery.log"
    launcher = RecoveryLauncher(["--no-such-option"], socket.socket.close, log)
    launcher.launch(1, exits.put_nowait)
    assert await exits.next() == (1, f"ended with exit code 2; see {log}")
    assert "--no-such-option" in log.read_text()
    launcher.close()


async def test_a_log_that_cannot_be_written_is_the_reason(tmp_path: Path) -> None:
    exits = Exits()
    launcher = RecoveryLauncher([], socket.socket.close, tmp_path / "missing" / "recovery.log")
    launcher.launch(7, exits.put_nowait)
    assert await exits.next() == (7, "cannot be started: No such file or directory")
