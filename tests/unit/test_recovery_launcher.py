"""The local service as a process of its own: started, replaced, ended, and missed."""

from __future__ import annotations

import os
import queue
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.ports import free_port

from holdfast.protocol.events import RecoveryExited
from holdfast.robot.recovery_launcher import RecoveryLauncher

PATIENCE_S = 60.0


@pytest.fixture
def exits() -> queue.SimpleQueue[RecoveryExited]:
    return queue.SimpleQueue()


@pytest.fixture
def launcher(exits: queue.SimpleQueue[RecoveryExited]) -> Iterator[RecoveryLauncher]:
    arguments = ["--listen", f"tcp/127.0.0.1:{free_port()}", "--until-stdin-closes"]
    made = RecoveryLauncher(arguments, exits.put)
    yield made
    made.close()


def pid_of(launcher: RecoveryLauncher) -> int:
    assert launcher._process is not None
    return launcher._process.pid


def test_a_killed_service_is_reported_with_its_number(
    launcher: RecoveryLauncher, exits: queue.SimpleQueue[RecoveryExited]
) -> None:
    launcher.launch(3)
    os.kill(pid_of(launcher), signal.SIGKILL)
    assert exits.get(timeout=PATIENCE_S) == (3, "was ended by SIGKILL")


def test_a_service_that_is_replaced_or_closed_is_not_reported(
    launcher: RecoveryLauncher, exits: queue.SimpleQueue[RecoveryExited]
) -> None:
    launcher.launch(1)
    first = pid_of(launcher)
    launcher.launch(2)
    assert pid_of(launcher) != first
    with pytest.raises(ProcessLookupError):
        os.kill(first, 0)
    launcher.close()
    launcher.close()
    assert exits.empty()


def test_one_that_refuses_its_options_says_why_in_its_log(
    tmp_path: Path, exits: queue.SimpleQueue[RecoveryExited]
) -> None:
    log = tmp_path / "recovery.log"
    launcher = RecoveryLauncher(["--no-such-option"], exits.put, log)
    launcher.launch(1)
    assert exits.get(timeout=PATIENCE_S) == (1, f"ended with exit code 2; see {log}")
    assert "--no-such-option" in log.read_text()
    launcher.close()


def test_a_log_that_cannot_be_written_is_the_reason(
    tmp_path: Path, exits: queue.SimpleQueue[RecoveryExited]
) -> None:
    launcher = RecoveryLauncher([], exits.put, tmp_path / "missing" / "recovery.log")
    launcher.launch(7)
    assert exits.get(timeout=PATIENCE_S) == (7, "cannot be started: No such file or directory")
