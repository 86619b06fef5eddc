"""The page of the settings names every key with its default."""

import json
import re
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import msgspec
import pytest

from holdfast.config.source import SETTINGS

PAGE = (Path(__file__).parents[2] / "docs" / "settings.md").read_text(encoding="utf-8")


def text_of(section: str) -> str:
    return PAGE.partition(f"## `{section}`\n")[2].partition("\n## ")[0]


@pytest.mark.parametrize("section", SETTINGS)
def test_each_key_stands_there_with_its_default(section: str) -> None:
    rows = re.findall(r"^\| `(\w+)` \| `(.*?)` \|", text_of(section), re.MULTILINE)
    defaults = msgspec.to_builtins(SETTINGS[section]())
    assert rows == [
        (key, value if isinstance(value, str) else json.dumps(value))
        for key, value in defaults.items()
    ]


def test_each_choice_stands_in_its_row() -> None:
    missing, found = [], 0
    for section, settings in SETTINGS.items():
        for key, hint in get_type_hints(settings).items():
            # One that may be None, too, is a union.
            literals = [each for each in (hint, *get_args(hint)) if get_origin(each) is Literal]
            choices = [choice for literal in literals for choice in get_args(literal)]
            rows = re.findall(rf"^\| `{key}` \|.*", text_of(section), re.MULTILINE)
            missing += [choice for choice in choices if f"`{choice}`" not in rows[0]]
            found += bool(choices)
    assert missing == []
    assert found >= 8
