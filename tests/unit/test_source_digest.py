"""Digests of code: what changes them, and what does not."""

import argparse
import hashlib
import importlib
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.programs import said_by

import holdfast
from holdfast import _kernel
from holdfast.config import registry
from holdfast.config.imports import follow_imports
from holdfast.config.source_digest import core_version, problem_digest, problem_sources

ROOT = Path(__file__).parents[2]
PACKAGE = Path(holdfast.__file__).parent

SOURCES = {
    "arm_problem.py": """
import math, arm_tables
from arm_parts.joints import Joint
from holdfast.problems.capsule_robot import CapsuleRobot
from arm_base import Base
class Arm(Base, CapsuleRobot):
    def late(self):
        import arm_late
""",
    "arm_base.py": "import numpy as np\nclass Base: pass\n",
    "arm_tables.py": "import arm_tables_more\n",
    "arm_tables_more.py": "import arm_problem\n",
    "arm_late.py": "",
    "arm_stranger.py": "",
    "arm_parts/__init__.py": "",
    "arm_parts/joints.py": "from . import limits\nfrom .links import Link\nclass Joint: pass\n",
    "arm_parts/limits.py": "",
    "arm_parts/links.py": "from .steel import SIZE\nclass Link: pass\n",
    "arm_parts/steel/__init__.py": "from .. import units\nSIZE = 1\n",
    "arm_parts/units.py": "",
    "arm_parts/unused.py": "",
}


def module_of(file: str) -> str:
    return file.removesuffix(".py").replace("/", ".").removesuffix(".__init__")


OF_THE_ARM = {module_of(file) for file in SOURCES} - {"arm_stranger", "arm_parts.unused"}


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    for name, text in SOURCES.items():
        path = tmp_path / "arm" / name
        path.parent.mkdir(exist_ok=True, parents=True)
        path.write_text(text)
    yield tmp_path / "arm"
    for name in [each for each in sys.modules if each.partition(".")[0].startswith("arm_")]:
        del sys.modules[name]
    importlib.invalidate_caches()


def arm_of(folder: Path) -> type:
    return registry.problem_class("arm_problem:Arm", folder)


