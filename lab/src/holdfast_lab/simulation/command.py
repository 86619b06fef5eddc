"""``holdfast simulate``: the search for a schedule of faults that changes a decision."""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, ClassVar

from holdfast.cli.exit_codes import EXIT_DIFFERENT, ended_by_signals
from holdfast.config.reading import read_bounded
from holdfast.errors import HoldfastError, OptionError
from holdfast.runtime.command_line import (
    MAX_JOBS,
    Options,
    bad_value,
    flag,
    location,
    option,
    whole_number,
)
from holdfast.runtime.files import shown_path

if TYPE_CHECKING:
    from holdfast_lab.simulation.exploration import ExplorationTally
    from holdfast_lab.simulation.schedule import SimulationSchedule


SUMMARY = "Search for faults that change a decision."
"""Its line in ``holdfast --help``."""

_SEEDS = re.compile(r"([-+]?\d+):([-+]?\d+)", re.ASCII)
_MAX_SEED = 10**12
_MAX_DIGITS = 20
_MAX_SCHEDULE_BYTES = 1024 * 1024


def _seeds(text: str) -> range:
    match = _SEEDS.fullmatch(text)
    if match is None:
        raise bad_value(text, "two whole numbers A:B, such as 0:1000")
    for number in match.groups():
        if len(number) > _MAX_DIGITS or not 0 <= int(number) <= _MAX_SEED:
            raise bad_value(text, f"seeds from 0 to {_MAX_SEED:,}")
    begin, end = map(int, match.groups())
    if begin >= end:
        raise bad_value(text, "A:B with B above A")
    return range(begin, end)


class SimulateOptions(Options):
    """Run a robot and its services through faults that are drawn by seed, and check what they do.

    The state machines are those of production, with a simulated clock, wire and disk: messages are
    lost, late, doubled, damaged and misrouted, links are cut, services and the robot itself are
    stopped, slowed down, killed and started again. Every run must decide what the run without
    faults decides, perform each action once and in order, and come to an end.

    The search ends at the first seed under which a run does not. It prints the schedule of faults,
    a smaller one, and the command that runs it again.
    """

    exit_codes: ClassVar = {0: "no such seed", 1: "there is one"}

    seeds: range | None = option(
        metavar="A:B",
        read=_seeds,
        help="Run the schedules of the seeds from A up to, but not, B (default: 0:1000; with "
        "--story 0:1).",
    )
    schedule: Path | None = option(
        metavar="FILE",
        read=location,
        help="Run the schedule in a file instead and print its story; without --seeds, --story.",
    )
    story: bool = flag(help="Print the events under each seed; for a few of them.")
    jobs: int = option(
        "-j",
        metavar="N",
        read=whole_number(0, MAX_JOBS),
        default=0,
        help="Processes; 0: one for each core. Changes time only.",
    )
    shrink: bool = flag(
        default=True,
        help="Make the schedule of the first finding as small as possible.",
    )


def main(arguments: Sequence[str]) -> int:
    """Search, or run one schedule, and return the exit code."""
    options = SimulateOptions.parse("simulate", arguments)
    if options.schedule is not None:
        if options.seeds is not None or options.story:
            raise OptionError(
                f"--schedule {shown_path(options.schedule)} is a run by itself; leave --seeds and "
                "--story out"
            )
        with ended_by_signals():
            good = _run_file(Path(shown_path(options.schedule)), shrink=options.shrink)
    elif options.story:
        good = all(_tell_seed(seed) for seed in options.seeds or range(1))
    else:
        with ended_by_signals():
            good = _explore(options.seeds or range(1000), options.jobs, shrink=options.shrink)
    return 0 if good else EXIT_DIFFERENT


# -- one run ---------------------------------------------------------------------------------------


def _run_file(path: Path, *, shrink: bool) -> bool:
    from holdfast_lab.errors import ScheduleError
    from holdfast_lab.simulation.schedule import parse_schedule

    try:
        schedule = parse_schedule(read_bounded(path, _MAX_SCHEDULE_BYTES).decode())
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not text in UTF-8"
        raise HoldfastError(f"{path}: cannot be read: {reason}") from error
    except ScheduleError as error:
        raise HoldfastError(f"{path}: {error}") from error
    is_good = _tell(schedule)
    if shrink and not is_good:
        _print_smaller(schedule)
    return is_good


