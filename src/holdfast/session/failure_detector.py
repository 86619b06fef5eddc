"""Is a service dead, or only slow? A guess from what is seen of it, revised by whatever comes next.

Nobody can know, so the detector is made to be wrong cheaply: a service that is suspected is asked
no more at first, but whatever it says clears it, and a decision that two services make is the same
decision. Four things are looked at:

- *presence*: the link, which breaks when the process dies; this finds a killed service in
  milliseconds, but a hung one keeps its link for a while;
- *signs of life*: a service that has a robot's request in work says so every few tens of
  milliseconds, so silence while something is awaited from it means that its process hangs, is
  stopped or cut off (a single computation that never ends is not seen by this);
- *calls that end without an answer*: whoever was asked is gone;
- *deadlines*: a decision that takes too long although signs come is no use either.

A service of which nothing is awaited may be silent as long as it likes.
"""

from __future__ import annotations

__all__ = ["FailureDetector"]


class FailureDetector:
    """What a robot believes about one service.

    Parameters
    ----------
    detection_timeout_s : float
        Longest silence of a service from which something is awaited.

    Attributes
    ----------
    boot : str or None
        Of the process that is there; None if none is.
    suspicion : str or None
        Why the service is not trusted; None if it is.
    seen : bool
        Whether it was ever present.
    """

    def __init__(self, detection_timeout_s: float) -> None:
        self._usual_timeout_s = detection_timeout_s
        self._timeout_s = detection_timeout_s
        self._longest_silence_s = 0.0
        self._awaited = 0
        self._last_sign = 0.0
        self.boot: str | None = None
        self.suspicion: str | None = None
        self.seen = False

    @property
    def present(self) -> bool:
        """Whether it is there."""
        return self.boot is not None

    @property
    def trusted(self) -> bool:
        """Whether it is present and not suspected."""
        return self.boot is not None and self.suspicion is None

    def appeared(self, boot: str) -> bool:
        """Take note that a process is there; True if it was not there before."""
        fresh = boot != self.boot
        self.boot = boot
        self.seen = True
        if fresh:
            self.suspicion = None
        return fresh

    def vanished(self, boot: str) -> bool:
        """Take note that a process is gone; True if it was the present one."""
        if boot != self.boot:
            return False
        self.boot = None
        return True

    def asked(self, now: float) -> None:
        """Something is awaited from now on."""
        if self._awaited == 0:
            self._last_sign = now
        self._awaited += 1

    def settled(self) -> None:
        """One thing is awaited no more."""
        self._awaited = max(0, self._awaited - 1)

    def heard(self, now: float) -> None:
        """Something came: it lives and makes progress."""
        if self._awaited:
            self._longest_silence_s = max(self._longest_silence_s, now - self._last_sign)
        self._last_sign = now
        self.suspicion = None

    def extend_patience(self, factor: float, limit_s: float) -> None:
        """Allow a longer silence from now on, up to a limit."""
        self._timeout_s = min(factor * self._timeout_s, max(limit_s, self._timeout_s))

    def answered(self) -> None:
        """Take note of a whole answer: how long it was silent meanwhile is what it needs.

        What was allowed beyond that, because it seemed to be slow and was not, is taken back.
        """
        needed_s = 2.0 * self._longest_silence_s
        shorter_s = max(0.5 * self._timeout_s, needed_s, self._usual_timeout_s)
        self._timeout_s = min(self._timeout_s, shorter_s)
        self._longest_silence_s = 0.0

    def excuse(self, seconds: float) -> None:
        """Take note that for this long nothing could be heard."""
        self._last_sign += seconds

    def silence_s(self, now: float) -> float:
        """Return how long nothing has been heard."""
        return max(0.0, now - self._last_sign)

    def suspect(self, reason: str) -> None:
        """Trust it no more until it is heard or another process takes its place."""
        self.suspicion = reason

    def fell_silent(self, now: float) -> bool:
        """Suspect it if it owes a sign; True if it is suspected only now."""
        deadline = self.deadline()
        if deadline is None or now < deadline:
            return False
        self.suspicion = f"no sign of progress for {1e3 * (now - self._last_sign):.0f} ms"
        return True

    def deadline(self) -> float | None:
        """Return when it will be suspected if nothing comes; None if nothing is due."""
        if self._awaited == 0 or self.suspicion is not None:
            return None
        return self._last_sign + self._timeout_s
