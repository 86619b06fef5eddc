"""Command lines: each command declares its options once, as the attributes of a class.

The parser, the help, the messages about bad values and the command line that repeats a call follow
from that class. ``argparse`` splits the words. A service that replaces a dead one reads its options
here, too, and its start-up time is recovery time: so nothing that is slow to load is imported.
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import os
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, NoReturn, Self

from holdfast.errors import OptionError
from holdfast.printable import brief

MAX_JOBS = 1024
"""Largest number of worker processes that a command can be asked for (``--jobs``)."""

MAX_SEED = 2**63 - 1
"""Largest seed, as in the configuration."""

MAX_TRIALS = 10_000_000
"""Largest number of trials, as in the configuration."""

_MAX_COLUMNS = 100

_AFTER_DASHES = "\0"
"""Put before each word after ``--``; no word of a command line has this character."""

_EXIT_CODES = {
    0: "done",
    1: "different",
    2: "an error",
    3: "a service answered otherwise than the robot's own planner",
    4: "an error, but the run can go on",
    5: "the machine was rebooted, and nobody lets the robot go on",
}


class Option(NamedTuple):
    """An option or a positional argument of a command."""

    # The long name first, by default that of the attribute; empty for a positional argument.
    names: tuple[str, ...]
    help: str
    metavar: str
    read: Callable[[str], Any]  # turns the text into the value; see :func:`bad_value`
    default: Any
    many: bool = False  # whether it may be given several times; then the value is a tuple
    key: str | None = None  # the configuration's ``section.key`` that it replaces
    hidden: bool = False  # whether the help leaves it out
    least: int = 0  # how many of a positional argument there must be

    @property
    def place(self) -> str:
        """A positional argument in the usage line."""
        dots = "..." if self.many else ""
        return (
            " ".join([self.metavar] * self.least) + dots
            if self.least
            else f"[{self.metavar}{dots}]"
        )

    @property
    def is_flag(self) -> bool:
        """Whether it takes no value."""
        return isinstance(self.default, bool)

    def words(self, value: Any) -> list[str]:
        """Return the words of a command line that give this value."""
        if self.is_flag:
            return [self.names[0] if value else f"--no-{self.names[0].removeprefix('--')}"]
        from holdfast.runtime.files import shown_path

        values = [
            shown_path(each) if isinstance(each, Path) else str(each)
            for each in (value if self.many else (value,))
        ]
        if not self.names:
            return [f"./{each}" if each.startswith("-") else each for each in values]
        # In two words a value with a dash in front would be taken for an option.
        return [
            word
            for each in values
            for word in (
                [f"{self.names[0]}={each}"] if each.startswith("-") else [self.names[0], each]
            )
        ]


def argument(
    metavar: str,
    help: str,  # noqa: A002
    read: Callable[[str], Any] = str,
    *,
    many: bool = False,
    least: int = 1,
) -> Any:
    """Declare a positional argument; see :class:`Option`."""
    return Option((), help, metavar, read, () if many else None, many, least=least)


def option(
    *names: str,
    help: str,  # noqa: A002
    metavar: str,
    read: Callable[[str], Any] = str,
    default: Any = None,
    many: bool = False,
    key: str | None = None,
    hidden: bool = False,
) -> Any:
    """Declare an option with a value; see :class:`Option`.

    ``names`` are its short name, and a long one that is not the attribute's.
    """
    return Option(
        _with_long(names), help, metavar, read, () if many else default, many, key, hidden
    )


def flag(*names: str, help: str, default: bool = False) -> Any:  # noqa: A002
    """Declare an option without a value; one that is on by default is switched off by ``--no-``."""
    return Option(_with_long(names), help, "", str, default)


def seed_option() -> Any:
    """Declare the ``--seed`` of a command that runs trials."""
    return option(
        metavar="S",
        read=whole_number(0, MAX_SEED),
        key="simulator.seed",
        help="Seed of all random draws, instead of the file's.",
    )


def jobs_option(more: str = " Changes time only.") -> Any:
    """Declare the ``--jobs`` of a command that runs trials; ``more`` ends its help."""
    return option(
        "-j",
        metavar="N",
        read=whole_number(1, MAX_JOBS),
        help=f"Largest number of processes (default: one for each core).{more}",
    )


def set_option(example: str, *, instead_of: str = "the file's") -> Any:
    """Declare the ``--set`` of a command that reads a configuration."""
    return option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        many=True,
        help=f"A value instead of {instead_of}, as YAML: {example}.",
    )


def problem_option() -> Any:
    """Declare the ``--problem`` of a command that reads a configuration."""
    return option(
        metavar="NAME", help="Problem instead of the file's: a registered name or module:Class."
    )


def module_option() -> Any:
    """Declare the ``--problem-directory`` of a command that reads a configuration."""
    return option(
        metavar="DIR",
        read=location,
        key="problem_directory",
        help="Where the problem's module lies, instead of where the file says.",
    )


def out_option(default: str) -> Any:
    """Declare the ``--out`` of a command that writes a directory."""
    return option(
        "-o",
        metavar="DIR",
        read=location,
        help=f"Directory for the results (default: runs/{default}, numbered if taken).",
    )


def _with_long(names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names with room for the attribute's, unless one of them is long."""
    return names if names and names[0].startswith("--") else ("", *names)


