"""What the tests of deployment begin with."""

from collections.abc import Iterator

import pytest
from tests.deploy.docker import Engine, Images, build, running_engine
from tests.processes.conftest import references, site  # noqa: F401 - fixtures


@pytest.fixture(scope="session")
def engine() -> Iterator[Engine]:
    """Return a Docker Engine."""
    with running_engine() as engine:
        yield engine


@pytest.fixture(scope="session")
def images(engine: Engine) -> Images:
    """Return the images of this tree."""
    return build(engine)
