"""A run in a viewer while it goes on, without delaying a decision.

The robot's loop hands over the records that it has just journalled, which take some hundred bytes a
step, and goes on. Another process (:mod:`holdfast.recording.live_follower`) folds them to the same
beliefs, computes the entropies again and draws them. So nothing of the viewer runs in the robot's
process: neither its memory nor its crash nor its closed window is the robot's concern.

If that process falls behind, it leaves out steps. If it takes nothing at all, what waits for it is
bounded, and then it goes on with the next trial.
"""

from __future__ import annotations

import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from time import monotonic
from typing import TYPE_CHECKING, TypeAlias

import msgspec

from holdfast.config.user_code import in_words
from holdfast.errors import ViewError
from holdfast.planning.outcome import TrialResult
from holdfast.protocol.events import Timing
from holdfast.protocol.records import Record
from holdfast.recording.live_follower import (
    HEADER_BYTES,
    EndedMessage,
    EventMessage,
    FinishMessage,
    FollowerReport,
    LostMessage,
    RecordsMessage,
    TimingMessage,
    ViewMessage,
    follow,
)
from holdfast.runtime.log_lines import json_line
from holdfast.runtime.workers import WorkerProcess, end_workers

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.recording.view_target import ViewTarget

__all__ = ["LiveView"]

_START_S = 60.0
"""Longest wait for the viewer, before the run begins."""

_CLOSE_S = 10.0
"""Longest wait for the rest to be drawn, when the run is over."""

_MAX_WAITING_BYTES = 16 << 20
"""Bound on what waits for the follower: about 100,000 steps."""

_POLL_S = 0.02

_Work: TypeAlias = Callable[..., None]


class LiveView:
    """Shows a run while it goes on; an event sink, too.

    Parameters
    ----------
    on_note : callable
        Gets what the user should know, once each.
    work : callable
        What the other process does.
    """

    def __init__(
        self,
        configuration: Configuration,
        target: ViewTarget,
        on_note: Callable[[str], None],
        work: _Work = follow,
    ) -> None:
        self._worker = WorkerProcess(
            "holdfast-view", work, (configuration.plain(), tuple(target)), threads=1
        )
        self._on_note = on_note
        # Events come from several threads.
        self._lock = threading.RLock()
        self._encode = msgspec.msgpack.Encoder().encode
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._sent_of_first = 0
        self._trial: int | None = None
        self._is_lost = False
        self._explaining: threading.Thread | None = None
        self._told = False
        self._open = False

    def start(self) -> None:
        """Start the other process, and wait until the viewer is there.

        Raises
        ------
        ViewError
            If it cannot be.
        """
        self._worker.start()
        connection = self._worker.connection
        if not connection.poll(_START_S):
            end_workers([self._worker])
            raise ViewError(f"the view was not ready within {_START_S:g} s")
        report = self._report()
        if report.error is not None:
            end_workers([self._worker])
            raise ViewError(report.error)
        os.set_blocking(connection.fileno(), False)
        self._open = True

    def records(self, trial: int, records: Sequence[Record]) -> None:
        """Take what was journalled of a trial, in order and from its beginning on."""
        if trial != self._trial:
            self._trial, self._is_lost = trial, False
        if not self._is_lost:
            self._send(RecordsMessage(time.time_ns(), trial, tuple(records)))

    def timing(self, timing: Timing) -> None:
        """Take who decided."""
        self._send(TimingMessage(time.time_ns(), timing))

    def ended(self, result: TrialResult) -> None:
        """Take the result of a trial."""
        brief = msgspec.structs.replace(result, decisions=None, sensing_ms=())
        self._send(EndedMessage(time.time_ns(), brief))

    def event(self, name: str, /, **fields: object) -> None:
        """Take an event."""
        now = time.time_ns()
        self._send(EventMessage(now, json_line(now, "robot", name, fields)))

    def close(self) -> None:
        """Let the rest be drawn, for a bounded time, and end the other process."""
        with self._lock:
            if self._open:
                self._send(FinishMessage())
            until = monotonic() + _CLOSE_S
            while self._open and monotonic() < until:
                self._write()
                if self._open and self._worker.connection.poll(_POLL_S):
                    self._open = False
                    self._explain(self._report(), "")
            if self._open:
                self._open = False
                self._tell(f"the view was not complete {_CLOSE_S:g} s after the run")
            if self._explaining is not None:
                self._explaining.join(_CLOSE_S)
            end_workers([self._worker])

    def _send(self, message: ViewMessage) -> None:
        """Hand a message over, or lose it with all that waited."""
        with self._lock:
            if not self._open:
                return
            try:
                data = self._encode(message)
            except Exception as error:  # noqa: BLE001 - the robot goes on without its view
                self._open = False
                self._tell(f"the view has ended: {in_words(error)}; the run goes on without it")
                return
            self._waiting.append(len(data).to_bytes(HEADER_BYTES, "little") + data)
            self._waiting_bytes += HEADER_BYTES + len(data)
            self._write()
            if self._waiting_bytes <= _MAX_WAITING_BYTES:
                return
            # What is on its way has to arrive whole.
            kept = [self._waiting[0]] if self._sent_of_first else []
            self._waiting = deque(kept)
            self._waiting_bytes = sum(map(len, kept))
            self._is_lost = True
            self._tell("the viewer takes nothing: the view goes on with the next trial")
            self._send(LostMessage())

    def _write(self) -> None:
        """Write as much as the pipe takes at once."""
        descriptor = self._worker.connection.fileno()
        while self._waiting:
            first = self._waiting[0]
            try:
                self._sent_of_first += os.write(descriptor, first[self._sent_of_first :])
            except BlockingIOError:
                return
            except OSError:
                self._open = False
                self._waiting.clear()
                # Its end may take a moment, for which the robot does not wait.
                self._explaining = threading.Thread(target=self._explain_now, daemon=True)
                self._explaining.start()
                return
            if self._sent_of_first == len(first):
                self._waiting.popleft()
                self._waiting_bytes -= len(first)
                self._sent_of_first = 0

    def _report(self) -> FollowerReport:
        """Return what the other process says, or that it has died."""
        connection = self._worker.connection
        os.set_blocking(connection.fileno(), True)
        message = self._worker.receive() if connection.poll(0) else None
        if message is None:
            return FollowerReport(f"its process {self._worker.how_it_ended()[0]}")
        return msgspec.msgpack.decode(message, type=FollowerReport)

    def _explain_now(self) -> None:
        self._explain(self._report(), "; the run goes on without it")

    def _explain(self, report: FollowerReport, run: str) -> None:
        if report.error is not None:
            self._tell(f"the view has ended: {report.error}{run}")
        elif report.left_out:
            self._tell(
                f"the view was too slow for {report.left_out:,} of {report.steps:,} steps and "
                "left them out; holdfast view shows all of them"
            )

    def _tell(self, text: str) -> None:
        if not self._told:
            self._told = True
            self._on_note(text)
