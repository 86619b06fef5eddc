"""One part of a run, on a thread of its own: from where the journal ends until all trials are done.

A part ends early when somebody pauses it, or when something fails. The next part goes on where it
ended, in this process or another one.
"""

from __future__ import annotations

import contextlib
import enum
import itertools
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from time import perf_counter
from typing import NamedTuple

from holdfast.configuration import Configuration
from holdfast.errors import HoldfastError
from holdfast.outcome import TrialResult
from holdfast.planning import PlanningState
from holdfast.recording.journal import LostJournalError
from holdfast.recording.robot_run import Onlooker, perform_trials
from holdfast.recording.run_directory import RunDirectory
from holdfast.ros.ros2.parameters import in_parameters
from holdfast.runtime.environment import EnvironmentMaker
from holdfast.runtime.logs import EventSink
from holdfast.runtime.robot_process import RobotProcess
from holdfast.runtime.robot_watch import Condition
from holdfast.session.effects import Act, Sense, Timing
from holdfast.session.replies import StaleEpochError
from holdfast.session.robot import HeldError, UnknownPerformanceError

__all__ = ["MAX_TRIALS_TOLD", "Ending", "Part", "PartOfRun"]

MAX_TRIALS_TOLD = 10_000
"""Of a result; ``trials.csv`` has all."""

_INTERRUPTED_S = 2.0
"""For a call of the environment that was interrupted to end."""

_CANNOT_GO_ON = (UnknownPerformanceError, LostJournalError, StaleEpochError)


class Ending(enum.IntEnum):
    """How a part of a run has ended."""

    FINISHED = 0
    """All trials are."""
    PAUSED = 1
    """Somebody asked for it."""
    HELD = 2
    """An error; the run goes on when its reason is gone."""
    FAILED = 3
    """An error; the run cannot go on."""


class Part(NamedTuple):
    """What a part of a run came to.

    Attributes
    ----------
    ending : Ending
    message : str
    trials : tuple of TrialResult
        All that are finished, of earlier parts too; the first :data:`MAX_TRIALS_TOLD`.
    status : str
        Who decided at its end; empty if it had not come so far.
    num_finished : int
        Trials, those of earlier parts too.
    """

    ending: Ending
    message: str
    trials: tuple[TrialResult, ...]
    status: str = ""
    num_finished: int = 0


