"""``holdfast demo``: kills and recoveries on one machine, in less than half a minute."""

from __future__ import annotations

import contextlib
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from holdfast.cli.exit_codes import EXIT_DIFFERENT, ended_by_signals, interrupted_by
from holdfast.errors import HoldfastError
from holdfast.runtime.command_line import MAX_SEED, Options, flag, location, option, whole_number

if TYPE_CHECKING:
    from holdfast_lab.demo.scenario import Findings


SUMMARY = "See a cloud and a robot killed, and no decision change."
"""Its line in ``holdfast --help``."""

_RUNS = Path("runs")
_ORDERLY_END_S = 3.0

_INTRODUCTION = """\
A robot puts a peg into a hole that it can hardly see. A service in the cloud
decides what it measures and how it moves. Here that service is killed, twice,
and then the robot's own process. Time may be lost, but nothing else: what is
decided must be, bit for bit, what a run without kills decides.

"""


class DemoOptions(Options):
    """Kill the cloud, twice, and the robot, and show that no decision changes.

    Real processes and real kills on this machine: a service (holdfast serve) and a robot that uses
    it (holdfast run --service). A bar each shows the cloud service, the local service that the
    robot launches when the cloud is gone, and the robot, with a C while the cloud decides and an L
    while the local service does. Events are listed below. At the end: how long each reaction took,
    and whether the decisions are those of a run without kills.

    Ctrl-C ends all processes.
    """

    exit_codes: ClassVar = {
        0: "the decisions are the same",
        1: "they differ",
        2: "an error, or something did not happen that the message names",
    }

    out: Path | None = option(
        "-o",
        metavar="DIR",
        read=location,
        help="Directory for both runs and the logs (default: runs/demo, numbered if taken).",
    )
    seed: int = option(
        metavar="S",
        read=whole_number(0, MAX_SEED),
        default=0,
        help="Seed of all random draws.",
    )
    quick: bool = flag(help="A shorter run: about half the time.")


def main(arguments: Sequence[str]) -> int:
    """Run the demo and return the exit code."""
    options = DemoOptions.parse("demo", arguments)
    with ended_by_signals(once=True):
        findings = _run(options.out, options.seed, quick=options.quick)
    return 0 if findings.comparison.identical else EXIT_DIFFERENT


def _run(out: Path | None, seed: int, *, quick: bool) -> Findings:
    from holdfast.runtime.output_directory import claim_directory
    from holdfast_lab.demo.narrator import DemoState
    from holdfast_lab.demo.scenario import Demo, Plan
    from holdfast_lab.demo.timeline import make_show
    from holdfast_lab.testbed.driver import Testbed

    directory = claim_directory(out, _RUNS, "demo")
    sys.stderr.write(_INTRODUCTION)
    sys.stderr.flush()
    plan = Plan(min_steps=240, duration_s=9.0) if quick else Plan()
    show = make_show()
    state = DemoState(expected_s=plan.duration_s + 3.0)
    try:
        with Testbed(directory, orderly_end_s=_ORDERLY_END_S) as testbed:
            show.start(state)
            try:
                findings = Demo(testbed, seed, plan, state, show.say).run()
            finally:
                # The terminal comes first; after SIGHUP there is none.
                with contextlib.suppress(OSError):
                    show.stop()
    except HoldfastError:
        show.conclude(state)
        raise
    except KeyboardInterrupt as interruption:
        how = interrupted_by(interruption)
        sys.stderr.write(f"\n{how}; all processes are ended. The logs are in {directory}\n")
        raise
    show.conclude(state)
    sys.stdout.write(account(findings, directory))
    sys.stdout.flush()
    return findings


def account(findings: Findings, directory: Path) -> str:
    """Return the findings as text."""
    from holdfast_lab.demo.scenario import KILLED_RUN_NAME, REFERENCE_RUN_NAME

    def row(label: str, *values: float | None) -> str:
        texts = ["-" if value is None else f"{value:.0f} ms" for value in values]
        return f"  {label:<42}" + "".join(f"{text:>12}" for text in texts)

    outages = findings.outages
    local_ms = [
        None
        if each.recovery_ms is None or each.detection_ms is None
        else max(0.0, each.recovery_ms - each.detection_ms)
        for each in outages
    ]
    passed = [" -> ".join(each) for each in findings.statuses]
    comparison = findings.comparison
    runs = [directory / name for name in (REFERENCE_RUN_NAME, KILLED_RUN_NAME)]
    if comparison.identical:
        verdict = "The decisions are those of the run without kills:"
    else:
        verdict = "The decisions are NOT those of the run without kills:"
    lines = [
        "",
        f"{'What the kills cost':<44}{'1st kill':>12}{'2nd kill':>12}",
        row("cloud killed -> found", *(each.detection_ms for each in outages)),
        row("found -> first local decision", *local_ms),
        row("longest wait for a decision", *(each.longest_wait_ms for each in outages)),
        row("local service: spawned -> up", *(each.launch_ms for each in outages)),
        row("cloud: spawned -> listening", *findings.listening_ms),
        row("cloud: listening -> used again", *(each.failback_ms for each in outages)),
        row("robot killed -> acting again", findings.robot_kill.recovery_ms),
        "After a kill the robot moves on to its next sensing step; the wait is how long",
        "it stood still there. Without a kill it does not.",
        "",
        "Statuses that the robot passed",
        f"  {passed[0]}",
        *(f"  after its restart: {each}" for each in passed[1:]),
        "",
        verdict,
        comparison.describe(),
        "",
        "Look for yourself:",
        f"  {shlex.join(['holdfast', 'compare', *map(str, runs)])}",
    ]
    return "".join(f"{line}\n" for line in lines)
