"""What a robot knows of the services: who may be asked, when again, and what each of them lacks.

Nothing here asks anybody. What is known of a service is its presence and its silence (the failure
detector), how it answered last (well, busy, refusing), and which of the robot's states it holds.
From the last follows what a request to it must carry: nothing but the last observations if it has
answered before, else the whole state.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from holdfast.session.failure_detector import FailureDetector
from holdfast.session.messages import Observed
from holdfast.session.question import Question

__all__ = ["KnownService", "KnownServices", "Lack"]

_LATE_IN_A_ROW = 3
"""So many late replies are no accident: the service is further away than the timeout is long."""

_FIRST_RETRY_S = 0.02
_LAST_RETRY_S = 1.0
_MAX_BUSY_S = 5.0
"""A busy service is asked again after this time, whatever it says: it may be wrong, or lie."""

_MAX_REFUSALS = 3

_OUT_OF_MEMORY = "out_of_memory"
_MAX_OUT_OF_MEMORY = 5
_OUT_OF_MEMORY_RETRY_S = 0.1
"""What another robot's decision takes is given back soon: more tries, further apart."""

_MAX_REPLAYED_STEPS = 1024
"""A trial longer than this is not planned again for a service that knows nothing of it."""

_LARGE_CHECKPOINT = 1 << 20
"""Bytes from which a service rather plans the trial again than be sent its state."""

_MAX_DRIFTS = 2
"""A service that came to another state this often in a row is sent the state each time."""

_LOCAL_PATIENCE = 4.0
"""The local service may be silent this much longer: to replace it costs more than to wait."""

_WRONG_ANSWER = "wrong_answer"

_FINAL_REFUSALS = frozenset({"unknown_problem", "other_code", "version", "too_large"})
_REFUSED_BY_ALL = frozenset({"invalid", "failed"})
"""Refusals that say something of the question itself: any other service would say the same."""


class Lack(NamedTuple):
    """What a service needs to be told to answer a question.

    Attributes
    ----------
    opening : bool
        Whether it does not know the robot, or not any more.
    fresh : bool
        Whether there is nothing to know but the opening: the trial has only begun.
    observations : tuple of Observed
        From what it holds to the question's state.
    checkpoint : bytes or None
        The state itself, where that is better.
    """

    opening: bool
    fresh: bool
    observations: tuple[Observed, ...]
    checkpoint: bytes | None


