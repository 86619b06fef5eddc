"""What a robot knows of the services: which can be asked, when again, and what each must be sent.

All services answer alike, so they are replicas of one another. Known of a replica are its presence
and silence (:class:`FailureDetector`), how it last answered (well, busy, refusing) and which of the
robot's states it holds. The last determines what a request carries: only the latest observations
for a replica that holds the previous state, else the whole state, or all observations where the
state is large. Nothing here sends anything.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence

from holdfast.protocol.failure_detector import FailureDetector
from holdfast.protocol.question import Question

_LATE_IN_A_ROW = 3
"""After so many late replies in a row, the service is further away than the timeout."""

_FIRST_RETRY_S = 0.02
_LONGEST_RETRY_S = 1.0
_MAX_BUSY_S = 5.0
"""A busy service is asked again after this time at the latest; its own estimate may be wrong."""

_MAX_REFUSALS = 3

_OUT_OF_MEMORY = "out_of_memory"
_MAX_OUT_OF_MEMORY = 5
_OUT_OF_MEMORY_RETRY_S = 0.1
"""The memory for another robot's decision is soon free: more tries, further apart."""

_MAX_REPLAYED_STEPS = 1024
"""In a longer trial a service without any state of it is sent the state."""

_MAX_DIVERGED = 2
"""A service that diverged so often in a row is sent the state each time."""

_LARGE_CHECKPOINT = 1 << 20
"""From this size in bytes on, a service replays the trial instead of being sent the state."""

_LOCAL_PATIENCE = 4.0
"""Factor on the local service's timeout: replacing it costs more than waiting."""

_WRONG_ANSWER = "wrong_answer"

_FINAL_REFUSALS = frozenset({"unknown_problem", "other_code", "version", "too_large"})
_REFUSED_BY_ALL = frozenset({"invalid", "failed"})
"""Refusals caused by the question itself; any service would refuse."""


class Replica:
    """One service, as far as the robot knows it."""

    def __init__(
        self, name: str, detection_timeout_s: float, late_after_s: float = math.inf
    ) -> None:
        self.name = name
        self.detector = FailureDetector(detection_timeout_s)
        self.last_incarnation: str | None = None  # of the process seen last
        self.late_after_s = late_after_s  # the first reply to a request is late after this time
        self.late_at = -math.inf
        self.late_s: list[float] = []  # first replies late in a row
        self.distrusted: str | None = None  # why it is not asked, not even after a restart
        self.forget()

    def forget(self) -> None:
        """Reset what was known of the previous process."""
        self.opened = False  # whether it knows the session
        # Trial and number of inputs of the latest state that it is known to hold.
        self.acknowledged: tuple[int, int] | None = None
        # Times in a row that it came to another state than the robot from the same observations.
        self.num_diverged = 0
        # Of the task and of the sensing part, since it last gave that part: a problem's code can
        # fail in one part only. And the text of the last.
        self.num_refusals = [0, 0]
        self.complaint: str | None = None
        self.refusal = self.distrusted  # why it is no longer asked
        self.refusal_code = "" if self.refusal is None else _WRONG_ANSWER
        self.retry_at = 0.0  # it is not asked before, and then delayed by the following
        self.backoff_s = _FIRST_RETRY_S
        self.num_busy = 0

    @property
    def reliable(self) -> bool:
        """Whether it is trusted and does not refuse; it may still ask for a pause."""
        return self.detector.trusted and self.refusal is None

    def usable(self, now: float) -> bool:
        """Return whether it can be expected to answer now."""
        return self.reliable and self.retry_at <= now

    def delay(self, now: float) -> None:
        """Do not ask it for a while, longer each time."""
        self.retry_at = now + self.backoff_s
        self.backoff_s = min(2.0 * self.backoff_s, _LONGEST_RETRY_S)

    # -- what it says ----------------------------------------------------------------------------

    def note_first_reply(self, sent_at: float, now: float) -> float | None:
        """Record the time to the first reply; return the shortest of several late in a row, once.

        In seconds; None otherwise.
        """
        after_s = now - sent_at
        if len(self.late_s) == _LATE_IN_A_ROW:
            return None
        if after_s <= self.late_after_s:
            self.late_s.clear()
        elif sent_at >= self.late_at:
            # Calls that were sent meanwhile have waited for the same thing, such as a process that
            # stood still.
            self.late_at = now
            self.late_s.append(after_s)
            if len(self.late_s) == _LATE_IN_A_ROW:
                return min(self.late_s)
        return None

    def note_answer(self, question: Question, now: float, *, sensing: bool, restored: bool) -> None:
        """Record a part of an answer: it lives and holds the question's state.

        ``restored`` if the request carried the state.
        """
        self.detector.heard(now)
        self.opened = True
        self.retry_at = 0.0
        self.num_refusals[sensing] = 0
        if not any(self.num_refusals):
            self.backoff_s = _FIRST_RETRY_S
            self.complaint = None
        if not restored:
            self.num_diverged = 0
        holds = (question.state.trial, question.num_inputs)
        self.acknowledged = max(self.acknowledged or holds, holds)

    def note_busy(self, retry_after_s: float, now: float) -> float:
        """Record that it is busy; return for how long it is left alone, in seconds."""
        # Its own estimate, but never as often as it can answer.
        after_s = max(min(retry_after_s, _MAX_BUSY_S), self.backoff_s)
        self.delay(now)
        self.retry_at = now + after_s
        self.num_busy += 1
        return after_s

    def note_lost_state(self) -> None:
        """Record that it lacks the robot's state."""
        self.opened = False
        self.acknowledged = None

    def note_refusal(self, code: str, text: str, now: float, *, sensing: bool) -> bool:
        """Record a refusal, which delays it; return whether it is no longer asked."""
        most = _MAX_REFUSALS
        if code == _OUT_OF_MEMORY:
            most = _MAX_OUT_OF_MEMORY
            self.backoff_s = max(self.backoff_s, _OUT_OF_MEMORY_RETRY_S)
        self.delay(now)
        self.num_refusals[sensing] += 1
        self.complaint = f"{code}: {text}"
        final = code in _FINAL_REFUSALS or self.num_refusals[sensing] >= most
        if final:
            self.refusal = text
            self.refusal_code = code
        return final

    def distrust(self, text: str) -> None:
        """Stop asking it in this run, because it was wrong."""
        self.distrusted = self.refusal = text
        self.refusal_code = _WRONG_ANSWER

    # -- what it needs ---------------------------------------------------------------------------

    def num_lacking(self, question: Question, *, whole_state: bool) -> int | None:
        """Return how many of the latest inputs lead the service to the question's state.

        None if it must be sent the whole state, or where that is better.
        """
        state = question.state
        known = self.acknowledged
        start = known[1] if known is not None and known[0] == state.trial else 0
        missing = question.num_inputs - start
        if missing > question.new_inputs or not (self.opened or question.is_first):
            # It knows nothing, or others have decided since. Replaying takes time that other robots
            # need, so it is sent the state, unless that is large.
            whole_state |= (
                8 * state.belief.states.size <= _LARGE_CHECKPOINT
                or state.step > _MAX_REPLAYED_STEPS
            )
        if self.num_diverged >= _MAX_DIVERGED or missing > len(question.inputs):
            whole_state = True
        return None if whole_state else max(0, missing)


