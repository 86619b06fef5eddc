"""What can go wrong in the laboratory, as types."""

from __future__ import annotations

from holdfast.errors import HoldfastError


class CancelledTrialError(HoldfastError):
    """A trial was given up because the series is."""


class SimulationError(HoldfastError):
    """The seeds cannot be run."""


class ScheduleError(HoldfastError):
    """Text that is no schedule."""


class Violation(Exception):  # noqa: N818 - it is what was looked for, not an error of the simulator
    """What must never happen has happened."""


class CannotStartError(HoldfastError):
    """A process cannot be started."""


class ProcessEndedError(HoldfastError):
    """A process of the testbed has ended that should not."""


class NoProgressError(HoldfastError):
    """What a run on the testbed waits for has not happened in time."""
