"""Whether a service is dead or only slow, judged from what is seen of it."""

from __future__ import annotations


class FailureDetector:
    """Is one service dead, or only slow? Evidence from what is seen of it.

    Nobody can know for certain, so errors are made cheap: a suspected service is no longer
    preferred, but any sign of life clears it, and two services that decide the same question decide
    alike. There are four kinds of evidence:

    - *presence*: the link breaks when the process dies. This finds a killed service in
      milliseconds, but a hung one keeps its link for a while;
    - *signs of life*: every reply is one. While a request waits or is computed, the service sends a
      ``Progress`` reply every few tens of milliseconds, so silence means that its process hangs, is
      stopped or is cut off. A service of which nothing is awaited may be silent for any time;
    - *calls that end without an answer*: the process is gone;
    - *deadlines*: a decision that takes too long is of no use even with signs of life.
    """

    def __init__(self, detection_timeout_s: float) -> None:
        self._usual_timeout_s = detection_timeout_s
        self._timeout_s = detection_timeout_s  # accepted silence while something is awaited
        self._longest_silence_s = 0.0
        self._awaited = 0
        self._last_sign = 0.0
        # Of the present process; None if the service is absent. ``seen`` says if it ever was
        # present.
        self.incarnation: str | None = None
        self.suspicion: str | None = None  # why the service is not trusted; None if it is
        self.seen = False

    @property
    def present(self) -> bool:
        """Whether its process is there."""
        return self.incarnation is not None

    @property
    def trusted(self) -> bool:
        """Whether it is present and not suspected."""
        return self.incarnation is not None and self.suspicion is None

    def appeared(self, incarnation: str, now: float) -> bool:
        """Note the presence of a process; return whether it is new."""
        fresh = incarnation != self.incarnation
        self.incarnation = incarnation
        self.seen = True
        if fresh:
            self.suspicion = None
            self._last_sign = now
        return fresh

    def vanished(self, incarnation: str) -> bool:
        """Note the end of a process; return whether it was the present one."""
        if incarnation != self.incarnation:
            return False
        self.incarnation = None
        return True

    def asked(self, now: float) -> None:
        """Note that a request was sent."""
        if self._awaited == 0:
            self._last_sign = now
        self._awaited += 1

    def settled(self) -> None:
        """Note that one request is no longer awaited."""
        self._awaited = max(0, self._awaited - 1)

    def heard(self, now: float) -> None:
        """Note a sign of life."""
        if self._awaited:
            self._longest_silence_s = max(self._longest_silence_s, now - self._last_sign)
        self._last_sign = now
        self.suspicion = None

    def extend_patience(self, factor: float, limit_s: float) -> None:
        """Accept a longer silence, up to a limit."""
        self._timeout_s = min(factor * self._timeout_s, max(limit_s, self._timeout_s))

    def answered(self) -> None:
        """Note a complete answer, and shorten an extended timeout.

        It becomes twice the longest silence of that answer, but at least half of what it was.
        """
        needed_s = 2.0 * self._longest_silence_s
        shorter_s = max(0.5 * self._timeout_s, needed_s, self._usual_timeout_s)
        self._timeout_s = min(self._timeout_s, shorter_s)
        self._longest_silence_s = 0.0

    def excuse(self, seconds: float) -> None:
        """Disregard a time in which the robot could not receive."""
        self._last_sign += seconds

    def silence_s(self, now: float) -> float:
        """Return the time since the last sign of life.

        Its appearance is one, and so is a request that is sent while none is awaited.
        """
        return max(0.0, now - self._last_sign)

    def suspect(self, reason: str) -> None:
        """Distrust it until it is heard or another process takes its place."""
        self.suspicion = reason

    def suspect_if_silent(self, now: float) -> bool:
        """Suspect it if its silence is too long; return whether that is new."""
        deadline = self.deadline()
        if deadline is None or now < deadline:
            return False
        self.suspicion = f"no sign of progress for {1e3 * (now - self._last_sign):.0f} ms"
        return True

    def deadline(self) -> float | None:
        """Return when it becomes suspected if nothing comes; None if nothing is awaited."""
        if self._awaited == 0 or self.suspicion is not None:
            return None
        return self._last_sign + self._timeout_s
