"""The page of the settings names every key with its default."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import get_args, get_type_hints

import msgspec
import pytest

from holdfast.planning.settings import (
    ActiveSensingSettings,
    EnvironmentSettings,
    LostSettings,
    OffloadSettings,
    ParticleFilterSettings,
    RecoverySettings,
    SelectorSettings,
    SimulatorSettings,
)

PAGE = (Path(__file__).parents[2] / "docs" / "settings.md").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("section", "settings"),
    [
        ("particle_filter", ParticleFilterSettings()),
        ("active_sensing", ActiveSensingSettings()),
        ("selector", SelectorSettings()),
        ("simulator", SimulatorSettings()),
        ("offload", OffloadSettings()),
        ("recovery", RecoverySettings()),
        ("lost", LostSettings()),
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


@pytest.mark.parametrize(
    ("key", "settings"),
    [
        ("estimate", ParticleFilterSettings),
        ("method", SelectorSettings),
        ("estimator", SelectorSettings),
        ("actions", SelectorSettings),
        ("rollout_reward", SelectorSettings),
        ("launch", RecoverySettings),
        ("journal_survives", RecoverySettings),
        ("on_lost", LostSettings),
    ],
)
def test_each_choice_stands_in_its_row(key: str, settings: type[msgspec.Struct]) -> None:
    (row,) = re.findall(rf"^\| `{key}` \|.*", PAGE, re.MULTILINE)
    hint = get_type_hints(settings)[key]
    # One that may be None, too, is a union.
    literals = [each for each in get_args(hint) if get_args(each)] or [hint]
    choices = [choice for literal in literals for choice in get_args(literal)]
    assert choices
    assert [choice for choice in choices if f"`{choice}`" not in row] == []
