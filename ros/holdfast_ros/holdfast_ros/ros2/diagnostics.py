"""The robot's state for ``/diagnostics``, with a level.

Holding still is not an error at first. When the only service dies, the robot holds still while its
local service starts, and then continues: a warning. It is an error once that start fails, takes
longer than the settings allow, or no local service may be started.
"""

from __future__ import annotations

import enum
from collections.abc import Callable
from time import monotonic
from typing import NamedTuple

from holdfast.planning.settings import RecoverySettings
from holdfast.protocol.status import Status
from holdfast_ros.ros2.run_segment import Ending, RunSegment, SegmentResult
from holdfast_ros.ros2.telemetry import Telemetry

_HOLDING = "holding still"
_ALARMS = ("lost", "sensor_suspect", "wrong_answer")


Level = enum.IntEnum("Level", ["OK", "WARN", "ERROR"], start=0)  # as ROS counts


class RobotDiagnosis(NamedTuple):
    """A robot's state for ``/diagnostics``: its condition in a word, and facts by key."""

    level: Level
    word: str
    facts: dict[str, str]


class Diagnostics:
    """Follows the segments of one run."""

    def __init__(self, recovery: RecoverySettings, clock: Callable[[], float] = monotonic) -> None:
        self._may_launch = recovery.launch != "never"
        self._launch_s = 1e-3 * recovery.launch_timeout_ms
        self._clock = clock
        self._holding_since: float | None = None
        self._launch_failed = False
        self._status = ""
        self._finished: int | str = ""
        self._alarms: set[str] = set()

    def event(self, name: str) -> None:
        """Take note of an event of the robot's, from its thread."""
        if name in _ALARMS:
            self._alarms.add(name)
        elif name in ("reinitialised", "trial"):
            # The belief is a new one. A service that has answered wrongly is asked no more.
            self._alarms &= {"wrong_answer"}
        elif name == "holding":
            self._holding_since = self._clock()
            self._launch_failed = False
        elif name == "resumed":
            self._holding_since = None
        elif name in ("launch_failed", "recovery_exited"):
            self._launch_failed = True

    def tell(
        self, segment: RunSegment | None, last: SegmentResult | None, telemetry: Telemetry | None
    ) -> RobotDiagnosis:
        """Return the diagnosis, by the running segment, the last result and the last telemetry."""
        condition = None if segment is None else segment.condition()
        level = Level.OK
        if condition is not None:
            word = condition.word
            if word == _HOLDING:
                level = self._level_of_holding()
            elif word == Status.LOCAL_RECOVERY.value or self._alarms:
                level = Level.WARN
        elif last is not None and segment is None:
            word = last.ending.name.lower()
            level = Level.ERROR if last.ending in (Ending.HELD, Ending.FAILED) else Level.OK
        else:
            word = "idle" if segment is None else "starting"
        if (part := segment or last) is not None:
            # Until the next segment has a status, the last known one is shown.
            self._status = part.status or self._status
            self._finished = part.num_finished
        trial = None if condition is None else condition.trial
        facts = {
            "status": self._status,
            # Who decided before the status changed does so no more.
            "decided_by": "" if telemetry is None else telemetry.decided_in(self._status),
            "holding": str(word == _HOLDING).lower(),
            "trial": "" if trial is None else trial,
            "finished_trials": self._finished,
            "unexplained_observations": 0 if segment is None else segment.unexplained_observations,
            **{name: str(name in self._alarms).lower() for name in _ALARMS},
            "decisions_not_published": 0 if telemetry is None else telemetry.dropped_decisions,
            "last_error": "" if last is None or level != Level.ERROR else last.message[:500],
        }
        return RobotDiagnosis(level, word, {key: str(value) for key, value in facts.items()})

    def _level_of_holding(self) -> Level:
        since = self._holding_since
        held_s = 0.0 if since is None else self._clock() - since
        is_launching = self._may_launch and not self._launch_failed and held_s <= self._launch_s
        return Level.WARN if is_launching else Level.ERROR
