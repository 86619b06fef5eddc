"""Which module a configuration's name leads to, where several have the name."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import Any

import pytest

import holdfast as hf
from holdfast.config import registry
from holdfast.config.user_modules import find_in
from holdfast.errors import ConfigurationError
from holdfast.robot.environment_maker import load_environment

ROBOT = """
class Robot:
    def __init__(self):
        self.where = WHERE

    def perform_sensing(self, sensing_action):
        return None

    def perform(self, task_action):
        return None

    def is_done(self):
        return True
"""

PROBLEM = """
from holdfast.problems.peg_in_hole_2d import PegInHole2D


class Peg(PegInHole2D):
    where = WHERE
"""


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def written(directory: Path, **modules: str) -> Path:
    """Write modules, with where they are, and return their directory."""
    directory.mkdir(parents=True, exist_ok=True)
    for name, text in modules.items():
        (directory / f"{name}.py").write_text(f"WHERE = {directory.name!r}\n{text}")
    return directory


def robot_of(directory: Path, name: str = "um_robot:Robot") -> Any:
    path = directory / "robot.yaml"
    path.write_text(f"problem: peg_in_hole_2d\nenvironment: {{object: '{name}'}}\n")
    return load_environment(hf.load_configuration(path))(0)


def problem_of(directory: Path, name: str = "um_peg:Peg") -> Any:
    path = directory / "peg.yaml"
    path.write_text(f"problem: {name}\n")
    return hf.load_configuration(path).problem


def test_the_module_beside_the_configuration_and_its_helper(tmp_path: Path) -> None:
    first = written(tmp_path / "first", um_robot="from um_helper import Robot", um_helper=ROBOT)
    assert robot_of(first).where == "first"
    assert robot_of(first).where == "first"  # again


class TestTwoDirectories:
    """The second has a module of the first one's name."""

    def test_a_robot(self, tmp_path: Path) -> None:
        first, second = (written(tmp_path / each, um_robot=ROBOT) for each in ("first", "second"))
        assert robot_of(first).where == "first"
        with pytest.raises(ConfigurationError) as caught:
            robot_of(second)
        for file in (first / "um_robot.py", second / "um_robot.py"):
            assert str(file) in str(caught.value)
        assert "rename one of them, or use each in a process of its own" in str(caught.value)
        assert robot_of(first).where == "first"

    def test_a_problem(self, tmp_path: Path) -> None:
        first, second = (written(tmp_path / each, um_peg=PROBLEM) for each in ("first", "second"))
        assert problem_of(first).where == "first"
        with pytest.raises(ConfigurationError, match=r"peg\.yaml, line 1: .*second/um_peg\.py"):
            problem_of(second)

    def test_a_helper_in_a_folder_of_its_own(self, tmp_path: Path) -> None:
        """Each module puts its ``lib`` on the import path, and so does one that has no helper."""
        path = "import os, sys\nsys.path.insert(0, os.path.join(os.path.dirname(__file__), 'lib'))"
        text = f"{path}\nfrom um_below import *"
        first = written(tmp_path / "first", um_robot=text)
        second = written(tmp_path / "second", um_other=text)
        below = [written(each / "lib", um_below=ROBOT) / "um_below.py" for each in (first, second)]
        assert robot_of(first).where == "lib"
        with pytest.raises(ConfigurationError) as caught:
            robot_of(second, "um_other:Robot")
        for file in below:
            assert str(file) in str(caught.value)
        third = written(tmp_path / "third", um_third=text)  # which uses the first one's
        assert robot_of(third, "um_third:Robot").where == "lib"
        assert robot_of(first).where == "lib"

    def test_a_helper_that_is_imported_later(self, tmp_path: Path) -> None:
        later = (
            "    @property\n    def helper(self):\n        import um_helper\n"
            "        return um_helper\n"
        )
        first = written(tmp_path / "first", um_robot=ROBOT + later, um_helper="")
        robot = robot_of(first)
        with pytest.raises(ConfigurationError, match="um_helper"):
            second = written(tmp_path / "second", um_other="import um_helper", um_helper=ROBOT)
            robot_of(second, "um_other:Robot")
        third = written(tmp_path / "third", um_third=ROBOT, um_helper="")  # which needs none
        assert robot_of(third, "um_third:Robot").where == "third"
        assert robot.helper.WHERE == "first"

    def test_functions_of_gymnasium(self, tmp_path: Path) -> None:
        pytest.importorskip("gymnasium")
        text = (
            "problem: peg_in_hole_2d\nenvironment: {object: gymnasium, arguments: "
            "{env_id: Pendulum-v1, sensing: 'um_sense:show', action: 'um_sense:act'}}\n"
        )
        functions = "def show(env, seen, action):\n    return WHERE\ndef act(env, action): ...\n"
        worlds = []
        for each in ("first", "second"):
            written(tmp_path / each, um_sense=functions)
            (tmp_path / each / "robot.yaml").write_text(text)
            worlds.append(hf.load_configuration(tmp_path / each / "robot.yaml"))
        load_environment(worlds[0])(0)
        with pytest.raises(ConfigurationError, match=r"um_sense is .*second/um_sense\.py"):
            load_environment(worlds[1])

    def test_a_module_that_was_taken_out(self, tmp_path: Path) -> None:
        first, second = (written(tmp_path / each, um_robot=ROBOT) for each in ("first", "second"))
        assert robot_of(first).where == "first"
        del sys.modules["um_robot"]
        assert robot_of(second).where == "second"

    def test_a_link_to_the_first(self, tmp_path: Path) -> None:
        first = written(tmp_path / "first", um_robot=ROBOT)
        (tmp_path / "second").symlink_to(first)
        assert robot_of(first).where == robot_of(tmp_path / "second").where == "first"


