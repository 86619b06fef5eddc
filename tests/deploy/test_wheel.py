"""The wheel that ``make wheel`` makes holds what it should, and runs where no compiler is."""

import platform
import posixpath
import subprocess
import sys
import tarfile
import zipfile
from email import message_from_bytes
from pathlib import Path

import pytest
from tests.deploy.docker import BASE, ROOT, Engine, missing
from tests.golden.table import pinned
from tests.programs import completed

import holdfast

pytestmark = pytest.mark.slow  # building it takes minutes

_BUILD_S = 1200.0
_NOT_IN_SOURCES = (".ci/", ".github/", "docs/images/")
_LINK_POLICY = "manylinux_2_"

# A machine as one gets it: Debian with Python. What is tried there is what a user does first, then
# every decision that is pinned, then a service and a robot that asks it.
_TRIAL = """
apt-get update -q && apt-get install -q -y --no-install-recommends python3-venv
for compiler in c++ g++ cc gcc clang; do
    if command -v $compiler; then echo "there is a compiler"; exit 1; fi
done
python3 -m venv /opt/holdfast
export PATH=/opt/holdfast/bin:$PATH
pip install -q --only-binary :all: /dist/*.whl
pip check
holdfast --version
cd /tree
python -m tests.golden.table --check
# A compiler whose runtime does not know processors would leave the wheel slow, and right.
HOLDFAST_SIMD=$(grep -o -w -m 1 avx2 /proc/cpuinfo | head -n 1) \\
    python -c 'import holdfast.numerics.reproducible'
holdfast serve --listen tcp/127.0.0.1:7447 > /tmp/service.log 2>&1 &
holdfast run examples/peg_in_hole_2d.yaml --trials 3 --set simulator.max_steps=300 --quiet \\
    --service tcp/127.0.0.1:7447 --recovery never --out /tmp/run
kill $! && wait $!
echo "served: $(grep -o '"digest": "[0-9a-f]*"' /tmp/run/summary.json)"
"""


def _make(goal: str, dist: Path) -> None:
    done = completed(["make", goal, f"DIST={dist}"], cwd=ROOT, timeout=_BUILD_S)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"


def _tracked(under: str = "") -> set[str]:
    command = ["git", "ls-files", "-z", under or "."]
    found = subprocess.run(command, cwd=ROOT, text=True, capture_output=True, check=True).stdout
    return {name for name in found.split("\0") if name and (ROOT / name).exists()}


@pytest.fixture(scope="module")
def dist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    directory = tmp_path_factory.mktemp("release") / "dist"
    _make("wheel", directory)
    return directory


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (wheel,) = dist.glob("*.whl")
    return wheel


def test_it_fits_other_machines_and_brings_no_library(wheel: Path) -> None:
    platform_tag = wheel.stem.split("-")[-1]
    assert platform_tag.startswith(_LINK_POLICY), wheel.name
    assert platform_tag.endswith(platform.machine())
    # Libraries beyond what every machine has would have been put here by the repair.
    assert not [name for name in zipfile.ZipFile(wheel).namelist() if ".libs/" in name]


def test_it_holds_the_package_and_nothing_else(wheel: Path) -> None:
    archive = zipfile.ZipFile(wheel)
    names = {name for name in archive.namelist() if not name.endswith("/")}
    about = f"holdfast_sensing-{holdfast.__version__}.dist-info/"
    (kernel,) = (name for name in names if name.endswith(".so"))
    assert kernel.startswith("holdfast/_kernel.")
    package = {name.removeprefix("src/") for name in _tracked("src")}
    assert {name for name in names if not name.startswith(about)} == package | {kernel}
    assert {"holdfast/py.typed", "holdfast_env/py.typed"} <= names
    assert {name.removeprefix(about) for name in names if name.startswith(about)} == {
        *("METADATA", "RECORD", "WHEEL", "entry_points.txt"),
        *("licenses/LICENSE", "sboms/kernel.cdx.json"),
    }
    metadata = message_from_bytes(archive.read(f"{about}METADATA"))
    assert metadata["Version"] == holdfast.__version__
    assert metadata["License-Expression"] == "Apache-2.0"
    assert archive.read(f"{about}licenses/LICENSE") == (ROOT / "LICENSE").read_bytes()
    assert b"holdfast = holdfast.cli:main" in archive.read(f"{about}entry_points.txt")


def test_the_laboratory_is_a_wheel_of_its_own(dist: Path) -> None:
    (wheel,) = (dist / "lab").glob("*.whl")
    archive = zipfile.ZipFile(wheel)
    about = f"holdfast_lab-{holdfast.__version__}.dist-info/"
    package = {name.removeprefix("lab/src/") for name in _tracked("lab/src")}
    assert {name for name in archive.namelist() if not name.startswith(about)} == package
    assert archive.read(f"{about}licenses/LICENSE") == (ROOT / "LICENSE").read_bytes()
    assert b"[holdfast.commands]" in archive.read(f"{about}entry_points.txt")


def test_the_sources_are_whole(dist: Path) -> None:
    """The wheel is built of them, so what they lack it would lack; and they have the tests."""
    (sources,) = dist.glob("*.tar.gz")
    with tarfile.open(sources) as archive:
        members = archive.getmembers()
    names = {member.name.partition("/")[2] for member in members if member.isfile()}
    for member in members:
        if member.issym():  # of the packages of ROS, to a file that is there as well
            place = member.name.partition("/")[2]
            target = posixpath.normpath(posixpath.join(posixpath.dirname(place), member.linkname))
            assert target in names, f"{place} leads to {target}"
            names.add(place)
    lacking = {name for name in _tracked() - names if not name.startswith(_NOT_IN_SOURCES)}
    assert not lacking
    assert not [name for name in names if name.endswith((".so", ".pyc"))]


@pytest.mark.usefixtures("images")  # which stand on the bare machine's own
def test_it_runs_on_a_bare_machine(wheel: Path, engine: Engine) -> None:
    if sys.version_info[:2] != (3, 11):
        missing(f"{wheel.name} is not for the Python 3.11 of {BASE}")
    said = engine.docker(
        *("run", "--rm", "-v", f"{wheel.parent}:/dist:ro"),
        *(f"-v={ROOT / name}:/tree/{name}:ro" for name in ("tests", "examples", "studies")),
        *("-e", "PIP_CERT=/etc/ssl/certs/ca-certificates.crt", "-e", "PYTHONDONTWRITEBYTECODE=1"),
        *(BASE, "sh", "-euc", _TRIAL),
        timeout=_BUILD_S,
    )
    lines = said.splitlines()
    assert any(line.startswith(f"holdfast {holdfast.__version__}+") for line in lines), said
    assert (
        f"{len(pinned())} runs on {platform.machine()}, 0 of them differ from digests.csv" in lines
    )
    _, digest = pinned()["examples/peg_in_hole_2d.yaml, as it is"]
    assert lines[-1] == f'served: "digest": "{digest}"'


def test_made_again_it_is_the_same(wheel: Path, tmp_path: Path) -> None:
    again = tmp_path / "dist"
    _make("wheel", again)
    assert (again / wheel.name).read_bytes() == wheel.read_bytes()


def test_its_parts_are_written_down(wheel: Path) -> None:
    """Valid, and with a licence for each part: otherwise the command fails."""
    _make("sbom", wheel.parent)
    (bom,) = wheel.parent.glob("*.cdx.json")
    text = bom.read_text(encoding="utf-8")
    for part in ("numpy", "msgspec", "cryptography", "nanobind", "robin-map"):
        assert f'"name": "{part}"' in text
    assert str(wheel.parent) not in text
