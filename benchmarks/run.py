"""Run the benchmarks: ``python benchmarks/run.py [--quick] [--only NAME...]``.

A full run writes benchmarks/RESULTS.md; a quick or partial one prints only, unless ``--output``
says where. A bar that is missed does not change the exit status: the machine may have a slow
minute.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import scipy
from rich.console import Console

from benchmarks import (
    command,
    decisions,
    far,
    faults,
    horizon,
    neighbours,
    path_entropy,
    region,
    scale,
    service,
    simulator,
)
from benchmarks.common import Case, Context
from benchmarks.measure import OtherLoad
from benchmarks.report import BARS_HEADER, Result, Table, markdown_of, show
from holdfast.runtime.files import write_atomically
from holdfast.runtime.machine import available_cores
from holdfast_lab.testbed.machine import describe, kernel_hash

RESULTS = Path(__file__).with_name("RESULTS.md")

# Cores that others may use before the report says so.
LOUD = 0.15

# How long others must have been quiet when --patience waits for it.
QUIET_S = 3.0

# In the order of RESULTS.md, with rough durations in seconds.
CASES = (
    Case("default", "A decision by the default", decisions.default_decision, 30.0, 2.0),
    Case("decision", "A decision by the published method", decisions.decision, 60.0, 6.0),
    Case("ratio", "Against the literal algorithm", decisions.ratio, 60.0, 4.0),
    Case("large", "100,000 particles", scale.large, 60.0, 12.0),
    Case("growth", "How the cost grows", scale.growth, 60.0, 4.0),
    Case("trials", "A thousand trials", command.trials, 40.0, 3.0),
    Case("floor", "Distance from the floor", decisions.floor, 10.0, 1.0),
    Case("simd", "Instruction sets", decisions.instruction_sets, 25.0, 3.0),
    Case("busy", "On a busy machine", decisions.busy_machine, 30.0, 8.0),
    Case("startup", "Start-up", command.startup, 20.0, 3.0),
    Case("estimators", "Estimators and methods", decisions.estimators, 20.0, 1.0),
    Case("path", "Along the path", path_entropy.path_entropy, 60.0, 10.0),
    Case("horizon", "Steps ahead", horizon.horizon, 60.0, 6.0),
    Case("offload", "A question to a service", service.offload, 5.0, 2.0),
    Case("robot", "A robot's loop, with and without a service", service.robot_loop, 20.0, 4.0),
    Case("paced", "A robot at its own pace", service.paced, 60.0, 7.0),
    Case("wire", "Bytes on the wire", service.wire, 20.0, 4.0),
    Case("kills", "A killed cloud, and a new one", faults.kills, 90.0, 12.0),
    Case("far", "A cloud far away", far.far, 600.0, 90.0),
    Case("standstill", "A far robot that moves on", far.standstill, 180.0, 20.0),
    Case("neighbours", "Bad neighbours", neighbours.neighbours, 150.0, 30.0),
    Case("capacity", "Many robots", service.capacity, 290.0, 60.0),
    Case("region", "A region dies", region.region, 75.0, 30.0),
    Case("robot_costs", "What a robot costs", region.costs, 80.0, 45.0),
    Case("serve", "The service's process", service.serve, 50.0, 14.0),
    Case("simulated", "Simulated runs", simulator.simulated, 15.0, 5.0),
)


class Progress:
    """One line with what runs and the time left; nothing of it runs while something is timed."""

    def __init__(self, cases: list[Case], quick: bool) -> None:
        self._expected = {
            case.name: case.quick_seconds if quick else case.seconds for case in cases
        }
        self._titles = {case.name: case.title for case in cases}
        self._terminal = sys.stderr.isatty()
        self._start = time.monotonic()
        self._done = 0.0

    def of(self, name: str) -> Callable[[float], None]:
        """Return what a case reports its fraction to."""
        self._show(name, 0.0)
        return lambda fraction: self._show(name, fraction)

    def finish(self, name: str) -> None:
        """Count a case as done."""
        self._done += self._expected[name]
        if self._terminal:
            print("\r\033[K", end="", file=sys.stderr, flush=True)

    def _show(self, name: str, fraction: float) -> None:
        total = sum(self._expected.values())
        done = self._done + fraction * self._expected[name]
        elapsed = time.monotonic() - self._start
        # Trust the expectation at first, what has been seen more and more.
        pace = (elapsed + 5.0) / (done + 5.0)
        left = (total - done) * pace
        text = f"{done / total:4.0%}  {self._titles[name]}, about {left:.0f} s left in all"
        if self._terminal:
            print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)
        elif fraction == 0.0:
            print(text, file=sys.stderr, flush=True)


def wait_for_quiet(until: float) -> None:
    """Wait until others let the machine alone, but not longer than to a time of the clock."""
    while time.monotonic() < until:
        other = OtherLoad()
        time.sleep(QUIET_S)
        cores = other.cores()
        if cores is None or cores <= LOUD:
            return


def measure(
    case: Case, quick: bool, progress: Progress, patience_s: float
) -> tuple[Result, float | None]:
    """Run a case, again if others were loud meanwhile and there is time; return the last."""
    until = time.monotonic() + patience_s
    while True:
        wait_for_quiet(until)
        other = OtherLoad()
        result = case.run(Context(quick, progress.of(case.name)))
        cores = other.cores()
        if not cores or cores <= LOUD or time.monotonic() >= until:
            progress.finish(case.name)
            return result, cores


def load_in_words(cores: float | None) -> str:
    """Return what else the machine had to do, of a mean number of cores."""
    average = f"load average {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    if cores is None:
        return average or "the load is unknown"
    return f"others kept {cores:.2f} cores busy" + (f", {average}" if average else "")


class Section(NamedTuple):
    """What the report says of one case.

    Attributes
    ----------
    body : str
        In Markdown.
    bars : list of list of str
        Rows of the table of bars.
    """

    title: str
    body: str
    bars: list[list[str]]


def section(case: Case, result: Result, meanwhile: str) -> Section:
    """Return the section of a case that was measured."""
    parts = [part if isinstance(part, str) else markdown_of(part) for part in result.content]
    bars = [bar.cells(case.name) for bar in result.bars]
    return Section(case.title, "\n\n".join([*parts, meanwhile]), bars)


def sections_of(text: str) -> dict[str, Section]:
    """Return the sections of a report that was written before, by the names of their cases."""
    bodies = dict(part.split("\n\n", 1) for part in text.split("\n## ")[1:])
    rows = [
        [cell.strip() for cell in line.strip("|").split("|")]
        for line in bodies.get("Bars", "").splitlines()
        if line.startswith("| ")
    ]
    return {
        case.name: Section(
            case.title,
            bodies[case.title].rstrip("\n"),
            [row for row in rows if row[-1] == case.name],
        )
        for case in CASES
        if case.title in bodies
    }


def report(machine: dict[str, str], sections: Sequence[Section], notes: Sequence[str]) -> str:
    """Return the report in Markdown."""
    bars = [row for each in sections for row in each.bars]
    parts = [
        "# Benchmarks",
        "Written by `make bench`. What is compared ran in turns within one run; times are medians. "
        "Timings are no tests: a miss here fails nothing. One case alone: "
        "`python benchmarks/run.py --only CASE`.",
        *notes,
        "## Bars",
        markdown_of(Table(BARS_HEADER, bars)) if bars else "None here.",
        "## Machine",
        markdown_of(Table(("", ""), [[name, value] for name, value in machine.items()])),
    ]
    for each in sections:
        parts += [f"## {each.title}", each.body]
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Run the cases that the command line names."""
    parser = argparse.ArgumentParser(
        description="Measure holdfast and write benchmarks/RESULTS.md."
    )
    parser.add_argument("--quick", action="store_true", help="measure less, in about half a minute")
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="NAME",
        choices=[case.name for case in CASES],
        help=f"only these: {', '.join(case.name for case in CASES)}",
    )
    parser.add_argument(
        "--output", type=Path, help="where to write (default: RESULTS.md after a full run)"
    )
    parser.add_argument(
        "--update",
        action="store_true",
        help="put what is measured into the report in the place of what it says of these cases",
    )
    parser.add_argument(
        "--patience",
        type=float,
        default=0.0,
        metavar="MINUTES",
        help="wait before each case until others let the machine alone, and measure again if they "
        "did not while it ran, for no longer than this",
    )
    options = parser.parse_args()
    cases = [case for case in CASES if not options.only or case.name in options.only]
    complete = not options.quick and len(cases) == len(CASES)
    output = options.output or (RESULTS if complete or options.update else None)

    # Services are started as they are where holdfast is installed: from compiled modules.
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    console = Console()
    progress = Progress(cases, options.quick)
    machine, kernel = {**describe(), "SciPy": scipy.__version__}, kernel_hash()
    sections = {}
    loads = []
    for case in cases:
        result, cores = measure(case, options.quick, progress, 60.0 * options.patience)
        loads.append(cores or 0.0)
        meanwhile = f"Meanwhile, {load_in_words(cores)} ({machine['holdfast']}, {machine['date']})."
        sections[case.name] = section(case, result, meanwhile)
        console.rule(case.title)
        show(console, [*result.content, meanwhile])

    notes = []
    if options.quick:
        notes.append("**A quick run: few repetitions, rough numbers.**")
    if max(loads) > LOUD:
        notes.append(
            f"**Other programs kept up to {max(loads):.1f} of {available_cores()} cores busy: "
            "an idle machine is faster, on two threads above all.**"
        )
    if kernel_hash() != kernel:
        notes.append("**The kernel was built again during this run: the sections differ in it.**")
    show(console, notes)
    bars = [row for each in sections.values() for row in each.bars]
    if bars:
        console.rule("Bars")
        show(console, [Table(BARS_HEADER, bars)])
    if output is not None:
        if options.update and output.exists():
            sections = sections_of(output.read_text()) | sections
            notes = []  # they would seem to be about all sections; each says its own
        ordered = [sections[case.name] for case in CASES if case.name in sections]
        write_atomically(output, report(machine, ordered, notes))
        console.print(f"written to {output}", highlight=False)


if __name__ == "__main__":
    main()
