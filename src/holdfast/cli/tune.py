"""``holdfast tune``: find what to sense on one's own problem, by simulating it."""

from __future__ import annotations

import math
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from time import monotonic
from typing import ClassVar

from holdfast.cli.exit_codes import (
    EXIT_CAN_GO_ON,
    ended_by_signals,
    goes_on,
    interrupted_by,
    say_interrupted,
)
from holdfast.cli.overrides import combined, overrides_of
from holdfast.cli.terminal import duration, progress_line
from holdfast.errors import InvalidValueError, OutputError, RunError, WorkerDiedError
from holdfast.printable import printable
from holdfast.runtime import command_line
from holdfast.runtime.files import shown_path
from holdfast.runtime.output_directory import claim_directory

_MOST_TRIALS = 100_000
_LONGEST_S = 30 * 86_400.0
_UNITS_S = {"s": 1.0, "m": 60.0, "h": 3600.0}


def duration_text(text: str) -> str:
    """Read a duration, such as 90s, 10m or 2h."""
    _seconds(text)
    return text


def _seconds(text: str) -> float:
    found = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    value = float(found[1]) * _UNITS_S[found[2]] if found else 0.0
    if not 1.0 <= value <= _LONGEST_S:
        raise command_line.bad_value(text, "durations from 1s to 720h, such as 90s, 10m or 2h")
    return value


def variations(text: str) -> str:
    """Read what is to be tried, separated by commas."""
    from holdfast.tuning.candidates import VARIATIONS
    from holdfast.validation import close_match

    for each in text.split(","):
        if each not in VARIATIONS:
            allowed = f"{', '.join(VARIATIONS)}, with commas between"
            raise command_line.bad_value(each, allowed + close_match(each, VARIATIONS))
    return text


class TuneOptions(command_line.Options):
    """Find what to sense on the problem of CONFIG, by simulating it.

    Methods and settings race in the same simulated worlds; what is beaten is dropped. The winner is
    then judged beside CONFIG and random sensing on trials that had no part in the race.

    DIR gets tuned.yaml (CONFIG, --set, and the keys that changed), tune.md (tables with intervals),
    tune.png, candidates.csv and trials.csv.
    """

    needs_arguments = True
    exit_codes: ClassVar = {4: None}

    configuration: Path = command_line.argument(
        "CONFIG", "Configuration file (YAML).", command_line.location
    )
    vary: str = command_line.option(
        metavar="WHAT,...",
        read=variations,
        default="methods,looks,resolution",
        help="What is tried: methods, looks (ahead, of expected_return), resolution (3 and 10 "
        "times), estimators, fixed (always one sensing action); then, of the winner, interval "
        "and particles.",
    )
    objective: str | None = command_line.option(
        metavar="NAME",
        read=command_line.one_of("reward", "steps", "success"),
        help="What decides: reward (less prices), steps (without success the limit) or success "
        "(default: reward if sensing has prices, else steps).",
    )
    budget: str = command_line.option(
        metavar="TIME",
        read=duration_text,
        default="10m",
        help="How long it may take, but for the trials that run at its end: 90s, 10m, 2h.",
    )
    trials: int = command_line.option(
        metavar="N",
        read=command_line.whole_number(20, _MOST_TRIALS),
        default=200,
        help="Most trials of a candidate in the race, and as many to judge.",
    )
    max_decision_ms: float = command_line.option(
        metavar="MS",
        read=command_line.number(1e-3, 3.6e6, "ms"),
        default=math.inf,
        help="No candidate may win whose median decision takes longer (default: no limit).",
    )
    jobs: int | None = command_line.jobs_option(more="")
    ray: str | None = command_line.option(
        metavar="ADDRESS",
        help="Run the trials on a Ray cluster: auto (of this machine), HOST:PORT or "
        "ray://HOST:PORT; on all of its cores unless --jobs says otherwise.",
    )
    seed: int | None = command_line.seed_option()
    assignments: tuple[str, ...] = command_line.set_option("simulator.max_steps=200")
    problem: str | None = command_line.problem_option()
    problem_directory: Path | None = command_line.module_option()
    out: Path | None = command_line.out_option("CONFIG-tuned")
    resume: bool = command_line.flag(
        help="Go on with the tuning in DIR; a larger --budget finds more."
    )
    check: bool = command_line.flag(
        default=True, help="Check the problem first, and stop at an error (holdfast check)."
    )
    quiet: bool = command_line.flag("-q", help="Show only the sentence.")


