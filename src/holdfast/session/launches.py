"""When the local service is started, and when it is started again.

It is not launched before it is wanted. Then it may not come up, or end, or hang: the next launch
follows at once the first time, for most failures happen once, and ever more rarely after that, for
one that has failed often is likely to fail again. An answer, or a life of some length, makes up for
all failures before.

One that was not seen in time may hang, or its machine may be so busy that it is only slow. To end
it then is to throw away all that it has done, so each time the next one is given more time; else no
local service would ever come up on such a machine.
"""

from __future__ import annotations

from holdfast.settings import RecoverySettings

__all__ = ["Launches"]

_LONG_LIFE_S = 1.0
"""A process that has lived for longer has not failed at its start."""

_MOST_TIME = 8
"""How many times as long as the first one a later launch may take."""


class Launches:
    """The launches of the local service.

    Parameters
    ----------
    settings : RecoverySettings

    Attributes
    ----------
    number : int
        Of the last launch; 0 if there was none.
    """

    def __init__(self, settings: RecoverySettings) -> None:
        self._timeout_s = 1e-3 * settings.launch_timeout_ms
        self._pause_s = 1e-3 * settings.relaunch_delay_ms
        self._launched_at: float | None = None
        self._launch_after: float | None = None
        self._failures = 0
        self._late = 0
        self.number = 0

    @property
    def pending(self) -> bool:
        """Whether the next launch is settled, if not yet due."""
        return self._launch_after is not None

    def want(self, now: float) -> None:
        """Launch it now if it was never launched."""
        if self._launch_after is None and self._launched_at is None:
            self._launch_after = now

    def is_due(self, now: float) -> bool:
        """Tell whether it is to be launched."""
        return self._launch_after is not None and self._launch_after <= now

    def begin(self, now: float) -> int:
        """Take note that it is launched now; return the number of the launch."""
        self._launch_after = None
        self._launched_at = now
        self.number += 1
        return self.number

    def since_launch_s(self, now: float) -> float | None:
        """Return for how long the last launch has lasted; None if there was none."""
        return None if self._launched_at is None else now - self._launched_at

    def overdue_s(self, now: float, *, present: bool) -> float | None:
        """Return for how long it should have been seen; None if it may take longer, or was seen.

        Parameters
        ----------
        now : float
        present : bool
            Whether it is seen.
        """
        if self._launched_at is None or self._launch_after is not None or present:
            return None
        # The same sum as in next_wakeup: the difference may be rounded to less than the limit.
        return now - self._launched_at if now >= self._launched_at + self._allowed_s else None

    def gave_up(self, now: float) -> None:
        """Launch again because it was not seen in time; the next one may take longer."""
        self._late += 1
        self.failed(now)

    def failed(self, now: float) -> None:
        """Launch again: at once the first time, then ever more rarely."""
        if self._launch_after is not None:
            return
        factor = min(2 ** max(0, self._failures - 1), 32)
        self._launch_after = now + (0.0 if self._failures == 0 else self._pause_s * factor)
        self._failures += 1

    def ended(self, now: float) -> None:
        """Take note that its process is gone."""
        if self._launched_at is not None and now - self._launched_at > _LONG_LIFE_S:
            self.succeeded()
        self.failed(now)

    def succeeded(self) -> None:
        """Take note that it does what it is for: it is not to be replaced any more."""
        self._failures = 0
        self._late = 0
        self._launch_after = None

    def next_wakeup(self, *, present: bool) -> float | None:
        """Return when there is something to be done; None if there is nothing to wait for."""
        if self._launch_after is not None:
            return self._launch_after
        if self._launched_at is not None and not present:
            return self._launched_at + self._allowed_s
        return None

    @property
    def _allowed_s(self) -> float:
        factor: int = min(2**self._late, _MOST_TIME)
        return self._timeout_s * factor
