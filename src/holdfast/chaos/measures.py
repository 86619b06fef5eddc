"""How long reactions took, from what the processes wrote: pure functions of lists of times.

Two clocks never meet here: all processes are on one machine and write its one clock. Of each fault
four times are of interest. *Detection*: from the fault until the robot says that it has lost
something. *Recovery*: from the fault until the robot carries out a decision that somebody else
made. *Launch*: from the start of the local service until the robot sees it. *Failback*: from the
moment at which what was struck can be used again until the robot carries out a decision of it.

A fault that was not noticed has none of them, and that is no mistake: a service that was not needed
while it stood still has cost nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import msgspec

from holdfast.chaos.processes import Decision, time_of
from holdfast.runtime.links import RECOVERY_SERVICE
from holdfast.session.status import Status

__all__ = [
    "ROBOT",
    "FaultTimes",
    "Spread",
    "Strike",
    "Told",
    "spread_of",
    "times_of_strikes",
    "told_of",
]

ROBOT = "robot"
"""The target of what strikes the robot's own process; others are named as the robot names them."""

_LOST = ("service_vanished", "service_suspected")


class Told(NamedTuple):
    """An event of the robot's."""

    at: float
    name: str
    fields: Mapping[str, Any]


def told_of(line: str) -> Told | None:
    """Return the event that a line of a process's log in JSON is; None if it is none."""
    if not line.startswith("{"):
        return None
    try:
        event = msgspec.json.decode(line, type=dict[str, Any])
        return Told(time_of(event["time"]), str(event["event"]), event)
    except (msgspec.DecodeError, KeyError, TypeError, ValueError):
        return None


class Strike(msgspec.Struct, kw_only=True):
    """A fault as it happened; times in seconds since the epoch.

    Attributes
    ----------
    kind : str
    target : str
        What was struck, as the robot names it.
    struck_at : float
    usable_at : float or None
        From when on what was struck could be used again; None if that was not seen.
    """

    kind: str
    target: str
    struck_at: float
    usable_at: float | None = None


class FaultTimes(msgspec.Struct, frozen=True, kw_only=True):
    """What a fault came to; times in milliseconds, None where there is nothing to be measured.

    Attributes
    ----------
    kind, target : str
    away_ms : float or None
        From the fault until what was struck could be used again.
    in_use : bool
        Whether the robot's last decision before was made by what was struck.
    detection_ms, recovery_ms, launch_ms, failback_ms : float or None
        See the module.
    longest_wait_ms : float or None
        Longest time that the robot stood still for a decision, until it used again what was struck.
    """

    kind: str
    target: str
    away_ms: float | None
    in_use: bool
    detection_ms: float | None
    recovery_ms: float | None
    launch_ms: float | None
    failback_ms: float | None
    longest_wait_ms: float | None


def times_of_strikes(
    strikes: Sequence[Strike], told: Sequence[Told], decisions: Sequence[Decision]
) -> list[FaultTimes]:
    """Return what each fault of a run came to.

    Parameters
    ----------
    strikes : sequence of Strike
        In order of time.
    told : sequence of Told
        All events of the robot.
    decisions : sequence of Decision
        The robot's table.
    """
    return [
        _times_of(strike, _end_of(strike, strikes[index + 1 :]), told, decisions)
        for index, strike in enumerate(strikes)
    ]


def _end_of(strike: Strike, later: Sequence[Strike]) -> float:
    """Return until when what happens is due to a fault."""
    ends = (
        other.struck_at
        for other in later
        if strike.target == ROBOT or other.target in (strike.target, ROBOT)
    )
    return min(ends, default=math.inf)


def _times_of(
    strike: Strike, until: float, told: Sequence[Told], decisions: Sequence[Decision]
) -> FaultTimes:
    before = [each for each in decisions if each.at <= strike.struck_at]
    after = [each for each in decisions if strike.struck_at < each.at < until]
    events = [each for each in told if strike.struck_at <= each.at < until]
    in_use = strike.target == ROBOT or (bool(before) and before[-1].service == strike.target)
    usable_at = strike.usable_at
    detected_at = recovered_at = used_again_at = None
    recovered_from = strike.struck_at
    if strike.target == ROBOT:
        # Nobody tells of it; it recovers by itself, and a robot that stood still does at once.
        recovered_at = _first_at(after, usable_at)
        if strike.kind == "robot_stopped" and usable_at is not None:
            recovered_from = usable_at
    else:
        detected_at = _detection(strike, events, in_use=in_use)
        if in_use and detected_at is not None:
            launched_again_at = None
            if strike.target == RECOVERY_SERVICE:
                launched_again_at = next((e.at for e in events if e.name == "launched"), None)
            recovered_at = _first_at(
                (
                    each
                    for each in after
                    if each.service != strike.target
                    or (launched_again_at is not None and each.at >= launched_again_at)
                ),
                strike.struck_at,
            )
            if strike.target != RECOVERY_SERVICE:
                used_again_at = _first_at(
                    (each for each in after if each.service == strike.target), usable_at
                )
    launch = next((each for each in events if each.name == "launched"), None)
    ends_at = used_again_at or recovered_at or until
    waits = [each.waited_ms for each in after if each.at <= ends_at]
    return FaultTimes(
        kind=strike.kind,
        target=strike.target,
        away_ms=_milliseconds(strike.struck_at, usable_at),
        in_use=in_use,
        detection_ms=_milliseconds(strike.struck_at, detected_at),
        recovery_ms=_milliseconds(recovered_from, recovered_at),
        launch_ms=None if launch is None else float(launch.fields["launch_ms"]),
        failback_ms=None if usable_at is None else _milliseconds(usable_at, used_again_at),
        longest_wait_ms=max(waits, default=None),
    )


def _detection(strike: Strike, events: Sequence[Told], *, in_use: bool) -> float | None:
    for each in events:
        lost = each.name in _LOST and each.fields.get("service") == strike.target
        left = in_use and each.name == "status" and each.fields["to"] == Status.LOCAL_RECOVERY.value
        ended = strike.target == RECOVERY_SERVICE and each.name == "recovery_exited"
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
    """Some times together.

    Attributes
    ----------
    count : int
    median_ms, p95_ms, max_ms : float
    """

    count: int
    median_ms: float
    p95_ms: float
    max_ms: float


def spread_of(times_ms: Sequence[float]) -> Spread | None:
    """Return median, 95th percentile and maximum; None if there are no times."""
    if not times_ms:
        return None
    ordered = sorted(times_ms)
    return Spread(
        count=len(ordered),
        median_ms=_quantile(ordered, 0.5),
        p95_ms=_quantile(ordered, 0.95),
        max_ms=ordered[-1],
    )


def _quantile(ordered: Sequence[float], share: float) -> float:
    """Interpolate between the two nearest of ordered values."""
    place = share * (len(ordered) - 1)
    below = math.floor(place)
    above = min(below + 1, len(ordered) - 1)
    return ordered[below] + (place - below) * (ordered[above] - ordered[below])
