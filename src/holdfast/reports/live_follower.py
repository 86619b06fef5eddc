"""The process that shows a run while it goes on: it reads the run's files, and draws them.

A belief is a function of the journal's records, so this process comes to the robot's own beliefs.
To fold a record costs little. To compute the entropies of the alternatives again and to draw a step
costs more, so both are left out for what was read more than three seconds ago.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, cast

import msgspec

from holdfast.config.loader import Configuration
from holdfast.errors import HoldfastError
from holdfast.journal.journal_file import JOURNAL_NAME, Finished, Steps
from holdfast.journal.journal_reader import JournalReader, decode_records, decode_result
from holdfast.journal.run_directory import EVENTS_NAME, TIMINGS_NAME
from holdfast.journal.timings import TimingRow, timings_of
from holdfast.numerics.arrays import FloatArray
from holdfast.planning.inputs import ActingRecord, Late, Moved, Record, Sensed
from holdfast.planning.outcome import TrialResult
from holdfast.planning.planner import Planner, PlanningState
from holdfast.planning.tracking import Trial
from holdfast.protocol.robot_events import Timing
from holdfast.reports.facts import (
    FactSink,
    LateFact,
    SensingFact,
    TaskFact,
    TrialBeginFact,
    TrialEndFact,
)
from holdfast.reports.step_times import events_of
from holdfast.reports.view_target import ViewTarget
from holdfast.robot.environment import Environment, SimulatedEnvironment
from holdfast.robot.trial import LateStep, SensingStep, TaskStep

_LATE_NS = 3_000_000_000
"""A step that was read longer ago is not drawn."""

_NICENESS = 10

_POLL_S = 0.02


class FollowerReport(msgspec.Struct, array_like=True, frozen=True):
    """What the process that shows a run says: once when it is ready, once at its end."""

    error: str | None = None  # why it shows nothing any more
    # Task actions that it was told of, and those that there was no time to show.
    steps: int = 0
    left_out: int = 0


class Follower:
    """Makes facts of what a run writes; times are in nanoseconds since 1970.

    ``steps`` counts the task actions so far, ``left_out`` those that were too old to be shown.
    """

    def __init__(
        self, configuration: Configuration, sink: FactSink, clock: Callable[[], int] = time.time_ns
    ) -> None:
        self._configuration = configuration
        self._planner = Planner(configuration.problem, configuration.planning)
        self._sink = sink
        self._clock = clock
        self._trial: Trial | None = None
        self._simulated: SimulatedEnvironment | None = None
        self._decided: dict[tuple[int, int, str], TimingRow] = {}
        self._answered: Timing | None = None
        self.steps = self.left_out = 0

    def timing(self, row: TimingRow) -> None:
        """Take who decided, before the record of that decision."""
        self._decided[row.timing[:3]] = row

    def records(self, number: int, records: list[Record], time_ns: int) -> None:
        """Take what was journalled of a trial, in order and from its beginning on."""
        trial = self._trial
        if trial is None or trial.state.trial != number:
            self.end(time_ns)
            trial = self._begin(number, time_ns)
        for record in records:
            self._take(trial, record, time_ns)

    def _begin(self, number: int, time_ns: int) -> Trial:
        seed = self._configuration.simulator.seed
        self._trial = trial = Trial(self._planner, seed, number)
        self._answered = None
        if self._configuration.environment.object is None:
            self._simulated = SimulatedEnvironment(self._planner.problem, seed, number)
        self._sink.trial_begins(TrialBeginFact(number, time_ns))
        return trial

    def finished(self, result: TrialResult, time_ns: int) -> None:
        """Take the result of a trial, and with it that its last action was performed."""
        self.records(result.trial, [], time_ns)
        assert self._trial is not None
        if self._trial.pending is not None:
            self._take(self._trial, Moved(self._trial.state.step, None), time_ns)
        self.end(time_ns, result)

    def end(self, time_ns: int, result: TrialResult | None = None) -> None:
        """End the trial, as far as its records go."""
        if self._trial is None:
            return
        state = self._trial.state
        self._sink.trial_ends(
            TrialEndFact(
                trial=state.trial,
                time_ns=time_ns,
                steps=state.step,
                result=result,
                belief=state.belief,
                estimate=self._planner.estimate(state),
                true_state=self._true_state,
            )
        )
        self._trial = self._simulated = None
        self._decided = {at: row for at, row in self._decided.items() if at[0] != state.trial}

    @property
    def _true_state(self) -> FloatArray | None:
        return None if self._simulated is None else self._simulated.state

    def _take(self, trial: Trial, record: Record, time_ns: int) -> None:
        is_late = self._clock() - time_ns > _LATE_NS
        before, action, why = trial.state, trial.pending, None
        if isinstance(record, Sensed) and not is_late:
            why = self._planner.choose_sensing_action(before)[1]
        record = trial.take(record)
        if isinstance(record, Sensed):
            row = self._decided.pop((before.trial, before.step, "sensing"), None)
            if why is not None:
                assert trial.found is not None
                step = SensingStep(before, record, why, trial.state, trial.found)
                decider, decided_ns = (None, time_ns) if row is None else row[:2]
                self._sink.sensed(SensingFact(step, decided_ns, time_ns, decider))
        elif isinstance(record, ActingRecord):
            self.steps += 1
            self.left_out += is_late
            if not is_late:
                assert trial.pending is not None
                self._acting(before, trial.pending, time_ns)
        elif isinstance(record, Moved):
            if self._simulated is not None:
                assert action is not None
                self._simulated.perform(action)
        elif isinstance(record, Late) and not is_late:
            assert trial.found is not None
            late = LateStep(record, trial.state, trial.found)
            self._sink.observed_late(LateFact(late, time_ns))

    def _acting(self, state: PlanningState, action: FloatArray, time_ns: int) -> None:
        """Show an action when it is ordered: how it went shows at the next one."""
        row = self._decided.pop((state.trial, state.step, "task"), None)
        if row is not None:
            # An answer has the task actions up to the next sensing step.
            self._answered = row.timing
        info = self._planner.choose_task_action(state)[1]
        step = TaskStep(
            cast("Environment", self._simulated), state, info, action, Moved(state.step, None)
        )
        self._sink.acted(TaskFact(step, time_ns, self._answered, self._true_state))


class RunFiles:
    """The files of a run that goes on, read as far as they are written.

    Of the trials that were finished when they were opened, and of the lines before, nothing comes.
    """

    def __init__(self, directory: Path) -> None:
        self._journal = JournalReader.read(directory / JOURNAL_NAME)
        self._begun = self._journal.unfinished()
        self._timings = _Lines(directory / TIMINGS_NAME)
        self._events = _Lines(directory / EVENTS_NAME)

    def tell(self, follower: Follower, sink: FactSink, now_ns: int) -> None:
        """Tell what was written since the last time."""
        # The journal first: what decided its records is in the table then.
        entries = list(self._journal.read_on())
        for row in timings_of(self._timings.read()):
            follower.timing(row)
        for event in events_of(self._events.read()):
            sink.happened(event)
        begun, self._begun = self._begun, None
        if begun is not None:
            follower.records(begun.trial, begun.records, now_ns)
        for entry in entries:
            if isinstance(entry, Steps):
                follower.records(entry.trial, decode_records(entry.records), now_ns)
            elif isinstance(entry, Finished):
                follower.finished(decode_result(entry.result), now_ns)


class _Lines:
    """The lines of a file that are added to it; it need not be there yet."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0
        self.read()

    def read(self) -> list[str]:
        if not self._path.is_file():
            return []
        with self._path.open("rb") as file:
            file.seek(self._offset)
            data = file.read()
        whole = data[: data.rfind(b"\n") + 1]  # the rest is being written, or was cut short
        self._offset += len(whole)
        return whole.decode("utf-8", "replace").split("\n")[:-1]