class Options:
    """The options of a command, to be derived from: its docstring is the help.

    Attributes
    ----------
    exit_codes : mapping of int to str or None
        The codes with which the command ends besides 0 and 2, and what they mean if that is not
        what they mean in general.
    needs_arguments : bool
        Whether the command without any arguments shows its help.
    program : str
        What is typed before the command.
    """

    exit_codes: ClassVar[Mapping[int, str | None]] = {}
    needs_arguments: ClassVar[bool] = False
    program: ClassVar[str] = "holdfast"

    def __init_subclass__(cls) -> None:
        for name, each in cls.table().items():
            if each.names[:1] == ("",):
                names = (f"--{name.replace('_', '-')}", *each.names[1:])
                setattr(cls, name, each._replace(names=names))

    def __init__(self, **values: Any) -> None:
        for name, each in self.table().items():
            setattr(self, name, values.get(name, each.default))

    @classmethod
    def table(cls) -> dict[str, Option]:
        """Return the options by the names of their attributes."""
        own = {name: each for kind in reversed(cls.__mro__) for name, each in vars(kind).items()}
        return {name: each for name, each in own.items() if isinstance(each, Option)}

    @classmethod
    def parse(cls, command: str, arguments: Sequence[str]) -> Self:
        """Read the arguments of a command.

        Raises OptionError if one of them cannot be used; the message names the option, the value
        and the limit; SystemExit after the help was shown.
        """
        from holdfast.runtime.files import remember_directory

        remember_directory()
        program = f"{cls.program} {command}"
        parser = _parser(cls, program)
        if cls.needs_arguments and not arguments:
            import sys

            parser.print_help(sys.stderr)
            raise SystemExit(2)
        try:
            found, unknown = parser.parse_known_intermixed_args(_marked(arguments))
        except argparse.ArgumentError as error:
            raise OptionError(_complaint(error, cls, program, arguments)) from None
        if unknown:
            word = unknown[0].partition("=")[0]
            if not word.startswith("-"):
                word = word.removeprefix(_AFTER_DASHES)
                raise OptionError(f"{brief(word)} is one argument too many")
            from holdfast.validation import close_match

            names = [name for each in cls.table().values() for name in each.names]
            hint = close_match(word, names)
            raise OptionError(f"{brief(word)} is no option of {program}{hint}")
        table = cls.table()
        values = {
            name: tuple(value) if table[name].many else value for name, value in vars(found).items()
        }
        for name, each in table.items():
            if each.least and values[name] in (None, ()):
                raise OptionError(f"{each.metavar} is missing")
        return cls(**values)

    def words(self, *without: str) -> list[str]:
        """Return the command line that gives these options, but for defaults and those named."""
        given = [
            each.words(value)
            for name, each in self.table().items()
            if name not in without and (value := getattr(self, name)) != each.default
        ]
        return list(itertools.chain.from_iterable(given))

    def command_to_resume(self, command: str, directory: Path, *without: str) -> str:
        """Return the command that goes on in a directory, but for the options named."""
        import shlex  # for a command that has stopped

        out = self.table()["out"].words(directory)
        words = [command, *self.words("out", "resume", *without), *out, "--resume"]
        return shlex.join(["holdfast", *words])


class _Parser(argparse.ArgumentParser):
    """Raises what another parser prints."""

    def error(self, message: str) -> NoReturn:
        raise OptionError(message)


class _Help(argparse.HelpFormatter):
    """Separates paragraphs, and shows the metavar of an option once."""

    def __init__(self, prog: str) -> None:
        # With its width, because shutil, which would find it, is slow to load.
        columns = 80
        with contextlib.suppress(OSError):
            columns = min(os.get_terminal_size().columns, _MAX_COLUMNS)
        super().__init__(prog, max_help_position=32, width=columns - 2)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        paragraphs = re.split(r"\n\s*\n", text.strip())
        return "\n\n".join(
            super(_Help, self)._fill_text(each, width, indent) for each in paragraphs
        )

    def _format_action_invocation(self, action: argparse.Action) -> str:
        names = sorted(action.option_strings, key=len)
        if not names or action.nargs == 0:
            return ", ".join(names) or str(action.metavar)
        return f"{', '.join(names)} {action.metavar}"


