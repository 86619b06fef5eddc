"""The tree: each module has its tests, and each folder of the product its line in ARCHITECTURE."""

import ast
import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "holdfast"
PACKAGES = {
    "": PACKAGE,
    "ros/": ROOT / "ros" / "holdfast_ros" / "holdfast_ros",
    "master/": ROOT / "ros" / "ros1_master_guard" / "ros1_master_guard",
}
"""Packages whose modules have tests here, by what their modules are called here."""

TESTS = {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
BESIDE = {
    "lab": (ROOT / "lab" / "src" / "holdfast_lab", ROOT / "lab" / "tests"),
    "studies": (ROOT / "studies", ROOT / "studies" / "tests"),
}
"""What is no part of the product, and its tests."""

ELSEWHERE = tomllib.loads(
    (Path(__file__).parent / "data" / "tested_elsewhere.toml").read_text(encoding="utf-8")
)
"""Modules that no test is named after, and why; or which one tries them, as a part of something."""


def modules(package: Path = PACKAGE) -> list[str]:
    return sorted(
        str(path.relative_to(package).with_suffix(""))
        for path in package.rglob("*.py")
        if path.name != "__init__.py" and path.relative_to(package).parts[0] != "tests"
    )


MODULES = [f"{prefix}{each}" for prefix, package in PACKAGES.items() for each in modules(package)]


def is_tested(module: str, known: list[str], tests: set[str]) -> bool:
    """Whether a test is named after it: test_NAME, or where names repeat test_FOLDER_NAME."""
    *folders, name = module.split("/")
    repeats = sum(other.rpartition("/")[2] == name for other in known) > 1
    starts = range(len(folders) if repeats and folders else len(folders) + 1)
    wanted = {f"test_{'_'.join([*folders[start:], name.lstrip('_')])}" for start in starts}
    return not wanted.isdisjoint(tests)


def test_each_module_has_a_test_named_after_it() -> None:
    untested = {each for each in MODULES if not is_tested(each, MODULES, TESTS)}
    assert untested == set(ELSEWHERE["product"])


@pytest.mark.parametrize("name", BESIDE)
def test_what_is_beside_the_product_has_its_tests_beside_it(name: str) -> None:
    package, folder = BESIDE[name]
    known, elsewhere = modules(package), ELSEWHERE[name]
    tests = {path.stem for path in folder.glob("test_*.py")}
    assert {each for each in known if not is_tested(each, known, tests)} == set(elsewhere)
    for place in elsewhere.values():
        assert (ROOT / place).is_file(), place


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
    for folder in folders - {()}:
        assert any("/".join(folder[: end + 1]) in named for end in range(len(folder))), folder
    for path in PACKAGE.glob("*.py"):
        if not path.name.startswith("__"):
            assert f"`{path.name}`" in code_map, path.name
