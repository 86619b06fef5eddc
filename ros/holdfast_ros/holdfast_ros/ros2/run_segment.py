"""A segment of a run, on its own thread: from the end of the journal until all trials are done.

It ends early when it is paused or something fails. The next one continues there.
"""

from __future__ import annotations

import contextlib
import enum
import functools
import itertools
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any, NamedTuple

from holdfast.config.loader import Configuration
from holdfast.errors import (
    HeldError,
    HoldfastError,
    LostJournalError,
    StaleEpochError,
    UnknownPerformanceError,
)
from holdfast.journal.run_directory import RunDirectory
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import PlanningState
from holdfast.problems.problem import Problem
from holdfast.protocol.robot_events import Act, Sense, Timing
from holdfast.robot.environment_maker import EnvironmentMaker, load_environment
from holdfast.robot.health import Condition
from holdfast.robot.process import RobotProcess
from holdfast.robot.recomputing import resume_run_if_begun
from holdfast.robot.robot_run import RobotObserver, perform_trials
from holdfast.runtime.events import EventSink
from holdfast_ros.executive import DecideCode, DecisionHandover, ExecutiveEnvironment
from holdfast_ros.ros2.parameters import NodeParameters, in_parameters

MAX_TRIALS_TOLD = 10_000  # in a result; trials.csv has all
_INTERRUPTED_S = 2.0  # for a call of the environment that was interrupted to end
_CANNOT_GO_ON = (UnknownPerformanceError, LostJournalError, StaleEpochError)


class Ending(enum.IntEnum):
    """How a segment ended."""

    FINISHED = 0  # all trials are finished
    PAUSED = 1  # it was asked to pause
    HELD = 2  # an error; the run can continue once its cause is gone
    FAILED = 3  # an error; the run cannot continue


class SegmentResult(NamedTuple):
    """How a segment ended, with the first finished trials of this and earlier segments.

    ``status`` is empty if the robot had not started.
    """

    ending: Ending
    message: str
    trials: tuple[TrialResult, ...]
    status: str = ""
    num_finished: int = 0


class World(NamedTuple):
    """What a segment acts on."""

    maker: EnvironmentMaker
    interrupt: Callable[[str], None]  # ends the current call where possible, for a reason
    interrupt_at_once: bool = False  # an interrupted call is repeated later, so it costs nothing
    handover: DecisionHandover | None = None  # where calls of ~/decide meet the run


def make_world(connections: Any, parameters: NodeParameters) -> World:
    """Make what the parameters name, for one segment of a run."""
    configuration, own = parameters.configuration, parameters.own
    if own.environment == "configuration":
        return World(load_environment(configuration), lambda _: None)
    settings, seed = configuration.environment, configuration.simulator.seed
    # Other threads than the robot's use it.
    problem = Configuration.from_plain(configuration.plain()).problem

    def maker(name: str, problem: Problem, make: Any) -> EnvironmentMaker:
        missing = settings.max_missing_in_a_row
        return EnvironmentMaker(
            name, problem, seed, settings.timeout_ms, make, max_missing_in_a_row=missing
        )

    if own.environment == "executive":
        handover = DecisionHandover(problem)
        make: Any = functools.partial(ExecutiveEnvironment, handover)
        interrupt = functools.partial(handover.end, DecideCode.ENDED)
        executive = maker("the executive", configuration.problem, make)
        return World(executive, interrupt, interrupt_at_once=True, handover=handover)
    from holdfast_ros.ros2_environment import Ros2Environment

    make = functools.partial(
        Ros2Environment,
        connections,
        act=own.act,
        timeout_ms=settings.timeout_ms,
        discovery_timeout_ms=own.discovery_timeout_ms,
    )
    return World(maker("the robot", problem, make), lambda _: connections.cancel())


