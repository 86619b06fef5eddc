"""The images: built of this tree and hardened. What runs in them decides as outside: Compose's."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from tests.deploy.docker import ROOT, USER, Engine, Images, holdfast

HARDENED = (
    *("--read-only", "--tmpfs", "/tmp", "--cap-drop", "ALL"),
    *("--security-opt", "no-new-privileges"),
)
CONFIGURATION = ROOT / "examples/peg_in_hole_2d.yaml"
ROLES = pytest.mark.parametrize("role", ["cloud", "robot"])


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