class TestProblem:
    def test_all_that_lies_beside_and_is_imported(self, folder: Path) -> None:
        sources = problem_sources(arm_of(folder))
        assert set(sources) == OF_THE_ARM
        for name, digest in sources.items():
            place = folder.joinpath(*name.split("."))
            path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
            assert digest == hashlib.blake2b(path.read_bytes(), digest_size=32).hexdigest()

    @pytest.mark.parametrize("name", SOURCES)
    def test_a_changed_module(self, name: str, folder: Path) -> None:
        arm = arm_of(folder)
        before = problem_digest(arm)
        with (folder / name).open("a") as file:
            file.write("X = 1\n")
        assert (problem_digest(arm) != before) == (module_of(name) in OF_THE_ARM)

    def test_the_place_does_not_count(self, folder: Path, tmp_path: Path) -> None:
        shutil.copytree(folder, tmp_path / "elsewhere")
        program = (
            "import sys; from pathlib import Path\n"
            "from holdfast.config import registry\n"
            "from holdfast.config.source_digest import problem_digest\n"
            "print(problem_digest(registry.problem_class('arm_problem:Arm', Path(sys.argv[1]))))"
        )
        found = {
            said_by(program, str(place), flags=flags)
            for place, flags in (
                (folder, ()),
                (tmp_path / "elsewhere", ("-O",)),
                (tmp_path / "elsewhere", ("-B",)),
            )
        }
        assert found == {problem_digest(arm_of(folder)) + "\n"}

    def test_an_installed_problem_has_no_neighbours(self, folder: Path) -> None:
        libraries = folder.parent / "site-packages"
        folder.rename(libraries)
        sources = problem_sources(registry.problem_class("arm_problem:Arm", libraries))
        assert set(sources) == {"arm_problem", "arm_base"}  # a class that it is derived from

    def test_problems_of_holdfast_are_part_of_the_core(self) -> None:
        for name in registry.BUILT_IN:
            assert problem_sources(registry.problem_class(name)) == {}

    def test_problems_of_the_studies_are_not(self) -> None:
        name = "studies.busy_room:BusyRoom"
        assert "studies.busy_room" in problem_sources(registry.problem_class(name))

    def test_source_that_is_no_python_any_more(self, folder: Path) -> None:
        arm = arm_of(folder)
        (folder / "arm_tables.py").write_text("import (")
        assert set(problem_sources(arm)) == OF_THE_ARM - {"arm_tables_more"}

    def test_a_module_that_is_called_as_one_of_the_standard_library(
        self, folder: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.delitem(sys.modules, "turtle", raising=False)
        text = "import cmd, arm_late\nimport queue\nclass P: pass\n"
        (folder / "turtle.py").write_text(text)
        (folder / "cmd.py").write_text("X = 1\n")
        assert "turtle" in sys.stdlib_module_names
        try:
            # As a script's: a configuration's would be refused.
            monkeypatch.syspath_prepend(folder)
            sources = problem_sources(importlib.import_module("turtle").P, "turtle")
        finally:
            sys.modules.pop("turtle", None)
            sys.modules.pop("cmd", None)
        assert set(sources) == {"turtle", "cmd", "arm_late"}

    def test_the_standard_librarys_own_are_no_part(self) -> None:
        class Derived(argparse.Namespace):
            pass

        assert "argparse" not in problem_sources(Derived)

    def test_the_module_that_the_configuration_names(self, folder: Path) -> None:
        (folder / "arm_mine.py").write_text(
            "from arm_problem import Arm\nimport arm_stranger\nArm.LENGTH = 2\n"
        )
        named_in = registry.problem_module("arm_mine:Arm")
        arm = registry.problem_class("arm_mine:Arm", folder)
        assert set(problem_sources(arm, named_in)) == {*OF_THE_ARM, "arm_mine", "arm_stranger"}
        before = problem_digest(arm, named_in)
        (folder / "arm_mine.py").write_text("from arm_problem import Arm\nArm.LENGTH = 3\n")
        assert problem_digest(arm, named_in) != before

    def test_a_folder_that_is_put_on_the_import_path(self, folder: Path) -> None:
        sources = {
            "arm_paths.py": "import sys, pathlib, importlib\n"
            "sys.path.insert(0, str(pathlib.Path(__file__).parent / 'lib'))\n"
            "import arm_helper\n"
            "arm_stranger = importlib.import_module('arm_stranger')\n"
            "class Arm:\n"
            "    def __init__(self):\n        import arm_lazy\n",
            "lib/arm_helper.py": "import arm_deeper\n",
            "lib/arm_deeper.py": "",
            "lib/arm_lazy.py": "",
            "lib/arm_of_another.py": "",
        }
        for name, text in sources.items():
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(text)
        arm = registry.problem_class("arm_paths:Arm", folder)
        expected = {"arm_paths", "arm_helper", "arm_deeper", "arm_stranger"}
        assert set(problem_sources(arm, "arm_paths")) == expected
        # What one process alone has loaded makes no difference: an instance, an environment.
        arm()
        importlib.import_module("arm_of_another")
        assert "arm_lazy" in sys.modules
        assert set(problem_sources(arm, "arm_paths")) == expected

    @pytest.mark.parametrize(
        ("name", "module"),
        [
            ("mine:P", "mine"),
            ("my.own:P", "my.own"),
            ("capsule_robot", "holdfast.problems.capsule_robot"),
            ("nobody", None),
        ],
    )
    def test_where_a_name_leads(self, name: str, module: str | None) -> None:
        assert registry.problem_module(name) == module


class TestCore:
    def test_version_and_digest(self) -> None:
        version, _, digest = core_version().partition("+")
        assert version == holdfast.__version__
        assert len(bytes.fromhex(digest)) == 8

    def test_all_that_decides_is_part_of_it(self) -> None:
        """What planning and the problems import, directly or not, stands where it is hashed."""

        def locate(name: str) -> Path | None:
            place = PACKAGE.parent.joinpath(*name.split("."))
            path = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
            return path if name.startswith("holdfast") and path.is_file() else None

        problems = [own.place.partition(":")[0] for own in registry.BUILT_IN.values()]
        deciding = ["holdfast.planning.planner", *problems]
        found = follow_imports(deciding, locate)
        assert len(found) > 15
        folders = {path.parent for path in found.values()}
        rooms = (PACKAGE / room for room in ("numerics", "planning", "problems"))
        assert folders == {PACKAGE, *rooms}

    @pytest.mark.parametrize("changed", ["planning/sensing.py", "config/problem_builder.py", None])
    def test_a_changed_source(self, changed: str | None, tmp_path: Path) -> None:
        """An installation is copied, and asked for its version as a process of its own."""
        shutil.copytree(
            PACKAGE, tmp_path / "holdfast", ignore=shutil.ignore_patterns("__pycache__")
        )
        kernel = Path(_kernel.__file__ or "")
        shutil.copy(kernel, tmp_path / "holdfast" / kernel.name)
        if changed is not None:
            with (tmp_path / "holdfast" / changed).open("a") as file:
                file.write("# changed\n")
        program = (
            "import sys; sys.meta_path = [each for each in sys.meta_path "
            "if 'ScikitBuild' not in type(each).__name__]\n"
            f"sys.path.insert(0, {str(tmp_path)!r})\n"
            "import holdfast, holdfast.config.source_digest as source_digest\n"
            "print(holdfast.__file__); print(source_digest.core_version())"
        )
        file_name, version = said_by(program).split()
        assert file_name == str(tmp_path / "holdfast" / "__init__.py")
        assert (version == core_version()) == (changed is None)

    @pytest.mark.skipif(not (ROOT / "cpp").is_dir(), reason="the kernel's sources are not here")
    def test_the_kernel_is_told_by_its_sources(self) -> None:
        sources = sorted(
            path.relative_to(ROOT).as_posix()
            for suffix in ("cpp", "hpp")
            for path in (ROOT / "cpp").rglob(f"*.{suffix}")
        )
        lines = "".join(
            f"{name} {hashlib.sha256((ROOT / name).read_bytes()).hexdigest()}\n"
            for name in (*sources, "CMakeLists.txt")
        )
        assert _kernel.sources() == hashlib.sha256(lines.encode()).hexdigest(), "build it again"
