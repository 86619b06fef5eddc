"""What both ends' effects have in common; a service starts sooner without the robot's."""

from __future__ import annotations

from collections import Counter
from typing import Generic, NamedTuple, TypeVar


class LogEvent(NamedTuple):
    """One line of the log of a robot or a service: plain data; durations end in ``_ms``."""

    name: str
    fields: dict[str, object]


_Effect = TypeVar("_Effect")


class Effects(list[_Effect | LogEvent], Generic[_Effect]):
    """The effects of one end so far; its parts share this list, since their order counts."""

    def __init__(self) -> None:
        # Events for metrics, by kind, also those that were not reported.
        self.counts: Counter[str] = Counter()

    def report(self, name: str, **fields: object) -> None:
        """Append a line of the log."""
        self.append(LogEvent(name, fields))

    def take(self) -> list[_Effect | LogEvent]:
        """Return the effects so far, and clear them."""
        effects = self.copy()
        self.clear()
        return effects
