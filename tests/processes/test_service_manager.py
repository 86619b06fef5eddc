"""What systemd hears from a process, over a real socket."""

import asyncio
import os
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

from holdfast.runtime.events import BoundedEventLog
from holdfast.runtime.service_manager import ServiceManager

EVENTS = BoundedEventLog()


@pytest.fixture
def notified(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as end:
        end.bind(str(tmp_path / "notify"))
        end.settimeout(30.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield end


def heard(end: socket.socket) -> list[str]:
    return end.recv(4096).decode().splitlines()


def test_its_variables_are_not_inherited(notified: socket.socket) -> None:
    manager = ServiceManager()
    assert "NOTIFY_SOCKET" not in os.environ
    manager.starting(90.0)
    manager.ready()
    manager.stopping(2.5)
    assert heard(notified) == ["EXTEND_TIMEOUT_USEC=90000000"]
    assert heard(notified) == ["READY=1"]
    assert heard(notified) == ["STOPPING=1", "EXTEND_TIMEOUT_USEC=2500000"]
    manager.close()


async def test_the_status_and_the_watchdog(
    notified: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "40000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    manager = ServiceManager()
    alive = [True]
    manager.watch(asyncio.get_running_loop(), EVENTS, lambda: "serving", lambda: alive[0])
    assert heard(notified) == ["STATUS=serving", "WATCHDOG=1"]
    notified.setblocking(False)
    assert await asyncio.get_running_loop().sock_recv(notified, 4096) == b"WATCHDOG=1"
    notified.setblocking(True)
    alive[0] = False
    manager.close()
    while (last := heard(notified)) == ["WATCHDOG=1"]:
        pass
    assert last == ["WATCHDOG_USEC=0"]


def test_the_watchdog_of_another_process_is_not_fed(
    notified: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "40000")
    monkeypatch.setenv("WATCHDOG_PID", "1")
    manager = ServiceManager()
    manager.close()
    manager.ready()
    notified.setblocking(False)
    with pytest.raises(BlockingIOError):
        notified.recv(10)
