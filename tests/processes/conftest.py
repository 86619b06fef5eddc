"""What the tests of faults begin with."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.processes.faults import References, Site


@pytest.fixture(scope="session", autouse=True)
def _signals_are_heard() -> None:
    """Let processes hear signals that a shell has its background jobs ignore."""
    for number in (signal.SIGINT, signal.SIGQUIT):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(
                number,
                signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL,
            )


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """Return a directory with its processes; all of them have ended afterwards."""
    with Site(tmp_path) as site:
        yield site


@pytest.fixture(scope="session")
def references(tmp_path_factory: pytest.TempPathFactory) -> References:
    """Return the runs without faults."""
    return References(tmp_path_factory.mktemp("references"))
