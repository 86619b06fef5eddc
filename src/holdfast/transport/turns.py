"""Whose turn it is: who sends too much at once waits, and nobody waits for that.

Hundreds of kilobytes can come with one look at a socket, and be tens of thousands of messages. So
what has come on a link is handled for a millisecond. What is left of it waits, and nothing more is
read of that link: in each turn of the loop one of those that wait goes on for another millisecond,
and in between all others are heard.

Links of one *owner* share all of that, however many there are: those with the same certificate, and
those whose handshake is not complete, of whom nobody knows anything yet. A link without TLS is one
by itself.
"""

from __future__ import annotations

import asyncio
from collections import OrderedDict, deque
from typing import Final, Protocol

__all__ = ["TURN_S", "Participant", "Turns"]

TURN_S: Final = 0.001
"""For so long a link goes on before others are heard."""

_WINDOW_S: Final = 0.005
"""In so long an owner has one such turn without waiting for it."""


class Participant(Protocol):
    """Who takes turns."""

    @property
    def owner(self) -> object:
        """With whom it shares its turns."""
        ...

    def go_on(self) -> None:
        """Take a turn."""
        ...


class Turns:
    """Lets those that have more to do than fits into one turn go on one after another.

    Parameters
    ----------
    pause_s : float
        Between such turns, for whoever has better to do with its time than to hear all of it.
    """

    def __init__(self, pause_s: float = 0.0) -> None:
        self._pause_s = pause_s
        self._waiting: OrderedDict[object, deque[Participant]] = OrderedDict()
        self._spent_s: dict[object, float] = {}
        self._window_ends_at = float("-inf")

    def may_go_on(self, owner: object, now: float) -> bool:
        """Tell whether what has come just now may be handled at once."""
        if now >= self._window_ends_at:
            self._spent_s.clear()
            self._window_ends_at = now + _WINDOW_S
        return owner not in self._waiting and self._spent_s.get(owner, 0.0) < TURN_S

    def spend(self, owner: object, seconds: float) -> None:
        """Take note how long one has gone on."""
        self._spent_s[owner] = self._spent_s.get(owner, 0.0) + seconds

    def wait(self, participant: Participant) -> None:
        """Let somebody go on when it is its turn."""
        if not self._waiting:
            self._plan()
        self._waiting.setdefault(participant.owner, deque()).append(participant)

    def _next(self) -> None:
        owner, participants = self._waiting.popitem(last=False)
        participant = participants.popleft()
        if participants:
            self._waiting[owner] = participants
        if self._waiting:
            self._plan()
        participant.go_on()

    def _plan(self) -> None:
        loop = asyncio.get_running_loop()
        if self._pause_s:
            loop.call_later(self._pause_s, self._next)
        else:
            loop.call_soon(self._next)
