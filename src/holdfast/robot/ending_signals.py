"""SIGINT, SIGTERM and SIGHUP as events of a loop: the first ends a run in order, the second now.

``loop.add_signal_handler`` does not fit: while user code runs, which may never return, it reports
neither the first signal nor the second.
"""

from __future__ import annotations

import asyncio
import contextlib
import signal
import socket
import threading
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def ending_signals(
    loop: asyncio.AbstractEventLoop, on_signal: Callable[[int], None]
) -> Iterator[None]:
    """Handle the first ending signal by a callback, within a ``with`` block of the main thread.

    Before the callback runs, the previous handlers are restored, so a second signal has its usual
    effect. In other threads, which receive no signals, nothing changes. Ignored signals stay
    ignored. ``on_signal`` is called in the signal handler, so it must not wait.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    saved = {
        number: before
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        if (before := signal.getsignal(number)) is not signal.SIG_IGN
    }

    def restore() -> None:
        for number, before in saved.items():
            signal.signal(number, before)

    def handle(number: int, frame: object) -> None:
        del frame
        restore()
        on_signal(number)

    # A signal that arrives just before the loop sleeps wakes it by a byte in this pair.
    reader, writer = socket.socketpair()
    with reader, writer:
        for end in (reader, writer):
            end.setblocking(False)
        loop.add_reader(reader, reader.recv, 4096)
        wakeup_before = signal.set_wakeup_fd(writer.fileno(), warn_on_full_buffer=False)
        try:
            for number in saved:
                signal.signal(number, handle)
            yield
        finally:
            restore()
            signal.set_wakeup_fd(wakeup_before)
            loop.remove_reader(reader)
