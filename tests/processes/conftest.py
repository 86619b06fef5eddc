"""What the tests of faults begin with."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.processes.faults import References, Site


@pytest.fixture(scope="session", autouse=True)
def _signals_are_heard() -> None:
    """Let processes hear signals that a shell, or nohup, has its background jobs ignore."""
    handlers: dict[int, Any] = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGQUIT: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    for number, handler in handlers.items():
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, handler)


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """Return a directory with its processes; all of them have ended afterwards."""
    with Site(tmp_path) as site:
        yield site


@pytest.fixture(scope="session")
def references(tmp_path_factory: pytest.TempPathFactory) -> References:
    """Return the runs without faults."""
    return References(tmp_path_factory.mktemp("references"))


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with the keys of a robot and a service, and of strangers."""
    directory = tmp_path_factory.mktemp("keys")
    with Site(directory) as site:
        for name in ("ours", "theirs"):
            made = site.holdfast("keys", directory / name)
            assert made.process.returncode == 0, made.account()
    return directory