@ended_by_signals()
def main(arguments: Sequence[str]) -> int:
    """Tune and return the exit code."""
    options = TuneOptions.parse("tune", arguments)
    from holdfast.config.loader import load
    from holdfast.tuning.check_process import require_right
    from holdfast.tuning.findings import Finding
    from holdfast.tuning.kept_trials import TRIALS_NAME
    from holdfast.tuning.tune import Progress, tune
    from holdfast.tuning.tuning_report import CONFIGURATION_NAME, tuning_tables

    def warn(found: Finding) -> None:
        if not options.quiet:
            sys.stderr.write(printable(f"note: {found.check}: {found.seen} -> {found.advice}\n"))

    runs, began_s, budget_s = Path("runs").absolute(), monotonic(), _seconds(options.budget)
    given = combined(overrides_of(options, options.assignments))
    path = shown_path(options.configuration)
    with goes_on(options if options.resume else None, "tune"):
        configuration = load(path, problem=options.problem, overrides=given)
    if options.check and not options.resume:
        same = {"configuration", "assignments", "problem", "problem_directory"}
        words = options.words(*(options.table().keys() - same))
        require_right(configuration, budget_s, warn, shlex.join(["holdfast", "check", *words]))
    if options.resume:
        if options.out is None or not (options.out / TRIALS_NAME).is_file():
            raise InvalidValueError(f"--resume needs --out DIR, of a tuning that has {TRIALS_NAME}")
        out = options.out
    else:
        out = claim_directory(options.out, runs, f"{options.configuration.stem}-tuned")
    again = options.command_to_resume("tune", out)
    left_s = max(0.5 * budget_s, budget_s - (monotonic() - began_s))  # the check had its part
    line = progress_line(round(budget_s), quiet=options.quiet, noun="second", speed=False)
    doing = ""

    def show(progress: Progress) -> None:
        nonlocal doing
        if progress.doing != doing:
            doing = progress.doing
            line.say(f"{doing}; at most {duration(max(0.0, left_s - progress.spent_s))} left")
        spent = min(round(progress.spent_s), round(budget_s) - 1)
        line.show(spent, f"{progress.trials:,} trials")

    line.start(f"{configuration.problem_name}; results in {shown_path(out)}", 0, "")
    try:
        found = tune(
            configuration,
            vary=tuple(options.vary.split(",")),  # type: ignore[arg-type]
            objective=options.objective,  # type: ignore[arg-type]
            budget_s=left_s,
            most=options.trials,
            jobs=options.jobs,
            ray=options.ray,
            max_decision_ms=options.max_decision_ms,
            check=False,
            out=out,
            on_progress=show,
        )
    except KeyboardInterrupt as interruption:
        line.stop()
        kept = "The finished trials are kept."
        say_interrupted(interrupted_by(interruption), kept, again)
        raise
    except (OutputError, WorkerDiedError) as error:
        if not doing:
            raise  # the directory is not ours
        raise RunError(error, again, EXIT_CAN_GO_ON) from error
    finally:
        line.stop()
    text = f"{found.sentence}\n" if options.quiet else tuning_tables(found)
    sys.stdout.write(printable(text))
    if (found.changes or configuration.overrides) and not options.quiet:
        sys.stderr.write(f"Take it: holdfast run {shown_path(out / CONFIGURATION_NAME)}\n")
    return 0
