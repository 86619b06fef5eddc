"""Nothing from outside moves the terminal's cursor, whatever a command says of it."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from msgspec import structs

from holdfast.cli import _print_defect, main
from holdfast.cli.terminal import print_summary, progress_line
from holdfast.printable import printable
from holdfast.recording.tables import SummaryBuilder
from holdfast.runtime.logs import EventLog

HOSTILE = "\x1b[2J\x1b]0;title\x07\r\x9b1A\u202e\x7f"
SEEN = "\\x1b[2J\\x1b]0;title\\x07\\r\\x9b1A\\u202e\\x7f"


def test_what_is_shown() -> None:
    assert printable("as it is, ä, 字, µ") == "as it is, ä, 字, µ"
    assert printable(f"one\n\ttwo {HOSTILE}") == f"one\n\ttwo {SEEN}"
    assert printable("a\nb", keep="") == "a\\nb"


PROBLEM = f"""
from holdfast.problems.peg_in_hole_2d import PegInHole2D


class Raises(PegInHole2D):
    def policy(self, states, stage):
        raise ValueError({HOSTILE!r})


class Refuses(PegInHole2D):
    def __init__(self, *settings):
        raise ValueError({HOSTILE!r})


class Named(PegInHole2D):
    name = "{HOSTILE.encode("unicode_escape").decode()}"

    def reward(self, states, actions):
        return "none"
"""


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "hostile.py").write_text(PROBLEM)
    yield tmp_path
    sys.modules.pop("hostile", None)


Run = Callable[..., str]


@pytest.fixture
def said(
    workplace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Run:
    """Run a command that ends with an error, and return all that it shows."""

    def run(*arguments: str) -> str:
        monkeypatch.setattr(sys, "argv", ["holdfast", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        assert ended.value.code in (2, 4)
        shown = capsys.readouterr()
        return shown.out + shown.err

    return run


def require_harmless(shown: str) -> None:
    assert all(letter.isprintable() or letter in "\n\t" for letter in shown), repr(shown)
    assert "[2J" in shown


@pytest.mark.parametrize("mode", [[], ["--rate", "10000"], ["--rate", "10000", "--log", "json"]])
@pytest.mark.parametrize("name", ["Raises", "Refuses", "Named"])
def test_a_user_s_problem(name: str, mode: list[str], workplace: Path, said: Run) -> None:
    (workplace / "run.yaml").write_text(
        f"problem: hostile:{name}\nparticle_filter: {{num_particles: 20}}\n"
    )
    require_harmless(said("run", "run.yaml", "--out", "out", *mode))


@pytest.mark.parametrize(
    "text",
    [
        'problem: "{}"',
        'problem: peg_in_hole_2d\n"{}": 3',
        'problem: peg_in_hole_2d\nmodel: {{"{}": 3}}',
        'problem: peg_in_hole_2d\nselector: {{method: "{}"}}',
        'problem: peg_in_hole_2d\noffload: {{services: ["{}"]}}',
        'problem: peg_in_hole_2d\nenvironment: {{object: "{}"}}',
    ],
)
def test_a_configuration(text: str, workplace: Path, said: Run) -> None:
    escaped = "".join(f"\\u{ord(letter):04x}" for letter in HOSTILE)
    (workplace / "run.yaml").write_text(text.format(escaped))
    require_harmless(said("run", "run.yaml"))


@pytest.mark.parametrize(
    "arguments",
    [
        ["run", HOSTILE],
        ["run", "run.yaml", "--trials", HOSTILE],
        ["run", "run.yaml", "--set", HOSTILE],
        ["compare", HOSTILE, HOSTILE],
        ["simulate", "--seeds", HOSTILE],
        ["serve", "--listen", HOSTILE],
        ["serve", "--problem", HOSTILE],
        [HOSTILE],
    ],
    ids=lambda arguments: arguments[0] if len(arguments[0]) < 10 else "command",
)
def test_a_command_line(arguments: list[str], said: Run) -> None:
    require_harmless(said(*arguments))


def test_a_defect_s_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    error = ValueError(HOSTILE)
    _print_defect(type(error), error, None)
    assert capsys.readouterr().err == f"ValueError: {SEEN}\n"


def test_progress(capsys: pytest.CaptureFixture[str]) -> None:
    progress_line(3, quiet=False).say(HOSTILE)
    assert capsys.readouterr().err == f"{SEEN}\n"


def test_a_summary_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    """Of an address in brackets nothing is left out."""
    empty = SummaryBuilder().build(problem="", seed=0, version="", trials=0, wall_time_s=0.0)
    answers = {"tcp/[fe80::1]:7447": 3, HOSTILE: 4}
    print_summary(structs.replace(empty, sensing_decisions_by_service=answers))
    shown = capsys.readouterr().out
    assert "tcp/[fe80::1]:7447 3" in shown
    require_harmless(shown)


def test_a_line_of_json_keeps_its_meaning(tmp_path: Path) -> None:
    with EventLog(tmp_path / "events", format="json", component="robot") as log:
        log.event("note", reason=HOSTILE)
    line = (tmp_path / "events").read_text()
    require_harmless(line)
    assert json.loads(line)["reason"] == HOSTILE
