"""The page of the problems names every setting of each built-in problem, with default and unit."""

import json
import re
from pathlib import Path
from typing import Any

import msgspec
import pytest

from holdfast.config import registry

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "problems.md").read_text(encoding="utf-8")


def written(default: Any) -> str:
    """Return how the page writes a default; of long lists it says the length."""
    if isinstance(default, list) and default and isinstance(default[0], dict):
        return f"{len(default)} of them"
    return json.dumps(default)


@pytest.mark.parametrize("name", registry.BUILT_IN)
def test_each_setting_stands_there(name: str) -> None:
    kind = registry.problem_class(name)
    text = PAGE.partition(f"### `{name}`\n")[2].partition("\n#")[0]
    for section, settings in (
        ("model", kind.Model),
        ("state_space_planner", kind.StateSpacePlanner),
    ):
        table = text.partition(f"| `{section}` |")[2].partition("\n\n")[0]
        rows = re.findall(r"^\| `(\w+)` \| `(.*?)` \| (.+?) \| .+ \|$", table, re.MULTILINE)
        defaults = msgspec.to_builtins(settings())
        assert [row[:2] for row in rows] == [
            (key, written(value)) for key, value in defaults.items()
        ]
        for key, _, unit in rows:
            assert re.fullmatch(r"-|[m²radstep1/ ,()36o]+", unit), (key, unit)


def test_the_table_of_problems_is_whole() -> None:
    table = PAGE.partition("\n## ")[0]
    assert re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE) == list(registry.BUILT_IN)


def test_no_key_is_in_both_sections() -> None:
    """``make`` tells the sections apart by their keys."""
    for name in registry.BUILT_IN:
        kind = registry.problem_class(name)
        own, planner = kind.Model.__struct_fields__, kind.StateSpacePlanner.__struct_fields__
        assert not set(own) & set(planner)


def test_the_figure_is_there() -> None:
    for image in re.findall(r"!\[.*?\]\((.+?)\)", PAGE):
        assert (ROOT / "docs" / image).is_file()
