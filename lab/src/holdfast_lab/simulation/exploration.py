"""Many seeds, on one core or on several, what was found under them, and that made small."""

from __future__ import annotations

import multiprocessing
import signal
from collections import Counter, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import cache
from typing import TypeAlias

import msgspec

from holdfast.errors import InvalidValueError
from holdfast.runtime.command_line import MAX_JOBS
from holdfast_lab.errors import SimulationError
from holdfast_lab.simulation.schedule import RunSettings, SimulatedFault, SimulationSchedule
from holdfast_lab.simulation.schedule_draws import draw_schedule
from holdfast_lab.simulation.world import Simulator

_BATCH = 25
"""Seeds that a process runs between two reports: a fraction of a second's work."""

_AHEAD = 3
"""Batches that wait for each process."""

_MAX_CANDIDATES = 2000
"""Schedules that are tried to make one smaller."""


class ViolationFound(msgspec.Struct, frozen=True):
    """A seed under which something happened that must not."""

    seed: int
    violation: str


class ExplorationTally(msgspec.Struct, kw_only=True):
    """What was seen under some seeds."""

    runs: int = 0
    held: int = 0  # of these, how many ended with a robot that rightly holds still for good
    faults: dict[str, int] = msgspec.field(default_factory=dict)  # by kind, how many have happened
    messages: int = 0
    # Virtual time from the end of the last fault to the end of a run.
    longest_recovery_s: float = 0.0
    findings: list[ViolationFound] = msgspec.field(default_factory=list)

    def add(self, other: ExplorationTally) -> None:
        """Add what was seen under other seeds."""
        self.runs += other.runs
        self.held += other.held
        self.faults = dict(Counter(self.faults) + Counter(other.faults))
        self.messages += other.messages
        self.longest_recovery_s = max(self.longest_recovery_s, other.longest_recovery_s)
        self.findings = sorted(self.findings + other.findings, key=lambda found: found.seed)


def explore(
    seeds: range,
    jobs: int,
    on_batch: Callable[[range, ExplorationTally], bool],
    batch: int = _BATCH,
) -> None:
    """Run the schedules of many seeds, in so many processes; 1 is this one. That changes time only.

    ``on_batch`` gets the seeds of a batch that was run, in their order, and what was seen; it
    returns whether to go on. Raises InvalidValueError if the number of processes is out of bounds,
    and SimulationError if a process was killed; what it had is not known.
    """
    if not 1 <= jobs <= MAX_JOBS:
        raise InvalidValueError(f"jobs is {jobs}: must be from 1 to {MAX_JOBS}")
    batches = (seeds[begin : begin + batch] for begin in range(0, len(seeds), batch))
    if jobs == 1 or len(seeds) <= batch:
        simulator = Simulator()
        for some in batches:
            if not on_batch(some, _run(some, simulator)):
                return
    else:
        _explore_in_processes(batches, jobs, on_batch)


def _explore_in_processes(
    batches: Iterator[range], jobs: int, on_batch: Callable[[range, ExplorationTally], bool]
) -> None:
    others = set(multiprocessing.active_children())
    pool = ProcessPoolExecutor(
        jobs,
        multiprocessing.get_context("spawn"),
        # Ctrl-C reaches every process of the terminal; the first one alone answers it.
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),
    )
    try:
        running: deque[tuple[range, Future[ExplorationTally]]] = deque()
        while True:
            while len(running) < _AHEAD * jobs and (some := next(batches, None)) is not None:
                running.append((some, pool.submit(_run_here, some)))
            if not running:
                return
            some, done = running.popleft()
            if not on_batch(some, done.result()):
                return
    except BrokenProcessPool as error:
        raise SimulationError(
            "a process that ran seeds was killed; often the machine is out of memory: fewer "
            "processes (--jobs) need less"
        ) from error
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
        # Nobody waits for what they still compute.
        for process in set(multiprocessing.active_children()) - others:
            process.kill()


@cache
def _simulator_of_this_process() -> Simulator:
    return Simulator()


def _run_here(seeds: range) -> ExplorationTally:
    return _run(seeds, _simulator_of_this_process())


def _run(seeds: range, simulator: Simulator) -> ExplorationTally:
    tally = ExplorationTally(runs=len(seeds))
    faults: Counter[str] = Counter()
    for seed in seeds:
        outcome = simulator.run(draw_schedule(seed))
        faults.update(outcome.faults)
        tally.held += outcome.held is not None
        tally.messages += outcome.messages
        tally.longest_recovery_s = max(tally.longest_recovery_s, outcome.recovery_s)
        if outcome.violation is not None:
            tally.findings.append(ViolationFound(seed, outcome.violation))
    tally.faults = dict(faults)
    return tally


# -- making a finding small ------------------------------------------------------------------------


_Holds: TypeAlias = Callable[[RunSettings, tuple[SimulatedFault, ...]], bool]


class _BudgetSpentError(Exception):
    """Enough has been tried."""


def shrink(
    schedule: SimulationSchedule, fails: Callable[[SimulationSchedule], bool]
) -> SimulationSchedule:
    """Return a smaller schedule that fails as well; the same one if there is none.

    A drawn schedule has dozens of faults, and most have nothing to do with what went wrong. First
    faults are left out, in ever smaller groups (delta debugging; Zeller and Hildebrandt, IEEE
    Transactions on Software Engineering 28, 2002). Then what is unusual about the run itself is
    made usual, value by value.

    Ctrl-C, or 2,000 candidates, end the search with the smallest one so far.
    """
    smallest = schedule
    left = _MAX_CANDIDATES

    def holds(run: RunSettings, faults: tuple[SimulatedFault, ...]) -> bool:
        nonlocal smallest, left
        if not left:
            raise _BudgetSpentError
        left -= 1
        candidate = SimulationSchedule(run, faults)
        if not fails(candidate):
            return False
        smallest = candidate
        return True

    try:
        before = None
        while smallest != before:
            before = smallest
            _leave_out(smallest, holds)
            _make_usual(smallest, holds)
    except (_BudgetSpentError, KeyboardInterrupt):
        pass
    return smallest


def _leave_out(schedule: SimulationSchedule, holds: _Holds) -> None:
    """Leave faults out, in groups of half of them down to one."""
    faults = schedule.faults
    size = max(1, len(faults) // 2)
    while faults:
        begin = 0
        while begin < len(faults):
            rest = faults[:begin] + faults[begin + size :]
            if holds(schedule.run, rest):
                faults = rest
            else:
                begin += size
        if size == 1:
            return
        size //= 2


def _make_usual(schedule: SimulationSchedule, holds: _Holds) -> None:
    """Give each value of the run the one that it has by default, where that changes nothing."""
    run, faults = schedule.run, schedule.faults
    for field in msgspec.structs.fields(RunSettings):
        if getattr(run, field.name) == field.default:
            continue
        usual = msgspec.structs.replace(run, **{field.name: field.default})
        named = {getattr(fault, "service", None) for fault in faults}
        if field.name == "replicas" and not named <= {None, "local", *usual.services}:
            continue
        if holds(usual, faults):
            run = usual
