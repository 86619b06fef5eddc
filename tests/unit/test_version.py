"""The version stands in five files for several kinds of reader; they must be told the same."""

import re
import tomllib
from importlib import metadata
from pathlib import Path

import yaml

import holdfast

ROOT = Path(__file__).parents[2]


def test_all_files_tell_the_same_version() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lab = tomllib.loads((ROOT / "lab" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    newest = re.search(r"^## (\S+)", changes, re.MULTILINE)
    assert newest is not None
    told = {
        "pyproject.toml": project["version"],
        "lab/pyproject.toml": lab["version"],
        "CITATION.cff": str(citation["version"]),
        "CHANGELOG.md": newest[1],
        "installed": metadata.version("holdfast-sensing"),
        "installed, the laboratory": metadata.version("holdfast-lab"),
    }
    assert told == dict.fromkeys(told, holdfast.__version__)
    assert lab["dependencies"] == [f"holdfast-sensing[figures,service]=={holdfast.__version__}"]
    assert re.fullmatch(r"\d+\.\d+\.\d+", holdfast.__version__)
    assert citation["license"] == project["license"]


def test_the_packages_for_ros_have_it_too() -> None:
    files = [*(ROOT / "ros").glob("*/package.xml"), *(ROOT / "ros").glob("*/setup.py")]
    told = {
        path.relative_to(ROOT).as_posix(): re.findall(
            r"""(?:<version>|^    version=["'])([\d.]+)""",
            path.read_text(encoding="utf-8"),
            re.MULTILINE,
        )
        for path in files
    }
    assert len(told) == 6
    assert told == {path: [holdfast.__version__] for path in told}
