"""When the local service is launched, launched again, and asked as well as the cloud.

It is first launched when it is wanted. It may then fail to come up, exit or hang. The next launch
follows at once the first time, since most failures are transient, and after a growing delay later.
An answer, or a sufficiently long life, resets the failures.

A process that was not seen in time may hang, or its machine may be busy. Replacing it discards its
progress, so each later launch gets more time; else it would never come up on a slow machine.
"""

from __future__ import annotations

from holdfast.planning.settings import OffloadSettings, RecoverySettings

_HEDGING_BURST = 3.0
"""Hedges that may be made at once."""

_LONG_LIFE_S = 1.0
"""A process that lived longer after it appeared did not fail at its start."""

_MOST_TIME = 8
"""Largest factor by which a later launch may take longer than the first."""


class RestartPolicy:
    """Decides when the local service's process is (re)started."""

    def __init__(self, settings: RecoverySettings) -> None:
        self._timeout_s = 1e-3 * settings.launch_timeout_ms
        self._pause_s = 1e-3 * settings.relaunch_delay_ms
        self._launched_at: float | None = None
        self._appeared_at: float | None = None
        self._launch_after: float | None = None
        self._failures = 0
        self._late = 0
        self.number = 0  # of the last launch; 0 before the first

    @property
    def pending(self) -> bool:
        """Whether the next launch is scheduled."""
        return self._launch_after is not None

    def want(self, now: float) -> None:
        """Schedule the first launch."""
        if self._launch_after is None and self._launched_at is None:
            self._launch_after = now

    def is_due(self, now: float) -> bool:
        """Return whether the launch is due."""
        return self._launch_after is not None and self._launch_after <= now

    def begin(self, now: float) -> int:
        """Note a launch; return its number."""
        self._launch_after = None
        self._launched_at = now
        self._appeared_at = None
        self.number += 1
        return self.number

    def appeared(self, now: float) -> float | None:
        """Note that its process can be asked; return the time since the launch, if any."""
        self._appeared_at = now
        return None if self._launched_at is None else now - self._launched_at

    def overdue_launch_age_s(self, now: float, *, present: bool) -> float | None:
        """Return the time since a launch that should be visible by now; None if none is overdue."""
        if self._launched_at is None or self._launch_after is not None or present:
            return None
        # The same sum as in next_wakeup: the difference may be rounded to less than the limit.
        return now - self._launched_at if now >= self._launched_at + self._allowed_s else None

    def failed(self, now: float, *, late: bool = False) -> None:
        """Schedule another launch: at once the first time, then after growing delays.

        After one that was not seen in time (``late``) the next one gets more time.
        """
        self._late += late
        if self._launch_after is not None:
            return
        factor = min(2 ** max(0, self._failures - 1), 32)
        self._launch_after = now + (0.0 if self._failures == 0 else self._pause_s * factor)
        self._failures += 1

    def ended(self, now: float) -> None:
        """Note the end of the process."""
        if self._appeared_at is not None and now - self._appeared_at > _LONG_LIFE_S:
            self.succeeded()
        self.failed(now)

    def succeeded(self) -> None:
        """Note an answer: the process is not to be replaced."""
        self._failures = 0
        self._late = 0
        self._launch_after = None

    def next_wakeup(self, *, present: bool) -> float | None:
        """Return when something is due; None if nothing is."""
        if self._launch_after is not None:
            return self._launch_after
        if self._launched_at is not None and not present:
            return self._launched_at + self._allowed_s
        return None

    @property
    def _allowed_s(self) -> float:
        factor: int = min(2**self._late, _MOST_TIME)
        return self._timeout_s * factor


class HedgingBudget:
    """Decides when a late question is sent to the local service as well, and bounds how often.

    Both services give the same answer, so hedging costs only computation. Each question adds a
    share of a hedge to the budget and each hedge takes one, so in the long run at most that share
    of the questions is asked twice.
    """

    def __init__(self, settings: OffloadSettings) -> None:
        self._deadline_ms = settings.decision_deadline_ms
        self._share = settings.max_hedged_share
        self._budget = _HEDGING_BURST

    def earn(self) -> None:
        """Count a new question."""
        self._budget = min(_HEDGING_BURST, self._budget + self._share)

    def spend(self) -> None:
        """Count a hedge."""
        self._budget -= 1.0

    def due_at(self, needed_at: float | None) -> float | None:
        """Return when a question is late; None if it is not awaited, or nothing is left."""
        if self._deadline_ms is None or needed_at is None or self._budget < 1.0:
            return None
        return needed_at + 1e-3 * self._deadline_ms
