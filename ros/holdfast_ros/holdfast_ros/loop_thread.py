"""An asyncio loop on its own thread, which runs while other threads wait or compute."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, wait
from typing import Any, TypeVar

from holdfast.errors import TransportError

_T = TypeVar("_T")


class LoopThread:
    """A loop that runs until it is closed."""

    def __init__(self, name: str) -> None:
        self._loop = asyncio.new_event_loop()
        self._ended: Future[Any] = Future()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def run(self, coroutine: Coroutine[Any, Any, _T], within_s: float | None = None) -> _T:
        """Run a coroutine there, and wait at most ``within_s`` for its result.

        Raises TransportError if it takes longer, or this is closed before.
        """
        try:
            future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        except RuntimeError:
            coroutine.close()
            raise TransportError("it is closed") from None
        try:
            wait((future, self._ended), within_s, FIRST_COMPLETED)  # an ended loop runs none
            if future.done():
                return future.result()
            text = "it is closed" if self._ended.done() else f"it took longer than {within_s:g} s"
            raise TransportError(text)
        except CancelledError:
            raise TransportError("it is closed") from None
        finally:
            self.call(future.cancel)

    def call(self, function: Callable[..., object], *arguments: object) -> None:
        """Call a function there; after the end nothing happens."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *arguments)

    def close(self, timeout_s: float) -> None:
        """End the loop; may be repeated."""
        self.call(self._loop.stop)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:  # its end cancels all tasks
            runner.get_loop().run_forever()
        self._ended.set_result(None)
