"""A wide-area line emulated by two numbers: a delay, and a share of lost packets.

A line carries packets and knows no connections. Retransmissions and windows are the business of the
real protocols at its ends.

:class:`DelayLine` is one direction of a line, without clock or socket; :class:`Carrier` is the
thread that moves packets over lines.
"""

from __future__ import annotations

import contextlib
import os
import random
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Generic, NamedTuple, TypeVar

from holdfast.errors import InvalidValueError

__all__ = ["Carrier", "DelayLine"]

_LARGEST = 65_536
_CAPACITY = 4096
"""Packets on the way in one direction: 6 MB of the usual size, as a router may hold."""

_LONGEST_DELAY_S = 60.0
_IDLE_S = 1.0

Item = TypeVar("Item")


class DelayLine(Generic[Item]):
    """One direction of a line: items come out later, in order, or never.

    Parameters
    ----------
    delay_s : float
        From 0 to 60.
    loss : float
        Share of lost items, from 0 to 1.
    seed : str
        Of the losses.
    capacity : int
        Items put into a full line are lost, as in a router.

    Attributes
    ----------
    lost : int
        Number of lost items.

    Raises
    ------
    InvalidValueError
        If a number is out of bounds.
    """

    def __init__(self, delay_s: float, loss: float, seed: str, capacity: int = _CAPACITY) -> None:
        if not 0.0 <= delay_s <= _LONGEST_DELAY_S:
            raise InvalidValueError(f"delay_s {delay_s}: must be from 0 to {_LONGEST_DELAY_S:g}")
        if not 0.0 <= loss <= 1.0:
            raise InvalidValueError(f"loss {loss}: must be from 0 to 1")
        self._delay_s = delay_s
        self._loss = loss
        self._chance = random.Random(seed)
        self._capacity = capacity
        self._waiting: deque[tuple[float, Item]] = deque()
        self.lost = 0

    def put(self, item: Item, now: float) -> None:
        """Send an item; ``now``, in seconds, never goes back."""
        if len(self._waiting) >= self._capacity or self._chance.random() < self._loss:
            self.lost += 1
            return
        self._waiting.append((now + self._delay_s, item))

    def take(self, now: float) -> list[Item]:
        """Return the items that have arrived, in the order in which they were sent."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now:
            arrived.append(self._waiting.popleft()[1])
        return arrived

    @property
    def due(self) -> float:
        """When the next item arrives; infinite if there is none."""
        return self._waiting[0][0] if self._waiting else float("inf")


class _Way(NamedTuple):
    """From a readable descriptor, over a line, to a function that sends."""

    receive: Callable[[], Any]
    line: DelayLine[Any]
    send: Callable[[Any], object]


class Carrier:
    """A thread that moves packets from descriptors over lines.

    A packet that cannot be sent is lost.
    """

    def __init__(self, name: str) -> None:
        self._ways: dict[int, _Way] = {}
        self._lock = threading.Lock()
        self._ending = False
        self._wake_read, self._wake_write = os.pipe()
        os.set_blocking(self._wake_read, False)
        os.set_blocking(self._wake_write, False)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def add(
        self,
        descriptor: int,
        receive: Callable[[], Any],
        line: DelayLine[Any],
        send: Callable[[Any], object],
    ) -> None:
        """Carry from a descriptor.

        Parameters
        ----------
        receive : callable
            Returns the next packet, without waiting; raises BlockingIOError if there is none.
        """
        with self._lock:
            self._ways[descriptor] = _Way(receive, line, send)
        self._wake()

    def remove(self, descriptor: int) -> None:
        """Carry no more from a descriptor; what is on its line is lost."""
        with self._lock:
            self._ways.pop(descriptor, None)
        self._wake()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End; may be repeated."""
        self._ending = True
        if self._thread.is_alive():
            self._wake()
            self._thread.join()
        for descriptor in (self._wake_read, self._wake_write):
            if descriptor >= 0:
                os.close(descriptor)
        self._wake_read = self._wake_write = -1

    def _wake(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.write(self._wake_write, b".")

    def _run(self) -> None:
        while not self._ending:
            with self._lock:
                ways = dict(self._ways)
            due = min((way.line.due for way in ways.values()), default=float("inf"))
            wait_s = min(_IDLE_S, max(0.0, due - time.monotonic()))
            # poll has whole milliseconds, which would falsify short delays.
            ready, _, _ = select.select([self._wake_read, *ways], [], [], wait_s)
            for descriptor in ready:
                if descriptor == self._wake_read:
                    with contextlib.suppress(BlockingIOError):
                        os.read(self._wake_read, _LARGEST)
                else:
                    self._receive(ways[descriptor])
            for way in ways.values():
                for packet in way.line.take(time.monotonic()):
                    with contextlib.suppress(OSError):
                        way.send(packet)

    @staticmethod
    def _receive(way: _Way) -> None:
        # Bounded, because other descriptors have packets too.
        for _ in range(_CAPACITY):
            try:
                packet = way.receive()
            except BlockingIOError:
                return
            except OSError:
                return  # the last packet was refused
            way.line.put(packet, time.monotonic())
