"""The tree: each module of the product has its tests, and each folder its line in ARCHITECTURE."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "holdfast"
TESTS = {path.stem for path in (ROOT / "tests").rglob("test_*.py")}

WITHOUT_TESTS = {
    "__main__": "one line, which every process test runs",
    "cli/doctor": "options and printing; tests/processes/test_robot_doctor.py runs it",
    "errors": "types without behaviour",
    "protocol/events": "types without behaviour",
    "recording/facts": "types without behaviour",
    "recording/live_messages": "types without behaviour",
    "robot/health": "tests/processes/test_unattended.py asks it over HTTP",
    "ros/ros2/__main__": "one line, which tests/ros runs",
    "robot/session_configuration": "one function; tests/unit/test_reference_decisions.py calls it",
    "ros/ros2/messages": "converts rclpy's messages, which only tests/ros has",
    "ros/ros2_connections": "needs ROS 2; tests/ros/test_ros2_environment.py",
}
"""Modules of the product that no test is named after, and why."""


def modules() -> list[str]:
    return sorted(
        str(path.relative_to(PACKAGE).with_suffix(""))
        for path in PACKAGE.rglob("*.py")
        if path.name != "__init__.py" and path.relative_to(PACKAGE).parts[0] != "lab"
    )


def is_tested(module: str) -> bool:
    """Whether a test is named after it: test_NAME, or where names repeat test_FOLDER_NAME."""
    *folders, name = module.split("/")
    repeats = sum(other.rpartition("/")[2] == name for other in modules()) > 1
    starts = range(len(folders) if repeats and folders else len(folders) + 1)
    wanted = {f"test_{'_'.join([*folders[start:], name.lstrip('_')])}" for start in starts}
    return not wanted.isdisjoint(TESTS)


@pytest.mark.parametrize("module", modules())
def test_a_test_is_named_after_it(module: str) -> None:
    assert is_tested(module) != (module in WITHOUT_TESTS)


def test_reasons_are_for_modules_that_exist() -> None:
    assert set(WITHOUT_TESTS) <= set(modules())


DEFINED_IN_PACKAGES = {"holdfast": {"_kernel", "__version__"}, "holdfast.cli": {"main"}}
"""Names that a package itself has, and not from one of its modules."""


def from_a_face(module: str) -> list[str]:
    """Return what a module imports from a package, and not from the module that defines it."""
    tree = ast.parse((PACKAGE / f"{module}.py").read_text(encoding="utf-8"))
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom):
            package = (node.module or "").split(".")
            place = PACKAGE.parent.joinpath(*package)
            if node.level or package[0] != "holdfast" or not place.is_dir():
                continue
            for alias in node.names:
                is_module = (place / alias.name).with_suffix(".py").is_file()
                own = DEFINED_IN_PACKAGES.get(node.module or "", ())
                if not is_module and alias.name not in own:
                    found.append(f"from {node.module} import {alias.name}")
        elif isinstance(node, ast.Import):
            found += [f"import {alias.name}" for alias in node.names if alias.name == "holdfast"]
    return found


def test_no_module_of_the_product_imports_a_package_s_face() -> None:
    """It would depend on all that the face names, and no floor would show."""
    assert {module: found for module in modules() if (found := from_a_face(module))} == {}


def test_architecture_names_every_folder() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    code_map = text[text.index("## Code map") : text.index("## Invariants")]
    named = set(re.findall(r"`([\w/]+)/`", code_map))
    folders = {path.parent.relative_to(PACKAGE).parts for path in PACKAGE.rglob("*.py")}
    for folder in folders - {(), ("lab",)}:
        assert any("/".join(folder[: end + 1]) in named for end in range(len(folder))), folder
    for path in PACKAGE.glob("*.py"):
        if not path.name.startswith("__"):
            assert f"`{path.name}`" in code_map, path.name
