"""The trials of a run as a robot performs them, step by step and journalled.

The command and the node of ROS both call :func:`perform_trials`. It opens the links to the services
and the run's logs, runs the robot's process, and closes all of them again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from holdfast.journal.run_clock import read_clocks
from holdfast.journal.run_directory import (
    EVENTS_NAME,
    RECOVERY_LOG_NAME,
    TIMINGS_NAME,
    VERIFICATION_NAME,
)
from holdfast.journal.timings import EventTable, count_verified
from holdfast.protocol.robot_events import Timing, VerificationNoted
from holdfast.robot.links import make_links
from holdfast.robot.process import RobotProcess
from holdfast.runtime.events import BoundedEventLog
from holdfast.runtime.logs import EventLog

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.journal.run_directory import RunDirectory
    from holdfast.planning.outcome import TrialResult
    from holdfast.planning.planner import PlanningState
    from holdfast.protocol.robot_events import Act, Sense
    from holdfast.robot.environment_maker import EnvironmentMaker
    from holdfast.robot.health import RobotWatch
    from holdfast.runtime.events import EventSink


class RobotObserver(NamedTuple):
    """Callbacks on the robot's event loop, so each must return at once."""

    process: Callable[[RobotProcess], None]  # before it runs
    order: Callable[[PlanningState, Act | Sense], None]  # with the state in which it was decided
    timing: Callable[[Timing], None]  # of each decision, before the order that comes of it


class _StampedLog:
    """Writes with each event how long the machine has been up: its wall clock may be set."""

    def __init__(self, path: Path) -> None:
        self._now_ns = 0
        self._log = EventLog(path, format="json", component="robot", clock=lambda: self._now_ns)
        self.close = self._log.close

    def event(self, name: str, /, **fields: object) -> None:
        """Write an event."""
        self._now_ns, stamp = read_clocks()
        # First, for the end of a line that is too long is cut off.
        own = {"boot": stamp.boot, "uptime_s": float(stamp.uptime_s)}
        self._log.event(name, **{**own, **fields})


def perform_trials(
    configuration: Configuration,
    directory: RunDirectory,
    maker: EnvironmentMaker,
    on_result: Callable[[TrialResult], None],
    *,
    rate_hz: float | None,
    sinks: Sequence[EventSink],
    after_reboot: bool = False,
    watch: Callable[[EventSink], RobotWatch] | None = None,
    observer: RobotObserver | None = None,
    view: contextlib.AbstractContextManager[object] | None = None,
) -> int:
    """Run the missing trials one after another; return how many ticks of the rate were missed.

    The ``sinks`` get the events, besides the run's own log, and are closed at the end; so is the
    ``view``, which shows the run while it goes on. ``after_reboot`` says that a person lets the
    run go on although the machine was rebooted; RebootedError if nobody does. HoldfastError if the
    robot holds still and cannot go on.
    """
    if len(directory.journal.finished()) < configuration.simulator.num_trials:
        directory.allow_robot(after_reboot=after_reboot)
    with contextlib.ExitStack() as stack:
        log = _StampedLog(directory.path / EVENTS_NAME)
        if view is not None:
            stack.enter_context(view)  # it is left when all is written
        events = BoundedEventLog(log, *sinks)
        stack.callback(events.close)
        if directory.before_upgrade is not None:
            events.event("version_changed", reason=directory.before_upgrade.in_words())
        links = make_links(configuration, directory.path / RECOVERY_LOG_NAME, events)
        timings = EventTable(directory.path / TIMINGS_NAME, Timing)
        stack.callback(timings.close)
        earlier = verification = None
        if configuration.offload.services:  # else there is nothing to verify, and no table
            earlier = count_verified(directory.path / VERIFICATION_NAME)
            verification = EventTable(directory.path / VERIFICATION_NAME, VerificationNoted)
            stack.callback(verification.close)

        def on_timing(timing: Timing) -> None:
            timings.add(timing)
            if observer is not None:
                observer.timing(timing)

        robot = RobotProcess(
            configuration,
            links,
            directory.journal,
            maker,
            events,
            on_result,
            on_timing,
            (lambda _: None) if verification is None else verification.add,
            rate_hz,
            () if earlier is None else earlier.wrong_answers,
            watch=None if watch is None else watch(events),
            on_order=None if observer is None else observer.order,
        )
        if observer is not None:
            observer.process(robot)
        robot.run(directory.journal.finished())
        return robot.robot.missed_ticks
