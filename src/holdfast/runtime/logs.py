"""The event log: events as lines on a stream or in a file.

A log must never hurt the process that writes it. A closed terminal, a full disk or a value that
cannot be written costs at most the line. A terminal or pipe that nobody reads must not stop the
event loop, so a thread writes to those, from a bounded queue.

``logging.handlers`` would not do: its import takes 4 to 5 ms of a service's start, and its listener
waits without bound for a reader that does not read.
"""

from __future__ import annotations

import contextlib
import os
import stat
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Self, TextIO

from holdfast.errors import OutputError
from holdfast.runtime.command_line import one_of, option
from holdfast.runtime.log_lines import LINES, LogFormat

_MAX_QUEUED_LINES = 10_000
_FLUSH_TIMEOUT_S = 0.5


def log_option(
    help: str = "Form of the ready line and of the log on standard error: text or json.",  # noqa: A002
) -> Any:
    """Declare the option ``--log``, whose value is a ``LogFormat``."""
    return option(metavar="FORMAT", read=one_of(*LINES), default="text", help=help)


class EventLog:
    """Writes events as lines; thread-safe, and safe in signal handlers.

    A stream stays open when the log is closed. A file is appended to, each line in one piece, so
    several processes can write to the same file; OutputError if it cannot be opened. ``component``
    is who reports: ``robot``, or a service's name. (The text form writes ``service`` for all
    services, because names are longer than the column.) ``clock`` returns nanoseconds since 1970.
    """

    def __init__(
        self,
        target: TextIO | Path | str,
        *,
        format: LogFormat = "text",  # noqa: A002 (nothing else says it as well)
        component: str,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        self._line = LINES[format]
        self._component = component
        self._clock = clock
        self._stream: TextIO | None = None
        self._descriptor: int | None = None
        # Reentrant: a signal handler may report an event while this thread writes one.
        self._lock = threading.RLock()
        self._writer: _BackgroundWriter | None = None
        if isinstance(target, (str, Path)):
            self._descriptor = _open_for_lines(Path(target))
        else:
            self._stream = target
            if _may_block(target):
                self._writer = _BackgroundWriter(target)

    def event(self, name: str, /, **fields: object) -> None:
        """Write an event: numbers, texts, None, lists and mappings of them; bytes as hexadecimal.

        Names of fields end in their unit; those in ``_ms`` are rounded to three digits.
        """
        now_ns = self._clock()
        try:
            line = self._line(now_ns, self._component, name, fields)
        except Exception as error:  # noqa: BLE001
            # A field's own methods must not end a robot's run.
            unwritable = {"unwritable_fields": type(error).__name__}
            line = self._line(now_ns, self._component, name, unwritable)
        # ValueError: the stream is closed. RuntimeError: a signal handler writes in mid-write.
        with self._lock, contextlib.suppress(OSError, ValueError, RuntimeError):
            if self._descriptor is not None:
                os.write(self._descriptor, line.encode())
            elif self._writer is not None:
                self._writer.put(line)
            elif self._stream is not None:
                _write_line(self._stream, line)

    def close(self) -> None:
        """Ignore further events; may be repeated. Waits at most 0.5 s for a slow terminal."""
        with self._lock:
            writer, self._writer = self._writer, None
            self._stream = None
            if self._descriptor is not None:
                os.close(self._descriptor)
                self._descriptor = None
        if writer is not None:
            writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def write_event(component: str, name: str, /, **fields: object) -> None:
    """Write one event to the standard error, as JSON, in a process that has no log open."""
    with EventLog(sys.stderr, format="json", component=component) as log:
        log.event(name, **fields)


class _BackgroundWriter:
    """Writes lines on a daemon thread, from a queue that signal handlers may enter, too."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self._lines: SimpleQueue[str | None] = SimpleQueue()
        self._thread: threading.Thread | None = None

    def put(self, line: str) -> None:
        """Queue a line, or drop it if the queue is full. The caller holds a lock."""
        if self._lines.qsize() >= _MAX_QUEUED_LINES:
            return
        self._lines.put(line)
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name="holdfast-log", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Write what can be written in time."""
        self._lines.put(None)
        if self._thread is not None:
            self._thread.join(_FLUSH_TIMEOUT_S)

    def _work(self) -> None:
        while (line := self._lines.get()) is not None:
            with contextlib.suppress(OSError, ValueError, RuntimeError):
                _write_line(self._stream, line)


def _may_block(stream: TextIO) -> bool:
    """Return whether a write to a stream may wait for a reader."""
    try:
        mode = os.fstat(stream.fileno()).st_mode
    except (OSError, ValueError, AttributeError):
        return False
    return stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or stat.S_ISSOCK(mode)


def _write_line(stream: TextIO, line: str) -> None:
    try:
        stream.write(line)
    except UnicodeEncodeError:
        stream.write(line.encode("ascii", "backslashreplace").decode())
    stream.flush()


def _open_for_lines(path: Path) -> int:
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
        size = os.fstat(descriptor).st_size
        # A power cut may have left half a line.
        if size and os.pread(descriptor, 1, size - 1) != b"\n":
            os.write(descriptor, b"\n")
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {error.strerror}") from error
    return descriptor
