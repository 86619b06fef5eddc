"""``holdfast simulate``: the search for a schedule of faults that changes a decision."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

from holdfast.cli.endings import EXIT_DIFFERENT, ended_by_signals
from holdfast.cli.options import location, whole_number
from holdfast.errors import HoldfastError
from holdfast.files import read_bounded
from holdfast.runtime.command_line import MAX_JOBS

if TYPE_CHECKING:
    from holdfast.simulation.exploration import Tally
    from holdfast.simulation.schedule import Schedule
    from holdfast.simulation.world import Outcome

__all__ = ["simulate"]

_SEEDS = re.compile(r"([-+]?\d+):([-+]?\d+)", re.ASCII)
_MAX_SEED = 10**12
_MAX_DIGITS = 20
_MAX_SCHEDULE_BYTES = 1024 * 1024


def simulate(
    seeds: Annotated[
        str | None,
        typer.Option(
            metavar="A:B",
            show_default=False,
            help="Run the schedules of the seeds from A up to, but not, B. [default: 0:1000; with "
            "--story 0:1]",
        ),
    ] = None,
    schedule: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            parser=location("--schedule"),
            show_default=False,
            help="Run the schedule in a file instead and tell its story; without --seeds, --story.",
        ),
    ] = None,
    story: Annotated[
        bool,
        typer.Option("--story", help="Tell what happens under each seed; for a few of them."),
    ] = False,
    jobs: Annotated[
        int,
        typer.Option(
            "--jobs",
            "-j",
            metavar="N",
            parser=whole_number("--jobs", 0, MAX_JOBS),
            help="Processes; 0: one for each core. Changes time only.",
        ),
    ] = 0,
    shrink: Annotated[
        bool, typer.Option(help="Make the schedule of the first finding as small as it can be.")
    ] = True,
) -> None:
    """Run a robot and its services through faults that are drawn by seed, and check what they do.

    The machines are those of production, with a simulated clock, wire and disk: messages are
    lost, late, doubled, damaged and misrouted, links are cut, services and the robot itself are
    stopped, slowed down, killed and started again. Every run must decide what the run without
    faults decides, perform each action once and in order, and come to an end.

    Ends at the first seed under which it does not, and prints its schedule, a smaller one, and the
    command that runs it again. Exit code 0: there was none. 1: there was one.
    """
    if schedule is not None:
        if seeds is not None or story:
            raise HoldfastError(
                f"--schedule {schedule}: is a run by itself; leave --seeds and --story out"
            )
        with ended_by_signals():
            _run_file(schedule, shrink=shrink)
        return
    if seeds is None:
        seeds = "0:1" if story else "0:1000"
    wanted = _seeds_of(seeds)
    if story:
        for seed in wanted:
            _tell_seed(seed)
        return
    with ended_by_signals():
        _explore(wanted, jobs, shrink=shrink)


def _seeds_of(text: str) -> range:
    match = _SEEDS.fullmatch(text)
    if match is None:
        raise HoldfastError(f"--seeds {text}: must be two whole numbers A:B, such as 0:1000")
    for number in match.groups():
        if len(number) > _MAX_DIGITS or not 0 <= int(number) <= _MAX_SEED:
            raise HoldfastError(
                f"--seeds {text}: {number} is no seed; allowed are 0 to {_MAX_SEED:,}"
            )
    begin, end = map(int, match.groups())
    if begin >= end:
        raise HoldfastError(
            f"--seeds {text}: holds no seed; the second number ({end}) must be above the first "
            f"({begin})"
        )
    return range(begin, end)


# -- one run ---------------------------------------------------------------------------------------


def _run_file(path: Path, *, shrink: bool) -> None:
    from holdfast.simulation.schedule import ScheduleError, parse_schedule

    try:
        text = read_bounded(path, _MAX_SCHEDULE_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise HoldfastError(f"{path}: cannot be read: {reason}") from error
    try:
        schedule = parse_schedule(text)
    except ScheduleError as error:
        raise HoldfastError(f"{path}: {error}") from error
    if _tell(schedule).violation is not None:
        if shrink:
            _print_smaller(schedule)
        raise typer.Exit(EXIT_DIFFERENT)


def _tell_seed(seed: int) -> None:
    from holdfast.simulation.schedule import draw_schedule

    schedule = draw_schedule(seed)
    sys.stdout.write(f"# seed {seed}\n{schedule.text()}\n")
    if _tell(schedule).violation is not None:
        raise typer.Exit(EXIT_DIFFERENT)


def _tell(schedule: Schedule) -> Outcome:
    from holdfast.simulation.story import story_lines
    from holdfast.simulation.world import Simulator

    outcome = Simulator().run(schedule, tell=True)
    for line in story_lines(outcome):
        sys.stdout.write(f"{line}\n")
    sys.stdout.write(f"\n{_verdict(outcome)}\n")
    return outcome


def _verdict(outcome: Outcome) -> str:
    if outcome.violation is not None:
        return f"VIOLATION: {outcome.violation}"
    if outcome.held is not None:
        return f"the robot rightly holds still: {outcome.held}"
    return f"the run decided as the one without faults, in {outcome.duration_s:.3f} s of its time"


# -- many runs -------------------------------------------------------------------------------------


def _explore(seeds: range, jobs: int, *, shrink: bool) -> None:
    from holdfast.cli.terminal import counted, progress_line
    from holdfast.runtime.trials import available_cores
    from holdfast.simulation.exploration import Tally, explore

    tally = Tally()
    following = seeds.start
    begun_at = perf_counter()
    progress = progress_line(len(seeds), quiet=False, noun="run")
    progress.start(f"seeds {seeds.start}:{seeds.stop}", 0, "no violation")

    def on_batch(some: range, seen: Tally) -> bool:
        nonlocal following
        tally.add(seen)
        following = some.stop
        progress.show(tally.runs, "a violation" if tally.findings else "no violation")
        return not tally.findings

    try:
        explore(seeds, jobs or available_cores(), on_batch)
    except KeyboardInterrupt:
        progress.stop()
        _print_tally(tally, range(seeds.start, following), perf_counter() - begun_at)
        sys.stdout.write(
            f"\nInterrupted. Go on with: holdfast simulate --seeds {following}:{seeds.stop}\n"
        )
        raise
    finally:
        progress.stop()
    _print_tally(tally, range(seeds.start, following), perf_counter() - begun_at)
    if tally.findings:
        _print_finding(tally, shrink=shrink)
        raise typer.Exit(EXIT_DIFFERENT)
    runs = counted(tally.runs, "run")
    stopped = (
        f"; the {tally.held:,} that stopped on purpose did so up to where they stopped"
        if tally.held
        else ""
    )
    sys.stdout.write(f"\n{runs} decided as the runs without faults do, bit for bit{stopped}.\n")


def _print_tally(tally: Tally, seeds: range, elapsed_s: float) -> None:
    from holdfast.cli.terminal import duration

    kinds = sorted(tally.faults.items(), key=lambda kind: -kind[1])
    by_kind = "".join(f"\n  {count:>10,}  {kind}" for kind, count in kinds)
    sys.stdout.write(
        f"seeds         {seeds.start}:{seeds.stop}\n"
        f"runs          {tally.runs:,} in {duration(elapsed_s)}"
        f" ({tally.runs / elapsed_s:.0f} a second)\n"
        f"messages      {tally.messages:,}\n"
        f"stopped       {tally.held:,} on purpose: nobody could know what was performed\n"
        f"to the end    {tally.longest_recovery_s:.2f} s at most, from the last fault on\n"
        f"faults        {sum(tally.faults.values()):,}{by_kind}\n"
        f"violations    {len(tally.findings):,}\n"
    )
    sys.stdout.flush()


def _print_finding(tally: Tally, *, shrink: bool) -> None:
    from holdfast.simulation.schedule import draw_schedule
    from holdfast.simulation.world import Simulator

    found = tally.findings[0]
    schedule = draw_schedule(found.seed)
    sys.stdout.write(
        f"\nVIOLATION under seed {found.seed}: {found.violation}\n\n"
        f"Its schedule:\n\n{schedule.text()}\n"
        f"Again, with its story: holdfast simulate --story --seeds {found.seed}:{found.seed + 1}\n"
    )
    sys.stdout.flush()
    if not shrink:
        return
    if Simulator().run(schedule).violation is None:
        sys.stdout.write(
            "Alone it does not happen: it hangs on what was computed in the runs before it.\n"
        )
        return
    _print_smaller(schedule)


def _print_smaller(schedule: Schedule) -> None:
    from holdfast.simulation.shrinking import shrink
    from holdfast.simulation.world import Simulator

    sys.stderr.write("Making it smaller (Ctrl-C ends that with what there is) ...\n")
    simulator = Simulator()
    smaller = shrink(schedule, lambda each: simulator.run(each).violation is not None)
    if smaller == schedule:
        sys.stdout.write("\nNothing of it can be left out.\n")
        return
    sys.stdout.write(
        f"\nThe smallest that was found under which something goes wrong:\n\n{smaller.text()}\n"
        f"{simulator.run(smaller).violation}\n"
        "In a file it can be run again: holdfast simulate --schedule FILE\n"
    )