class KnownService:
    """What is known of one service.

    Parameters
    ----------
    name : str
    detection_timeout_s : float
    late_after_s : float
        A reply to a call is late if it is the first one and comes after more than this.

    Attributes
    ----------
    detector : FailureDetector
    last_boot : str or None
        Of the process that was seen last.
    opened : bool
        Whether it knows this robot.
    acknowledged : tuple of int or None
        The trial and the number of observations of the last state that it is known to hold.
    drifts : int
        Times in a row that it came to another state than the robot.
    task_refusals, sensing_refusals : int
        Of each part of an answer, since it last gave that part. A problem can fail in one part
        alone, so the other part says nothing of it.
    complaint : str or None
        What it refused last with, since such a part.
    refused, refused_code : str or None, str
        Why it is asked no more.
    distrusted : str or None
        Why it is asked no more, whichever process takes its place.
    retry_at : float
        It is not asked before.
    backoff_s : float
        The next delay.
    num_busy : int
    """

    __slots__ = (
        "acknowledged",
        "backoff_s",
        "complaint",
        "detector",
        "distrusted",
        "drifts",
        "last_boot",
        "late_after_s",
        "late_at",
        "late_soonest_s",
        "late_times",
        "name",
        "num_busy",
        "opened",
        "refused",
        "refused_code",
        "retry_at",
        "sensing_refusals",
        "task_refusals",
    )

    def __init__(
        self, name: str, detection_timeout_s: float, late_after_s: float = math.inf
    ) -> None:
        self.name = name
        self.detector = FailureDetector(detection_timeout_s)
        self.last_boot: str | None = None
        self.late_after_s = late_after_s
        self.late_at = -math.inf
        self.late_soonest_s = math.inf
        self.late_times = 0
        self.distrusted: str | None = None
        self.forget()

    def forget(self) -> None:
        """Note that another process has taken its place: it knows nothing."""
        self.opened = False
        self.acknowledged: tuple[int, int] | None = None
        self.drifts = 0
        self.task_refusals = self.sensing_refusals = 0
        self.complaint: str | None = None
        self.refused = self.distrusted
        self.refused_code = "" if self.refused is None else _WRONG_ANSWER
        self.retry_at = 0.0
        self.backoff_s = _FIRST_RETRY_S
        self.num_busy = 0

    @property
    def reliable(self) -> bool:
        """Whether it is trusted and does not refuse, though it may want to be left alone now."""
        return self.detector.trusted and self.refused is None

    def usable(self, now: float) -> bool:
        """Tell whether it can be asked with the prospect of an answer."""
        return self.reliable and self.retry_at <= now

    def delay(self, now: float) -> None:
        """Ask it again only after a while, longer each time."""
        self.retry_at = now + self.backoff_s
        self.backoff_s = min(2.0 * self.backoff_s, _LAST_RETRY_S)

    # -- what it says ----------------------------------------------------------------------------

    def note_first_reply(self, sent_at: float, now: float) -> float | None:
        """Take note of when a call was sent and first replied to.

        Returns
        -------
        float or None
            Once, when too many in a row were late: the time in seconds that the soonest took.
        """
        after_s = now - sent_at
        if self.late_times >= _LATE_IN_A_ROW:
            return None
        if after_s <= self.late_after_s:
            self.late_times, self.late_soonest_s = 0, math.inf
        elif sent_at >= self.late_at:
            # Calls that were sent meanwhile have waited for the same thing, such as a process that
            # stood still.
            self.late_at = now
            self.late_times += 1
            self.late_soonest_s = min(self.late_soonest_s, after_s)
            if self.late_times == _LATE_IN_A_ROW:
                return self.late_soonest_s
        return None

    def note_answer(self, question: Question, now: float, *, sensing: bool, restored: bool) -> None:
        """Take note of a part of an answer: it lives and holds the question's state.

        Parameters
        ----------
        question : Question
        now : float
        sensing : bool
            Whether it is the sensing part.
        restored : bool
            Whether it was sent the state.
        """
        self.detector.heard(now)
        self.opened = True
        if sensing:
            self.sensing_refusals = 0
        else:
            self.task_refusals = 0
        self.retry_at = 0.0
        if not self.task_refusals and not self.sensing_refusals:
            self.backoff_s = _FIRST_RETRY_S
            self.complaint = None
        if not restored:
            self.drifts = 0
        holds = (question.state.trial, question.num_observations)
        self.acknowledged = max(self.acknowledged or holds, holds)

    def note_busy(self, retry_after_s: float, now: float) -> float:
        """Take note that it asks for patience; return for how long it is left alone."""
        # Its own estimate, but never as often as it can answer.
        after_s = max(min(retry_after_s, _MAX_BUSY_S), self.backoff_s)
        self.delay(now)
        self.retry_at = now + after_s
        self.num_busy += 1
        return after_s

    def note_lost_state(self, *, differs: bool) -> None:
        """Take note that it holds no state, or one that is not the robot's."""
        self.opened = False
        self.acknowledged = None
        if differs:
            self.drifts += 1

    def note_refusal(self, code: str, text: str, now: float, *, sensing: bool) -> bool:
        """Take note of a refusal, which delays it; True if it is asked no more.

        Parameters
        ----------
        code, text : str
        now : float
        sensing : bool
            Whether it refuses the sensing part; the task part may have come.
        """
        most = _MAX_REFUSALS
        if code == _OUT_OF_MEMORY:
            most = _MAX_OUT_OF_MEMORY
            self.backoff_s = max(self.backoff_s, _OUT_OF_MEMORY_RETRY_S)
        self.delay(now)
        if sensing:
            self.sensing_refusals += 1
        else:
            self.task_refusals += 1
        self.complaint = f"{code}: {text}"
        refusals = self.sensing_refusals if sensing else self.task_refusals
        final = code in _FINAL_REFUSALS or refusals >= most
        if final:
            self.refused = text
            self.refused_code = code
        return final

    def distrust(self, text: str) -> None:
        """Take note that it was wrong: it is asked no more in this run."""
        self.distrusted = self.refused = text
        self.refused_code = _WRONG_ANSWER

    # -- what it needs ---------------------------------------------------------------------------

    def lacks(self, question: Question, *, whole_state: bool) -> Lack:
        """Return what it needs to be told.

        Parameters
        ----------
        question : Question
        whole_state : bool
            Whether it needs the state for certain.
        """
        state = question.state
        known = self.acknowledged
        start = known[1] if known is not None and known[0] == state.trial else 0
        missing = question.num_observations - start
        fresh = state.step == 0 and missing == 0
        if missing > 1 or not (self.opened or fresh):
            # It knows nothing, or others have decided since. To plan what it has missed keeps it
            # from other robots, just when it has too many; but a large state is worse.
            whole_state |= (
                8 * state.belief.states.size <= _LARGE_CHECKPOINT
                or state.step > _MAX_REPLAYED_STEPS
            )
        if self.drifts >= _MAX_DRIFTS or missing > len(question.observations):
            whole_state = True
        if whole_state:
            return Lack(not self.opened, fresh, (), question.checkpoint())
        observations = question.observations[-missing:] if missing > 0 else ()
        return Lack(not self.opened, fresh, observations, None)