class PartOfRun:
    """Runs, from :meth:`start` on, until it is done.

    Parameters
    ----------
    configuration : Configuration
    path : Path
        The run's directory.
    maker : EnvironmentMaker
    rate_hz : float or None
    sink : EventSink
        Is told what happens.
    on_order, on_timing : callable
        As of :class:`~holdfast.recording.robot_run.Onlooker`.
    on_end : callable
        Gets what it came to, on the thread of the run.
    interrupt : callable
        Ends the call of the environment that may be going on, if that can be; given the reason.
    interrupt_at_once : bool
        Whether a pause does so without waiting for the call to end by itself. It costs nothing only
        where what was interrupted is asked for again.

    Attributes
    ----------
    ended : threading.Event
    came_to : Part or None
        Once it has ended.
    num_finished : int
        Trials, those of earlier parts too.
    """

    def __init__(
        self,
        configuration: Configuration,
        path: Path,
        maker: EnvironmentMaker,
        *,
        rate_hz: float | None,
        sink: EventSink,
        on_order: Callable[[PlanningState, Act | Sense], None],
        on_timing: Callable[[Timing], None],
        on_end: Callable[[Part], None],
        interrupt: Callable[[str], None],
        interrupt_at_once: bool = False,
    ) -> None:
        self._configuration = configuration
        self._path = path
        self._maker = maker
        self._rate_hz = rate_hz
        self._sink = sink
        self._on_order = on_order
        self._on_timing = on_timing
        self._on_end = on_end
        self._interrupt = interrupt
        self._interrupt_at_once = interrupt_at_once
        self._changed = threading.Lock()
        self._process: RobotProcess | None = None
        self._why_paused: str | None = None
        self._pause_within_s = 0.0
        self._thread = threading.Thread(target=self._work, name="robot", daemon=True)
        self.ended = threading.Event()
        self.came_to: Part | None = None
        self.num_finished = 0

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def condition(self) -> Condition | None:
        """Return how the robot is doing; None before it runs."""
        process = self._process
        return None if process is None else process.condition()

    @property
    def status(self) -> str:
        """Who decides."""
        process = self._process
        return "" if process is None else process.status.value

    @property
    def unexplained_observations(self) -> int:
        """Those of the trial that is running."""
        process = self._process
        return 0 if process is None else process.unexplained_observations

    def pause(self, why: str, within_s: float) -> None:
        """End in order, from any thread: :attr:`ended` says when. Only the first call counts.

        Parameters
        ----------
        why : str
        within_s : float
            So long the environment may take to end the call that is going on; then it is
            interrupted, and left alone if that does not help.
        """
        with self._changed:
            if self._why_paused is not None:
                return
            self._why_paused = why
            self._pause_within_s = within_s + _INTERRUPTED_S
            process = self._process
        if process is not None:
            process.pause(self._pause_within_s)
        if self._interrupt_at_once:
            self._interrupt(why)
        else:
            threading.Thread(
                target=self._interrupt_later, args=(why, within_s), name="pause", daemon=True
            ).start()

    def _interrupt_later(self, why: str, within_s: float) -> None:
        if not self.ended.wait(within_s):
            self._interrupt(why)

    def _take_process(self, process: RobotProcess) -> None:
        with self._changed:
            self._process = process
            if self._why_paused is not None:
                process.pause(self._pause_within_s)

    def _work(self) -> None:
        trials: tuple[TrialResult, ...] = ()
        try:
            with RunDirectory.resume_if_begun(self._path, self._configuration) as directory:
                try:
                    self._run(directory)
                finally:
                    trials = tuple(itertools.islice(directory.journal.results(), MAX_TRIALS_TOLD))
                complete = self.num_finished >= self._configuration.simulator.num_trials
            if complete:
                part = Part(Ending.FINISHED, f"{self.num_finished} trials", trials)
            else:
                part = Part(Ending.PAUSED, self._why_paused or "paused", trials)
        except HoldfastError as error:
            part = Part(self._ending_of(error), in_parameters(str(error)), trials)
            if part.ending == Ending.PAUSED:
                part = part._replace(message=self._why_paused or part.message)
        except BaseException:  # noqa: BLE001 - who waits for this thread must hear of it
            part = Part(Ending.FAILED, traceback.format_exc(), trials)
        part = part._replace(status=self.status, num_finished=self.num_finished)
        self.came_to = part
        try:
            self._on_end(part)
        finally:
            self.ended.set()

    def _ending_of(self, error: HoldfastError) -> Ending:
        if isinstance(error, _CANNOT_GO_ON):
            return Ending.FAILED
        # What was interrupted says that it has failed.
        paused = self._why_paused is not None and isinstance(error, HeldError)
        return Ending.PAUSED if paused else Ending.HELD

    def _run(self, directory: RunDirectory) -> None:
        self.num_finished = directory.journal.tally().finished
        if directory.told_summary() is not None:
            return
        began = perf_counter()

        def on_result(result: TrialResult) -> None:
            directory.add(result)
            self.num_finished += 1

        onlooker = Onlooker(self._take_process, self._on_order, self._on_timing)
        try:
            perform_trials(
                self._configuration,
                directory,
                self._maker,
                on_result,
                rate_hz=self._rate_hz,
                sinks=[self._sink],
                onlooker=onlooker,
            )
        except BaseException:
            # If the disk is the trouble, the first error says so.
            with contextlib.suppress(HoldfastError):
                directory.write_tables(perf_counter() - began)
            raise
        directory.write_tables(perf_counter() - began)
