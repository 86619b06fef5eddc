"""What the page about ROS shows of its example is what stands there."""

from __future__ import annotations

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]


def methods(source: str) -> dict[str, list[str]]:
    """Return the statements of each function of a source, its docstring excepted."""
    found = {}
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef):
            body = node.body[1:] if ast.get_docstring(node) else node.body
            found[node.name] = [ast.unparse(statement) for statement in body]
    return found


def test_the_method_shown_is_the_examples() -> None:
    page = (ROOT / "docs" / "ros.md").read_text(encoding="utf-8")
    shown = methods(page.partition("\n```py\n")[2].partition("```")[0])
    example = methods((ROOT / "examples" / "ros2" / "topic_robot.py").read_text(encoding="utf-8"))
    assert list(shown) == ["perform_sensing"]
    assert shown.items() <= example.items()
    assert {"perform_sensing", "perform", "is_done", "steps_performed"} <= example.keys()