def _parser(options: type[Options], program: str) -> _Parser:
    table = options.table()
    places = [each.place for each in table.values() if not each.names]
    codes = {0: None, 2: None, **options.exit_codes}
    meanings = [f"{code} {codes[code] or _EXIT_CODES[code]}" for code in sorted(codes)]
    parser = _Parser(
        prog=program,
        usage=" ".join([program, "[OPTIONS]", *places]),
        description=options.__doc__,
        epilog=f"Exit codes: {'; '.join(meanings)}; 128 + N ended by the signal N.",
        formatter_class=_Help,
        allow_abbrev=False,
        exit_on_error=False,
        add_help=False,
    )
    parser.add_argument("-h", "--help", action="help", help="Show this help and exit.")
    # Else "-3:2" is taken for an option.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    for name, each in table.items():
        given: dict[str, Any] = {"help": argparse.SUPPRESS if each.hidden else _help(each)}
        if each.is_flag:
            on = argparse.BooleanOptionalAction
            given |= {"action": on if each.default else "store_true", "default": each.default}
        else:
            given |= {"metavar": each.metavar, "type": each.read, "default": each.default}
        if each.names:
            if each.many:
                given |= {"action": "append", "default": []}
            parser.add_argument(*each.names, dest=name, **given)
        else:
            given["type"] = _unmarked(each.read)
            parser.add_argument(name, nargs="*" if each.many else "?", **given)
    return parser


def _marked(words: Sequence[str]) -> list[str]:
    """Return the words without ``--``, and mark those behind it: none of them is an option.

    ``parse_known_intermixed_args`` reads a command line twice, and forgets ``--`` in between.
    """
    before = list(itertools.takewhile(lambda word: word != "--", words))
    return before + [_AFTER_DASHES + word for word in words[len(before) + 1 :]]


def _unmarked(read: Callable[[str], Any]) -> Callable[[str], Any]:
    return lambda text: read(text.removeprefix(_AFTER_DASHES))


def _help(each: Option) -> str:
    text = each.help.replace("%", "%%")
    if each.many and each.names:
        text += " May be repeated."
    if each.is_flag or each.default in (None, ()) or "default" in text:
        return text
    default = f"{each.default:g}" if isinstance(each.default, float) else each.default
    return f"{text} (default: {default})"


def _complaint(
    error: argparse.ArgumentError, options: type[Options], program: str, arguments: Sequence[str]
) -> str:
    """Return the message about an argument, with its long name."""
    name = (error.argument_name or "").split("/")[0]
    if error.message == "expected one argument":
        wanted = next(each.metavar for each in options.table().values() if name in each.names)
        return f"{name} needs a value: {name} {wanted}"
    if error.message.startswith("ignored explicit argument"):
        value = error.message.partition("'")[2].removesuffix("'")
        # In -qx the letter is no value of -q.
        if any(re.fullmatch(rf"-\w+{re.escape(value)}", word) for word in arguments):
            return f"'-{value[0]}' is no option of {program}"
        return f"{name} takes no value"
    return f"{name} {error.message}"


def bad_value(text: str, allowed: str) -> argparse.ArgumentTypeError:
    """Return the error of a value; the parser puts the option's name before it."""
    return argparse.ArgumentTypeError(f"is {brief(text)}; allowed are {allowed}")


def whole_number(least: int, most: int) -> Callable[[str], int]:
    """Return a reader of whole numbers from ``least`` to ``most``."""

    def read(text: str) -> int:
        with contextlib.suppress(ValueError):
            if least <= (value := int(text)) <= most:
                return value
        raise bad_value(text, f"whole numbers from {least} to {most}")

    return read


def number(least: float, most: float, unit: str) -> Callable[[str], float]:
    """Return a reader of numbers from ``least`` to ``most``."""

    def read(text: str) -> float:
        with contextlib.suppress(ValueError):
            if least <= (value := float(text)) <= most:
                return value
        raise bad_value(text, f"numbers from {least:g} to {most:g} ({unit})")

    return read


def one_of(*choices: str) -> Callable[[str], str]:
    """Return a reader of one of a few words."""

    def read(text: str) -> str:
        if text not in choices:
            from holdfast.validation import close_match

            listed = ", ".join(choices[:-1]) + f" and {choices[-1]}"
            raise bad_value(text, listed + close_match(text, choices))
        return text

    return read


def location(text: str) -> Path:
    """Read a path. The empty text, such as an unset variable of a script, is not one.

    It is absolute from here on: the code of a problem or robot, which runs later, may change the
    current directory, as simulators do.
    """
    if not text:
        raise argparse.ArgumentTypeError("is ''; expected a path (. is the current directory)")
    return Path(text).absolute()


def wants_json(arguments: Sequence[str]) -> bool:
    """Return whether a command line, which need not be valid, asks for events as JSON."""
    chosen = "text"
    for name, value in itertools.pairwise([*arguments, ""]):
        if name == "--log":
            chosen = value
        elif name.startswith("--log="):
            chosen = name.removeprefix("--log=")
    return chosen == "json"
