"""``holdfast run`` as a robot does it: step by step, journalled, with services that may die."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from holdfast.cli.run import RunOptions
    from holdfast.config.loader import Configuration
    from holdfast.outcome import TrialResult
    from holdfast.recording.run_directory import RunDirectory
    from holdfast.robot.environment import EnvironmentMaker
    from holdfast.runtime.events import EventSink
    from holdfast.runtime.service_manager import ServiceManager

__all__ = ["RobotRun", "is_robot_run", "run_as_robot"]


class RobotRun(NamedTuple):
    """Findings of a robot's run besides its results.

    Attributes
    ----------
    missed_ticks : int
        Ticks of ``--rate`` that came late.
    refusals : dict of str
        Why a service was given up, by its name.
    unreachable : dict of str
        Why a service could not be reached the last time, by its name.
    """

    missed_ticks: int = 0
    refusals: Mapping[str, str] = {}
    unreachable: Mapping[str, str] = {}


class _Reasons:
    """An event sink that remembers which services refused for good or could not be reached."""

    def __init__(self, on_first_hold: Callable[[], None]) -> None:
        self._on_hold: Callable[[], None] | None = on_first_hold
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


def is_robot_run(configuration: Configuration, rate_hz: float | None) -> bool:
    """Return whether a run needs more than a batch of simulated trials does."""
    return (
        bool(configuration.offload.services)
        or configuration.environment.object is not None
        or rate_hz is not None
    )


def run_as_robot(
    options: RunOptions,
    configuration: Configuration,
    directory: RunDirectory,
    maker: EnvironmentMaker,
    on_result: Callable[[TrialResult], None],
    manager: ServiceManager,
    note: Callable[[str], None],
) -> RobotRun:
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

    reasons = _Reasons(hint)
    sinks: list[EventSink] = []
    if not options.quiet:
        sinks.append(EventLog(sys.stderr, format=options.log, component="robot"))
    sinks.append(reasons)
    missed_ticks = perform_trials(
        configuration,
        directory,
        maker,
        on_result,
        rate_hz=options.rate,
        sinks=sinks,
        watch=lambda events: RobotWatch(manager, options.health, events),
    )
    return RobotRun(missed_ticks, reasons.refusals, reasons.unreachable)
