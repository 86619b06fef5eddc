"""Threads for work that would block the event loop for too long.

They are daemons, so the end of the process does not wait for a computation. (It waits for the
threads of ``concurrent.futures``, however long that takes.)
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, TypeAlias, TypeVar

_Result = TypeVar("_Result")
_Task: TypeAlias = tuple[Callable[[], Any], Callable[[Any], None]]


class ThreadPool:
    """Runs functions on threads, and hands their results to an event loop.

    Its methods are called on the loop's thread. Threads start when they are needed. ``failed`` is
    called with an exception of a function; without it the loop's exception handler gets that. By
    ``niceness`` the threads get less of the processors while others want them; 5 is a third. (Only
    Linux knows that of one thread of a process.)
    """

    def __init__(
        self,
        num_threads: int,
        name: str,
        failed: Callable[[BaseException], None] | None = None,
        niceness: int = 0,
    ) -> None:
        self._niceness = niceness
        self._num_threads = num_threads
        self._name = name
        self._failed = failed or _raise
        self._queue: SimpleQueue[_Task | None] = SimpleQueue()
        self._threads: list[threading.Thread] = []
        self._closed = False
        self.num_open = 0  # functions whose results have not been delivered

    def submit(self, function: Callable[[], _Result], done: Callable[[_Result], None]) -> None:
        """Run a function on a thread, then ``done`` with its result on the running loop."""
        self._loop = asyncio.get_running_loop()
        self.num_open += 1
        if len(self._threads) < min(self.num_open, self._num_threads):
            name = f"{self._name}-{len(self._threads)}"
            thread = threading.Thread(target=self._work, name=name, daemon=True)
            self._threads.append(thread)
            thread.start()
        self._queue.put((function, done))

    def close(self, timeout_s: float = 0.0, last: Callable[[], object] | None = None) -> None:
        """End the threads, and deliver no more; wait so long for the computations that run.

        ``last`` is run after all else, unless no thread was needed. May be repeated.
        """
        self._closed = True
        if last is not None:
            self.num_open += 1
            self._queue.put((last, _dropped))
        for _ in self._threads:
            self._queue.put(None)
        for each in self._threads:
            each.join(timeout_s)

    def _work(self) -> None:
        if self._niceness and sys.platform == "linux":
            thread = threading.get_native_id()
            # A sandbox may refuse it (systemd's SystemCallFilter=~@resources); then all are equal.
            with contextlib.suppress(OSError):
                now = os.getpriority(os.PRIO_PROCESS, thread)
                os.setpriority(os.PRIO_PROCESS, thread, min(19, now + self._niceness))
        while (task := self._queue.get()) is not None:
            function, done = task
            try:
                result = function()
            except BaseException as error:  # noqa: BLE001 - the loop handles it
                done, result = self._failed, error
            # A loop that is closed wants no result; what was queued last is run all the same.
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._deliver, done, result)
            # Release everything before waiting for the next task.
            del task, function, done, result

    def _deliver(self, done: Callable[[Any], None], result: object) -> None:
        self.num_open -= 1
        if not self._closed:
            done(result)


def _raise(error: BaseException) -> None:
    raise error


def _dropped(result: object) -> None:
    """Take a result that nobody wants."""
