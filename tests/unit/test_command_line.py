"""One table of options gives the parser, the help, the messages and the repeated command."""

import shlex
import sys
from pathlib import Path

import pytest
from tests.answers import answers_in
from tests.command_line import commands, options_of

from holdfast.cli import main
from holdfast.errors import OptionError
from holdfast.runtime.command_line import (
    Options,
    argument,
    flag,
    location,
    number,
    one_of,
    option,
    wants_json,
    whole_number,
)
from holdfast.service.options import ServeOptions


class Brew(Options):
    """Make coffee."""

    beans: Path = argument("BEANS", "A bag.", location)
    guests: tuple[str, ...] = argument("GUEST", "Who drinks it.", many=True, least=0)
    cups: int = option("--cups", "-c", metavar="N", read=whole_number(1, 9), default=2, help="N.")
    heat: float | None = option("--heat", metavar="C", read=number(50.0, 99.5, "°C"), help="C.")
    mill: str = option(
        "--mill", metavar="M", read=one_of("fine", "coarse"), default="fine", help=""
    )
    milk: bool = flag("--milk", "-m", help="With milk.")
    lid: bool = flag("--lid", default=True, help="With a lid.")


def test_values_and_defaults() -> None:
    brew = Brew.parse("brew", ["bag", "--cups=3", "anna", "--no-lid", "-c", "4", "ben"])
    assert (brew.beans, brew.guests, brew.cups) == (Path("bag").absolute(), ("anna", "ben"), 4)
    assert (brew.heat, brew.mill, brew.milk, brew.lid) == (None, "fine", False, False)
    assert brew.words() == ["bag", "anna", "ben", "--cups", "4", "--no-lid"]
    assert brew.words("guests", "cups") == ["bag", "--no-lid"]


def test_words_after_two_dashes_are_no_options() -> None:
    brew = Brew.parse("brew", ["--cups", "3", "--", "-b", "--milk", "--", "-3"])
    assert (brew.beans, brew.guests, brew.milk) == (
        Path("-b").absolute(),
        ("--milk", "--", "-3"),
        False,
    )


def test_words_with_a_dash_in_front_are_read_again() -> None:
    brew = Brew(beans=Path("-b"), guests=("anna",))
    assert brew.words() == ["./-b", "anna"]
    serve = ServeOptions(name="-x", listen=("-y", "tcp/z:1"))
    assert vars(ServeOptions.parse("serve", serve.words())) == vars(serve)


@pytest.mark.parametrize(
    ("line", "message"), [*answers_in("option_mistakes.txt"), ("", "BEANS is missing")]
)
def test_bad_arguments(line: str, message: str) -> None:
    with pytest.raises(OptionError) as refused:
        Brew.parse("brew", shlex.split(line))
    assert message in str(refused.value)


def test_events_as_json_are_wanted() -> None:
    assert wants_json(["run", "--log", "json"]) and wants_json(["--log=json"])
    assert not wants_json(["--log", "json", "--log=text"])


@pytest.mark.parametrize("command", commands())
def test_help_names_every_option_and_exit_code(
    command: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["holdfast", command, "--help"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert not ended.value.code
    text = capsys.readouterr().out
    assert text.startswith(f"usage: holdfast {command} [OPTIONS]")
    options = options_of(command)
    for each in options.table().values():
        assert each.hidden or all(name in text for name in each.names)
    codes = text.partition("Exit codes: ")[2]
    assert all(f"{code} " in codes for code in (0, 2, *options.exit_codes))


@pytest.mark.parametrize("command", commands())
def test_words_give_the_same_options_again(command: str) -> None:
    options = options_of(command)
    chosen = {
        name: (each.default is False)
        if each.is_flag
        else ("a", "b")
        if each.many and each.read is str
        else (Path("p").absolute(), Path("q").absolute())
        if each.many and each.read is location
        else Path("p").absolute()
        if each.read is location
        else each.default or "p"
        if each.least
        else each.default
        for name, each in options.table().items()
    }
    words = options(**chosen).words()
    again = options.parse(command, words)
    assert words
    assert vars(again) == chosen


def test_the_usage_line_says_how_many(capsys: pytest.CaptureFixture[str]) -> None:
    for command, expected in (("compare", "RUN RUN..."), ("run", "CONFIG"), ("doctor", "[CONFIG]")):
        with pytest.raises(SystemExit):
            options_of(command).parse(command, ["--help"])
        usage = capsys.readouterr().out.splitlines()[0]
        assert usage == f"usage: holdfast {command} [OPTIONS] {expected}"
