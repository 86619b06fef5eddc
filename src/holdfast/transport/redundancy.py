"""Sending datagrams over a lossy path: copies, and a budget for all repetition.

A message that may be lost is sent twice while the path loses datagrams. Copies, retransmissions and
hedges are paid for from a budget of twice the bytes of first transmissions, so a congested path
gets at most three times the load.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import Final, NamedTuple

from holdfast.transport.datagram_cipher import OVERHEAD

COPY_DELAY_S: Final = 0.003
"""Between a message and its copy."""

_EXTRA_SHARE: Final = 2
"""Bytes of repetition earned by each byte of a first transmission."""

_EXTRA_BURST_BYTES: Final = 8192
_IP_AND_UDP_BYTES: Final = 28


class Paths(NamedTuple):
    """The two paths to the other end: each sends a message.

    On the stream the number of its request goes with it. ``num_lost`` returns how many of the other
    end's last datagrams were lost.
    """

    datagram: Callable[[bytes], None]
    stream: Callable[[int, bytes], None]
    num_lost: Callable[[], int]


class RedundantSender:
    """Sends messages as datagrams, with copies while the path loses some."""

    def __init__(self, paths: Paths) -> None:
        self.paths = paths
        self.num_lost = 1  # of this end's last datagrams, as the other end reports
        self._copies: deque[tuple[float, int, bytes, Callable[[], bool]]] = deque()
        self._budget_bytes = _EXTRA_BURST_BYTES

    @property
    def due(self) -> float:
        """When :meth:`expire` is to be called."""
        return self._copies[0][0] if self._copies else math.inf

    def send_first(self, kind: int, body: bytes, now: float, wanted: Callable[[], bool]) -> None:
        """Send a datagram for the first time.

        ``wanted`` says whether the copy is still of use when its time has come.
        """
        earned = _EXTRA_SHARE * _packet_bytes(body)
        self._budget_bytes = min(_EXTRA_BURST_BYTES, self._budget_bytes + earned)
        self.send_unbudgeted(kind, body)
        if self.num_lost:
            self._copies.append((now + COPY_DELAY_S, kind, body, wanted))

    def retransmit(self, kind: int, body: bytes) -> None:
        """Send a datagram again, if the budget allows it."""
        size = _packet_bytes(body)
        if size <= self._budget_bytes:
            self._budget_bytes -= size
            self.send_unbudgeted(kind, body)

    def hedge(self, number: int, kind: int, body: bytes) -> None:
        """Send on the stream what was sent as a datagram, at the budget's cost."""
        self._budget_bytes -= _packet_bytes(body)
        self.send_on_stream(number, kind, body)

    def send_unbudgeted(self, kind: int, body: bytes) -> None:
        """Send a datagram outside of the budget."""
        self.paths.datagram(bytes((kind, min(255, self.paths.num_lost()))) + body)

    def send_on_stream(self, number: int, kind: int, body: bytes) -> None:
        """Send a message on the stream."""
        self.paths.stream(number, bytes((kind, min(255, self.paths.num_lost()))) + body)

    def expire(self, now: float) -> None:
        """Send the copies that are due."""
        while self._copies and self._copies[0][0] <= now:
            _, kind, body, wanted = self._copies.popleft()
            if wanted():
                self.retransmit(kind, body)


def _packet_bytes(body: bytes) -> int:
    return len(body) + 2 + OVERHEAD + _IP_AND_UDP_BYTES