class ReplicaSet:
    """All services that a robot may ask."""

    def __init__(
        self,
        cloud: Sequence[str],  # names in order of preference
        local: str | None,  # name of the local service
        detection_timeout_s: float,
        # For so long after :meth:`start`, absent services may be coming up.
        startup_timeout_s: float = 0.0,
        distrusted: Collection[str] = (),  # services that answered wrongly earlier in this run
    ) -> None:
        self.cloud = [
            Replica(name, detection_timeout_s, late_after_s=detection_timeout_s) for name in cloud
        ]
        self.local = (
            None if local is None else Replica(local, _LOCAL_PATIENCE * detection_timeout_s)
        )
        self._by_name = {replica.name: replica for replica in self.cloud}
        if self.local is not None:
            self._by_name[self.local.name] = self.local
        for name in distrusted:
            if name in self._by_name:
                self._by_name[name].distrust(
                    "answered otherwise than the robot's own planner in an earlier part of this "
                    "run; name another service, or begin anew in another directory"
                )
        self._startup_timeout_s = startup_timeout_s
        self.startup_until: float | None = None  # when the services must have come up

    def __iter__(self) -> Iterator[Replica]:
        return iter(self._by_name.values())

    def get(self, name: str) -> Replica | None:
        """Return the service of a name; None if there is none."""
        return self._by_name.get(name)

    def start(self, now: float) -> None:
        """Give the services time to come up."""
        self.startup_until = now + self._startup_timeout_s

    def is_starting(self, now: float) -> bool:
        """Return whether services may still be coming up."""
        seen = [each.detector.seen for each in self.cloud if each.refusal is None]
        until = self.startup_until
        return until is not None and now < until and bool(seen) and not any(seen)

    def local_usable(self, now: float) -> bool:
        """Return whether the local service can be expected to answer now."""
        return self.local is not None and self.local.usable(now)

    def busy_until(self, now: float) -> float | None:
        """Return when the first busy cloud service may be asked again; None if none is busy."""
        times = [
            replica.retry_at
            for replica in self.cloud
            if replica.reliable and replica.retry_at > now
        ]
        return min(times, default=None)

    def all_refuse(self) -> bool:
        """Return whether no service will ever answer."""
        if self.local is not None and self.local.refusal_code in _REFUSED_BY_ALL:
            return True
        return all(replica.refusal is not None for replica in self)

    def silence_s(self, now: float) -> float | None:
        """Return how long the cloud has been silent; None if it was never present."""
        silences = [each.detector.silence_s(now) for each in self.cloud if each.detector.seen]
        return min(silences, default=None)

    # -- in words --------------------------------------------------------------------------------

    def explain_no_service(self) -> str:
        """Explain why no service decides."""
        reasons = []
        for replica in self:
            if replica.refusal is not None:
                why = f"{replica.refusal_code}: {replica.refusal}"
            elif not replica.detector.present:
                absent = "is not there" if replica.detector.seen else "has not appeared"
                why = "is being launched" if replica is self.local else absent
            else:
                why = replica.detector.suspicion or replica.complaint or "is busy"
            reasons.append(f"{replica.name}: {why}")
        return "; ".join(reasons)

    def why_lost(self) -> str:
        """Explain why no cloud service is usable."""
        return "; ".join(
            f"{replica.name} "
            + (
                replica.refusal
                or replica.detector.suspicion
                or replica.complaint
                or ("is busy" if replica.detector.present else None)
                or ("is gone" if replica.detector.seen else "has not appeared")
            )
            for replica in self.cloud
        )
