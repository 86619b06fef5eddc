"""The images: built of this tree, hardened, and what runs in them decides as it does outside."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tomllib
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.deploy.docker import ROOT, USER, Engine, Images, give_to, holdfast, wait_until

HARDENED = (
    *("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"),
    *("--security-opt", "no-new-privileges"),
)
CONFIGURATION = ROOT / "examples/peg_in_hole_2d.yaml"
ROLES = pytest.mark.parametrize("role", ["cloud", "robot"])


@pytest.fixture
def container(engine: Engine) -> Iterator[str]:
    """Return a name for a container, which is gone afterwards."""
    name = f"holdfast-test-{uuid.uuid4().hex[:8]}"
    yield name
    engine.run("docker", "rm", "--force", "--volumes", name)


@pytest.fixture
def network(engine: Engine) -> Iterator[str]:
    """Return a network, which is gone afterwards."""
    name = f"holdfast-test-{uuid.uuid4().hex[:8]}"
    engine.docker("network", "create", name)
    yield name
    engine.docker("network", "rm", name)


def test_the_containerfile_has_no_bad_habits() -> None:
    linter = Path(sys.executable).with_name("hadolint")
    done = subprocess.run(
        [linter, "deploy/Containerfile"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, "")


@ROLES
def test_what_an_image_says_of_itself(engine: Engine, images: Images, role: str) -> None:
    found = engine.inspect(getattr(images, role))
    said, labels = found["Config"], found["Config"]["Labels"]
    print(f"holdfast-{role}: {found['Size'] / 1e6:.0f} MB")
    assert said["User"] == f"{USER}:{USER}"
    assert said["Entrypoint"] == ["holdfast"]
    assert "/readyz" in said["Healthcheck"]["Test"][-1]
    assert labels["org.opencontainers.image.title"] == f"holdfast-{role}"
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert labels["org.opencontainers.image.version"] == version
    assert list(said.get("Volumes") or ()) == (["/runs"] if role == "robot" else [])


@ROLES
def test_nothing_in_an_image_helps_an_intruder(engine: Engine, images: Images, role: str) -> None:
    """No rights to borrow, nothing to write, no compiler, no installer, no key and no test."""
    look = """
        find / -xdev -type f -perm /6000
        find / -xdev -type d -writable -not -path '/runs*' -not -path '/tmp*' -not -path '/dev*'
        find /opt -name '*.pem' -o -name '*.key' -o -name tests -o -name pip
        command -v gcc c++ cc pip pip3 git curl make || true
        touch /opt/holdfast/written 2>/dev/null && echo /opt/holdfast/written
        find /opt/holdfast/lib/python3*/site-packages/holdfast -name '*.py' |
        while read -r source; do
            compiled="${source%/*}/__pycache__/$(basename "$source" .py).cpython-*.pyc"
            ls $compiled >/dev/null 2>&1 || echo "$source is not compiled"
        done
        grep CapBnd /proc/self/status | grep -v 0000000000000000
        true
    """
    image = getattr(images, role)
    command = ("run", "--rm", *HARDENED, "--entrypoint", "bash", image, "-c", look)
    assert engine.docker(*command) == ""


def test_keys_of_another_user_are_named(engine: Engine, images: Images, tmp_path: Path) -> None:
    holdfast("keys", "keys", cwd=tmp_path)
    done = engine.run(
        *("docker", "run", "--rm", *HARDENED),
        *("-v", f"{tmp_path}/keys/service:/keys:ro", images.cloud),
    )
    assert done.returncode == 2, done.stderr
    assert "Permission denied; this process is user 10001" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_robot_in_a_container_decides_as_outside(
    engine: Engine, images: Images, container: str, network: str, tmp_path: Path
) -> None:
    """A service in the one, a robot in the other; each hears of its end, and leaves nobody."""
    holdfast("keys", "keys", "--host", "cloud", cwd=tmp_path)
    holdfast("run", CONFIGURATION, "--trials", 2, "--out", "calm", cwd=tmp_path)
    runs = tmp_path / "runs"
    runs.mkdir()
    give_to(USER, tmp_path / "keys", runs)
    engine.docker(
        *("run", "-d", "--name", container, "--network", network, "--network-alias", "cloud"),
        *(*HARDENED, "--pids-limit", 256, "-v", f"{tmp_path}/keys/service:/keys:ro", images.cloud),
    )

    def health() -> str:
        return str(engine.inspect(container)["State"]["Health"]["Status"])

    wait_until(lambda: health() == "healthy", "the service to be healthy")
    engine.docker(
        *("run", "--rm", "--network", network, *HARDENED, "-v", f"{runs}:/runs"),
        *("-v", f"{CONFIGURATION}:/config/robot.yaml:ro", "-v", f"{tmp_path}/keys/robot:/keys:ro"),
        *(images.robot, "run", "robot.yaml", "--out", "/runs/run", "--trials", 2),
        *("--service", "tls/cloud:7447", "--tls", "/keys", "--recovery", "never"),
    )
    holdfast("compare", "calm", "runs/run", cwd=tmp_path)
    summary = json.loads((runs / "run/summary.json").read_text())
    assert list(summary["sensing_decisions_by_service"]) == ["tls/cloud:7447"]
    engine.docker("stop", "--time", 60, container)
    assert engine.inspect(container)["State"]["ExitCode"] == 0
    shutil.rmtree(runs)