class KnownServices:
    """All services that a robot may ask.

    Parameters
    ----------
    cloud : sequence of str
        Names in order of preference.
    local : str or None
        The local service.
    detection_timeout_s : float

    Attributes
    ----------
    cloud : list of KnownService
    local : KnownService or None
    """

    def __init__(self, cloud: Sequence[str], local: str | None, detection_timeout_s: float) -> None:
        timeout_s = detection_timeout_s
        self.cloud = [KnownService(name, timeout_s, late_after_s=timeout_s) for name in cloud]
        self.local = None if local is None else KnownService(local, _LOCAL_PATIENCE * timeout_s)
        self._by_name = {service.name: service for service in self.cloud}
        if self.local is not None:
            self._by_name[self.local.name] = self.local

    def __iter__(self) -> Iterator[KnownService]:
        return iter(self._by_name.values())

    def get(self, name: str) -> KnownService | None:
        """Return the service of a name; None if there is none."""
        return self._by_name.get(name)

    def all_to_come(self) -> bool:
        """Tell whether no service of the cloud was ever there; those that refuse do not count.

        If all refuse, none is to come.
        """
        seen = [each.detector.seen for each in self.cloud if each.refused is None]
        return bool(seen) and not any(seen)

    def any_reliable(self) -> bool:
        """Tell whether a service of the cloud can be counted on."""
        return any(service.reliable for service in self.cloud)

    def busy_until(self, now: float) -> float | None:
        """Return when the first service that only asked for patience may be asked again."""
        times = [
            service.retry_at
            for service in self.cloud
            if service.reliable and service.retry_at > now
        ]
        return min(times, default=None)

    def hopeless(self) -> bool:
        """Tell whether none will ever answer."""
        if self.local is not None and self.local.refused_code in _REFUSED_BY_ALL:
            return True
        return all(service.refused is not None for service in self)

    def silence_s(self, now: float) -> float | None:
        """Return how long nothing was heard of the cloud; None if it was never there."""
        silences = [each.detector.silence_s(now) for each in self.cloud if each.detector.seen]
        return min(silences, default=None)

    # -- in words --------------------------------------------------------------------------------

    def why_nobody(self) -> str:
        """Say of each service why it does not decide."""
        reasons = []
        for service in self:
            if service.refused is not None:
                why = f"{service.refused_code}: {service.refused}"
            elif not service.detector.present:
                absent = "is not there" if service.detector.seen else "has not appeared"
                why = "is being launched" if service is self.local else absent
            else:
                why = service.detector.suspicion or service.complaint or "is busy"
            reasons.append(f"{service.name}: {why}")
        return "; ".join(reasons)

    def why_lost(self) -> str:
        """Say of each service of the cloud why it cannot be used."""
        return "; ".join(
            f"{service.name} "
            + (
                service.refused
                or service.detector.suspicion
                or service.complaint
                or ("is busy" if service.detector.present else None)
                or ("is gone" if service.detector.seen else "has not appeared")
            )
            for service in self.cloud
        )
