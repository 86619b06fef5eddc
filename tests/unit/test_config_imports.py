"""Which modules a module imports, by its source."""

from __future__ import annotations

from pathlib import Path

import pytest

from holdfast.config.imports import follow_imports


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("import one", {"one"}),
        ("import one.two", {"one", "one.two"}),
        ("from one import two", {"one", "one.two"}),
        ("def later():\n    import one", {"one"}),
        ("import importlib\nimportlib.import_module('one')", {"one"}),
        ("if TYPE_CHECKING:\n    import one", set()),
        ("if not TYPE_CHECKING:\n    import one", {"one"}),
        ("import numpy, queue", set()),
        ("import (", set()),
    ],
)
def test_what_is_imported(text: str, found: set[str], tmp_path: Path) -> None:
    for name, own in {"robot": text, "one": "", "one.two": ""}.items():
        (tmp_path / f"{name}.py").write_text(own)

    def locate(name: str) -> Path | None:
        path = tmp_path / f"{name}.py"
        return path if path.is_file() else None

    assert set(follow_imports(["robot"], locate)) == {"robot", *found}
