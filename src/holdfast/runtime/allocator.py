"""How much of the memory that a service gives back the C library keeps.

glibc hands out memory from *arenas*, eight for each core, so that threads that allocate at the same
time do not wait for each other. What is freed goes back to the arena that it came from, and an
arena shrinks at its end alone. So each of them grows to the most that its threads ever held at the
same time, and keeps that. The greatest moments of a service's workers come by chance, so it seems
to leak until every arena has had its own.

A service gains little by arenas, since its threads mostly hold the interpreter when they allocate.
"""

from __future__ import annotations

import ctypes
import os

__all__ = ["limit_arenas"]

_ARENAS = 2
"""One for whoever holds the interpreter, and one for those who compute without it."""

_M_ARENA_MAX = -8
"""Of ``malloc.h``, the same on all platforms."""


def limit_arenas() -> None:
    """Have all threads of this process share a few arenas; to be called before there are many.

    Whoever starts the process may choose another number by glibc's own environment variables. Where
    there is another C library, nothing is done.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if "MALLOC_ARENA_MAX" in os.environ or "glibc.malloc.arena_max" in tunables:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _ARENAS)
