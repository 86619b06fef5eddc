"""A bound on the memory that the C library keeps of what a service has freed.

glibc allocates from *arenas*, eight per core, so that threads need not wait for each other. Freed
memory returns to its arena, and an arena shrinks only at its end. So each arena keeps the most that
its threads ever held at once. These peaks come by chance, and until every arena has had its own the
service seems to leak.

A service gains little from arenas: its threads mostly hold the interpreter when they allocate.
"""

from __future__ import annotations

import ctypes
import os

_ARENAS = 2
"""One for the thread that holds the interpreter, one for those that compute without it."""

_M_ARENA_MAX = -8
"""``M_ARENA_MAX`` of ``malloc.h``, the same on all platforms."""


def limit_arenas() -> None:
    """Have all threads of this process share two arenas; call it before there are many threads.

    glibc's own environment variables take precedence. With another C library nothing is done.
    """
    tunables = os.environ.get("GLIBC_TUNABLES", "")
    if "MALLOC_ARENA_MAX" in os.environ or "glibc.malloc.arena_max" in tunables:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, _ARENAS)
