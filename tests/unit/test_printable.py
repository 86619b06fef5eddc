"""Nothing from outside moves the terminal's cursor, whatever a command says of it."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec import structs
from tests.command_line import Workplace

from holdfast.cli import _print_defect
from holdfast.cli.terminal import print_summary
from holdfast.journal.tables import SummaryBuilder
from holdfast.printable import brief, cell, one_line, printable
from holdfast.protocol.messages import Refused, decode_reply, encode
from holdfast.runtime.log_lines import json_line, text_line
from holdfast.transport.frames import read_goodbye

HOSTILE = "\x1b[2J\x1b]0;title\x07\r\x9b1A\u202e\x7f"
SEEN = "\\x1b[2J\\x1b]0;title\\x07\\r\\x9b1A\\u202e\\x7f"


def test_what_is_shown() -> None:
    assert printable("as it is, ä, 字, µ") == "as it is, ä, 字, µ"
    assert printable(f"one\n\ttwo {HOSTILE}") == f"one\n\ttwo {SEEN}"
    assert printable("a\nb", keep="") == "a\\nb"


FORGED = "busy\n2026-01-01 robot status  up\x85\u2028\u2029\x1c\r\x0b ok \u061c\U000e0001\u202e"


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        ("short", "'short'"),
        ([1.25] * 30, f"[{'1.25, ' * 11}1.25,..."),
        ("a b\n" * 40, f"'{'a b' + chr(92) + 'na b' + chr(92) + 'n'}"),
        ("x" * 90, f"'{'x' * 76}..."),
        (Path("/home/me/deep") / ("d/" * 40) / "run.yaml", "PosixPath('/home/me/.../d/d/"),
    ],
)
def test_a_long_value_is_cut_between_words(value: object, shown: str) -> None:
    assert brief(value).startswith(shown)
    assert len(brief(value)) <= 80
    if isinstance(value, Path):
        assert brief(value).endswith("/run.yaml')")


def test_what_a_peer_says_is_one_line() -> None:
    """Wherever it goes: a note, an error, the log of a robot or of ROS."""
    refused = decode_reply(encode(Refused(1, 13 * FORGED[-3:], 60 * FORGED)))
    assert isinstance(refused, Refused)
    assert decode_reply(encode(refused)) == refused  # as long as before it was escaped
    goodbye = read_goodbye(FORGED.encode())
    line = text_line(0, "robot", FORGED, {FORGED: FORGED, "reason": FORGED, "list": [FORGED]})
    as_json = json_line(0, "robot", FORGED, {FORGED: FORGED, "list": [FORGED]})
    for text in (refused.code, refused.text, goodbye, line[:-1], as_json[:-1], one_line(FORGED)):
        assert text.isprintable(), text
        assert len(text.splitlines()) == 1
    # One that is broken by the terminal looks like two.
    assert "   " not in text_line(0, "robot", "status", {"reason": f"a{' ' * 90}b"})[60:]
    assert json.loads(as_json)[FORGED] == FORGED


def test_a_spreadsheet_runs_no_cell() -> None:
    for text in ("=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(1)", "\t=1", "\r", "-"):
        assert cell(text) == f"'{text}"
    for value in ("-1.5", "-1.5 2.0 -inf", "+3", "1=1", "tcp/a:1", "", None, -1.5, True):
        assert cell(value) is value


Run = Callable[..., str]

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
def said(workplace: Workplace) -> Run:
    """Run a command that ends with an error, and return all that it shows."""
    workplace.write("hostile.py", PROBLEM)

    def run(*arguments: str) -> str:
        shown = workplace.run(*arguments)
        assert shown.code in (2, 4)
        return shown.stdout + shown.stderr

    return run


def require_harmless(shown: str) -> None:
    assert all(letter.isprintable() or letter in "\n\t" for letter in shown), repr(shown)
    assert "[2J" in shown


@pytest.mark.parametrize("mode", [[], ["--rate", "10000", "--log", "json"]])
@pytest.mark.parametrize("name", ["Raises", "Refuses", "Named"])
def test_a_user_s_problem(name: str, mode: list[str], workplace: Workplace, said: Run) -> None:
    workplace.write(
        "run.yaml", f"problem: hostile:{name}\nparticle_filter: {{num_particles: 20}}\n"
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
def test_a_configuration(text: str, workplace: Workplace, said: Run) -> None:
    escaped = "".join(f"\\u{ord(letter):04x}" for letter in HOSTILE)
    workplace.write("run.yaml", text.format(escaped))
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
        ["serve", "--listen", "unix/nix", "--problem", HOSTILE],
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


def test_a_summary_is_no_markup(capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing of an address in brackets is left out."""
    empty = SummaryBuilder().build(problem="", seed=0, version="", trials=0, wall_time_s=0.0)
    answers = {"tcp/[fe80::1]:7447": 3, HOSTILE: 4}
    print_summary(structs.replace(empty, sensing_decisions_by_service=answers))
    shown = capsys.readouterr().out
    assert "tcp/[fe80::1]:7447 3" in shown
    require_harmless(shown)
