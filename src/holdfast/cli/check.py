"""``holdfast check``: what is wrong with a problem, before a day is lost with it."""

from __future__ import annotations

import contextlib
import json
import shutil
import signal
import sys
import textwrap
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from holdfast.cli.exit_codes import EXIT_DIFFERENT, ended_by_signals
from holdfast.errors import ConfigurationError, InvalidValueError
from holdfast.printable import printable
from holdfast.runtime.command_line import (
    MAX_SEED,
    Options,
    argument,
    flag,
    location,
    number,
    option,
    whole_number,
)

if TYPE_CHECKING:
    from types import FrameType

    from holdfast.config.loader import Configuration
    from holdfast.tuning.findings import Finding

__all__ = ["inspected", "main"]

_WIDEST = 110

_PATIENCE = 3.0
"""A call that takes so many times the budget is ended, where the system can."""


class CheckOptions(Options):
    """Check a problem: its functions, its likelihoods, its goal, its sensors and its resolution.

    PROBLEM is a configuration file, a registered name, or module:Class of a module in the current
    directory. Of a configuration the simulated world is used, never its environment: no robot
    moves.

    Errors make decisions wrong, warnings make them worse. The statistical tests of a right
    problem, all together, find an error in one check of a thousand.
    """

    exit_codes: ClassVar = {0: "no error, perhaps warnings", 1: "an error in the problem"}
    needs_arguments = True

    problem: str = argument("PROBLEM", "Configuration file, name, or module:Class.")
    assignments: tuple[str, ...] = option(
        "--set",
        metavar="SECTION.KEY=VALUE",
        many=True,
        help="A value instead of the file's, or of the default, as YAML: model.width=0.3.",
    )
    problem_directory: Path | None = option(
        metavar="DIR",
        read=location,
        help="Where the module of module:Class is (default: here, or where the file says).",
    )
    seed: int = option(
        metavar="S",
        read=whole_number(0, MAX_SEED),
        default=0,
        help="Names all random draws; the same seed finds the same.",
    )
    budget: float = option(
        metavar="SECONDS",
        read=number(0.1, 86_400.0, "s"),
        default=20.0,
        help="Time after which no further work is begun; most problems need a few seconds.",
    )
    json: bool = flag(help="Print each finding as a JSON object, one a line.")
    quiet: bool = flag("-q", help="Show no progress, and no information: errors and warnings only.")


def main(arguments: Sequence[str]) -> int:
    """Check the problem and return the exit code."""
    options = CheckOptions.parse("check", arguments)
    with ended_by_signals():
        return _check(options)


def _check(options: CheckOptions) -> int:
    from holdfast.cli.terminal import counted, progress_line
    from holdfast.tuning.problem_check import CHECKS

    configuration = _configuration(options)
    line = progress_line(len(CHECKS), quiet=options.quiet or options.json, noun="check")
    names = list(CHECKS)
    line.start(f"checking {configuration.problem_name}", 0, "")
    try:
        found = inspected(
            configuration,
            _PATIENCE * options.budget,
            seed=options.seed,
            budget_s=options.budget,
            on_check=lambda name: line.show(names.index(name), name),
        )
    finally:
        line.stop()
    shown = [each for each in found if not options.quiet or each.severity != "information"]
    for each in shown:
        text = json.dumps(each._asdict()) if options.json else printable(_wrapped(str(each)))
        sys.stdout.write(f"{text}\n")
    errors, warnings = (
        sum(each.severity == kind for each in found) for kind in ("error", "warning")
    )
    if not options.json:
        sys.stdout.write(f"{counted(errors, 'error')}, {counted(warnings, 'warning')}\n")
    return EXIT_DIFFERENT if errors else 0


def inspected(configuration: Configuration, patience_s: float, **how: Any) -> list[Finding]:
    """Check the problem of a configuration, which may print and hang; ``how`` as it is checked."""
    from holdfast.tuning.problem_check import check_problem

    # What the problem's code prints is no finding.
    with contextlib.redirect_stdout(sys.stderr), _impatient(patience_s):
        return check_problem(
            configuration.problem,
            configuration.planning,
            max_steps=configuration.simulator.max_steps,
            **how,
        )


def _configuration(options: CheckOptions) -> Configuration:
    """Return the configuration of a file, or one of defaults for a problem's name."""
    from holdfast.cli.overrides import combined, parse_assignment
    from holdfast.config.loader import Configuration, load

    given = combined(parse_assignment(each) for each in options.assignments)
    directory = options.problem_directory
    if options.problem.endswith((".yaml", ".yml")) or Path(options.problem).is_file():
        if directory is not None:
            raise InvalidValueError(
                "--problem-directory goes with module:Class; a configuration file has the key "
                "problem_directory"
            )
        return load(Path(options.problem).absolute(), overrides=given)
    sections: dict[str, object] = {"problem": options.problem}
    if directory is not None:
        sections["problem_directory"] = str(directory)
    for name, value in given.items():
        section, _, key = name.partition(".")
        own = sections.setdefault(section, {})
        if not isinstance(own, dict):
            raise InvalidValueError(f"--set {name}: {section} has no keys")
        own[key] = value
    path = str(Path.cwd() / options.problem.replace("/", "_"))
    try:
        return Configuration.from_plain({"path": path, "configuration": sections})
    except ConfigurationError as error:
        # There is no such file.
        raise type(error)(str(error).removeprefix(f"{path}: ")) from error


@contextlib.contextmanager
def _impatient(seconds: float) -> Iterator[None]:
    """Raise TimeoutError in the problem's code if it takes so long: a finding with its lines."""
    from holdfast.config.user_code import is_users_file

    ours = str(Path(__file__).parents[1] / "tuning")

    def end(number: int, frame: FrameType | None) -> None:
        del number
        while frame is not None and not frame.f_code.co_filename.startswith(ours):
            if is_users_file(frame.f_code.co_filename):
                raise TimeoutError(f"it was still running {seconds:g} s after the check began")
            frame = frame.f_back

    before = signal.signal(signal.SIGALRM, end)
    # Again each second: what runs then may be ours, or a second function of the problem's.
    signal.setitimer(signal.ITIMER_REAL, seconds, 1.0)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _wrapped(text: str) -> str:
    """Break the long lines of a finding, but for those of the user's code, which are indented."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    wrapper = textwrap.TextWrapper(
        width, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
    )
    return "\n".join(
        line if line.startswith("      ") else wrapper.fill(line) for line in text.splitlines()
    )
