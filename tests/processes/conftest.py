"""What the tests of faults begin with."""

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


@pytest.fixture(scope="session")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with the keys of a robot and a service, and of strangers."""
    directory = tmp_path_factory.mktemp("keys")
    with Site(directory) as site:
        for name in ("ours", "theirs"):
            made = site.holdfast("keys", directory / name)
            assert made.process.returncode == 0, made.account()
    return directory
