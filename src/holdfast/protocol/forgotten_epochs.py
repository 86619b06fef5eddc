"""Epochs of sessions that a service has forgotten, so that a replaced process stays replaced."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import TypeAlias

__all__ = ["ForgottenEpochs", "Owner", "SessionKey"]

Owner: TypeAlias = str | None
"""Name in the robot's verified certificate; None without one."""

SessionKey: TypeAlias = tuple[Owner, bytes]
"""Owner and session id."""


class ForgottenEpochs:
    """The epochs, by owner and session id.

    Parameters
    ----------
    most : int
        So many are kept; beyond that the oldest of the owner with the most is dropped.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._count = 0
        # Owners in the order in which they were noted last.
        self._of: OrderedDict[Owner, OrderedDict[bytes, int]] = OrderedDict()

    def __iter__(self) -> Iterator[SessionKey]:
        return ((owner, session) for owner, epochs in self._of.items() for session in epochs)

    def get(self, key: SessionKey) -> int:
        """Return a session's epoch; 0 if unknown."""
        owner, session = key
        epochs = self._of.get(owner)
        return 0 if epochs is None else epochs.get(session, 0)

    def note(self, key: SessionKey, epoch: int) -> None:
        """Keep an epoch."""
        owner, session = key
        self.forget(key)
        self._of.setdefault(owner, OrderedDict())[session] = epoch
        self._of.move_to_end(owner)
        self._count += 1
        if self._count > self._most:
            largest = max(self._of, key=lambda each: len(self._of[each]))
            self.forget((largest, next(iter(self._of[largest]))))

    def forget(self, key: SessionKey) -> None:
        """Drop the epoch of a session that is held again."""
        owner, session = key
        epochs = self._of.get(owner)
        if epochs is not None and epochs.pop(session, None) is not None:
            self._count -= 1
            if not epochs:
                del self._of[owner]
