"""What started this process, and wants to be told how it is: systemd, by ``sd_notify(3)``.

A unit with ``Type=notify`` names a socket in the variable ``NOTIFY_SOCKET``, and what it gets there
are lines of text. That a process runs says little; so with ``WatchdogSec=`` a line from the event
loop has to come again and again, and where none comes the process is ended and started anew. The
lines come from the loop itself: one that stands still sends none.
"""

from __future__ import annotations

import contextlib
import os
import re
import socket
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import asyncio

__all__ = ["ServiceManager"]

_LOOK_EVERY_S = 1.0
"""At least so often it is looked whether the status has changed."""

_LEAST_PAUSE_S = 0.01


class ServiceManager:
    """Tells the service manager, if there is one; else its methods do nothing.

    It is found by variables of the environment, which are removed: what this process starts must
    not speak in its name. So one is made, before anything is started.
    """

    def __init__(self) -> None:
        address = os.environ.pop("NOTIFY_SOCKET", "")
        watchdog_us = os.environ.pop("WATCHDOG_USEC", "")
        its_process = os.environ.pop("WATCHDOG_PID", str(os.getpid()))
        self._socket: socket.socket | None = None
        self._beats = False
        self._every_s = _LOOK_EVERY_S
        self._told: str | None = None
        self._owes_ready = False
        self._timer: asyncio.TimerHandle | None = None
        if not address.startswith(("/", "@")):
            return
        # One that begins with @ is no file: its name begins with a zero byte.
        self._address = f"\0{address[1:]}" if address.startswith("@") else address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        if its_process == str(os.getpid()) and re.fullmatch("0*[1-9][0-9]{0,17}", watchdog_us):
            self._beats = True
            self._every_s = min(_LOOK_EVERY_S, max(_LEAST_PAUSE_S, 0.5e-6 * int(watchdog_us)))

    def watch(
        self,
        loop: asyncio.AbstractEventLoop,
        status: Callable[[], str],
        is_alive: Callable[[], bool] = lambda: True,
    ) -> None:
        """Tell from now on, out of this loop, that it moves, and the status whenever it changes.

        Parameters
        ----------
        loop : asyncio.AbstractEventLoop
        status : callable
            Returns a few words for people.
        is_alive : callable
            While it returns False, it is not told that the loop moves.
        """
        if self._socket is None:
            return

        def look() -> None:
            if self._owes_ready:
                self.ready()
            lines = []
            text = status()
            if text != self._told:
                self._told = text
                lines.append(f"STATUS={text}")
            if self._beats and is_alive():
                lines.append("WATCHDOG=1")
            self._tell(*lines)
            self._timer = loop.call_later(self._every_s, look)

        look()

    def ready(self) -> None:
        """Tell that what was started is up."""
        self._owes_ready = not self._tell("READY=1")

    def reloading(self) -> None:
        """Tell that files are read again; when they are, tell that it is :meth:`ready`."""
        self._tell("RELOADING=1", f"MONOTONIC_USEC={time.monotonic_ns() // 1000}")

    def stopping(self, within_s: float = 0.0) -> None:
        """Tell that this process is about to end, and how long that may take."""
        extended = [f"EXTEND_TIMEOUT_USEC={within_s * 1e6:.0f}"] if within_s else []
        self._tell("STOPPING=1", *extended)

    def close(self) -> None:
        """Tell that no loop moves from now on, and nothing more after that; may be repeated."""
        if self._timer is not None:
            self._timer.cancel()
        if self._beats:
            self._beats = False
            self._tell("WATCHDOG_USEC=0")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, *lines: str) -> bool:
        """Return whether it could be told."""
        if self._socket is None or not lines:
            return False
        # Whoever does not read, or is gone, is no reason to stop.
        with contextlib.suppress(OSError):
            self._socket.sendto("\n".join(lines).encode(), self._address)
            return True
        return False
