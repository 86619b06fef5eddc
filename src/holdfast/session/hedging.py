"""When a late decision is asked of the local service too: whoever answers first decides.

Both give the same answer, so a hedge costs work alone. A budget bounds that: every question adds a
share of a hedge to it, and every hedge takes one, so however slow the cloud becomes, no more than
that share of all questions is asked twice in the long run.
"""

from __future__ import annotations

from holdfast.session.question import Question
from holdfast.settings import OffloadSettings

__all__ = ["Hedging"]

_HEDGING_BURST = 3.0


class Hedging:
    """Deadline and budget of the second asking.

    Parameters
    ----------
    settings : OffloadSettings
    """

    def __init__(self, settings: OffloadSettings) -> None:
        self._deadline_ms = settings.decision_deadline_ms
        self._share = settings.max_hedged_share
        self._budget = _HEDGING_BURST

    def earn(self) -> None:
        """Take note of a new question."""
        self._budget = min(_HEDGING_BURST, self._budget + self._share)

    def spend(self) -> None:
        """Take note of a hedge."""
        self._budget -= 1.0

    def due_at(self, question: Question) -> float | None:
        """Return when a question is late; None if it is not needed, or nothing is to be spent."""
        if self._deadline_ms is None or question.needed_at is None or self._budget < 1.0:
            return None
        return question.needed_at + 1e-3 * self._deadline_ms
