"""Garbage that refers to itself, collected by the event loop's thread, a little at a time.

Python collects it in whichever thread makes one object too many, and holds the interpreter
meanwhile. Threads that plan have a lower priority. On a busy machine such a thread is set aside in
the middle of a collection, and the event loop with all its robots waits for it (0.3 s were seen).
So automatic collection is off, and a timer of the loop collects what few milliseconds can.
"""

from __future__ import annotations

import gc
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    import asyncio

_INTERVAL_S: Final = 0.25

_YOUNG_OBJECTS: Final = 500
"""From so many on a collection is worth its time."""

_YOUNGER_COLLECTIONS: Final = 10
"""After so many an older generation is collected, too, as Python does."""


def collect_in_loop(loop: asyncio.AbstractEventLoop) -> None:
    """Collect garbage in the running loop from now on, as long as it runs, and only there.

    What there is already (loaded modules, mostly) stays and is never scanned.
    """
    gc.disable()
    gc.freeze()

    def collect() -> None:
        loop.call_later(_INTERVAL_S, collect)
        young, younger, old = gc.get_count()
        if young >= _YOUNG_OBJECTS:
            old_too = old >= _YOUNGER_COLLECTIONS
            gc.collect(0 if younger < _YOUNGER_COLLECTIONS else 2 if old_too else 1)

    loop.call_later(_INTERVAL_S, collect)