def follow(
    connection: Connection, plain: dict[str, Any], target: tuple[str | None, ...], directory: str
) -> None:
    """Show a run: the work of the other process."""
    # The viewer, which outlives this process, must not hold the pipe open.
    os.set_inheritable(connection.fileno(), False)
    report = FollowerReport()
    try:
        from holdfast.reports.rerun_sink import RerunSink

        configuration = Configuration.from_plain(plain)
        with RerunSink(configuration, ViewTarget(*target), has_times=True, live=True) as sink:
            follower, files = Follower(configuration, sink), RunFiles(Path(directory))
            _send(connection, report)
            os.nice(_NICENESS)
            is_over = False
            while sink.streams.is_open and not is_over:
                is_over = connection.poll(_POLL_S)  # the robot says so, or is gone
                files.tell(follower, sink, time.time_ns())
            follower.end(time.time_ns())
            report = FollowerReport(None, follower.steps, follower.left_out)
        if (lost := sink.streams.lost) is not None:
            rest = "" if target[1] is None else "; the file is complete"
            report = FollowerReport(f"the viewer {lost}{rest}")
    except HoldfastError as error:
        report = FollowerReport(str(error))
    except Exception as error:  # noqa: BLE001 - the problem is anybody's code
        report = FollowerReport(f"{type(error).__name__}: {error}")
    _send(connection, report)
    if report.error is not None:
        # Rerun's client would wait for a viewer that takes nothing.
        os._exit(1)


def _send(connection: Connection, report: FollowerReport) -> None:
    connection.send_bytes(msgspec.msgpack.encode(report))
