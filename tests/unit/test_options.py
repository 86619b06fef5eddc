"""What cannot be an option's value is refused with one line, whichever command and option it is."""

from collections.abc import Callable

import pytest
from tests.command_line import Workplace, commands, options_of

from holdfast.runtime.command_line import Option, location


def values_of(command: str) -> list[Option]:
    """Return the options of a command that read a number, a path or the like."""
    return [
        each
        for each in options_of(command).table().values()
        if not (each.is_flag or each.hidden or each.read is str)
        and not (each.many and each.names)
        and "one_of" not in each.read.__qualname__
    ]


NUMBERS = [
    ([command, name], each.names[0])
    for command in commands()
    for each in values_of(command)
    if each.read is not location
    for name in each.names
]
PATHS = [
    [command, *each.names[:1]]
    for command in commands()
    for each in values_of(command)
    if each.read is location
]


Refused = Callable[..., str]


@pytest.fixture
def last_words(workplace: Workplace) -> Refused:
    """Run a command that is to be refused, and return the one line that it says."""
    workplace.write("peg.yaml", "problem: peg_in_hole_2d\n")

    def run(*arguments: str) -> str:
        said = workplace.fails(*arguments)
        assert said.count("\n") == 1, said
        assert workplace.names() == {"peg.yaml"}
        return said

    return run


@pytest.mark.parametrize("value", ["ten", "-1", "1e400"])
@pytest.mark.parametrize(("words", "option"), NUMBERS, ids=lambda each: "".join(each))
def test_a_number(words: list[str], option: str, value: str, last_words: Refused) -> None:
    line = last_words(*words, value)
    assert option in line
    assert value in line


@pytest.mark.parametrize("value", ["1e-300", "0", "0.0009", "10001", "inf"])
def test_a_rate(value: str, last_words: Refused) -> None:
    line = last_words("run", "peg.yaml", "--rate", value)
    assert line == (
        f"holdfast: error: --rate is '{value}'; allowed are numbers from 0.001 to 10000 (Hz)\n"
    )


@pytest.mark.parametrize("words", PATHS, ids=" ".join)
def test_an_empty_path_is_not_the_current_directory(words: list[str], last_words: Refused) -> None:
    line = last_words(*words, "")
    assert "''" in line
    assert "(. is the current directory)" in line


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["nonsense"], "'nonsense' is no command; commands are run, serve, "),
        (["rnu", "peg.yaml"], "'rnu' is no command; did you mean run?"),
        (["--versoin"], "'--versoin' is no option of holdfast; did you mean --version?"),
        (["peg.yaml", "--jobs", "2"], "no command; did you mean: holdfast run peg.yaml --jobs 2\n"),
        (["run", "peg.yaml", "--nonsense"], "--nonsense"),
        (["run", "peg.yaml", "again"], "again"),
        (["run", "peg.yaml", "--trials"], "--trials"),
        (["compare", "one"], "compare takes two runs"),
        (["serve", "--nonsense"], "--nonsense"),
        (["serve", "--log", "xml"], "--log"),
        (["serve", "--listen", "tcp/nowhere"], "--listen: endpoint 'tcp/nowhere' has no port"),
        (["serve", "--listen", "tcp/0.0.0.0:1"], "endpoint tcp/0.0.0.0:1: other machines"),
        (["run", "peg.yaml", "--log", "jsno"], "allowed are text and json; did you mean json?"),
        (["run", "peg.yaml", "--trails", "3"], "no option of holdfast run; did you mean --trials?"),
        (["run", "peg.yaml", "--quiet=3"], "--quiet takes no value"),
        (["view", "run", "--viewer", "a/b"], "--viewer is 'a/b'; allowed are HOST, HOST:PORT or"),
        (["keys", "mine", "--revoke-serial", "xyz"], "--revoke-serial is 'xyz'; allowed are hex"),
    ],
)
def test_other_misuse(arguments: list[str], reason: str, last_words: Refused) -> None:
    assert reason in last_words(*arguments)


@pytest.mark.parametrize("arguments", [[], ["run"], ["compare"], ["export"], ["view"], ["keys"]])
def test_without_arguments_there_is_help(arguments: list[str], workplace: Workplace) -> None:
    said = workplace.run(*arguments)
    assert said.code in (0, 2)
    assert (said.stdout + said.stderr).startswith("usage: holdfast")
