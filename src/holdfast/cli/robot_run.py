"""``holdfast run`` as a robot does it: step by step, journalled, with services that may die."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from holdfast.cli.run_options import RunOptions
    from holdfast.config.loader import Configuration
    from holdfast.planning.outcome import TrialResult
    from holdfast.recording.run_directory import RunDirectory
    from holdfast.robot.environment_maker import EnvironmentMaker
    from holdfast.runtime.events import EventSink
    from holdfast.runtime.service_manager import ServiceManager

__all__ = ["RobotFindings", "is_robot_run", "run_as_robot"]


class RobotFindings:
    """An event sink, for what a robot's run finds besides its results.

    Attributes
    ----------
    missed_ticks : int
        Ticks of ``--rate`` that came late.
    refusals : dict of str
        Why a service was given up, by its name.
    unreachable : dict of str
        Why a service could not be reached the last time, by its name.
    """

    def __init__(self, on_first_hold: Callable[[], None] = lambda: None) -> None:
        self._on_hold: Callable[[], None] | None = on_first_hold
        self.missed_ticks = 0
        self.refusals: dict[str, str] = {}
        self.unreachable: dict[str, str] = {}

    def event(self, name: str, /, **fields: object) -> None:
        """Take an event."""
        if name == "refused" and fields["final"]:
            self.refusals[str(fields["service"])] = f"{fields['code']}: {fields['reason']}"
        elif name == "unreachable":
            self.unreachable[str(fields["service"])] = str(fields["reason"])
        elif name == "holding" and self._on_hold is not None:
            self._on_hold()
            self._on_hold = None

    def close(self) -> None:
        """Do nothing."""


def is_robot_run(options: RunOptions, configuration: Configuration) -> bool:
    """Return whether a run needs more than a batch of simulated trials does."""
    return (
        bool(configuration.offload.services)
        or configuration.environment.object is not None
        or options.rate is not None
        or options.view_target() is not None
    )


def run_as_robot(
    options: RunOptions,
    configuration: Configuration,
    directory: RunDirectory,
    maker: EnvironmentMaker,
    on_result: Callable[[TrialResult], None],
    manager: ServiceManager,
    note: Callable[[str], None],
) -> RobotFindings:
    """Run the missing trials one after another.

    Raises
    ------
    HoldfastError
        If the robot holds still and cannot go on.
    """
    from holdfast.recording.robot_run import perform_trials
    from holdfast.robot.health import RobotWatch
    from holdfast.runtime.logs import EventLog

    def hint() -> None:
        if configuration.recovery.launch == "never":
            note(
                "the robot goes on when a service answers; with --recovery on_failure "
                "(recovery.launch) it launches a local service that decides meanwhile"
            )

    view = None
    if (target := options.view_target()) is not None:
        from holdfast.recording.live_view import LiveView

        view = LiveView(configuration, target, note)
    findings = RobotFindings(hint)
    sinks: list[EventSink] = [findings]
    if not options.quiet:
        sinks.insert(0, EventLog(sys.stderr, format=options.log, component="robot"))
    findings.missed_ticks = perform_trials(
        configuration,
        directory,
        maker,
        on_result,
        rate_hz=options.rate,
        sinks=sinks,
        after_reboot=options.after_reboot,
        watch=lambda events: RobotWatch(manager, options.health, options.metrics, events),
        view=view,
    )
    return findings
