"""What the tests of deployment begin with."""

from collections.abc import Iterator

import pytest
from tests.deploy.docker import Engine, Images, build, running_engine
from tests.processes.conftest import references, site  # noqa: F401 - fixtures


@pytest.hookimpl(tryfirst=True)  # before xdist reads the marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put what needs the engine on one worker, so that there is one engine; the rest on another."""
    for item in items:
        group = "engine" if "engine" in getattr(item, "fixturenames", ()) else "no engine"
        item.add_marker(pytest.mark.xdist_group(group))


@pytest.fixture(scope="session")
def engine() -> Iterator[Engine]:
    """Return a Docker Engine."""
    with running_engine() as engine:
        yield engine


@pytest.fixture(scope="session")
def images(engine: Engine) -> Images:
    """Return the images of this tree."""
    return build(engine)
