"""The guard's log: a line on the standard error for each event, as text or as JSON."""

from __future__ import annotations

import contextlib
import datetime as dt
import json
import queue
import threading
from collections.abc import Mapping
from typing import TextIO

_MAX_QUEUED_LINES = 1000
_MAX_LINE = 4000
_FLUSH_TIMEOUT_S = 0.5


class EventLog:
    """Writes events as lines.

    A thread writes, from a bounded queue: a terminal or pipe that nobody reads must not stop the
    guard. Lines beyond the bound are lost.
    """

    def __init__(self, stream: TextIO, *, as_json: bool) -> None:
        self._stream = stream
        self.as_json = as_json
        self._lines: queue.Queue[str | None] = queue.Queue(_MAX_QUEUED_LINES)
        self._thread = threading.Thread(target=self._work, name="log", daemon=True)
        self._thread.start()

    def event(self, name: str, /, **fields: object) -> None:
        """Write an event: a name, and fields in plain data or with a text of their own."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait((json_line if self.as_json else _text)(name, fields))

    def close(self) -> None:
        """Write what can be written in half a second."""
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(None)
        self._thread.join(_FLUSH_TIMEOUT_S)

    def _work(self) -> None:
        while (line := self._lines.get()) is not None:
            with contextlib.suppress(OSError, ValueError):
                self._stream.write(f"{line}\n")
                self._stream.flush()


def json_line(name: str, fields: Mapping[str, object]) -> str:
    """Return an event as JSON, on one line."""
    head = {"time": dt.datetime.now(dt.UTC).isoformat(), "component": "ros1-guard", "event": name}
    return json.dumps({**head, **fields}, default=str, separators=(",", ":"))


def _text(name: str, fields: Mapping[str, object]) -> str:
    parts = []
    for key, value in fields.items():
        shown = f"{value:.1f}" if isinstance(value, float) else str(value)
        if value is not None:
            parts.append(shown if key == "reason" else f"{key.replace('_', ' ')} {shown}")
    now = dt.datetime.now().astimezone().isoformat(timespec="milliseconds")
    line = f"{now} {name.replace('_', ' ')}: {', '.join(parts)}"[:_MAX_LINE]
    return "".join(each if each.isprintable() else ascii(each)[1:-1] for each in line)
