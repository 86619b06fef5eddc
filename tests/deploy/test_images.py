"""The images: built of this tree, hardened, and what runs in them decides as it does outside."""

from __future__ import annotations

import pytest
from tests.deploy.docker import Engine, Images

HARDENED = (
    *("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"),
    *("--security-opt", "no-new-privileges"),
)


@pytest.mark.parametrize("role", ["cloud", "robot"])
def test_the_command_runs_with_nothing_that_it_could_write(
    engine: Engine, images: Images, role: str
) -> None:
    name = getattr(images, role)
    assert engine.docker("run", "--rm", *HARDENED, name, "--version").startswith("holdfast ")
    assert engine.inspect(name)["Config"]["User"] == "10001:10001"
