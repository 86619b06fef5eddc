"""A run in a viewer while it goes on, without delaying a decision.

Another process (:mod:`holdfast.reports.live_follower`) reads the run's files, folds the records
to the same beliefs, computes the entropies again and draws them. The robot hands it nothing, so
nothing of the viewer is the robot's concern: neither its memory nor its crash nor its closed
window. If that process falls behind, it leaves out steps.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Self

import msgspec

from holdfast.errors import ViewError
from holdfast.reports.live_follower import FollowerReport, follow
from holdfast.runtime.workers import WorkerProcess, end_workers

if TYPE_CHECKING:
    from holdfast.config.loader import Configuration
    from holdfast.reports.view_target import ViewTarget


_START_S = 60.0
"""Longest wait for the viewer, before the run begins."""

_CLOSE_S = 10.0
"""Longest wait for the rest to be drawn, when the run is over."""

_REPORT = msgspec.msgpack.Decoder(FollowerReport)


class LiveView:
    """Shows a run while it goes on, from its ``directory``, where its journal is.

    ``on_note`` gets what the user should know, from another thread; ``work`` is what the other
    process does.
    """

    def __init__(
        self,
        configuration: Configuration,
        target: ViewTarget,
        directory: Path,
        on_note: Callable[[str], None],
        work: Callable[..., None] = follow,
    ) -> None:
        arguments = (configuration.plain(), tuple(target), str(directory))
        self._worker = WorkerProcess("holdfast-view", work, arguments, threads=1)
        self._on_note = on_note
        self._waiting = threading.Thread(target=self._wait, daemon=True)
        self._is_over = self._gave_up = False

    def __enter__(self) -> Self:
        """Start the other process, and wait until the viewer is there.

        Raises ViewError if it cannot be.
        """
        self._worker.start()
        error: str | None = f"the view was not ready within {_START_S:g} s"
        if self._worker.connection.poll(_START_S):
            error = self._report().error
        if error is not None:
            end_workers([self._worker])
            raise ViewError(error)
        self._waiting.start()
        return self

    def __exit__(self, *error: object) -> None:
        """Let the rest be drawn, for a bounded time, and end the other process."""
        if self._is_over or not self._waiting.ident:
            return
        self._is_over = True
        self._worker.send(b"")
        self._waiting.join(_CLOSE_S)
        if self._waiting.is_alive():
            self._on_note(f"the view was not complete {_CLOSE_S:g} s after the run")
            self._gave_up = True
            self._worker.kill()  # not yet awaited here: of two threads one would find no child
            self._waiting.join()
        end_workers([self._worker])

    def _report(self) -> FollowerReport:
        """Return what the other process says, or that it has died."""
        message = self._worker.receive()
        if message is None:
            return FollowerReport(f"its process {self._worker.how_it_ended()[0]}")
        return _REPORT.decode(message)

    def _wait(self) -> None:
        report = self._report()
        if report.error is not None and not self._gave_up:
            rest = "" if self._is_over else "; the run goes on without it"
            self._on_note(f"the view has ended: {report.error}{rest}")
        elif report.left_out:
            self._on_note(
                f"the view was too slow for {report.left_out:,} of {report.steps:,} steps and "
                "left them out; holdfast view shows all of them"
            )
