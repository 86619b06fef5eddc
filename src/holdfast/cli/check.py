"""``holdfast check``: what is wrong with a problem, before a day is lost with it."""

from __future__ import annotations

import functools
import json
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from holdfast.cli.exit_codes import EXIT_DIFFERENT, ended_by_signals
from holdfast.cli.overrides import combined, overrides_of
from holdfast.errors import ConfigurationError, InvalidValueError
from holdfast.printable import printable
from holdfast.runtime import command_line

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration


_WIDEST = 110


class CheckOptions(command_line.Options):
    """Check a problem: its functions, its likelihoods, its goal, its sensors and its resolution.

    PROBLEM is a configuration file, a registered name, or module:Class of a module in the current
    directory. Of a configuration the simulated world is used, never its environment: no robot
    moves. The check is a process of its own, so the problem's code cannot end or hang it.

    Errors make decisions wrong, warnings make them worse. The statistical tests of a right
    problem, all together, find an error in one check of a thousand.
    """

    exit_codes: ClassVar = {0: "no error, perhaps warnings", 1: "an error in the problem"}
    needs_arguments = True

    of: str = command_line.argument("PROBLEM", "Configuration file, name, or module:Class.")
    problem: str | None = command_line.problem_option()
    assignments: tuple[str, ...] = command_line.set_option(
        "model.width=0.3", instead_of="the file's, or of the default"
    )
    problem_directory: Path | None = command_line.option(
        metavar="DIR",
        read=command_line.location,
        key="problem_directory",
        help="Where the module of module:Class is (default: here, or where the file says).",
    )
    seed: int = command_line.option(
        metavar="S",
        read=command_line.whole_number(0, command_line.MAX_SEED),
        default=0,
        help="Names all random draws; the same seed finds the same.",
    )
    budget: float = command_line.option(
        metavar="SECONDS",
        read=command_line.number(0.1, 86_400.0, "s"),
        default=20.0,
        help="Time after which no further work is begun; most problems need a few seconds.",
    )
    trials: int = command_line.option(
        metavar="N",
        read=command_line.whole_number(0, command_line.MAX_TRIALS),
        default=100,
        help="Pairs of trials, at most, to tell whether the method beats random sensing.",
    )
    json: bool = command_line.flag(help="Print each finding as a JSON object, one a line.")
    quiet: bool = command_line.flag(
        "-q", help="Show no progress, and no information: errors and warnings only."
    )


@ended_by_signals()
def main(arguments: Sequence[str]) -> int:
    """Check the problem and return the exit code."""
    options = CheckOptions.parse("check", arguments)
    from holdfast.cli.terminal import counted, progress_line
    from holdfast.tuning.check_process import check_apart
    from holdfast.tuning.findings import OVER
    from holdfast.tuning.problem_check import CHECKS

    line = progress_line(len(CHECKS), quiet=options.quiet or options.json, noun="check")
    names = list(CHECKS)
    given = combined(overrides_of(options, options.assignments))
    line.start(f"checking {options.problem or options.of}", 0, "")
    try:
        found = check_apart(
            functools.partial(_configuration, options.of, options.problem, given),
            seed=options.seed,
            budget_s=options.budget,
            trials=options.trials,
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
        left_out = [each.check for each in found if each.seen == OVER]
        more = f"; too little time for {', '.join(left_out)} (--budget)" if left_out else ""
        sys.stdout.write(f"{counted(errors, 'error')}, {counted(warnings, 'warning')}{more}\n")
    return EXIT_DIFFERENT if errors else 0


def _configuration(of: str, problem: str | None, given: Mapping[str, Any]) -> Configuration:
    """Return the configuration of a file, or one of defaults for a problem's name."""
    from holdfast.config.loader import Configuration, load
    from holdfast.config.source import put_at

    if of.endswith((".yaml", ".yml")) or Path(of).is_file():
        return load(Path(of).absolute(), problem=problem, overrides=given)
    if problem is not None:
        raise InvalidValueError(f"--problem {problem}: {of} is no file; name one problem alone")
    sections: dict[str, object] = {"problem": of}
    for name, value in given.items():
        put_at(sections, name, value)
    path = str(Path.cwd() / of.replace("/", "_"))
    try:
        return Configuration.from_plain({"path": path, "configuration": sections})
    except ConfigurationError as error:
        # There is no such file.
        raise type(error)(str(error).removeprefix(f"{path}: ")) from error


def _wrapped(text: str) -> str:
    """Break the long lines of a finding, but for those of the user's code, which are indented."""
    width = min(shutil.get_terminal_size().columns, _WIDEST)
    wrapper = textwrap.TextWrapper(
        width, subsequent_indent="    ", break_long_words=False, break_on_hyphens=False
    )
    return "\n".join(
        line if line.startswith("      ") else wrapper.fill(line) for line in text.splitlines()
    )
