"""Threads that may still be in somebody else's code when the process ends.

Who closes a link does not wait for ever for the threads that are inside the network library on its
behalf: in there a peer that does not read holds them up. But a thread that comes back from foreign
code while the interpreter goes down aborts the process, with a core dump after all work was done.
So those that were left behind are waited for once more at the very end: for as long as they can
take, or, where it is known with which status the process is to end, only briefly, and then it ends
without the interpreter's last steps.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import sys
import threading
import weakref
from collections.abc import Iterable
from time import monotonic

__all__ = ["end_with", "join_until"]

_EXIT_TIMEOUT_S = 12.0
"""How long a process that ends waits for all of them: Zenoh gives up after ten."""

_EXIT_TIMEOUT_WITH_STATUS_S = 2.0
"""How long it waits if it can end without them."""

_EXIT_WAIT_S = 0.02
"""In waits so short: of them a machine that stands still meanwhile uses up one, not all."""

_left: weakref.WeakSet[threading.Thread] = weakref.WeakSet()

_status: int | None = None


def join_until(threads: Iterable[threading.Thread], deadline_s: float) -> None:
    """Wait for threads to end; those that do not in time are waited for again at exit.

    Parameters
    ----------
    threads : iterable of Thread
        Those that are not the calling one; daemons, or the interpreter waits for them anyway.
    deadline_s : float
        Until when, by :func:`time.monotonic`.
    """
    for thread in threads:
        thread.join(max(0.0, deadline_s - monotonic()))
        if thread.is_alive():
            _left.add(thread)


def end_with(status: int) -> None:
    """Tell with which status this process is about to end.

    It then need not wait for long for threads that are held up.

    Parameters
    ----------
    status : int
        Its exit status, whatever happens from now on.
    """
    global _status
    _status = status


def _wait_at_exit() -> None:
    timeout_s = _EXIT_TIMEOUT_S if _status is None else _EXIT_TIMEOUT_WITH_STATUS_S
    with contextlib.suppress(KeyboardInterrupt):  # somebody is in a hurry
        for _ in range(round(timeout_s / _EXIT_WAIT_S)):
            alive = [thread for thread in _left if thread.is_alive()]
            if not alive:
                return
            alive[0].join(_EXIT_WAIT_S)
    if _status is not None:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):  # nobody reads it, or it is closed
                stream.flush()
        os._exit(_status)


# Now, so that it runs after whatever closes a link at exit: what is registered first is called
# last, and what is registered by something that is called at exit is not called at all.
atexit.register(_wait_at_exit)
