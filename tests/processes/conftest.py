"""What the tests of faults begin with."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.processes.faults import References, Site


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Site]:
    """Return a directory with its processes; all of them have ended afterwards."""
    with Site(tmp_path) as site:
        yield site


@pytest.fixture(scope="session")
def references(tmp_path_factory: pytest.TempPathFactory) -> References:
    """Return the runs without faults."""
    return References(tmp_path_factory.mktemp("references"))
