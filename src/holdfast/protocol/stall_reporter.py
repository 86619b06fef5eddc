"""Log events about a robot that stands still, and when it continues.

A robot that *waits* has asked a service that takes its time. That is reported once per question and
only if it lasts. A robot that *holds* has no usable service. That is reported at once, with the
reason, and again when a service works on the question.
"""

from __future__ import annotations

from collections.abc import Collection

from holdfast.protocol.events import Effects, RobotEffect
from holdfast.protocol.question import Question

__all__ = ["StallReporter"]

_LONGEST_SILENT_WAIT_S = 1.0
"""A longer wait is reported."""


class StallReporter:
    """Reports waiting and holding.

    Parameters
    ----------
    detection_timeout_s : float
        Waits shorter than the detection of a dead service are not reported.
    """

    def __init__(self, detection_timeout_s: float, effects: Effects[RobotEffect]) -> None:
        self._patience_s = max(_LONGEST_SILENT_WAIT_S, detection_timeout_s)
        self._effects = effects
        self._holding_since: float | None = None
        self._reported: Question | None = None

    @property
    def is_holding(self) -> bool:
        """Whether the robot holds still: no service is usable, or its own planner has to decide."""
        return self._holding_since is not None

    def waiting_at(self, question: Question) -> float | None:
        """Return when the wait is reported; None if there is none or it was reported."""
        if question.needed_at is None or question is self._reported:
            return None
        return question.needed_at + self._patience_s

    def waits_long(self, question: Question, now: float) -> bool:
        """Return whether the wait is to be reported now."""
        at = self.waiting_at(question)
        return at is not None and now >= at

    def tell_waiting(self, question: Question, asked: Collection[str], now: float) -> None:
        """Report, once per question, that the robot waits for the services it has asked."""
        assert question.needed_at is not None
        self._reported = question
        self._effects.report(
            "waiting",
            service=", ".join(sorted(asked)),
            step=question.state.step,
            waited_ms=1e3 * (now - question.needed_at),
        )

    def hold(self, question: Question, reason: str, now: float) -> None:
        """Note that no service is usable; report it if the robot needs the answer."""
        if question.needed_at is not None and self._holding_since is None:
            self._holding_since = now
            self._effects.report("holding", step=question.state.step, reason=reason)

    def let_go(self, now: float) -> None:
        """Note that a service works on the question."""
        if self._holding_since is not None:
            self._effects.report("resumed", held_ms=1e3 * (now - self._holding_since))
            self._holding_since = None

    def forget(self) -> None:
        """Note that no answer is awaited any more."""
        self._holding_since = None
