"""How long reactions took, from what the processes wrote: pure functions of lists of times.

All processes are on one machine, so all times are of one clock. Each fault has up to four times.
*Detection*: from the fault until the robot logs a loss. *Recovery*: from the fault until the robot
carries out a decision of another service. *Launch*: from the start of the local service until the
robot sees it. *Failback*: from the moment at which the target can be used again until the robot
carries out a decision of it.

A fault that the robot does not notice has none of them: a service that was not needed while it was
stopped has cost nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from holdfast.protocol.status import Status
from holdfast.robot.links import RECOVERY_SERVICE
from holdfast_lab.testbed.records import Decision, LogEvent, of_services

ROBOT = "robot"
"""The target of faults of the robot's own process; others are named by their endpoints."""

_LOST = ("service_vanished", "service_suspected")


class InjectedFault(msgspec.Struct, kw_only=True):
    """A fault as it happened; times in seconds since the epoch."""

    kind: str
    target: str  # its process or line, as the robot names it
    injected_at: float
    # Since when the target could be used again; None if that was not seen.
    usable_at: float | None = None


class FaultTimes(msgspec.Struct, frozen=True, kw_only=True):
    """The times of a fault, in milliseconds; None where there is nothing to measure."""

    kind: str
    target: str
    away_ms: float | None  # from the fault until the target could be used again
    in_use: bool  # whether the target made the robot's last decision before the fault
    # See the module.
    detection_ms: float | None
    recovery_ms: float | None
    launch_ms: float | None
    failback_ms: float | None
    # Longest time that the robot stood still for a decision, until it used the target again.
    longest_wait_ms: float | None


def times_of_faults(
    faults: Sequence[InjectedFault], log: Sequence[LogEvent], decisions: Sequence[Decision]
) -> list[FaultTimes]:
    """Return the times of each fault of a run."""
    return [
        _times_of(fault, _end_of(fault, faults[index + 1 :]), log, decisions)
        for index, fault in enumerate(faults)
    ]


def _end_of(fault: InjectedFault, later: Sequence[InjectedFault]) -> float:
    """Return until when events are due to a fault."""
    ends = (
        other.injected_at
        for other in later
        if fault.target == ROBOT or other.target in (fault.target, ROBOT)
    )
    return min(ends, default=math.inf)


def _times_of(
    fault: InjectedFault, until: float, log: Sequence[LogEvent], decisions: Sequence[Decision]
) -> FaultTimes:
    if fault.target != ROBOT:
        decisions = of_services(decisions)
    before = [each for each in decisions if each.at <= fault.injected_at]
    after = [each for each in decisions if fault.injected_at < each.at < until]
    events = [each for each in log if fault.injected_at <= each.at < until]
    in_use = fault.target == ROBOT or (bool(before) and before[-1].service == fault.target)
    usable_at = fault.usable_at
    detected_at = recovered_at = used_again_at = None
    recovered_from = fault.injected_at
    if fault.target == ROBOT:
        # No event reports it. A robot that was stopped recovers as soon as it is resumed.
        recovered_at = _first_at(after, usable_at)
        if fault.kind == "robot_stopped" and usable_at is not None:
            recovered_from = usable_at
    else:
        detected_at = _detection(fault, events, in_use=in_use)
        if in_use and detected_at is not None:
            launched_again_at = None
            if fault.target == RECOVERY_SERVICE:
                launched_again_at = next((e.at for e in events if e.name == "launched"), None)
            recovered_at = _first_at(
                (
                    each
                    for each in after
                    if each.service != fault.target
                    or (launched_again_at is not None and each.at >= launched_again_at)
                ),
                fault.injected_at,
            )
            if fault.target != RECOVERY_SERVICE:
                used_again_at = _first_at(
                    (each for each in after if each.service == fault.target), usable_at
                )
    launch = next((each for each in events if each.name == "launched"), None)
    ends_at = used_again_at or recovered_at or until
    waits = [each.waited_ms for each in after if each.at <= ends_at]
    return FaultTimes(
        kind=fault.kind,
        target=fault.target,
        away_ms=_milliseconds(fault.injected_at, usable_at),
        in_use=in_use,
        detection_ms=_milliseconds(fault.injected_at, detected_at),
        recovery_ms=_milliseconds(recovered_from, recovered_at),
        launch_ms=None if launch is None else float(launch.fields["launch_ms"]),
        failback_ms=None if usable_at is None else _milliseconds(usable_at, used_again_at),
        longest_wait_ms=max(waits, default=None),
    )


def _detection(fault: InjectedFault, events: Sequence[LogEvent], *, in_use: bool) -> float | None:
    for each in events:
        lost = each.name in _LOST and each.fields.get("service") == fault.target
        left = in_use and each.name == "status" and each.fields["to"] == Status.LOCAL_RECOVERY.value
        ended = fault.target == RECOVERY_SERVICE and each.name == "recovery_exited"
        if lost or left or ended:
            return each.at
    return None


def _first_at(decisions: Iterable[Decision], since: float | None) -> float | None:
    if since is None:
        return None
    return next((each.at for each in decisions if each.at >= since), None)


def _milliseconds(since: float, until: float | None) -> float | None:
    return None if until is None else round(1e3 * (until - since), 3)


class Spread(msgspec.Struct, frozen=True, kw_only=True):
    """Some times together."""

    count: int
    median_ms: float
    p95_ms: float
    max_ms: float


def spread_of(times_ms: Sequence[float]) -> Spread | None:
    """Return median, 95th percentile and maximum; None if there are no times."""
    if not times_ms:
        return None
    median_ms, p95_ms, max_ms = map(float, np.percentile(times_ms, (50.0, 95.0, 100.0)))
    return Spread(count=len(times_ms), median_ms=median_ms, p95_ms=p95_ms, max_ms=max_ms)
