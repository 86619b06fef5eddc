"""Where Rerun's data goes: to a viewer, to a file, or to both.

Rerun's client keeps what a viewer has not taken yet in memory without a bound, and waits for it
without a bound when it is closed. So it is flushed every now and then within a bounded time, and a
viewer that does not take that is given up. A file goes on without it.

This module imports Rerun (extra ``view``); import it only where something is to be viewed.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep
from typing import Any
from urllib.parse import urlsplit

import rerun as rr
import rerun.blueprint as rrb

from holdfast.errors import ViewError
from holdfast.reports.view_target import LOCAL_URL, ViewTarget

_APPLICATION = "holdfast"
_START_S = 20.0
"""Longest wait for a viewer that was started."""

_FLUSH_EVERY_S = 0.25
_FLUSH_S = 5.0
"""A viewer that does not take within this time what it was sent is given up."""

_LAST_FLUSH_S = 60.0
_CONNECT_S = 1.0

_ENDING_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class RerunStreams:
    """Logs the same to each of its sinks.

    Raises ViewError if the viewer cannot be started or reached, or the file not be written.
    """

    def __init__(self, target: ViewTarget) -> None:
        self._target = target
        self._streams: dict[str, rr.RecordingStream] = {}
        self._next_flush = 0.0
        self.lost: str | None = None
        """Why the viewer was given up."""

    @property
    def is_open(self) -> bool:
        """Whether anything is left to log to."""
        return bool(self._streams)

    def open(self, blueprint: rrb.Blueprint) -> None:
        """Open the file, and connect to the viewer, which is started if none listens here."""
        url, file = self._target
        if file is not None:
            stream = self._new("file")
            try:
                stream.save(file, default_blueprint=blueprint)
            except (RuntimeError, OSError) as error:
                raise ViewError(f"{file}: cannot be written: {error}") from error
        if url is not None:
            url = url or LOCAL_URL
            if not _listens(url):
                if self._target.viewer:
                    raise ViewError(
                        f"no Rerun viewer listens at {url}; start one there with "
                        "rerun --bind 0.0.0.0, or give no address to start one here"
                    )
                _start_viewer(url)
            self._new("viewer").connect_grpc(url, default_blueprint=blueprint)

    def _new(self, name: str) -> rr.RecordingStream:
        stream = self._streams[name] = rr.RecordingStream(_APPLICATION)
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        return stream

    def set_time(self, timeline: str, **moment: Any) -> None:
        """Set the time of what is logged next."""
        for stream in self._streams.values():
            stream.set_time(timeline, **moment)

    def log(
        self, entity: str | list[object], *shapes: rr.AsComponents, static: bool = False
    ) -> None:
        """Log something under a path."""
        for stream in self._streams.values():
            stream.log(entity, *shapes, static=static)

    def flush(self, *, last: bool = False) -> None:
        """Send what was logged, if it is time to; give up a viewer that does not take it.

        Raises ViewError if the file cannot be written.
        """
        now = monotonic()
        if now < self._next_flush and not last:
            return
        for name, stream in list(self._streams.items()):
            try:
                stream.flush(timeout_sec=_LAST_FLUSH_S if last else _FLUSH_S)
            except RuntimeError as error:
                # To close it would wait for it.
                del self._streams[name]
                _GIVEN_UP.append(stream)
                if name == "file":
                    raise ViewError(f"{self._target.file}: cannot be written: {error}") from error
                if "timed out" in str(error):
                    self.lost = f"took nothing for {_FLUSH_S:g} s"
                else:
                    self.lost = "was closed, or the connection was lost"
        self._next_flush = monotonic() + _FLUSH_EVERY_S

    def close(self) -> None:
        """Send the rest, and complete the file."""
        self.flush(last=True)
        for stream in self._streams.values():
            stream.disconnect()
        self._streams.clear()


_GIVEN_UP: list[rr.RecordingStream] = []
"""Streams that must not be collected: that, too, would wait."""


def _address(url: str) -> tuple[str, int]:
    parts = urlsplit(url)
    return parts.hostname or "127.0.0.1", parts.port or 9876


def _listens(url: str) -> bool:
    try:
        socket.create_connection(_address(url), _CONNECT_S).close()
    except OSError:
        return False
    return True


def _start_viewer(url: str) -> None:
    """Start a viewer that others on this machine alone can reach, and that outlives this run."""
    try:
        import rerun_cli
    except ImportError as error:
        raise ViewError("this rerun-sdk comes without its viewer; start one yourself") from error
    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    host, port = _address(url)
    # A worker blocks the signals that end a run, and its child would, too.
    before = signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING_SIGNALS)
    try:
        viewer = subprocess.Popen(
            [
                str(Path(rerun_cli.__file__).parent / name),
                *("--bind", host, "--port", str(port), "--expect-data-soon"),
            ],
            env=os.environ | {"RERUN_APP_ONLY": "true"},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    until = monotonic() + _START_S
    while not _listens(url):
        if viewer.poll() is not None:
            raise ViewError(
                f"Rerun's viewer ended with exit code {viewer.returncode} as soon as it was "
                "started; the command rerun says why"
            )
        if monotonic() > until:
            raise ViewError(f"Rerun's viewer does not listen at {url} after {_START_S:g} s")
        sleep(0.05)
