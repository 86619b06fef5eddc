"""Reports to systemd, by ``sd_notify(3)``, and a watchdog where systemd does not watch.

A unit with ``Type=notify`` names a socket in ``NOTIFY_SOCKET`` and reads lines of text from it.
With ``WatchdogSec=`` it expects a line from the event loop at intervals, and restarts the process
when none comes. The loop itself sends them, so a stalled loop sends none. Without ``WatchdogSec=``
the process watches its loop itself (:mod:`holdfast.runtime.watchdog`). Both begin when it is ready.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from holdfast.runtime.watchdog import LoopWatchdog

if TYPE_CHECKING:
    import asyncio

    from holdfast.runtime.events import EventSink


_CHECK_INTERVAL_S = 1.0
"""The status is checked for changes at least this often."""

_MIN_INTERVAL_S = 0.01


class ServiceManager:
    """Notifies the service manager; without one only the watchdog of ``watchdog_s`` is at work.

    The constructor reads environment variables and removes them, so that child processes do not
    notify in this one's name. Make it before any child is started.
    """

    def __init__(self, watchdog_s: float | None = None) -> None:
        address = os.environ.pop("NOTIFY_SOCKET", "")
        watchdog_us = os.environ.pop("WATCHDOG_USEC", "")
        watched_process = os.environ.pop("WATCHDOG_PID", str(os.getpid()))
        self._socket: socket.socket | None = None
        self._has_watchdog = False
        self._watchdog_s = watchdog_s
        self._watchdog: LoopWatchdog | None = None
        self._interval_s = _CHECK_INTERVAL_S
        self._last_status: str | None = None
        self._ready_is_pending = False
        self._timer: asyncio.TimerHandle | None = None
        if not address.startswith(("/", "@")):
            return
        # One that begins with @ is no file: its name begins with a zero byte.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if watched_process == str(os.getpid()) and re.fullmatch("0*[1-9][0-9]{0,17}", watchdog_us):
            self._has_watchdog = True
            self._watchdog_s = None
            self._interval_s = min(
                _CHECK_INTERVAL_S, max(_MIN_INTERVAL_S, 0.5e-6 * int(watchdog_us))
            )

    def watch(
        self,
        loop: asyncio.AbstractEventLoop,
        events: EventSink,
        status: Callable[[], str],
        is_alive: Callable[[], bool] = lambda: True,
    ) -> None:
        """Send watchdog lines from this loop while ``is_alive``, and the status when it changes.

        ``events`` hears of a loop that the process's own watchdog finds stuck.
        """
        if self._watchdog_s is not None:
            self._watchdog = LoopWatchdog(loop, self._watchdog_s, events)
        if self._socket is None:
            return

        def check() -> None:
            if self._ready_is_pending:
                self.ready()
            lines = []
            text = status()
            if text != self._last_status:
                self._last_status = text
                lines.append(f"STATUS={text}")
            if self._has_watchdog and is_alive():
                lines.append("WATCHDOG=1")
            self._send(*lines)
            self._timer = loop.call_later(self._interval_s, check)

        check()

    def starting(self, within_s: float) -> None:
        """Report that the process has yet to be ready, and for how long it may go on so."""
        self._send(f"EXTEND_TIMEOUT_USEC={within_s * 1e6:.0f}")

    def ready(self) -> None:
        """Report that the process is ready; its loop is watched from now on."""
        self._ready_is_pending = not self._send("READY=1")
        if self._watchdog is not None:
            self._watchdog.start()

    def reloading(self) -> None:
        """Report that files are read again; :meth:`ready` reports the end of that."""
        self._send("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self, within_s: float = 0.0) -> None:
        """Report that this process is about to end, and how long that may take."""
        extended = [f"EXTEND_TIMEOUT_USEC={within_s * 1e6:.0f}"] if within_s else []
        self._send("STOPPING=1", *extended)

    def close(self) -> None:
        """Switch the watchdog off, and report nothing more; may be repeated."""
        if self._watchdog is not None:
            self._watchdog.close()
        if self._timer is not None:
            self._timer.cancel()
        if self._has_watchdog:
            self._has_watchdog = False
            self._send("WATCHDOG_USEC=0")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> bool:
        """Send lines; return whether they could be sent."""
        if self._socket is None or not lines:
            return False
        with contextlib.suppress(OSError):
            self._socket.sendto("\n".join(lines).encode(), self._address)
            return True
        return False
