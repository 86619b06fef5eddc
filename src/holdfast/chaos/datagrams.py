"""Late and lost datagrams: what a wide-area line does to packets, and nothing else.

A line of copper or glass knows no connections. It carries packets; each arrives later by the length
of the way, and some never do. What becomes of that (retransmissions, smaller windows, patience) is
the business of the protocols at its ends, which are the real ones. So what is emulated here is two
numbers, a delay and a share of losses, and a packet that arrives is the packet that was sent.

:class:`DelayLine` is one direction of such a line, without a clock or a socket of its own, and
:class:`Carrier` is the thread that keeps lines.
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
    """One direction of a line: what is put into it comes out later, in order, or never.

    Parameters
    ----------
    delay_s : float
        From 0 to 60.
    loss : float
        Share that never comes out, from 0 to 1.
    seed : str
        Of the losses.
    capacity : int
        What is put into a full line is lost, as in a router.

    Attributes
    ----------
    lost : int
        How much was.

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
        """Send something.

        Parameters
        ----------
        item : object
        now : float
            In seconds; never before that of an earlier call.
        """
        if len(self._waiting) >= self._capacity or self._chance.random() < self._loss:
            self.lost += 1
            return
        self._waiting.append((now + self._delay_s, item))

    def take(self, now: float) -> list[Item]:
        """Return what has arrived by now, in the order in which it was sent."""
        arrived = []
        while self._waiting and self._waiting[0][0] <= now:
            arrived.append(self._waiting.popleft()[1])
        return arrived

    @property
    def due(self) -> float:
        """When the next arrives; infinite if nothing is on the way."""
        return self._waiting[0][0] if self._waiting else float("inf")


class _Way(NamedTuple):
    """From a descriptor that can be read, over a line, to whatever sends it on."""

    receive: Callable[[], Any]
    line: DelayLine[Any]
    send: Callable[[Any], object]


class Carrier:
    """A thread that carries packets from descriptors, over lines, to where they go.

    A packet that cannot be sent, because nobody is there or no room is, is lost, as on any line.

    Parameters
    ----------
    name : str
        Of the thread.
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
        descriptor : int
        receive : callable
            Returns the next packet, without waiting; raises BlockingIOError if there is none.
        line : DelayLine
        send : callable
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
            # Not a poll in whole milliseconds: the delay is to be what it says it is.
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
        # As much as there is at the moment, but no more: others have packets too.
        for _ in range(_CAPACITY):
            try:
                packet = way.receive()
            except BlockingIOError:
                return
            except OSError:
                return  # nobody listened where the last one went
            way.line.put(packet, time.monotonic())
