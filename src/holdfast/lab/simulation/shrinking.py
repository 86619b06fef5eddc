"""From a schedule under which something goes wrong to a smaller one under which it still does.

A drawn schedule has dozens of faults, and most of them have nothing to do with what went wrong.
First faults are left out, in ever smaller groups (delta debugging; Zeller and Hildebrandt, IEEE
Transactions on Software Engineering 28, 2002). Then what is unusual about the run itself is made
usual, value by value.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec

from holdfast.lab.simulation.schedule import RunSettings, SimulatedFault, SimulationSchedule

__all__ = ["shrink"]

_MAX_RUNS = 2000


class _BudgetSpentError(Exception):
    """Enough has been tried."""


def shrink(
    schedule: SimulationSchedule, fails: Callable[[SimulationSchedule], bool]
) -> SimulationSchedule:
    """Return a smaller schedule that fails as well; the same one if there is none.

    Ctrl-C, or 2,000 candidates, end the search with the smallest one so far.
    """
    smallest = schedule
    left = _MAX_RUNS

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


def _leave_out(
    schedule: SimulationSchedule, holds: Callable[[RunSettings, tuple[SimulatedFault, ...]], bool]
) -> None:
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


def _make_usual(
    schedule: SimulationSchedule, holds: Callable[[RunSettings, tuple[SimulatedFault, ...]], bool]
) -> None:
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