@dataclass(eq=False, kw_only=True)
class RunSegment:
    """Runs the remaining trials of the run in the directory ``path``, once it is started.

    ``on_order`` and ``on_timing`` are those of a :class:`RobotObserver`; ``on_end`` gets the
    result, on the segment's thread. ``outcome`` is there when ``ended`` is set.
    """

    configuration: Configuration
    path: Path
    world: World
    sink: EventSink
    on_order: Callable[[PlanningState, Act | Sense], None]
    on_timing: Callable[[Timing], None]
    on_end: Callable[[SegmentResult], None]
    rate_hz: float | None = None
    after_reboot: bool = False

    def __post_init__(self) -> None:
        self._changed = threading.Lock()
        self._process: RobotProcess | None = None
        self._why_paused: str | None = None
        self._pause_within_s = 0.0
        self.ended = threading.Event()
        self.outcome: SegmentResult | None = None
        self.num_finished = 0

    def start(self) -> None:
        """Begin."""
        threading.Thread(target=self._work, name="robot", daemon=True).start()

    def condition(self) -> Condition | None:
        """Return how the robot is doing; None before it runs."""
        return None if self._process is None else self._process.condition()

    @property
    def status(self) -> str:
        """Who decides."""
        return "" if self._process is None else self._process.robot.status.value

    @property
    def unexplained_observations(self) -> int:
        """Those of the trial that is running."""
        return 0 if self._process is None else self._process.robot.unexplained_observations

    def pause(self, why: str, within_s: float) -> None:
        """End in order, from any thread; only the first call counts.

        The environment has ``within_s`` to end its current call, which is then interrupted, and
        abandoned if that does not help.
        """
        with self._changed:
            if self._why_paused is not None:
                return
            self._why_paused = why
            self._pause_within_s = within_s + _INTERRUPTED_S
            process = self._process
        if process is not None:
            process.pause(self._pause_within_s)
        if self.world.interrupt_at_once:
            self.world.interrupt(why)
        else:

            def interrupt_later() -> None:
                if not self.ended.wait(within_s):
                    self.world.interrupt(why)

            threading.Thread(target=interrupt_later, name="pause", daemon=True).start()

    def _take_process(self, process: RobotProcess) -> None:
        with self._changed:
            self._process = process
            if self._why_paused is not None:
                process.pause(self._pause_within_s)

    def _work(self) -> None:
        trials: tuple[TrialResult, ...] = ()
        try:
            with resume_run_if_begun(self.path, self.configuration) as directory:
                try:
                    self._run(directory)
                finally:
                    trials = tuple(itertools.islice(directory.journal.results(), MAX_TRIALS_TOLD))
                complete = self.num_finished >= self.configuration.simulator.num_trials
            ending = Ending.FINISHED if complete else Ending.PAUSED
            message = f"{self.num_finished} trials" if complete else self._why_paused or "paused"
            result = SegmentResult(ending, message, trials)
        except HoldfastError as error:
            # An interrupted call reports a failure.
            why = self._why_paused if isinstance(error, HeldError) else None
            is_final = isinstance(error, _CANNOT_GO_ON)
            ending = Ending.FAILED if is_final else Ending.HELD if why is None else Ending.PAUSED
            message = why if ending == Ending.PAUSED and why else in_parameters(str(error))
            result = SegmentResult(ending, message, trials)
        except BaseException:  # noqa: BLE001 - waiting callers need a result
            result = SegmentResult(Ending.FAILED, traceback.format_exc(), trials)
        result = result._replace(status=self.status, num_finished=self.num_finished)
        self.outcome = result
        try:
            self.on_end(result)
        finally:
            self.ended.set()

    def _run(self, directory: RunDirectory) -> None:
        self.num_finished = sum(1 for _ in directory.journal.results())
        if directory.complete_summary() is not None:
            return
        began = perf_counter()

        def on_result(result: TrialResult) -> None:
            directory.add(result)
            self.num_finished += 1

        try:
            perform_trials(
                *(self.configuration, directory, self.world.maker, on_result),
                rate_hz=self.rate_hz,
                after_reboot=self.after_reboot,
                sinks=[self.sink],
                observer=RobotObserver(self._take_process, self.on_order, self.on_timing),
            )
        except BaseException:
            # If the disk is the trouble, the first error says so.
            with contextlib.suppress(HoldfastError):
                directory.write_tables(perf_counter() - began)
            raise
        directory.write_tables(perf_counter() - began)
