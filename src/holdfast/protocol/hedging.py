"""A budget for asking two services the same question when the first is late."""

from __future__ import annotations

from holdfast.config.settings import OffloadSettings
from holdfast.protocol.question import Question

__all__ = ["HedgingBudget"]

_HEDGING_BURST = 3.0


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

    def due_at(self, question: Question) -> float | None:
        """Return when a question is late; None if it is not awaited, or nothing is left."""
        if self._deadline_ms is None or question.needed_at is None or self._budget < 1.0:
            return None
        return question.needed_at + 1e-3 * self._deadline_ms
