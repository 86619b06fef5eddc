"""What the page about ROS shows of its example is what stands there; layouts show all there is."""

import ast
import json
from pathlib import Path

from rosbags.highlevel import AnyReader
from tests.command_line import Workplace

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


def test_the_layouts_show_all_that_is_exported(workplace: Workplace) -> None:
    example = str(ROOT / "examples" / "peg_in_hole_2d.yaml")
    workplace.runs("run", example, "--trials", "1", "--out", "run", "-q")
    workplace.runs("export", "run", "--mcap", "run.mcap", "-q")
    with AnyReader([workplace.directory / "run.mcap"]) as reader:
        kinds = {each.topic: each.msgtype.partition("/")[0] for each in reader.connections}
    layouts = ROOT / "ros" / "holdfast_bringup"
    rviz = (layouts / "rviz" / "holdfast.rviz").read_text(encoding="utf-8")
    drawn = {topic for topic, of in kinds.items() if of.startswith(("geometry", "nav", "visual"))}
    assert len(drawn) == 7
    assert {topic for topic in drawn if f"Value: {topic}\n" not in rviz} == set()
    foxglove = json.dumps(json.loads((layouts / "foxglove" / "holdfast.json").read_bytes()))
    # Foxglove takes the frames without being told.
    assert {topic for topic in kinds if topic not in foxglove} == {"/tf", "/tf_static"}
