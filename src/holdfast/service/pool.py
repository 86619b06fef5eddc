"""Threads for what takes longer than an event loop may stand still.

They are daemons, and nobody waits for one that computes when the process ends. (Those of
``concurrent.futures`` are waited for at exit, however long that takes.)
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from queue import SimpleQueue
from typing import Any, TypeAlias, TypeVar

__all__ = ["ThreadPool"]

_Result = TypeVar("_Result")
_Task: TypeAlias = tuple[asyncio.AbstractEventLoop, Callable[[], Any], Callable[[Any], None]]


class ThreadPool:
    """Runs functions on threads, and hands their results to an event loop.

    Its methods are called on the loop's thread.

    Parameters
    ----------
    num_threads : int
        At most; they are started as they are needed.
    name : str
        Of the threads.
    failed : callable
        Is called on the loop with an error that a function has raised.

    Attributes
    ----------
    num_open : int
        Functions whose results have not been handed over.
    """

    def __init__(
        self,
        num_threads: int,
        name: str,
        failed: Callable[[BaseException], None],
    ) -> None:
        self._num_threads = num_threads
        self._name = name
        self._failed = failed
        self._queue: SimpleQueue[_Task | None] = SimpleQueue()
        self._threads: list[threading.Thread] = []
        self.num_open = 0

    def submit(self, function: Callable[[], _Result], done: Callable[[_Result], None]) -> None:
        """Run a function on a thread, then ``done`` with its result on the running loop."""
        loop = asyncio.get_running_loop()
        self.num_open += 1
        if len(self._threads) < min(self.num_open, self._num_threads):
            name = f"{self._name}-{len(self._threads)}"
            thread = threading.Thread(target=self._work, name=name, daemon=True)
            self._threads.append(thread)
            thread.start()
        self._queue.put((loop, function, done))

    def close(self) -> None:
        """Let the threads end; one that computes is not waited for."""
        for _ in self._threads:
            self._queue.put(None)

    def _work(self) -> None:
        while (task := self._queue.get()) is not None:
            loop, function, done = task
            try:
                result = function()
            except BaseException as error:  # noqa: BLE001 - the loop's side must hear of any
                function, done, result = _nothing, self._failed, error
            try:
                loop.call_soon_threadsafe(self._hand_over, done, result)
            except RuntimeError:
                return  # the loop is closed: nobody waits for it any more
            # Nothing of it is held while the thread waits for the next.
            del task, function, done, result

    def _hand_over(self, done: Callable[[Any], None], result: object) -> None:
        self.num_open -= 1
        done(result)


def _nothing() -> None:
    pass
