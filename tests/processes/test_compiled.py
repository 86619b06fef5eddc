"""Compiled state machines do, bit for bit, what the interpreted ones do.

Compilers have their own ideas of types, of integers and of when something is evaluated; so the same
schedules go through both, and everything that is told of the runs is compared. Both are of this
installation: a copy of it without its extension modules of machines is interpreted.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import holdfast
from holdfast.config.source_digest import machines

pytestmark = pytest.mark.skipif(
    machines() == "interpreted", reason="the machines of this installation are interpreted"
)

SEEDS = 300

OUTCOMES = f"""
import hashlib
from holdfast.config.source_digest import machines
from holdfast_lab.simulation.schedule_draws import draw_schedule
from holdfast_lab.simulation.world import Simulator
from holdfast.config.source_digest import core_version
simulator, hashed = Simulator(), hashlib.sha256()
for seed in range({SEEDS}):
    hashed.update(repr(simulator.run(draw_schedule(seed), tell=True)).encode())
print(machines(), core_version(), hashed.hexdigest())
"""


def outcomes(directory: Path | None = None) -> list[str]:
    """Return, of the package in a directory, the kind of machines, its version, and the hash of all
    that they did.
    """
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    if directory is not None:
        environment["PYTHONPATH"] = str(directory)
    done = subprocess.run(
        [sys.executable, "-c", OUTCOMES],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
        timeout=300,
    )
    return done.stdout.split()


def test_the_same_happens_as_interpreted(tmp_path: Path) -> None:
    package = Path(holdfast.__file__).parent
    shutil.copytree(package, tmp_path / "holdfast")
    for compiled in (tmp_path / "holdfast" / "protocol").glob("*.so"):
        compiled.unlink()
    compiled_kind, *of_compiled = outcomes()
    interpreted_kind, *of_interpreted = outcomes(tmp_path)
    assert (compiled_kind, interpreted_kind) == ("compiled", "interpreted")
    # A robot and a service of which one is compiled have the same code.
    assert of_compiled == of_interpreted
