"""The trials of a run as a robot performs them, step by step and journalled.

Whoever starts a robot, the command or a node of ROS, calls this one function. It joins the run's
directory, the links to the services and the robot's process, and closes all of them again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, NamedTuple

from holdfast.recording.run_directory import EVENTS_NAME, TIMINGS_NAME, VERIFICATION_NAME
from holdfast.recording.timings import TimingTable, VerificationTable, count_verified
from holdfast.runtime.links import make_links
from holdfast.runtime.logs import BoundedEventLog, EventLog, TeeEventLog
from holdfast.runtime.robot_process import RobotProcess

if TYPE_CHECKING:
    from holdfast.configuration import Configuration
    from holdfast.outcome import TrialResult
    from holdfast.planning import PlanningState
    from holdfast.recording.run_directory import RunDirectory
    from holdfast.runtime.environment import EnvironmentMaker
    from holdfast.runtime.logs import EventSink
    from holdfast.runtime.robot_watch import RobotWatch
    from holdfast.session.effects import Act, Sense, Timing, Verified

__all__ = ["RECOVERY_LOG_NAME", "Onlooker", "perform_trials"]

RECOVERY_LOG_NAME = "recovery.log"


class Onlooker(NamedTuple):
    """Who looks on while a robot runs; on its event loop, so each must return at once.

    Attributes
    ----------
    process : callable
        Gets the robot's process before it runs.
    order : callable
        Gets each order to the environment, and the state in which it was decided.
    timing : callable
        Gets the times of each decision, before the order that comes of it.
    """

    process: Callable[[RobotProcess], None]
    order: Callable[[PlanningState, Act | Sense], None]
    timing: Callable[[Timing], None]


def perform_trials(
    configuration: Configuration,
    directory: RunDirectory,
    maker: EnvironmentMaker,
    on_result: Callable[[TrialResult], None],
    *,
    rate_hz: float | None,
    sinks: Sequence[EventSink],
    watch: Callable[[EventSink], RobotWatch] | None = None,
    onlooker: Onlooker | None = None,
) -> int:
    """Run the missing trials one after another.

    Parameters
    ----------
    configuration : Configuration
    directory : RunDirectory
        Its journal keeps each step.
    maker : EnvironmentMaker
        Makes what the robot acts on.
    on_result : callable
        Gets each trial's result, and keeps it.
    rate_hz : float or None
        Task actions a second; None acts as soon as possible.
    sinks : sequence of EventSink
        Are told what happens, besides the run's own log; they are closed at the end.
    watch : callable or None
        Makes what tells others how the robot is doing, given where to tell of it.
    onlooker : Onlooker or None

    Returns
    -------
    int
        Ticks of the rate that were missed.

    Raises
    ------
    HoldfastError
        If the robot holds still and cannot go on.
    """
    with contextlib.ExitStack() as stack:
        # What is only for people on a terminal is kept in the file all the same.
        log = EventLog(directory.path / EVENTS_NAME, format="json", component="robot")
        events = BoundedEventLog(TeeEventLog(log, *sinks))
        stack.callback(events.close)
        links = make_links(configuration, directory.path / RECOVERY_LOG_NAME, events)
        stack.callback(links.close)
        timings = TimingTable(directory.path / TIMINGS_NAME)
        stack.callback(timings.close)
        on_verified: Callable[[Verified], None] = _ignore
        distrusted: Collection[str] = ()
        if configuration.offload.services:
            earlier = count_verified(directory.path / VERIFICATION_NAME)
            distrusted = () if earlier is None else earlier.wrong
            verification = VerificationTable(directory.path / VERIFICATION_NAME)
            stack.callback(verification.close)
            on_verified = verification.add

        def on_timing(timing: Timing) -> None:
            timings.add(timing)
            if onlooker is not None:
                onlooker.timing(timing)

        robot = RobotProcess(
            configuration,
            links.services,
            links.recovery,
            links.transport,
            directory.journal,
            maker,
            events,
            on_result,
            on_timing,
            on_verified,
            rate_hz,
            links.offload,
            distrusted,
            make_planner=links.make_planner,
            watch=None if watch is None else watch(events),
            on_order=None if onlooker is None else onlooker.order,
        )
        if onlooker is not None:
            onlooker.process(robot)
        launcher = None if links.launcher is None else links.launcher(robot.deliver)
        robot.run(directory.journal.finished(), launcher)
        return robot.missed_ticks


def _ignore(verified: Verified) -> None:
    """Do nothing: a robot that asks no service has nothing to verify."""
