"""The page on reliability names each line of a simulated schedule, and each kind of real fault."""

import re
from pathlib import Path
from typing import Literal, get_args, get_origin, get_type_hints

import msgspec
import pytest

from holdfast_lab.simulation.schedule import RunSettings, SimulatedFault, line_of, parse_schedule
from holdfast_lab.testbed.faults import FaultKind

PAGE = (Path(__file__).parents[2] / "docs" / "reliability.md").read_text(encoding="utf-8")
SECTION = PAGE.partition("## The lines of a schedule\n")[2].partition("\n## ")[0]
FAULTS = get_args(SimulatedFault)


def keys_of(kind: type[msgspec.Struct]) -> list[str]:
    """Return the keys as a line has them, each with its default if it has one."""
    shown = []
    for field in msgspec.structs.fields(kind):
        default = field.default
        if isinstance(default, bool) or default is None:
            default = str(default).lower()
        shown.append(field.name if field.required else f"{field.name}={default}")
    return shown


def choices_of(kind: type[msgspec.Struct]) -> set[str]:
    return {
        str(choice)
        for hint in get_type_hints(kind).values()
        if get_origin(hint) is Literal
        for choice in get_args(hint)
    }


def test_every_fault_stands_there_with_its_keys() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (.*?) \| (.*) \|$", SECTION, re.MULTILINE)
    assert [(name, keys) for name, keys, _ in rows] == [
        (kind.__struct_config__.tag, ", ".join(f"`{key}`" for key in keys_of(kind)))
        for kind in FAULTS
    ]
    for kind, (_, _, meaning) in zip(FAULTS, rows, strict=True):
        assert choices_of(kind) <= set(re.findall(r"`([\w-]+)`", meaning))


def test_every_key_of_a_run_stands_there_with_its_default() -> None:
    rows = re.findall(r"^\| `(\w+=\S+)` \| (.*) \|$", SECTION, re.MULTILINE)
    assert [key for key, _ in rows] == keys_of(RunSettings)
    meanings = " ".join(meaning for _, meaning in rows)
    assert choices_of(RunSettings) <= set(re.findall(r"`([\w-]+)`", meanings))


@pytest.mark.parametrize("default", keys_of(RunSettings))
def test_a_default_can_be_written(default: str) -> None:
    assert parse_schedule(f"run {default}").run == RunSettings()


def test_the_example_is_a_schedule() -> None:
    text = SECTION.partition("```text\n")[2].partition("```")[0]
    schedule = parse_schedule(text)
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert lines == [line_of(item) for item in (schedule.run, *schedule.faults)]


def test_the_table_of_chaos_names_every_kind() -> None:
    table = PAGE.partition("| kind of trial | injected fault |\n")[2].partition("\n\n")[0]
    first_cells = "".join(line.split("|")[1] for line in table.splitlines()[1:])
    assert re.findall(r"`(\w+)`", first_cells) == list(FaultKind)
