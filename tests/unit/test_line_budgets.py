"""A part of the repository that outgrows its budget fails the check."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.line_budgets import main


@pytest.mark.parametrize(("lines", "code"), [(5, 0), (6, 1)])
def test_a_part_has_its_budget(lines: int, code: int, tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").write_text(
        '[tool.line-budgets]\n"src/holdfast" = 5\nros = 1\ntests = 3\n'
    )
    for name, number in (
        ("src/holdfast/room/file.py", lines),
        ("ros/holdfast_ros/node.py", 1),
        ("ros/holdfast_ros/test/test_node.py", 1),
        ("tests/unit/test_file.py", 1),
        ("lab/tests/test_chaos.py", 1),
    ):
        file = tmp_path / name
        file.parent.mkdir(parents=True)
        file.write_text("\n" * number)
    assert main(tmp_path) == code
