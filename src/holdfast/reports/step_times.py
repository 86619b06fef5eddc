"""When each moment of a recorded run was, on one clock.

The clock is the robot's, where the run was recorded with times (``timings.csv``, ``events.jsonl``);
moments between two recorded times are spread evenly. Else every step takes the same time.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from holdfast.errors import OutputError
from holdfast.journal.run_clock import RunClock, Stamp
from holdfast.journal.run_directory import EVENTS_NAME, TIMINGS_NAME
from holdfast.journal.timings import TimingRow, nanoseconds, rows_by_trial
from holdfast.numerics.arrays import IntArray
from holdfast.protocol.robot_events import Timing
from holdfast.reports.facts import EventFact
from holdfast.runtime.files import bounded_lines

NS_PER_S = 1_000_000_000

UNTIMED_STEP_S = 0.1
"""How long a step takes in a run that was recorded without times."""

MOMENTS = 4
"""Sensing action decided, observed, task action decided, and before the next step."""

_LEAST_GAP_NS = 1_000
"""Between two moments of a trial, so that their order shows."""

_FIRST_NS = NS_PER_S
"""When a run without recorded times begins: for ROS, time 0 means that there is no time."""


class TrialTimes(NamedTuple):
    """When the moments of a trial were, and who decided, by step and kind."""

    times_ns: IntArray
    deciders: Mapping[tuple[int, str], Timing]

    def at(self, step: int, moment: int) -> int:
        """Return the time of a moment of a step, in nanoseconds."""
        return int(self.times_ns[MOMENTS * step + moment])


class StepClock:
    """Assigns times to the moments of one trial after the other; they only grow."""

    def __init__(self, period_ns: int = round(UNTIMED_STEP_S * NS_PER_S)) -> None:
        self._period_ns = period_ns
        self._last_ns = _FIRST_NS - self._period_ns

    def next_trial(
        self, steps: int, rows: Mapping[tuple[int, str], TimingRow], end_ns: int | None
    ) -> IntArray:
        """Return the times of all moments of a trial and of its end, in nanoseconds."""
        count = MOMENTS * (steps + 1)
        part_ns = self._period_ns / MOMENTS
        known = [
            (MOMENTS * step + (0 if kind == "sensing" else 2), row.time_ns)
            for (step, kind), row in rows.items()
            if kind in ("sensing", "task") and step <= steps
        ]
        if end_ns is not None:
            known.append((MOMENTS * steps, end_ns))
        anchors: list[tuple[int, int]] = []
        for moment, time_ns in sorted(known):
            # A clock that was set back is not followed.
            last_ns = anchors[-1][1] if anchors else self._last_ns
            if time_ns > last_ns and (not anchors or moment > anchors[-1][0]):
                anchors.append((moment, time_ns))
        if not anchors:
            anchors = [(0, self._last_ns + self._period_ns)]
        moments = np.array([moment for moment, _ in anchors], dtype=np.float64)
        origin = anchors[0][1]
        # From the first anchor on, because a double has no room for nanoseconds since 1970.
        since = np.array([time_ns - origin for _, time_ns in anchors], dtype=np.float64)
        positions = np.arange(count, dtype=np.float64)
        offsets = np.interp(positions, moments, since)
        early, late = positions < moments[0], positions > moments[-1]
        offsets[early] = (positions[early] - moments[0]) * part_ns
        offsets[late] = since[-1] + (positions[late] - moments[-1]) * part_ns
        times = origin + np.rint(offsets).astype(np.int64)
        floor = self._last_ns + _LEAST_GAP_NS * (1 + np.arange(count))
        # Each at least the least gap after the one before it.
        ramp = _LEAST_GAP_NS * np.arange(count)
        times = np.maximum.accumulate(np.maximum(times, floor) - ramp) + ramp
        self._last_ns = int(times[MOMENTS * steps])
        return np.asarray(times, dtype=np.int64)


class RunTimes(NamedTuple):
    """What a run has recorded of its times, on one clock: rows of decisions, by trial, and events.

    ``notes`` say how the robot's wall clock was set meanwhile.
    """

    rows: dict[int, dict[tuple[int, str], TimingRow]]
    events: list[EventFact]
    notes: tuple[str, ...]


def read_times(directory: Path) -> RunTimes:
    """Return what the directory of a run has of times; OutputError if it cannot be read."""
    rows = rows_by_trial(directory / TIMINGS_NAME)
    events = read_events(directory / EVENTS_NAME)
    clock = RunClock(
        [(event.stamp, event.time_ns) for event in events]
        + [(row.stamp, row.time_ns) for each in rows.values() for row in each.values()]
    )
    on_clock = {
        trial: {
            key: row._replace(time_ns=clock.time_ns(row.stamp, row.time_ns))
            for key, row in each.items()
        }
        for trial, each in rows.items()
    }
    return RunTimes(on_clock, dated(events, clock), clock.notes)


def read_events(path: Path) -> list[EventFact]:
    """Return the lines of ``events.jsonl`` as they are there, with the wall clock's times."""
    try:
        return events_of(bounded_lines(path))
    except FileNotFoundError:
        return []
    except OSError as error:
        raise OutputError(f"{path}: cannot be read: {error.strerror}") from error


def events_of(lines: Iterable[str]) -> list[EventFact]:
    """Return what lines of ``events.jsonl`` say."""
    events = []
    for line in lines:
        try:
            fields = json.loads(line)
            moment, name = fields.pop("time"), fields.pop("event")
            stamp = Stamp.of(fields.pop("boot", None), fields.pop("uptime_s", None))
            events.append(EventFact(nanoseconds(moment), str(name), fields, stamp))
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            continue  # a line that a power cut has corrupted
    return events


def dated(events: Iterable[EventFact], clock: RunClock) -> list[EventFact]:
    """Return events in the order of their times by a run's clock."""
    found = [event._replace(time_ns=clock.time_ns(event.stamp, event.time_ns)) for event in events]
    return sorted(found, key=lambda event: event.time_ns)


def trial_ends(events: Sequence[EventFact]) -> dict[int, int]:
    """Return when each trial ended, in nanoseconds."""
    ends = {}
    for event in events:
        trial = event.fields.get("trial")
        if event.name == "trial" and isinstance(trial, int):
            ends[trial] = event.time_ns
    return ends
