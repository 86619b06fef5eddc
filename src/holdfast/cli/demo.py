"""``holdfast demo``: the whole story on one machine, in less than half a minute."""

from __future__ import annotations

import contextlib
import shlex
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from holdfast.cli.endings import EXIT_DIFFERENT, ended_by_signals, signal_of
from holdfast.cli.options import MAX_SEED, location, whole_number
from holdfast.errors import HoldfastError

if TYPE_CHECKING:
    from holdfast.cli.story import Findings

__all__ = ["demo"]

_RUNS = Path("runs")

_INTRODUCTION = """\
A robot puts a peg into a hole that it can hardly see. A service in the cloud
decides what it measures and how it moves. Here that service is killed, twice,
and then the robot's own process. Time may be lost, but nothing else: what is
decided must be, bit for bit, what a run without kills decides.

"""


def demo(
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            metavar="DIR",
            parser=location("--out"),
            help="Directory for both runs and the logs (default: runs/demo, numbered if taken).",
            show_default=False,
        ),
    ] = None,
    seed: Annotated[
        int,
        typer.Option(
            "--seed",
            metavar="S",
            parser=whole_number("--seed", 0, MAX_SEED),
            help="Seed of all random draws.",
        ),
    ] = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="A shorter run: about half the time.")
    ] = False,
) -> None:
    """Kill the cloud, twice, and the robot, and show that no decision changes.

    Real processes and real kills on this machine: a service (holdfast serve) and a robot that uses
    it (holdfast run --service). What you see: a bar for the cloud service, for the local service
    that the robot launches when the cloud is gone, and for the robot, with a C while the cloud
    decides and an L while the local service does; below, what happens, in words. At the end: how
    long each reaction took, and whether the decisions are those of a run without kills.

    Exit code 0: they are. 1: they differ. 2: something did not happen; the message says what was
    awaited and where the logs are. Ctrl-C ends all processes.
    """
    with ended_by_signals(once=True):
        findings = _tell(out, seed, quick=quick)
    if not findings.comparison.identical:
        raise typer.Exit(EXIT_DIFFERENT)


def _tell(out: Path | None, seed: int, *, quick: bool) -> Findings:
    from holdfast.cli.story import Plan, Story
    from holdfast.cli.timeline import make_show
    from holdfast.files import claim_directory

    directory = claim_directory(out, _RUNS, "demo")
    show = make_show()
    sys.stderr.write(_INTRODUCTION)
    sys.stderr.flush()
    plan = Plan(min_steps=240, duration_s=9.0) if quick else Plan()
    try:
        with Story(directory, seed, plan, show) as story:
            try:
                findings = story.tell()
            finally:
                # First of all the terminal; after SIGHUP there is none to write to.
                with contextlib.suppress(OSError):
                    show.stop()
    except HoldfastError:
        show.conclude(story.chronicle)
        raise
    except KeyboardInterrupt as interruption:
        ended = signal_of(interruption)
        how = "Interrupted" if ended == signal.SIGINT else f"Ended by {ended.name}"
        sys.stderr.write(f"\n{how}; all processes are ended. The logs are in {directory}\n")
        raise
    show.conclude(story.chronicle)
    sys.stdout.write(account(findings, directory))
    sys.stdout.flush()
    return findings


def account(findings: Findings, directory: Path) -> str:
    """Say what came of it.

    Parameters
    ----------
    findings : Findings
    directory : Path
        Where the runs are.
    """
    from holdfast.cli.story import KILLED_RUN_NAME, UNDISTURBED_RUN_NAME

    def row(label: str, *values: float | None) -> str:
        texts = ["-" if value is None else f"{value:.0f} ms" for value in values]
        return f"  {label:<42}" + "".join(f"{text:>12}" for text in texts)

    outages = findings.outages
    passed = [" -> ".join(each) for each in findings.statuses]
    comparison = findings.comparison
    runs = [directory / name for name in (UNDISTURBED_RUN_NAME, KILLED_RUN_NAME)]
    if comparison.identical:
        verdict = "The decisions are those of the run without kills:"
    else:
        verdict = "The decisions are NOT those of the run without kills:"
    lines = [
        "",
        f"{'What the kills cost':<44}{'1st kill':>12}{'2nd kill':>12}",
        row("cloud killed -> found", *(each.found_ms for each in outages)),
        row("found -> first local decision", *(each.first_local_decision_ms for each in outages)),
        row("longest wait for a decision", *(each.longest_wait_ms for each in outages)),
        row("local service: spawned -> up", *(each.launched_ms for each in outages)),
        row("cloud: spawned -> listening", *(each.listening_ms for each in outages)),
        row("cloud: listening -> used again", *(each.used_again_ms for each in outages)),
        row("robot killed -> acting again", findings.robot_acting_again_ms),
        "After a kill the robot first uses up the actions that it has; the wait is how",
        f"long it stood still. Without a kill that is {findings.usual_wait_ms:.1f} ms (median).",
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
