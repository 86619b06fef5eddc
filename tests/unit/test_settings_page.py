"""The page of the settings names every key with its default."""

from __future__ import annotations

import json
import re
from pathlib import Path

import msgspec
import pytest

from holdfast.settings import EnvironmentSettings, OffloadSettings, RecoverySettings

PAGE = (Path(__file__).parents[2] / "docs" / "settings.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("section", "settings"),
    [
        ("offload", OffloadSettings()),
        ("recovery", RecoverySettings()),
        ("environment", EnvironmentSettings()),
    ],
)
def test_each_key_stands_there_with_its_default(section: str, settings: object) -> None:
    text = PAGE.partition(f"## `{section}`\n")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| `(\w+)` \| `(.*?)` \|", text, re.MULTILINE)
    defaults = msgspec.to_builtins(settings)
    assert rows == [
        (key, value if isinstance(value, str) else json.dumps(value))
        for key, value in defaults.items()
    ]
