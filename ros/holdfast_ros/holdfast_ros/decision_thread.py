"""The thread on which a typed service answers, one request after another."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, TypeVar

__all__ = ["DecisionThread"]

_T = TypeVar("_T")


class DecisionThread:
    """Answers requests; ``max_waiting`` may wait besides the one that is being answered.

    The next one is refused as busy, so that the client can ask another service.
    """

    def __init__(self, max_waiting: int) -> None:
        self._max_waiting = max_waiting
        self._thread = ThreadPoolExecutor(1, "holdfast-ros-decisions")
        self._owed: set[Future[Any]] = set()
        self._takes_more = True
        self._lock = threading.Lock()

    @property
    def is_busy(self) -> bool:
        """Whether answers are owed."""
        with self._lock:  # a request that was handed over may have begun before it is noted
            return bool(self._owed)

    def take_no_more(self) -> None:
        """Have the waiting requests answered, and later ones refused."""
        self._takes_more = False

    def submit(self, answer: Callable[[], _T], refuse: Callable[[str], _T]) -> Future[_T]:
        """Have a request answered in its turn, or refused at once with the reason.

        The future is cancelled if this is closed before its turn.
        """
        with self._lock:
            busy = "" if self._takes_more else "this service ends"
            if len(self._owed) > self._max_waiting:
                busy = f"{self._max_waiting} requests are waiting already"
            if not busy:
                future = self._thread.submit(answer)
                self._owed.add(future)
        if busy:
            future = Future()
            future.set_result(refuse(busy))
        future.add_done_callback(self._settle)
        return future

    def close(self, timeout_s: float) -> None:
        """Stop; wait so long at most for the request that is being answered. May be repeated."""
        with self._lock:
            self._takes_more = False
            owed = list(self._owed)
        self._thread.shutdown(wait=False, cancel_futures=True)
        wait([future for future in owed if not future.cancelled()], timeout_s)

    def _settle(self, future: Future[Any]) -> None:
        with self._lock:
            self._owed.discard(future)
