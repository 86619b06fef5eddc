"""What people are told while the robot stands still, and once it goes on.

There are two ways to stand still. If a service is being asked and takes its time, the robot is
*waiting*: that is said once for each question, and only if it lasts. If nobody can be asked it is
*holding*, and that is said at once, with the reason, and again when somebody turns up.
"""

from __future__ import annotations

from collections.abc import Collection

from holdfast.session.effects import Effect, Report
from holdfast.session.question import Question

__all__ = ["Standstill"]

_LONGEST_SILENT_WAIT_S = 1.0
"""When the robot stands still for longer than this, somebody should know why."""


class Standstill:
    """Reports of standing still.

    Parameters
    ----------
    detection_timeout_s : float
        What takes no longer than to find out that a service is dead is not worth a word.
    effects : list of Effect
        The reports are added to it.
    """

    def __init__(self, detection_timeout_s: float, effects: list[Effect]) -> None:
        self._patience_s = max(_LONGEST_SILENT_WAIT_S, detection_timeout_s)
        self._effects = effects
        self._holding_since: float | None = None

    @property
    def is_holding(self) -> bool:
        """Whether nobody can be asked for what the robot needs."""
        return self._holding_since is not None

    def waiting_at(self, question: Question) -> float | None:
        """Return when it is to be said that the robot waits; None if it does not, or was told."""
        if question.needed_at is None or question.told_waiting:
            return None
        return question.needed_at + self._patience_s

    def waits_long(self, question: Question, now: float) -> bool:
        """Tell whether it is to be said now."""
        at = self.waiting_at(question)
        return at is not None and now >= at

    def tell_waiting(self, question: Question, asked: Collection[str], now: float) -> None:
        """Say once that the robot stands still although somebody is being asked."""
        assert question.needed_at is not None
        question.told_waiting = True
        fields: dict[str, object] = {
            "service": ", ".join(sorted(asked)),
            "step": question.state.step,
            "waited_ms": 1e3 * (now - question.needed_at),
        }
        self._effects.append(Report("waiting", fields))

    def hold(self, question: Question, reason: str, now: float) -> None:
        """Note that nobody can be asked; it is said if the robot needs the answer."""
        if question.needed_at is not None and self._holding_since is None:
            self._holding_since = now
            fields: dict[str, object] = {"step": question.state.step, "reason": reason}
            self._effects.append(Report("holding", fields))

    def let_go(self, now: float) -> None:
        """Note that somebody works on what the robot holds still for."""
        if self._holding_since is not None:
            fields: dict[str, object] = {"held_ms": 1e3 * (now - self._holding_since)}
            self._effects.append(Report("resumed", fields))
            self._holding_since = None

    def forget(self) -> None:
        """Note that nothing is waited for any more."""
        self._holding_since = None