@pytest.mark.parametrize("name", ["platform", "queue", "html", "colorsys"])
class TestANameOfTheStandardLibrary:
    def test_a_file_that_nobody_imports(
        self, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        directory = written(tmp_path / "first", um_robot=ROBOT, **{name: "raise SystemExit"})
        assert robot_of(directory).where == "first"
        monkeypatch.delitem(sys.modules, name, raising=False)
        found = importlib.import_module(name)
        assert not str(found.__file__).startswith(str(tmp_path))

    def test_one_that_is_named(self, name: str, tmp_path: Path) -> None:
        directory = written(tmp_path / "first", **{name: ROBOT})
        with pytest.raises(ConfigurationError) as caught:
            robot_of(directory, f"{name}:Robot")
        assert str(directory / f"{name}.py") in str(caught.value)
        library = importlib.import_module(name)
        assert str(library.__file__) in str(caught.value)

    def test_one_that_the_module_imports(self, name: str, tmp_path: Path) -> None:
        """It may mean either; the caller cannot know."""
        directory = written(tmp_path / "first", um_robot=f"import {name}{ROBOT}", **{name: ""})
        with pytest.raises(ConfigurationError, match=f"first/{name}.py, and Python's standard lib"):
            robot_of(directory)


def test_a_module_of_the_current_directory_does_not_stand_in_the_way(tmp_path: Path) -> None:
    """As in a notebook, whose directory is the first on the import path."""
    sys.path.insert(0, "")
    written(tmp_path, um_robot=ROBOT, um_helper="")
    first = written(tmp_path / "first", um_robot="from um_helper import *", um_helper=ROBOT)
    assert robot_of(first).where == "first"


def test_an_installed_module_does_not(tmp_path: Path) -> None:
    sys.path.append(str(written(tmp_path / "site-packages", um_helper="")))
    first = written(tmp_path / "first", um_robot="from um_helper import *", um_helper=ROBOT)
    assert robot_of(first).where == "first"


def test_a_clone_of_a_library_beside_the_configuration(tmp_path: Path) -> None:
    """Its folder has the library's name, and is no package."""
    (tmp_path / "first" / "holdfast" / "src").mkdir(parents=True)
    directory = written(tmp_path / "first", um_peg=PROBLEM)
    assert problem_of(directory).where == "first"
    find_in(directory, "holdfast.problems.peg_in_hole_2d")
    assert registry.problem_class("holdfast.problems.peg_in_hole_2d:PegInHole2D", directory)


def test_an_edit_is_loaded_again(tmp_path: Path) -> None:
    directory = written(tmp_path / "first", um_robot=ROBOT)
    robot_of(directory)
    written(tmp_path / "first", um_robot=ROBOT.replace("WHERE", "'another place'"))
    importlib.reload(sys.modules["um_robot"])
    assert robot_of(directory).where == "another place"


def test_dataclasses_and_errors_know_their_module(tmp_path: Path) -> None:
    text = (
        "from __future__ import annotations\nimport dataclasses, typing\n"
        "@dataclasses.dataclass\nclass Reading:\n    values: list[Reading]\n"
        "typing.get_type_hints(Reading)\n" + ROBOT + "    def fail(self): raise KeyError(1)\n"
    )
    directory = written(tmp_path / "first")
    (directory / "um_robot.py").write_text(text.replace("WHERE", "1"))
    robot = robot_of(directory)
    assert type(robot).__module__ == "um_robot"
    with pytest.raises(KeyError) as caught:
        robot.fail()
    assert caught.traceback[-1].path == directory / "um_robot.py"