def _tell_seed(seed: int) -> bool:
    from holdfast_lab.simulation.schedule_draws import draw_schedule

    schedule = draw_schedule(seed)
    sys.stdout.write(f"# seed {seed}\n{schedule.text()}\n")
    return _tell(schedule)


def _tell(schedule: SimulationSchedule) -> bool:
    """Run a schedule and print its story; tell whether all was as it should be."""
    from holdfast_lab.simulation.story import story_lines
    from holdfast_lab.simulation.world import Simulator

    outcome = Simulator().run(schedule, tell=True)
    if outcome.violation is not None:
        verdict = f"VIOLATION: {outcome.violation}"
    elif outcome.held is not None:
        verdict = f"the robot rightly holds still: {outcome.held}"
    else:
        took_s = outcome.duration_s
        verdict = f"the run decided as the one without faults, in {took_s:.3f} s of its time"
    sys.stdout.write("".join(f"{line}\n" for line in [*story_lines(outcome), "", verdict]))
    return outcome.violation is None


# -- many runs -------------------------------------------------------------------------------------


def _explore(seeds: range, jobs: int, *, shrink: bool) -> bool:
    from holdfast.cli.terminal import counted, progress_line
    from holdfast.runtime.machine import available_cores
    from holdfast_lab.simulation.exploration import ExplorationTally, explore

    tally = ExplorationTally()
    begun_at = perf_counter()
    progress = progress_line(len(seeds), quiet=False, noun="run")
    progress.start(f"seeds {seeds.start}:{seeds.stop}", 0, "no violation")

    def on_batch(_: range, seen: ExplorationTally) -> bool:
        tally.add(seen)
        progress.show(tally.runs, "a violation" if tally.findings else "no violation")
        return not tally.findings

    try:
        explore(seeds, jobs or available_cores(), on_batch)
    except KeyboardInterrupt:
        progress.stop()
        _print_tally(tally, seeds.start, perf_counter() - begun_at)
        following = seeds.start + tally.runs
        sys.stdout.write(
            f"\nInterrupted. Go on with: holdfast simulate --seeds {following}:{seeds.stop}\n"
        )
        raise
    finally:
        progress.stop()
    _print_tally(tally, seeds.start, perf_counter() - begun_at)
    if tally.findings:
        _print_finding(tally, shrink=shrink)
        return False
    runs = counted(tally.runs, "run")
    stopped = (
        f"; the {tally.held:,} that stopped on purpose did so up to where they stopped"
        if tally.held
        else ""
    )
    sys.stdout.write(f"\n{runs} decided as the runs without faults do, bit for bit{stopped}.\n")
    return True


def _print_tally(tally: ExplorationTally, first: int, elapsed_s: float) -> None:
    from holdfast.cli.terminal import duration

    kinds = sorted(tally.faults.items(), key=lambda kind: -kind[1])
    by_kind = "".join(f"\n  {count:>10,}  {kind}" for kind, count in kinds)
    sys.stdout.write(
        f"seeds         {first}:{first + tally.runs}\n"
        f"runs          {tally.runs:,} in {duration(elapsed_s)}"
        f" ({tally.runs / elapsed_s:.0f} a second)\n"
        f"messages      {tally.messages:,}\n"
        f"stopped       {tally.held:,} on purpose: nobody could know what was performed\n"
        f"to the end    {tally.longest_recovery_s:.2f} s at most, from the last fault on\n"
        f"faults        {sum(tally.faults.values()):,}{by_kind}\n"
        f"violations    {len(tally.findings):,}\n"
    )
    sys.stdout.flush()


def _print_finding(tally: ExplorationTally, *, shrink: bool) -> None:
    from holdfast_lab.simulation.schedule_draws import draw_schedule
    from holdfast_lab.simulation.world import Simulator

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


def _print_smaller(schedule: SimulationSchedule) -> None:
    from holdfast_lab.simulation.exploration import shrink
    from holdfast_lab.simulation.world import Simulator

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
