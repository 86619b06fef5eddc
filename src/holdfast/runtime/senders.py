"""Threads that send, so that whoever does not read what he is sent holds up nobody else.

To send can block, if the other end does not read, for as long as a link can be silent. So what is
to be sent is put into *lanes*, one for each addressee; of a lane one thread sends at a time, and
whenever the last free thread begins to send, one more is started.

Few of them send at the same time, as long as none is held up: all threads of a process take turns
with the interpreter, and thirty that send a hundred bytes each leave next to nothing of it to the
one that decides what to send.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection
from queue import SimpleQueue
from time import monotonic
from typing import Protocol

from holdfast.runtime.last_threads import join_until

__all__ = ["NOBODY", "Sendable", "Senders"]

NOBODY = b""
"""The lane of what is for nobody in particular: it can wait."""

_MAX_THREADS = 32
"""So many addressees can be blocked, and the others notice nothing."""

_AT_ONCE = 2
"""Threads that send, besides those that are held up."""

_HELD_UP_S = 0.02
"""A thread that has sent for so long is held up by whoever is to receive it."""

_SENT_AT_A_TIME = 16
"""Calls of a lane that are sent to before it is another one's turn."""


class Sendable(Protocol):
    """What has something to send: each time it is posted, what it has by then is sent."""

    @property
    def lane(self) -> bytes:
        """Of whom it goes to."""
        ...

    def send(self) -> None:
        """Send what there is; may block."""
        ...


class Senders:
    """Sends what calls have in their outboxes, so that one that blocks holds up its lane alone.

    Parameters
    ----------
    name : str
        Of the threads.
    failed : callable or None
        Is called on a thread that fails, which is a defect; None lets Python tell of it.
    """

    def __init__(self, name: str, failed: Callable[[], None] | None = None) -> None:
        self._name = name
        self._failed = failed
        self._lock = threading.Lock()
        # Those in which something waits or is being sent.
        self._lanes: dict[bytes, deque[Sendable]] = {}
        self._turns: SimpleQueue[bytes | None] = SimpleQueue()
        self._by_itself = threading.Lock()
        # When each thread that sends, and does not count as held up, has begun to.
        self._sending: dict[threading.Thread, float] = {}
        self._turn_is_over = threading.Condition(self._lock)
        self._threads: list[threading.Thread] = []
        self._free = 0
        self._closed = False

    def start(self) -> None:
        """Begin to send."""
        with self._lock:
            self._add_thread()

    def post(self, calls: Collection[Sendable]) -> None:
        """Have the outboxes of these calls sent; never blocks."""
        for lane in self._entered(calls):
            self._turns.put(lane)

    def send(self, calls: Collection[Sendable]) -> None:
        """Send the outboxes of these calls, at once if no other thread is doing that.

        What cannot be sent at once, and what is in the lane of nobody, is posted.
        """
        for lane in self._entered(calls):
            if lane != NOBODY and self._by_itself.acquire(blocking=False):
                try:
                    self._send(lane)
                finally:
                    self._by_itself.release()
            else:
                self._turns.put(lane)

    def close(self, until: float) -> None:
        """Let the threads go; those that are blocked are not waited for beyond this time."""
        with self._lock:
            self._closed = True
            threads = list(self._threads)
        for _ in threads:
            self._turns.put(None)
        join_until(threads, until)

    def _entered(self, calls: Collection[Sendable]) -> list[bytes]:
        """Put calls into their lanes; return the lanes that nobody was taking care of."""
        idle = []
        with self._lock:
            for call in calls:
                lane = self._lanes.get(call.lane)
                if lane is None:
                    self._lanes[call.lane] = deque((call,))
                    idle.append(call.lane)
                else:
                    lane.append(call)
        return idle

    def _send(self, lane: bytes) -> None:
        """Send the first that wait in a lane, and leave the rest for another turn."""
        calls = self._lanes[lane]
        for _ in range(_SENT_AT_A_TIME):
            with self._lock:
                if not calls:
                    del self._lanes[lane]
                    return
                call = calls.popleft()
            call.send()
        self._turns.put(lane)

    def _add_thread(self) -> None:
        """Start another thread; the lock is held."""
        if self._closed or len(self._threads) >= _MAX_THREADS:
            return
        thread = threading.Thread(
            target=self._run, name=f"{self._name}-{len(self._threads)}", daemon=True
        )
        self._free += 1
        self._threads.append(thread)
        thread.start()

    def _wait_for_turn(self) -> None:
        """Wait until few others send, not counting those that are held up; the lock is held."""
        while len(self._sending) >= _AT_ONCE:
            slowest = min(self._sending, key=lambda thread: self._sending[thread])
            patience_s = self._sending[slowest] + _HELD_UP_S - monotonic()
            if patience_s <= 0.0:
                del self._sending[slowest]
            else:
                self._turn_is_over.wait(patience_s)
        self._sending[threading.current_thread()] = monotonic()

    def _end_turn(self) -> None:
        """Let another thread send; the lock is held."""
        if self._sending.pop(threading.current_thread(), None) is not None:
            self._turn_is_over.notify()

    def _run(self) -> None:
        try:
            while (lane := self._turns.get()) is not None:
                with self._lock:
                    self._free -= 1
                    if not self._free:
                        # This one may be held up; somebody has to be there for the next lane.
                        self._add_thread()
                    self._wait_for_turn()
                self._send(lane)
                with self._lock:
                    self._free += 1
                    self._end_turn()
        except BaseException:
            if self._failed is None:
                raise
            self._failed()
