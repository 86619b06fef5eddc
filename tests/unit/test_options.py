"""What cannot be an option's value is refused with one line, whichever command and option it is."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from tests.command_line import commands, options_of

from holdfast.cli import main

NUMBERS = [
    ["run", "peg.yaml", "--trials"],
    ["run", "peg.yaml", "--seed"],
    ["run", "peg.yaml", "--jobs"],
    ["run", "peg.yaml", "-j"],
    ["run", "peg.yaml", "--rate"],
    ["run", "peg.yaml", "--watchdog-s"],
    ["run", "peg.yaml", "--health"],
    ["run", "peg.yaml", "--view"],
    ["run", "peg.yaml", "--metrics"],
    ["demo", "--seed"],
    ["chaos", "--trials"],
    ["chaos", "--seed"],
    ["chaos", "--jobs"],
    ["chaos", "--first"],
    ["simulate", "--jobs"],
    ["simulate", "--seeds"],
    ["keys", "mine", "--days"],
    *(["check", "peg.yaml", f"--{name}"] for name in ("seed", "budget", "trials")),
    ["export", "run", "--trials"],
    ["view", "run", "--trials"],
    ["report", "run", "--worst"],
    ["serve", "--workers"],
    ["serve", "--lease-ms"],
    ["serve", "--max-sessions"],
    ["serve", "--metrics"],
    ["serve", "--health"],
    ["serve", "--processes"],
    ["serve", "--drain-s"],
    ["serve", "--watchdog-s"],
    ["serve", "--max-sessions-per-robot"],
    ["serve", "--max-decision-s"],
    ["serve", "--max-decision-mb"],
    *(["sweep", "peg.yaml", f"--{name}"] for name in ("trials", "seed", "jobs")),
    *(["tune", "peg.yaml", f"--{name}"] for name in ("vary", "budget", "trials", "seed", "jobs")),
    ["tune", "peg.yaml", "--max-decision-ms"],
]
PATHS = [
    ["run"],
    ["tune"],
    ["tune", "peg.yaml", "--out"],
    ["sweep"],
    ["sweep", "peg.yaml", "--out"],
    ["run", "peg.yaml", "--out"],
    ["run", "peg.yaml", "--tls"],
    ["run", "peg.yaml", "--view-file"],
    ["demo", "--out"],
    ["chaos", "--out"],
    ["simulate", "--schedule"],
    ["doctor", "--tls"],
    ["check", "peg.yaml", "--problem-directory"],
    ["compare"],
    ["compare", "one"],
    ["export"],
    ["export", "run", "--mcap"],
    ["export", "run", "--csv"],
    ["export", "run", "--problem-directory"],
    ["view"],
    ["view", "run", "--save"],
    ["view", "run", "--problem-directory"],
    ["report"],
    ["report", "run", "--out"],
    ["report", "run", "--problem-directory"],
    ["keys"],
    ["serve", "--tls"],
    ["serve", "--problem-directory"],
]


@pytest.fixture(autouse=True)
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "peg.yaml").write_text("problem: peg_in_hole_2d\n")


def last_words(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> str:
    """Run a command that is to be refused, and return the one line that it says."""
    monkeypatch.setattr(sys, "argv", ["holdfast", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("holdfast: error: ")
    assert said.err.count("\n") == 1, said.err
    assert sorted(path.name for path in Path().iterdir()) == ["peg.yaml"]
    return said.err


@pytest.mark.parametrize("value", ["ten", "-1", "1e400"])
@pytest.mark.parametrize("words", NUMBERS, ids=" ".join)
def test_a_number(
    words: list[str],
    value: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    option = {"-j": "--jobs"}.get(words[-1], words[-1])
    line = last_words([*words, value], capsys, monkeypatch)
    assert option in line
    assert value in line


@pytest.mark.parametrize("value", ["1e-300", "0", "0.0009", "10001", "inf"])
def test_a_rate(
    value: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    line = last_words(["run", "peg.yaml", "--rate", value], capsys, monkeypatch)
    assert line == (
        f"holdfast: error: --rate is '{value}'; allowed are numbers from 0.001 to 10000 (Hz)\n"
    )


@pytest.mark.parametrize("words", PATHS, ids=" ".join)
def test_an_empty_path_is_not_the_current_directory(
    words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    more = ["two"] if words[0] == "compare" and len(words) == 1 else []
    line = last_words([*words, "", *more], capsys, monkeypatch)
    assert "''" in line
    assert "(. is the current directory)" in line


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["nonsense"], "'nonsense' is no command; commands are run, serve, "),
        (["rnu", "peg.yaml"], "'rnu' is no command; did you mean run?"),
        (["--versoin"], "'--versoin' is no option of holdfast; did you mean --version?"),
        (["peg.yaml"], "peg.yaml is no command; did you mean: holdfast run peg.yaml"),
        (["run", "peg.yaml", "--nonsense"], "--nonsense"),
        (["run", "peg.yaml", "again"], "again"),
        (["run", "peg.yaml", "--trials"], "--trials"),
        (["compare", "one"], "compare takes two runs"),
        (["serve", "--nonsense"], "--nonsense"),
        (["serve", "--log", "xml"], "--log"),
        (["serve", "--listen", "tcp/nowhere"], "--listen: endpoint 'tcp/nowhere' has no port"),
        (
            ["serve", "--listen", "tcp/0.0.0.0:1"],
            "--listen: endpoint tcp/0.0.0.0:1: other machines",
        ),
        (
            ["run", "peg.yaml", "--log", "jsno"],
            "allowed are text and json; did you mean json?",
        ),
        (
            ["run", "peg.yaml", "--trails", "3"],
            "no option of holdfast run; did you mean --trials?",
        ),
        (["run", "peg.yaml", "--quiet=3"], "--quiet takes no value"),
        (["view", "run", "--viewer", "a/b"], "--viewer is 'a/b'; allowed are HOST, HOST:PORT or"),
        (["keys", "mine", "--revoke-serial", "xyz"], "--revoke-serial is 'xyz'; allowed are hex"),
    ],
)
def test_other_misuse(
    arguments: list[str],
    reason: str,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert reason in last_words(arguments, capsys, monkeypatch)


@pytest.mark.parametrize("arguments", [[], ["run"], ["compare"], ["export"], ["view"], ["keys"]])
def test_without_arguments_there_is_help(
    arguments: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["holdfast", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr()
    assert ended.value.code in (0, 2)
    assert (said.out + said.err).startswith("usage: holdfast")


@pytest.mark.parametrize("command", commands())
def test_every_number_and_path_is_in_these_tables(command: str) -> None:
    """So that a new option gets a line above."""
    listed = {(words[0], words[-1]) for words in [*NUMBERS, *PATHS]}
    for each in options_of(command).table().values():
        is_text = each.is_flag or each.read is str or "one_of" in each.read.__qualname__
        if each.names and not (is_text or each.many or each.hidden):
            assert any((command, name) in listed for name in each.names), each.names
