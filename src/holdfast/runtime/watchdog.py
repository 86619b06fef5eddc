"""A thread that ends this process when its event loop no longer turns.

systemd watches from outside (``WatchdogSec=``). A container engine only calls such a process
unhealthy and leaves it alone; once the process has ended, the engine starts it again.

The thread asks the loop for a sign and counts its own wake-ups until the sign comes. It reads no
clock: while the machine is suspended, or the process stopped or starved, neither of the two runs,
and almost nothing is counted. Native code that never releases the interpreter stops this thread,
too; only somebody outside can see that.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from holdfast.runtime.command_line import number, option

if TYPE_CHECKING:
    import asyncio

    from holdfast.runtime.events import EventSink


DEFAULT_WATCHDOG_S = 20.0
"""As ``WatchdogSec=`` of the units in ``deploy/systemd``."""

EXIT_STUCK = 128 + signal.SIGABRT
"""As of a process that systemd's watchdog ends."""

_WAKE_UPS = 20
"""Wake-ups in a row without a sign after which the loop is stuck."""

_MAX_FRAMES = 20
"""Innermost calls that the log names; a text there has 800 characters."""

_LAST_WORDS_S = 1.0
"""For the log to be written, by threads of its own."""


def watchdog_option(default: float | None, when: str = "") -> Any:
    """Declare the option ``--watchdog-s``."""
    return option(
        read=number(1.0, 3600.0, "s"),
        default=default,
        metavar="S",
        help="End this process when its event loop has stood still for so long, so that whatever "
        f"restarts it does{when}. Under systemd WatchdogSec= counts instead.",
    )


class LoopWatchdog:
    """Watches the loop that runs in the thread that makes it, from :meth:`start` on."""

    def __init__(self, loop: asyncio.AbstractEventLoop, limit_s: float, events: EventSink) -> None:
        self._loop = loop
        self._loop_thread = threading.get_ident()
        self._limit_s = limit_s
        self._events = events
        self._has_turned = True
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="holdfast-watchdog", daemon=True)

    def start(self) -> None:
        """Watch from now on; may be repeated."""
        if self._thread.ident is None:
            self._thread.start()

    def close(self) -> None:
        """Watch no more; may be repeated."""
        self._closed.set()

    def _turned(self) -> None:
        self._has_turned = True

    def _watch(self) -> None:
        missed = 0
        while not self._closed.wait(self._limit_s / _WAKE_UPS):
            if self._has_turned:
                missed, self._has_turned = 0, False
                try:
                    self._loop.call_soon_threadsafe(self._turned)
                except RuntimeError:  # the loop is closed
                    return
                continue
            missed += 1
            if missed == _WAKE_UPS:
                # On a thread of its own: the loop may stand still with a lock of the log.
                threading.Thread(target=self._report, daemon=True).start()
                time.sleep(_LAST_WORDS_S)
                os._exit(EXIT_STUCK)

    def _report(self) -> None:
        where: list[str] = []
        frame = sys._current_frames().get(self._loop_thread)
        while frame is not None and len(where) < _MAX_FRAMES:
            place = f"{Path(frame.f_code.co_filename).name}:{frame.f_lineno}"
            where.append(f"{frame.f_code.co_name} ({place})")
            frame = frame.f_back
        reason = f"the event loop has stood still for {self._limit_s:g} s; this process ends"
        self._events.event("stuck", reason=reason, where=" < ".join(where))
